"""What the page learns beside the pictures: when each was captured, the clock, and what is wrong with the camera."""

import time
from typing import Any

import numpy as np
import pytest

from mrbokeh.video.color import color_of
from mrbokeh.video.frames import display_bgr
from tests.scenes.streaming_viewers import HEIGHT, WIDTH, Feed, comes_true, in_time, streaming, watching
from tests.scenes.whep_viewers import Line, whep_of


def level(sequence: int) -> np.ndarray:
    """A flat grey that names the picture, in steps of 4 that outlive the 219 steps of the codec."""
    return np.full((HEIGHT, WIDTH, 3), 40 + 4 * (sequence % 48), np.uint8)


def named_by(frame: Any) -> int:
    bgr = display_bgr(frame, color_of(frame, "stream"), (WIDTH, HEIGHT))
    return round((float(bgr[40:-40, 40:-40].mean()) - 40) / 4)


def test_the_page_learns_when_the_picture_on_its_screen_was_captured() -> None:
    """A picture is named by its grey; status messages are joined to pictures by the RTP timestamp alone."""

    async def work() -> None:
        with streaming() as stream, Feed(stream, level, 30.0) as feed:
            async with whep_of(stream) as (_whep, url), watching(url) as viewer:
                # From the first status on; pictures before it came while the channel was not open yet.
                await viewer.until(viewer.statuses)
                arrived, from_ms = set[int](), 1000 * time.monotonic()
                Line(viewer, lambda _number, packet: arrived.add(packet.timestamp) or [packet])
                shown = [await viewer.next() for _ in range(20)]
                enough = len(viewer.statuses()) + 5
                await viewer.until(lambda: len(viewer.statuses()) >= enough)
                named = {each["rtp_timestamp"] for each in viewer.statuses() if each["captured_ms"] > from_ms}
                assert len(named) >= 5
                # The very timestamps that are in the packets, which is what a browser compares.
                await viewer.until(lambda: named <= arrived)
        statuses = viewer.statuses()
        # The decoder counts from its first picture, which has no status: any that the last one can be gives that start.
        starts = [each["rtp_timestamp"] - shown[-1].pts for each in statuses if each["sequence"] % 48 == named_by(shown[-1])]
        joined = [_joined(shown, statuses, start) for start in starts]
        pairs = next(pairs for pairs in joined if len(pairs) == len(shown))
        for frame, status in pairs:
            assert status["sequence"] % 48 == named_by(frame)
            assert status["captured_ms"] == 1000 * feed.captured_s[status["sequence"]]
            assert status["focus_distance_m"] == 2.0
            assert status["stages_ms"]["h264"] > 0
        # The clock of RTP is that of capture: 90 ticks for a millisecond, each rounded.
        (first, of_first), (last, of_last) = pairs[0], pairs[-1]
        assert last.pts - first.pts == pytest.approx(90 * (of_last["captured_ms"] - of_first["captured_ms"]), abs=1.01)

    in_time(work)


def _joined(shown: list[Any], statuses: list[dict[str, Any]], start: int) -> list[tuple[Any, dict[str, Any]]]:
    by_ticks = {(each["rtp_timestamp"] - start) & 0xFFFFFFFF: each for each in statuses}
    return [(frame, by_ticks[frame.pts]) for frame in shown if frame.pts in by_ticks]


def test_the_channel_answers_the_clock_and_refuses_the_rest() -> None:
    async def work() -> None:
        with streaming() as stream, Feed(stream):
            async with whep_of(stream) as (_whep, url), watching(url) as viewer:
                await comes_true(lambda: viewer.channel.readyState == "open")
                wrong = ["no JSON", '{"clock": "noon"}', '{"focus": 1}', "[" * 1000, "x" * 5000]
                asked_ms = 1000 * time.monotonic()
                for text in [*wrong, '{"clock": 12.5}']:
                    viewer.channel.send(text)
                await comes_true(lambda: any("clock" in each for each in viewer.messages))
                # The channel is neither ordered nor reliable, but this is loopback.
                assert sum("error" in each for each in viewer.messages) == len(wrong)
                answer = next(each for each in viewer.messages if "clock" in each)
                assert answer["clock"] == 12.5
                # The clock of the captures, in one process with this test.
                assert asked_ms <= answer["server_ms"] <= 1000 * time.monotonic()
                await viewer.next()

    in_time(work)


def test_the_failure_of_the_camera_reaches_the_page() -> None:
    async def work() -> None:
        with streaming() as stream:
            async with whep_of(stream) as (_whep, url), watching(url) as viewer:
                with Feed(stream):
                    await comes_true(lambda: viewer.channel.readyState == "open")
                    await viewer.next()
                stream.fail("the camera was unplugged")
                await comes_true(lambda: {"failure": "the camera was unplugged"} in viewer.messages)
                # A message may get lost: it is said again while it is so.
                viewer.messages.clear()
                await comes_true(lambda: {"failure": "the camera was unplugged"} in viewer.messages)

    in_time(work)


def test_who_comes_while_the_camera_is_away_is_told_and_sees_it_come_back() -> None:
    async def work() -> None:
        with streaming() as stream:
            stream.fail("the camera was unplugged")
            async with whep_of(stream) as (_whep, url), watching(url) as viewer:
                await comes_true(lambda: {"failure": "the camera was unplugged"} in viewer.messages)
                with Feed(stream):
                    await viewer.next()
                assert stream.failure is None

    in_time(work)

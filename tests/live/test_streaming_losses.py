"""A network that loses, delays and stalls: packets are sent again, keyframes mend; and what the page learns beside the pictures."""

import asyncio
import time
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from mrbokeh.video.color import color_of
from mrbokeh.video.frames import display_bgr
from tests.scenes.streaming_viewers import HEIGHT, PATIENT, WIDTH, Feed, Line, Viewer, noise, standing_still, streaming, watching, whep_of
from tests.scenes.waiting import comes_true
from viewfinder.streaming import whep
from viewfinder.streaming.encoders import StreamQuality


async def test_a_request_for_a_keyframe_reaches_the_encoder() -> None:
    with streaming(keyframe_gap_s=0.0) as stream, Feed(stream):
        async with whep_of(stream) as (_whep, url), watching(url) as viewer:
            await viewer.next()
            before = stream.keyframes["H264"]
            ssrc = viewer.transceiver.receiver.getSynchronizationSources()[0].source
            await viewer.transceiver.receiver._send_rtcp_pli(ssrc)
            await viewer.until(lambda: stream.keyframes["H264"] == before + 1)


async def test_without_aiortcs_private_method_keyframes_come_at_intervals(monkeypatch: pytest.MonkeyPatch) -> None:
    with streaming() as stream, Feed(stream):
        assert whep.keyframe_requests_arrive()
        monkeypatch.setattr(whep, "_KEYFRAME_REQUEST", "_renamed_in_some_release")
        async with whep_of(stream) as (_whep, url), watching(url) as viewer:
            await viewer.next()
            assert stream.keyframe_every_s == 2.0


async def test_lost_packets_are_sent_again() -> None:
    """Every seventh packet is lost once. Retransmissions carry another payload type, and are let through."""
    lost, kinds = list[int](), set[int]()

    def pass_on(number: int, packet: Any) -> list[Any]:
        kinds.add(packet.payload_type)
        if number > 1 and number % 7 == 0 and packet.payload_type == min(kinds):
            lost.append(number)
            return []
        return [packet]

    with streaming(StreamQuality(bitrate_bps=3_000_000), capacity=PATIENT) as stream, Feed(stream, noise):
        line = Line(Viewer(), pass_on)
        async with whep_of(stream) as (_whep, url), watching(url, viewer=line.viewer) as viewer:
            shown = [await viewer.next() for _ in range(25)]
            await asyncio.sleep(0.5)  # what is told of the last picture may come after it
        assert len(lost) >= 10
        assert line.number > 7 * len(lost)
        # No picture is missing: each follows the one before by what lies between two captures, and none needed a keyframe.
        sent = [each["rtp_timestamp"] for each in viewer.statuses()]
        steps = {b - a for a, b in pairwise(sent)}
        assert {b.pts - a.pts for a, b in pairwise(shown)} <= steps
        assert stream.keyframes["H264"] == 1


async def test_after_a_gap_that_nobody_can_fill_a_keyframe_mends_the_picture() -> None:
    """Everything is lost for a while, retransmissions too; the receiver gives up on it, asks for a keyframe and shows pictures again."""
    with streaming(StreamQuality(bitrate_bps=8_000_000), capacity=PATIENT, keyframe_gap_s=0.1) as stream, Feed(stream, noise):
        line = Line(Viewer(), lambda number, packet: [] if 100 < number <= 300 else [packet])
        async with whep_of(stream) as (_whep, url), watching(url, viewer=line.viewer) as viewer:
            await viewer.next()
            before = stream.keyframes["H264"]
            await viewer.until(lambda: line.number > 300 and stream.keyframes["H264"] > before, 20.0)
            mended = [await viewer.next() for _ in range(20)]
        assert all(b.pts > a.pts for a, b in pairwise(mended))


async def test_packets_that_overtake_one_another_are_put_in_order() -> None:
    held = []

    def pass_on(number: int, packet: Any) -> list[Any]:
        if number > 1 and number % 5 == 0:
            held.append(packet)
            return []
        return [packet, held.pop()] if held else [packet]

    with streaming(StreamQuality(bitrate_bps=3_000_000), capacity=PATIENT) as stream, Feed(stream, noise):
        async with whep_of(stream) as (_whep, url), watching(url, viewer=Line(Viewer(), pass_on).viewer) as viewer:
            shown = [await viewer.next() for _ in range(20)]
        assert all(b.pts > a.pts for a, b in pairwise(shown))
        assert stream.keyframes["H264"] == 1


async def test_a_viewer_whose_connection_stands_still_does_not_stall_the_others() -> None:
    with streaming(capacity=30, keyframe_gap_s=0.0) as stream, Feed(stream, fps=30.0):
        async with whep_of(stream) as (whep, url), watching(url) as slow, watching(url) as quick:
            await asyncio.gather(slow.next(), quick.next())
            with standing_still(next(each for each in whep._viewers.values() if each.track._queue is stream.viewers[0])):
                await quick.until(lambda: not stream.viewers[0].wants_frames)
                seen = len(quick.statuses())
                await quick.until(lambda: len(quick.statuses()) >= seen + 10)
                sequences = [each["sequence"] for each in quick.statuses()]
                keyframes = stream.keyframes["H264"]
            await slow.until(lambda: stream.keyframes["H264"] > keyframes)
            await slow.next()
            assert stream.viewers[0].dropped > 30
            assert stream.viewers[1].dropped == 0
            assert sequences == sorted(sequences)


def level(sequence: int) -> np.ndarray:
    """A flat grey that names the picture, in steps of 4 that outlive the 219 steps of the codec."""
    return np.full((HEIGHT, WIDTH, 3), 40 + 4 * (sequence % 48), np.uint8)


def named_by(frame: Any) -> int:
    bgr = display_bgr(frame, color_of(frame, "stream"), (WIDTH, HEIGHT))
    return round((float(bgr[40:-40, 40:-40].mean()) - 40) / 4)


async def test_the_page_learns_when_the_picture_on_its_screen_was_captured() -> None:
    """A picture is named by its grey; status messages are joined to pictures by the RTP timestamp alone."""
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


def _joined(shown: list[Any], statuses: list[dict[str, Any]], start: int) -> list[tuple[Any, dict[str, Any]]]:
    by_ticks = {(each["rtp_timestamp"] - start) & 0xFFFFFFFF: each for each in statuses}
    return [(frame, by_ticks[frame.pts]) for frame in shown if frame.pts in by_ticks]


async def test_the_channel_answers_the_clock_and_refuses_the_rest() -> None:
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


async def test_the_failure_of_the_camera_reaches_the_page() -> None:
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


async def test_who_comes_while_the_camera_is_away_is_told_and_sees_it_come_back() -> None:
    with streaming() as stream:
        stream.fail("the camera was unplugged")
        async with whep_of(stream) as (_whep, url), watching(url) as viewer:
            await comes_true(lambda: {"failure": "the camera was unplugged"} in viewer.messages)
            with Feed(stream):
                await viewer.next()
            assert stream.failure is None

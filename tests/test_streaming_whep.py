"""WHEP with viewers in this process: real HTTP, ICE, DTLS and SRTP on loopback, real encoders and decoders."""

import asyncio
import re
import threading
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from itertools import pairwise
from typing import Any

import aiohttp
import numpy as np
import pytest
from aiortc import RTCSessionDescription

from mrbokeh.video_color import color_of
from mrbokeh.video_frames import display_bgr
from tests.streaming_viewers import BARS, HEIGHT, WIDTH, Feed, Viewer, bar_centres, comes_true, in_time, noise, serving, streaming, watching
from viewfinder.streaming import viewer_connection
from viewfinder.streaming.encoded_stream import EncodedStream
from viewfinder.streaming.encoder import StreamQuality
from viewfinder.streaming.whep import Whep

# Packets that may wait where a test is not about viewers who fall behind: this process may be kept waiting for a second.
PATIENT = 1000
SDP = {"Content-Type": "application/sdp"}


@asynccontextmanager
async def whep_of(stream: EncodedStream, **settings: Any) -> AsyncIterator[tuple[Whep, str]]:
    whep = Whep(stream, **settings)
    async with serving(whep) as url:
        yield whep, url


def level(sequence: int) -> np.ndarray:
    """A flat grey that names the picture, in steps of 4 that outlive the 219 steps of the codec."""
    return np.full((HEIGHT, WIDTH, 3), 40 + 4 * (sequence % 48), np.uint8)


def named_by(frame: Any) -> int:
    bgr = display_bgr(frame, color_of(frame, "stream"), (WIDTH, HEIGHT))
    return round((float(bgr[40:-40, 40:-40].mean()) - 40) / 4)


@pytest.mark.parametrize(("offered", "codec"), [(("VP8", "H264"), "H264"), (("VP8",), "VP8"), (("H264",), "H264")])
def test_h264_is_sent_where_it_can_be_played_and_colours_arrive(offered: tuple[str, ...], codec: str) -> None:
    async def work() -> None:
        with streaming() as stream, Feed(stream):
            async with whep_of(stream) as (_whep, url), watching(url, offered) as viewer:
                for _ in range(8):
                    frame = await viewer.next()
            assert set(stream.encoded) == {codec}
        color = color_of(frame, "stream")
        # BT.601 limited. VP8 cannot say so; below HD it is what is meant.
        assert (color.matrix, color.code_range) == (6, 1)
        np.testing.assert_allclose(bar_centres(display_bgr(frame, color, (WIDTH, HEIGHT))), BARS.astype(int), atol=4)

    in_time(work)


def test_three_viewers_are_served_by_one_encoding() -> None:
    async def work() -> None:
        with streaming(capacity=PATIENT) as stream, Feed(stream) as feed:
            async with whep_of(stream) as (whep, url), watching(url) as a, watching(url) as b, watching(url) as c:
                viewers = (a, b, c)
                await asyncio.gather(*(viewer.until(lambda viewer=viewer: len(viewer.statuses()) >= 20) for viewer in viewers))
                assert whep.viewers == 3
                common = set.intersection(*({each["sequence"] for each in viewer.statuses()} for viewer in viewers))
                assert len(common) >= 10
                assert stream.encoded["H264"] <= len(feed.captured_s)
                # Three joined one after another: a keyframe for each at most.
                assert stream.keyframes["H264"] <= 3
            await comes_true(lambda: not stream.wants_frame)

    in_time(work)


def test_the_page_learns_when_the_picture_on_its_screen_was_captured() -> None:
    """A picture is named by its grey; status messages are joined to pictures by the RTP timestamp alone."""

    async def work() -> None:
        with streaming() as stream, Feed(stream, level, 30.0) as feed:
            async with whep_of(stream) as (_whep, url), watching(url) as viewer:
                # From the first status on; pictures before it came while the channel was not open yet.
                await viewer.until(viewer.statuses)
                arrived: set[int] = set()
                Line(viewer, lambda _number, packet: arrived.add(packet.timestamp) or [packet])
                shown = [await viewer.next() for _ in range(20)]
                enough = len(viewer.statuses()) + 5
                await viewer.until(lambda: len(viewer.statuses()) >= enough)
        statuses = viewer.statuses()
        # The very timestamps that are in the packets, which is what a browser compares.
        assert {each["rtp_timestamp"] for each in statuses[3:-3]} <= arrived | {each["rtp_timestamp"] for each in statuses[:3]}
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


def test_a_request_for_a_keyframe_reaches_the_encoder() -> None:
    async def work() -> None:
        with streaming(keyframe_gap_s=0.0) as stream, Feed(stream):
            async with whep_of(stream) as (_whep, url), watching(url) as viewer:
                await viewer.next()
                before = stream.keyframes["H264"]
                ssrc = viewer.transceiver.receiver.getSynchronizationSources()[0].source
                await viewer.transceiver.receiver._send_rtcp_pli(ssrc)
                await viewer.until(lambda: stream.keyframes["H264"] == before + 1)

    in_time(work)


def test_without_aiortcs_private_method_keyframes_come_at_intervals(monkeypatch: pytest.MonkeyPatch) -> None:
    async def work() -> None:
        with streaming() as stream, Feed(stream):
            assert viewer_connection.keyframe_requests_arrive()
            monkeypatch.setattr(viewer_connection, "_KEYFRAME_REQUEST", "_renamed_in_some_release")
            async with whep_of(stream) as (_whep, url), watching(url) as viewer:
                await viewer.next()
                assert stream.keyframe_every_s == 2.0

    in_time(work)


class Line:
    """What the network does to RTP packets before the viewer sees them: `pass_on(number, packet)` gives those to deliver."""

    def __init__(self, viewer: Viewer, pass_on: Any) -> None:
        receiver = viewer.transceiver.receiver
        deliver, self.number = receiver._handle_rtp_packet, 0

        async def handle(packet: Any, arrival_time_ms: int) -> None:
            self.number += 1
            for each in pass_on(self.number, packet):
                await deliver(each, arrival_time_ms)

        receiver._handle_rtp_packet = handle


def test_lost_packets_are_sent_again() -> None:
    """Every seventh packet is lost once. Retransmissions carry another payload type, and are let through."""

    async def work() -> None:
        with streaming(StreamQuality(bitrate_bps=3_000_000), capacity=PATIENT) as stream, Feed(stream, noise):
            async with whep_of(stream) as (_whep, url):
                viewer = Viewer()
                lost: list[int] = []
                kinds: set[int] = set()

                def pass_on(number: int, packet: Any) -> list[Any]:
                    kinds.add(packet.payload_type)
                    if number > 1 and number % 7 == 0 and packet.payload_type == min(kinds):
                        lost.append(number)
                        return []
                    return [packet]

                line = Line(viewer, pass_on)
                try:
                    async with aiohttp.ClientSession() as session:
                        await viewer.connect(url, session)
                    shown = [await viewer.next() for _ in range(25)]
                finally:
                    await viewer.peer.close()
                assert len(lost) >= 10
                assert line.number > 7 * len(lost)
                # No picture is missing: each follows the one before by what lies between two captures, and none needed a keyframe.
                sent = [each["rtp_timestamp"] for each in viewer.statuses()]
                steps = {b - a for a, b in pairwise(sent)}
                assert {b.pts - a.pts for a, b in pairwise(shown)} <= steps
                assert stream.keyframes["H264"] == 1

    in_time(work)


def test_after_a_gap_that_nobody_can_fill_a_keyframe_mends_the_picture() -> None:
    """Everything is lost for a while, retransmissions too; the receiver gives up on it, asks for a keyframe and shows pictures again."""

    async def work() -> None:
        with streaming(StreamQuality(bitrate_bps=8_000_000), capacity=PATIENT, keyframe_gap_s=0.1) as stream, Feed(stream, noise):
            async with whep_of(stream) as (_whep, url):
                viewer = Viewer()
                line = Line(viewer, lambda number, packet: [] if 100 < number <= 300 else [packet])
                try:
                    async with aiohttp.ClientSession() as session:
                        await viewer.connect(url, session)
                    await viewer.next()
                    before = stream.keyframes["H264"]
                    await viewer.until(lambda: line.number > 300 and stream.keyframes["H264"] > before, 20.0)
                    mended = [await viewer.next() for _ in range(20)]
                finally:
                    await viewer.peer.close()
                assert all(b.pts > a.pts for a, b in pairwise(mended))

    in_time(work)


def test_packets_that_overtake_one_another_are_put_in_order() -> None:
    async def work() -> None:
        with streaming(StreamQuality(bitrate_bps=3_000_000), capacity=PATIENT) as stream, Feed(stream, noise):
            async with whep_of(stream) as (_whep, url):
                viewer, held = Viewer(), []

                def pass_on(number: int, packet: Any) -> list[Any]:
                    if number > 1 and number % 5 == 0:
                        held.append(packet)
                        return []
                    return [packet, held.pop()] if held else [packet]

                Line(viewer, pass_on)
                try:
                    async with aiohttp.ClientSession() as session:
                        await viewer.connect(url, session)
                    shown = [await viewer.next() for _ in range(20)]
                finally:
                    await viewer.peer.close()
                assert all(b.pts > a.pts for a, b in pairwise(shown))
                assert stream.keyframes["H264"] == 1

    in_time(work)


def test_a_viewer_whose_connection_stands_still_does_not_stall_the_others() -> None:
    async def work() -> None:
        with streaming(capacity=30, keyframe_gap_s=0.0) as stream, Feed(stream, fps=30.0):
            async with whep_of(stream) as (whep, url), watching(url) as slow, watching(url) as quick:
                await asyncio.gather(slow.next(), quick.next())
                # The sender of the slow one waits in the middle of a packet, as it would for a full socket.
                connection = next(each for each in whep._viewers.values() if each.track._queue is stream.viewers[0])
                transport, gate = connection.track.sender.transport, asyncio.Event()
                send = transport._send_rtp

                async def stuck(data: bytes) -> None:
                    await gate.wait()
                    await send(data)

                transport._send_rtp = stuck
                await quick.until(lambda: not stream.viewers[0].wants_frames)
                seen = len(quick.statuses())
                await quick.until(lambda: len(quick.statuses()) >= seen + 10)
                sequences = [each["sequence"] for each in quick.statuses()]
                keyframes = stream.keyframes["H264"]
                gate.set()
                await slow.until(lambda: stream.keyframes["H264"] > keyframes)
                await slow.next()
                assert stream.viewers[0].dropped > 30
                assert stream.viewers[1].dropped == 0
                assert sequences == sorted(sequences)

    in_time(work)


@pytest.mark.parametrize(
    ("body", "sentence"),
    [
        (b"", "SDP offer"),
        (b"hello", "SDP offer"),
        (b"\xff\xfe", "UTF-8"),
        (b"v=0\r\n" * 20000, "65536"),
        (b"v=0\r\no=- 1 1 IN IP4 0.0.0.0\r\ns=-\r\nt=0 0\r\nm=audio 9 UDP/TLS/RTP/SAVPF 0\r\na=recvonly\r\n", "one video section"),
        (b"v=0\r\no=- 1 1 IN IP4 0.0.0.0\r\ns=-\r\nt=0 0\r\nm=video x y z\r\n", "SDP offer"),
    ],
)
def test_what_is_no_offer_is_refused_with_a_sentence(body: bytes, sentence: str) -> None:
    async def work() -> None:
        with streaming() as stream:
            async with whep_of(stream) as (whep, url), aiohttp.ClientSession() as session:
                async with session.post(f"{url}/whep", data=body, headers=SDP) as answer:
                    assert answer.status == 400
                    assert sentence in (await answer.json())["error"]
                assert whep.viewers == 0

    in_time(work)


def test_offers_that_cannot_be_served_leave_nothing_behind() -> None:
    async def refused(session: aiohttp.ClientSession, url: str, sdp: str) -> str:
        async with session.post(f"{url}/whep", data=sdp, headers=SDP) as answer:
            assert answer.status == 400
            return (await answer.json())["error"]

    async def work() -> None:
        viewer = Viewer()
        await viewer.peer.setLocalDescription()
        sdp = viewer.peer.localDescription.sdp
        with streaming() as stream:
            async with whep_of(stream) as (whep, url), aiohttp.ClientSession() as session:
                await refused(session, url, sdp.replace("H264/90000", "AV1/90000").replace("VP8/90000", "H265/90000"))
                assert "one video section" in await refused(session, url, sdp.replace("a=recvonly", "a=sendonly"))
                await refused(session, url, re.sub("a=ice-(ufrag|pwd).*\r\n", "", sdp))
                await refused(session, url, re.sub("a=fingerprint.*\r\n", "", sdp))
                async with session.post(f"{url}/whep", data=sdp) as answer:
                    assert answer.status == 415
                assert whep.viewers == 0
                assert stream.viewers == ()
        await viewer.peer.close()

    in_time(work)


def test_places_are_limited_and_given_back() -> None:
    async def work() -> None:
        with streaming() as stream, Feed(stream):
            async with whep_of(stream, viewers_limit=1) as (whep, url), aiohttp.ClientSession() as session, watching(url) as viewer:
                await viewer.next()
                second = Viewer()
                await second.peer.setLocalDescription()
                async with session.post(f"{url}/whep", data=second.peer.localDescription.sdp, headers=SDP) as answer:
                    assert answer.status == 503
                    assert "at most 1 viewers" in (await answer.json())["error"]
                async with session.delete(url + viewer.location) as answer:
                    assert answer.status == 200
                assert (whep.viewers, stream.viewers) == (0, ())
                async with session.delete(url + viewer.location) as answer:
                    assert answer.status == 404
                await second.connect(url, session)
                await second.next()
                await second.peer.close()
                # A peer that says goodbye is gone at once.
                await comes_true(lambda: whep.viewers == 0 and not stream.wants_frame)

    in_time(work)


def test_addresses_may_come_later() -> None:
    async def work() -> None:
        with streaming() as stream, Feed(stream):
            async with whep_of(stream) as (whep, url), aiohttp.ClientSession() as session:
                viewer = Viewer()
                await viewer.peer.setLocalDescription()
                sdp = viewer.peer.localDescription.sdp
                lines = re.findall(r"a=candidate:.*\r\n", sdp.split("m=application")[0])
                bare = re.sub(r"a=(candidate:.*|end-of-candidates)\r\n", "", sdp)
                async with session.post(f"{url}/whep", data=bare, headers=SDP) as answer:
                    place = url + answer.headers["Location"]
                    await viewer.peer.setRemoteDescription(RTCSessionDescription(await answer.text(), "answer"))
                headers = {"Content-Type": "application/trickle-ice-sdpfrag"}
                async with session.patch(place, data="a=mid:0\r\n" + "".join(lines), headers=headers) as answer:
                    assert answer.status == 204
                (connection,) = whep._viewers.values()
                known = connection.track.sender.transport.transport.getRemoteCandidates()
                assert {each.port for each in known} >= {int(line.split()[5]) for line in lines}
                async with session.patch(place, data="a=candidate:nonsense\r\n", headers=headers) as answer:
                    assert answer.status == 400
                async with session.patch(place, data="a=mid:0\r\n") as answer:
                    assert answer.status == 415
                async with session.patch(url + "/whep/nobody", data="", headers=headers) as answer:
                    assert answer.status == 404
                async with session.options(f"{url}/whep") as answer:
                    assert (answer.status, answer.headers["Accept-Post"]) == (204, "application/sdp")
                await viewer.next()
                await viewer.peer.close()

    in_time(work)


def test_a_viewer_that_never_connects_loses_its_place() -> None:
    async def work() -> None:
        with streaming() as stream:
            async with whep_of(stream, connect_within_s=2.0) as (whep, url), aiohttp.ClientSession() as session:
                viewer = Viewer()
                await viewer.peer.setLocalDescription()
                bare = re.sub(r"a=(candidate:.*|end-of-candidates)\r\n", "", viewer.peer.localDescription.sdp)
                async with session.post(f"{url}/whep", data=bare, headers=SDP) as answer:
                    assert answer.status == 201
                await viewer.peer.close()
                assert whep.viewers == 1
                await comes_true(lambda: whep.viewers == 0)
                assert not stream.wants_frame

    in_time(work)


def test_a_viewer_that_vanishes_without_a_word_is_removed(monkeypatch: pytest.MonkeyPatch) -> None:
    """As when a phone leaves the network; consent of ICE (RFC 7675) runs out, here sooner than its 30 s."""
    monkeypatch.setattr("aioice.ice.CONSENT_INTERVAL", 0.05)
    monkeypatch.setattr("aioice.ice.CONSENT_FAILURES", 2)
    monkeypatch.setattr("aioice.stun.RETRY_MAX", 1)
    monkeypatch.setattr("aioice.stun.RETRY_RTO", 0.05)

    async def work() -> None:
        with streaming() as stream, Feed(stream):
            async with whep_of(stream) as (whep, url), watching(url) as viewer:
                await viewer.next()
                for protocol in viewer.transceiver.receiver.transport.transport._connection._protocols:
                    monkeypatch.setattr(protocol, "datagram_received", lambda _data, _address: None)
                await comes_true(lambda: whep.viewers == 0 and not stream.wants_frame)

    in_time(work)


def test_the_failure_of_the_camera_reaches_the_page() -> None:
    async def work() -> None:
        with streaming() as stream, Feed(stream):
            async with whep_of(stream) as (_whep, url), watching(url) as viewer:
                await comes_true(lambda: viewer.channel.readyState == "open")
                await viewer.next()
                stream._stopping.set()
                stream.fail("the camera was unplugged")
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


def test_nothing_stays_after_the_server_is_closed() -> None:
    async def work() -> None:
        with streaming() as stream, Feed(stream):
            before, whep = asyncio.all_tasks(), Whep(stream)
            async with serving(whep) as url, watching(url) as a, watching(url, ("VP8",)) as b:
                await asyncio.gather(a.next(), b.next())
                await whep.close()
                assert (whep.viewers, stream.viewers) == (0, ())
                async with aiohttp.ClientSession() as session, session.post(f"{url}/whep", data="v=0", headers=SDP) as answer:
                    assert answer.status == 503
                await comes_true(lambda: a.peer.connectionState == b.peer.connectionState == "closed")
            await comes_true(lambda: asyncio.all_tasks() <= before)

    in_time(work)
    assert not {thread.name for thread in threading.enumerate()} & {"encode", "feed", "video-decoder"}

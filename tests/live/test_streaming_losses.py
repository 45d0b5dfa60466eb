"""A network that loses, delays and stalls: packets are sent again, keyframes mend, others go on."""

import asyncio
from itertools import pairwise
from typing import Any

import aiohttp
import pytest

from tests.scenes.streaming_viewers import Feed, Viewer, in_time, noise, streaming, watching
from tests.scenes.whep_viewers import PATIENT, Line, whep_of
from viewfinder.streaming import viewer_connection
from viewfinder.streaming.encoders import StreamQuality


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
                    await asyncio.sleep(0.5)  # what is told of the last picture may come after it
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

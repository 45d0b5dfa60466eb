"""WHEP with viewers in this process: real HTTP, ICE, DTLS and SRTP on loopback, real encoders and decoders."""

import asyncio
import re
import threading

import aiohttp
import numpy as np
import pytest

from mrbokeh.video.color import color_of
from mrbokeh.video.frames import display_bgr
from tests.scenes.streaming_viewers import BARS, HEIGHT, WIDTH, Feed, Viewer, bar_centres, comes_true, in_time, serving, streaming, watching
from tests.scenes.whep_viewers import PATIENT, SDP, whep_of
from viewfinder.streaming.whep import Whep


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

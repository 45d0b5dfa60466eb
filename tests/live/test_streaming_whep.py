"""WHEP with viewers in this process: real HTTP, ICE, DTLS and SRTP on loopback; what may be posted, and the addresses in offers."""

import asyncio
import re
import threading
import time

import aiohttp
import numpy as np
import pytest
from aiortc import RTCSessionDescription

from mrbokeh.video.color import color_of
from mrbokeh.video.frames import display_bgr
from tests.scenes.streaming_viewers import (
    BARS,
    HEIGHT,
    PATIENT,
    SDP,
    WIDTH,
    Feed,
    Viewer,
    bar_centres,
    serving,
    streaming,
    watching,
    whep_of,
)
from tests.scenes.waiting import comes_true
from viewfinder.streaming.session_description import with_address
from viewfinder.streaming.whep import Whep


@pytest.mark.parametrize(("offered", "codec"), [(("VP8", "H264"), "H264"), (("VP8",), "VP8"), (("H264",), "H264")])
async def test_h264_is_sent_where_it_can_be_played_and_colours_arrive(offered: tuple[str, ...], codec: str) -> None:
    with streaming() as stream, Feed(stream):
        async with whep_of(stream) as (_whep, url), watching(url, offered) as viewer:
            for _ in range(8):
                frame = await viewer.next()
        assert set(stream.encoded) == {codec}
    color = color_of(frame, "stream")
    # BT.601 limited. VP8 cannot say so; below HD it is what is meant.
    assert (color.matrix, color.code_range) == (6, 1)
    np.testing.assert_allclose(bar_centres(display_bgr(frame, color, (WIDTH, HEIGHT))), BARS.astype(int), atol=4)


async def test_three_viewers_are_served_by_one_encoding() -> None:
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


async def test_a_viewer_that_never_connects_loses_its_place() -> None:
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


async def test_a_viewer_that_vanishes_without_a_word_is_removed(monkeypatch: pytest.MonkeyPatch) -> None:
    """As when a phone leaves the network; consent of ICE (RFC 7675) runs out, here sooner than its 30 s."""
    monkeypatch.setattr("aioice.ice.CONSENT_INTERVAL", 0.05)
    monkeypatch.setattr("aioice.ice.CONSENT_FAILURES", 2)
    monkeypatch.setattr("aioice.stun.RETRY_MAX", 1)
    monkeypatch.setattr("aioice.stun.RETRY_RTO", 0.05)
    with streaming() as stream, Feed(stream):
        async with whep_of(stream) as (whep, url), watching(url) as viewer:
            await viewer.next()
            for protocol in viewer.transceiver.receiver.transport.transport._connection._protocols:
                monkeypatch.setattr(protocol, "datagram_received", lambda _data, _address: None)
            await comes_true(lambda: whep.viewers == 0 and not stream.wants_frame)


async def test_nothing_stays_after_the_server_is_closed() -> None:
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
    assert not {thread.name for thread in threading.enumerate()} & {"encode", "feed", "video-decoder"}


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
async def test_what_is_no_offer_is_refused_with_a_sentence(body: bytes, sentence: str) -> None:
    with streaming() as stream:
        async with whep_of(stream) as (whep, url), aiohttp.ClientSession() as session:
            async with session.post(f"{url}/whep", data=body, headers=SDP) as answer:
                assert answer.status == 400
                assert sentence in (await answer.json())["error"]
            assert whep.viewers == 0


async def test_offers_that_cannot_be_served_leave_nothing_behind() -> None:
    async def refused(session: aiohttp.ClientSession, url: str, sdp: str) -> str:
        async with session.post(f"{url}/whep", data=sdp, headers=SDP) as answer:
            assert answer.status == 400
            return (await answer.json())["error"]

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


async def test_names_that_only_multicast_resolves_are_not_waited_for() -> None:
    """Chromium's .local names cost a second each way; none of these resolves. The connection stands nevertheless, on loopback."""
    with streaming() as stream, Feed(stream):
        async with whep_of(stream) as (whep, url), aiohttp.ClientSession() as session:
            viewer = Viewer()
            await viewer.peer.setLocalDescription()
            sdp = viewer.peer.localDescription.sdp
            named = re.sub(r"(a=candidate:(?:\S+ ){4})\S+", r"\1nobody-has-this-name.local", sdp)
            assert named.count(".local ") == sdp.count("a=candidate:") > 0
            one_of_them = re.findall(r"a=candidate:.*\r\n", named)[0]
            started_s = time.perf_counter()
            async with session.post(f"{url}/whep", data=named, headers=SDP) as answer:
                await viewer.peer.setRemoteDescription(RTCSessionDescription(await answer.text(), "answer"))
                place = url + answer.headers["Location"]
            headers = {"Content-Type": "application/trickle-ice-sdpfrag"}
            async with session.patch(place, data="a=mid:0\r\n" + one_of_them, headers=headers) as later:
                assert later.status == 204
            assert time.perf_counter() - started_s < 0.9, "less than aioice waits for one name"
            (connection,) = whep._viewers.values()
            known = connection.track.sender.transport.transport.getRemoteCandidates()
            assert {each.ip for each in known if each.type == "host"} == {"127.0.0.1"}
            await viewer.next()
            await viewer.peer.close()


async def test_places_are_limited_and_given_back() -> None:
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


async def test_addresses_may_come_later() -> None:
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


NAMED = "a=candidate:383979905 1 udp 2113937151 05002700-30d8-431e-98c5-8a90d07e5099.local 42153 typ host generation 0 network-cost 999\r\n"
"""As headless Chromium writes it."""

ANSWERED = "a=candidate:383979905 1 udp 2113937151 192.168.1.7 42153 typ host generation 0 network-cost 999\r\n"
PLAIN = "a=candidate:1 1 udp 2113937151 10.0.0.3 9000 typ host\r\na=candidate:2 1 udp 1677 198.51.100.4 9000 typ srflx raddr 0.0.0.0\r\n"
REST = "v=0\r\no=- 1 1 IN IP4 host.local 42153 typ\r\na=mid:0\r\n"


def test_names_become_the_address_and_the_rest_stays() -> None:
    second = NAMED.replace("42153", "5000").replace("05002700", "A7FF5B81").replace(".local", ".LOCAL")
    expected = REST + ANSWERED + PLAIN + ANSWERED.replace("42153", "5000")
    assert with_address(REST + NAMED + PLAIN + second, "192.168.1.7") == expected


@pytest.mark.parametrize(
    ("remote", "written"),
    [("::1", "::1"), ("2001:db8::5", "2001:db8::5"), ("::ffff:192.168.1.7", "192.168.1.7")],
)
def test_addresses_of_the_other_kind(remote: str, written: str) -> None:
    assert with_address(NAMED, remote) == ANSWERED.replace("192.168.1.7", written)


@pytest.mark.parametrize("remote", [None, "", "phone.lan", "fe80::1%eth0", "192.168.1.7 evil", "a\r\na=x"])
def test_what_is_no_address_for_all_is_not_written(remote: str | None) -> None:
    assert with_address(NAMED, remote) == NAMED

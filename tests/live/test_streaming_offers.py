"""What may be posted to WHEP, by how many, and what is refused with a sentence."""

import re
import time

import aiohttp
import pytest
from aiortc import RTCSessionDescription

from tests.scenes.streaming_viewers import Feed, Viewer, comes_true, in_time, streaming, watching
from tests.scenes.whep_viewers import SDP, whep_of


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


def test_names_that_only_multicast_resolves_are_not_waited_for() -> None:
    """Chromium's .local names cost a second each way; none of these resolves. The connection stands nevertheless, on loopback."""

    async def work() -> None:
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

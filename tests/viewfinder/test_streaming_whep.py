"""WHEP with viewers in this process: real HTTP, ICE, DTLS and SRTP on loopback; what may be posted, and the addresses in offers. A network
that loses, delays and stalls: packets are sent again, keyframes mend; and what the page learns beside the pictures."""

import asyncio
import re
import threading
import time
from itertools import islice, pairwise
from typing import Any

import aiohttp
import numpy as np
import pytest
from aiortc import RTCSessionDescription

from mrbokeh.video.color import color_of
from mrbokeh.video.frames import display_bgr
from tests.support.streaming_viewers import (
    BARS,
    HEIGHT,
    PATIENT,
    SDP,
    WIDTH,
    Feed,
    Line,
    Viewer,
    bar_centres,
    noise,
    serving,
    standing_still,
    streaming,
    watching,
    whep_of,
)
from tests.support.waiting import comes_true
from viewfinder.streaming import whep
from viewfinder.streaming.encoders import StreamQuality
from viewfinder.streaming.session_description import with_address
from viewfinder.streaming.whep import Whep


@pytest.mark.parametrize(("offered", "codec"), [(("VP8", "H264"), "H264"), (("VP8",), "VP8")])
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


async def test_a_viewer_that_never_connects_loses_its_place() -> None:
    with streaming() as stream:
        async with whep_of(stream, connect_within_s=0.5) as (whep, url), aiohttp.ClientSession() as session:
            viewer = Viewer()
            await viewer.peer.setLocalDescription()
            async with session.post(f"{url}/whep", data=NO_ADDRESSES.sub("", viewer.peer.localDescription.sdp), headers=SDP) as answer:
                assert answer.status == 201
            await viewer.peer.close()
            await comes_true(lambda: whep.viewers == 0 and not stream.wants_frame)


NO_ADDRESSES = re.compile(r"a=(candidate:.*|end-of-candidates)\r\n")


async def test_a_viewer_that_vanishes_without_a_word_is_removed(monkeypatch: pytest.MonkeyPatch) -> None:
    """As when a phone leaves the network; consent of ICE (RFC 7675) runs out, here sooner than its 30 s."""
    for name, value in {"ice.CONSENT_INTERVAL": 0.05, "ice.CONSENT_FAILURES": 2, "stun.RETRY_MAX": 1, "stun.RETRY_RTO": 0.05}.items():
        monkeypatch.setattr(f"aioice.{name}", value)
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


HEAD = b"v=0\r\no=- 1 1 IN IP4 0.0.0.0\r\ns=-\r\nt=0 0\r\n"


async def test_what_is_no_offer_and_what_cannot_be_served_is_refused_with_a_sentence_and_leaves_nothing_behind() -> None:
    viewer = Viewer()
    await viewer.peer.setLocalDescription()
    sdp = viewer.peer.localDescription.sdp
    refused: list[tuple[str | bytes, str]] = [
        (b"", "SDP offer"), (b"hello", "SDP offer"), (b"\xff\xfe", "UTF-8"), (b"v=0\r\n" * 20000, "65536"),
        (HEAD + b"m=audio 9 UDP/TLS/RTP/SAVPF 0\r\na=recvonly\r\n", "one video section"), (HEAD + b"m=video x y z\r\n", "SDP offer"),
        (sdp.replace("H264/90000", "AV1/90000").replace("VP8/90000", "H265/90000"), ""),
        (sdp.replace("a=recvonly", "a=sendonly"), "one video section"),
        (re.sub("a=ice-(ufrag|pwd).*\r\n", "", sdp), ""), (re.sub("a=fingerprint.*\r\n", "", sdp), ""),
    ]  # fmt: skip
    with streaming() as stream:
        async with whep_of(stream) as (whep, url), aiohttp.ClientSession() as session:
            for body, sentence in refused:
                async with session.post(f"{url}/whep", data=body, headers=SDP) as answer:
                    assert answer.status == 400 and sentence in (await answer.json())["error"], body[:30]
            async with session.post(f"{url}/whep", data=sdp) as answer:
                assert answer.status == 415
            assert (whep.viewers, stream.viewers) == (0, ())
    await viewer.peer.close()


async def test_names_that_only_multicast_resolves_are_not_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Chromium's .local names cost a second each way; none of these resolves. The connection stands nevertheless, on loopback."""
    asked: list[str] = []
    monkeypatch.setattr("aioice.mdns.MDnsProtocol.resolve", lambda _self, name, *_rest: asked.append(name))
    with streaming() as stream, Feed(stream):
        async with whep_of(stream) as (whep, url), aiohttp.ClientSession() as session:
            viewer = Viewer()
            await viewer.peer.setLocalDescription()
            sdp = viewer.peer.localDescription.sdp
            named = re.sub(r"(a=candidate:(?:\S+ ){4})\S+", r"\1nobody-has-this-name.local", sdp)
            assert named.count(".local ") == sdp.count("a=candidate:") > 0
            one_of_them = re.findall(r"a=candidate:.*\r\n", named)[0]
            async with session.post(f"{url}/whep", data=named, headers=SDP) as answer:
                await viewer.peer.setRemoteDescription(RTCSessionDescription(await answer.text(), "answer"))
                place = url + answer.headers["Location"]
            headers = {"Content-Type": "application/trickle-ice-sdpfrag"}
            async with session.patch(place, data="a=mid:0\r\n" + one_of_them, headers=headers) as later:
                assert later.status == 204
            assert not asked
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
                assert answer.status == 503 and "at most 1 viewers" in (await answer.json())["error"]
            for _time in range(2):
                async with session.delete(url + viewer.location) as answer:
                    assert answer.status == 200, "once more is no error: its connection may close before the page can say so"
                assert (whep.viewers, stream.viewers) == (0, ())
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
            async with session.post(f"{url}/whep", data=NO_ADDRESSES.sub("", sdp), headers=SDP) as answer:
                place = url + answer.headers["Location"]
                await viewer.peer.setRemoteDescription(RTCSessionDescription(await answer.text(), "answer"))
            headers = {"Content-Type": "application/trickle-ice-sdpfrag"}
            async with session.patch(place, data="a=mid:0\r\n" + "".join(lines), headers=headers) as answer:
                assert answer.status == 204
            (connection,) = whep._viewers.values()
            known = connection.track.sender.transport.transport.getRemoteCandidates()
            assert {each.port for each in known} >= {int(line.split()[5]) for line in lines}
            refused: list[tuple[str, str, dict[str, str] | None, int]] = [
                (place, "a=candidate:nonsense\r\n", headers, 400), (place, "a=mid:0\r\n", None, 415),
                (url + "/whep/nobody", "", headers, 404),
            ]  # fmt: skip
            for address, data, sent, status in refused:
                async with session.patch(address, data=data, headers=sent) as answer:
                    assert answer.status == status
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
    for remote, written in (("::1", "::1"), ("2001:db8::5", "2001:db8::5"), ("::ffff:192.168.1.7", "192.168.1.7")):
        assert with_address(NAMED, remote) == ANSWERED.replace("192.168.1.7", written)
    for no_address_for_all in (None, "", "phone.lan", "fe80::1%eth0", "192.168.1.7 evil", "a\r\na=x"):
        assert with_address(NAMED, no_address_for_all) == NAMED


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
    lost, kinds, sent = list[int](), set[int](), dict[int, None]()

    def pass_on(number: int, packet: Any) -> list[Any]:
        kinds.add(packet.payload_type)
        sent[packet.timestamp] = None
        if number > 1 and number % 7 == 0 and packet.payload_type == min(kinds):
            lost.append(number)
            return []
        return [packet]

    with streaming(StreamQuality(bitrate_bps=3_000_000), capacity=PATIENT) as stream, Feed(stream, noise):
        line = Line(Viewer(), pass_on)
        async with whep_of(stream) as (_whep, url), watching(url, viewer=line.viewer) as viewer:
            shown = [await viewer.next() for _ in range(20)]
        assert len(lost) >= 10 and line.number > 7 * len(lost)
        # No picture is missing: those shown are the first that packets were sent for, and none needed another keyframe.
        first = next(iter(sent))
        assert [each.pts - shown[0].pts for each in shown] == [(each - first) % 2**32 for each in islice(sent, len(shown))]
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
        assert all(b.pts > a.pts for a, b in pairwise(shown)) and stream.keyframes["H264"] == 1


async def test_a_viewer_whose_connection_stands_still_does_not_stall_the_others() -> None:
    with streaming(capacity=10, keyframe_gap_s=0.0) as stream, Feed(stream, fps=30.0):
        async with whep_of(stream) as (whep, url), watching(url) as slow, watching(url) as quick:
            await asyncio.gather(slow.next(), quick.next())
            with standing_still(next(each for each in whep._viewers.values() if each.track._queue is stream.viewers[0])):
                await quick.until(lambda: not stream.viewers[0].wants_frames)
                seen = len(quick.statuses())
                await quick.until(lambda: len(quick.statuses()) >= seen + 10)
                sequences, keyframes = [each["sequence"] for each in quick.statuses()], stream.keyframes["H264"]
            await slow.until(lambda: stream.keyframes["H264"] > keyframes)
            await slow.next()
            assert stream.viewers[0].dropped > 10 and stream.viewers[1].dropped == 0 and sequences == sorted(sequences)


def level(sequence: int) -> np.ndarray:
    """A flat grey that names the picture, in steps of 4 that outlive the 219 steps of the codec."""
    return np.full((HEIGHT, WIDTH, 3), 40 + 4 * (sequence % 48), np.uint8)


async def test_a_status_names_the_very_picture_on_the_screen_and_tells_when_it_was_captured() -> None:
    """A picture is known by its grey; it is joined to its status by the RTP timestamp alone, which aiortc counts from its first packet."""
    arrived = list[int]()
    with streaming() as stream, Feed(stream, level, fps=30.0) as feed:
        line = Line(Viewer(), lambda _number, packet: arrived.append(packet.timestamp) or [packet])
        async with whep_of(stream) as (_whep, url), watching(url, viewer=line.viewer) as viewer:
            # Pictures before the first status came while the channel was not open yet.
            await viewer.until(lambda: len(viewer.statuses()) >= 3)
            shown = [await viewer.next() for _ in range(12)]
            status_of = {each["rtp_timestamp"]: each for each in viewer.statuses()}
            # The very timestamps that are in the packets, which is what a browser compares.
            await viewer.until(lambda: status_of.keys() <= set(arrived))
    pairs = [(each, status_of.get((arrived[0] + each.pts) & 0xFFFFFFFF)) for each in shown]
    told = [(each, status) for each, status in pairs if status is not None]
    assert len(told) >= 8
    for picture, status in told:
        bgr = display_bgr(picture, color_of(picture, "stream"), (WIDTH, HEIGHT))
        assert round((float(bgr[40:-40, 40:-40].mean()) - 40) / 4) == status["sequence"] % 48
        assert status["captured_ms"] == 1000 * feed.captured_s[status["sequence"]]
        assert status["focus_distance_m"] == 2.0 and status["stages_ms"]["h264"] > 0
    # The clock of RTP is that of capture: 90 ticks for a millisecond, each rounded.
    (first, of_first), (last, of_last) = told[0], told[-1]
    assert last.pts - first.pts == pytest.approx(90 * (of_last["captured_ms"] - of_first["captured_ms"]), abs=1.01)


async def test_the_channel_answers_the_clock_and_refuses_the_rest() -> None:
    with streaming() as stream, Feed(stream):
        async with whep_of(stream) as (_whep, url), watching(url) as viewer:
            await comes_true(lambda: viewer.channel.readyState == "open")
            wrong = ["no JSON", '{"clock": "noon"}', '{"focus": 1}', "[" * 1000, "x" * 5000]
            asked_ms = 1000 * time.monotonic()
            for text in [*wrong, '{"clock": 12.5}']:
                viewer.channel.send(text)
            # The channel is neither ordered nor reliable, but this is loopback.
            await comes_true(lambda: any("clock" in each for each in viewer.messages))
            assert sum("error" in each for each in viewer.messages) == len(wrong)
            [answer] = [each for each in viewer.messages if "clock" in each]
            # The clock of the captures, in one process with this test.
            assert answer["clock"] == 12.5 and asked_ms <= answer["server_ms"] <= 1000 * time.monotonic()
            await viewer.next()


async def test_the_failure_of_the_camera_reaches_the_page_and_who_comes_later_and_pictures_come_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A message may get lost: it is said again while it is so."""
    monkeypatch.setattr(whep, "_REMIND_S", 0.2)
    failure = {"failure": "the camera was unplugged"}
    with streaming() as stream:
        async with whep_of(stream) as (_whep, url), watching(url) as viewer:
            with Feed(stream):
                await comes_true(lambda: viewer.channel.readyState == "open")
                await viewer.next()
            stream.fail("the camera was unplugged")
            for _ in range(2):
                await comes_true(lambda: failure in viewer.messages)
                viewer.messages.clear()
            async with watching(url) as later:
                await comes_true(lambda: failure in later.messages)
                with Feed(stream):
                    await later.next()
                assert stream.failure is None

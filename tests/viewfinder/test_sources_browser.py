"""A browser camera through WHIP, played by aiortc itself over real sockets: pictures, sizes, lens and pose, refusals, coming back."""

import asyncio
import json
import math
import random
import re
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from threading import Event
from typing import Any

import aiohttp
import aiortc
import numpy as np
import pytest

from mrbokeh.system.errors import InputError
from tests.support.browser_sender import HEIGHT, WIDTH, Canvas, Sender, sending
from tests.support.streaming_viewers import serving_routes
from tests.support.waiting import comes_true
from viewfinder.frames import CameraFrame
from viewfinder.sources.browser_camera import LONGEST_MESSAGE, LONGEST_OFFER_BYTES, BrowserCameraSource, CameraKnowledge
from viewfinder.sources.frame_source import SizeLimit

RED, GREEN = (40, 60, 200), (60, 190, 50)


class Reader:
    """The capture thread of a pipeline: keeps the newest frame."""

    def __init__(self, source: BrowserCameraSource) -> None:
        self.newest: CameraFrame | None = None
        self.failure: BaseException | None = None
        self.sequences: list[int] = []
        self._source, self._stopping = source, Event()
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        try:
            for frame in self._source.frames(self._stopping):
                self.newest = frame
                self.sequences.append(frame.sequence)
        except BaseException as error:
            self.failure = error

    def stop(self) -> None:
        self._stopping.set()
        self._thread.join(10)
        assert not self._thread.is_alive() and self.failure is None, self.failure

    def shows(self, bgr: tuple[int, int, int], width_px: int = WIDTH) -> bool:
        """The newest frame has that colour but for what the codec leaves, and that width."""
        frame = self.newest
        if frame is None or frame.bgr.shape[1] != width_px:
            return False
        return bool(np.abs(frame.bgr.reshape(-1, 3).mean(axis=0) - bgr).max() < 8)


@asynccontextmanager
async def serving(source: BrowserCameraSource) -> AsyncIterator[tuple[str, Reader]]:
    reader = Reader(source)
    async with serving_routes(source.routes("/whip")) as url:
        try:
            yield url, reader
        finally:
            reader.stop()
            await source.close()


@pytest.fixture(autouse=True)
def no_thread_stays() -> Iterator[None]:
    before = set(threading.enumerate())
    yield
    left = [each for each in threading.enumerate() if each not in before and not each.name.startswith("asyncio_")]
    assert not left


@pytest.mark.parametrize("codec", ["video/VP8", "video/H264"])
async def test_pictures_arrive_in_colour_and_follow_the_size_that_is_sent(codec: str) -> None:
    source = BrowserCameraSource()
    async with serving(source) as (url, reader):
        assert source.status == "waiting for a browser camera"
        async with sending(url, Canvas(RED), codec) as sender:
            assert codec.split("/")[1] in sender.peer.remoteDescription.sdp
            await comes_true(lambda: reader.shows(RED))
            assert source.status is None and source.transfer == "bt709"
            sender.track.bgr, sender.track.size_px = GREEN, (WIDTH // 2, HEIGHT // 2)
            await comes_true(lambda: reader.shows(GREEN, WIDTH // 2))
            assert np.all(np.diff(reader.sequences) >= 1)


async def test_vp8_of_high_definition_has_the_matrix_of_bt601() -> None:
    """Untagged pictures of that size are taken for BT.709 elsewhere, which would leave green 20 codes off."""
    large = Canvas(GREEN)
    large.size_px = (1280, 720)
    async with serving(BrowserCameraSource(SizeLimit(160, 160))) as (url, reader), sending(url, large):
        await comes_true(lambda: reader.shows(GREEN, 160))
        assert reader.newest.bgr.shape == (90, 160, 3)


async def test_nobody_reads_and_nothing_piles_up() -> None:
    """aiortc's queue is emptied whether or not frames are asked for, and the source keeps one frame."""
    source = BrowserCameraSource()
    async with serving(source) as (url, reader):
        reader.stop()
        async with sending(url, Canvas(RED)):
            await comes_true(lambda: source._newest.waiting)
            await asyncio.sleep(0.3)
            receiver = receiver_of(source)
            # The buffer that releases on the marker is the one in use.
            assert type(receiver._RTCRtpReceiver__jitter_buffer).__name__ == "MarkerJitterBuffer"
            assert receiver.track._queue.qsize() <= 1 and source._newest.take(0.0)[0] > 1


def receiver_of(source: BrowserCameraSource) -> Any:
    (found,) = [each.receiver for each in source._session._peer.getTransceivers() if each.kind == "video"]
    return found


@pytest.mark.slow
async def test_loss_and_reordering_on_the_way_cost_no_torn_picture(caplog: pytest.LogCaptureFixture) -> None:
    """Each tenth packet is lost once and some arrive late: pictures go on in order, and the decoder never gets a broken one."""
    draw, noisy = random.Random(4), Canvas(RED)
    noisy.noise = 120
    caplog.set_level("WARNING", logger="aiortc.rtcrtpreceiver")
    source = BrowserCameraSource()
    async with serving(source) as (url, reader), sending(url, noisy, "video/H264"):
        await comes_true(lambda: reader.newest is not None)
        receiver = receiver_of(source)
        handle, lost, late = receiver._handle_rtp_packet, list[int](), list[Any]()

        async def lossy(packet: Any, arrival_time_ms: int) -> None:
            if draw.random() < 0.1:
                lost.append(packet.sequence_number)
            elif draw.random() < 0.1 and not late:
                late.append(packet)
            else:
                await handle(packet, arrival_time_ms=arrival_time_ms)
                while late:
                    await handle(late.pop(), arrival_time_ms=arrival_time_ms)

        receiver._handle_rtp_packet = lossy
        before = reader.sequences[-1]
        await comes_true(lambda: len(lost) > 10 and reader.sequences[-1] > before + 15)
        assert np.all(np.diff(reader.sequences) >= 1)
    assert not [each for each in caplog.records if "failed to decode" in each.getMessage()]


async def test_focus_and_pose_travel_with_the_frames() -> None:
    async with serving(BrowserCameraSource()) as (url, reader), sending(url, Canvas(RED)) as sender:
        await comes_true(lambda: sender.channel.readyState == "open" and reader.shows(RED))
        assert reader.newest.camera_from_world is None
        identity = [float(i % 5 == 0) for i in range(16)]
        sender.channel.send(json.dumps({"focusDistance": 0.8, "pose": [*identity[:12], 1.0, 2.0, 3.0, 1.0]}))
        await comes_true(lambda: reader.newest.lens.focus_distance_m == 0.8)
        # A camera at (1, 2, 3) of a world with y up and z backward stands at (1, -2, -3) of ours.
        np.testing.assert_allclose(reader.newest.camera_from_world[:3, 3], (-1.0, 2.0, 3.0))
        for bad in ("no json", "[]", '{"focusDistance": -1}', "x" * (LONGEST_MESSAGE + 1)):
            sender.channel.send(bad)
        await comes_true(lambda: len(sender.answers) == 4)
        assert all(list(each) == ["error"] for each in sender.answers) and reader.newest.lens.focus_distance_m == 0.8


async def test_a_camera_goes_is_replaced_and_comes_again() -> None:
    source = BrowserCameraSource()
    async with serving(source) as (url, reader), aiohttp.ClientSession() as session:
        async with sending(url, Canvas(RED)) as first:
            await comes_true(lambda: reader.shows(RED))
            # The page is loaded anew without a good-bye: the newer camera counts.
            async with sending(url, Canvas(GREEN)) as second:
                await comes_true(lambda: reader.shows(GREEN))
                assert first.location != second.location
                await comes_true(lambda: first.peer.connectionState in ("closed", "failed"))
                async with session.delete(url + first.location) as answer:
                    assert answer.status == 200 and source.status is None, "it has gone already, and the newer stays"
                async with session.delete(url + second.location) as answer:
                    assert answer.status == 200
                await comes_true(lambda: "waiting" in str(source.status))
                async with sending(url, Canvas(RED)):
                    await comes_true(lambda: reader.shows(RED) and source.status is None)
        await comes_true(lambda: "waiting" in str(source.status))


async def test_an_offer_whose_connection_never_stands_takes_nobodys_place() -> None:
    source = BrowserCameraSource()
    async with serving(source) as (url, reader), sending(url, Canvas(RED)) as sender, aiohttp.ClientSession() as session:
        await comes_true(lambda: reader.shows(RED))
        source._connect_within_s = 0.2
        for _ in range(3):
            silent = Sender(url, Canvas(GREEN))
            await silent.peer.setLocalDescription(await silent.peer.createOffer())
            offer = silent.peer.localDescription.sdp
            # Its addresses are those of somebody who never answers (RFC 5737).
            offer = re.sub(r"(a=candidate:(?:\S+ ){4})\S+", r"\g<1>192.0.2.254", offer)
            async with session.post(url + "/whip", data=offer, headers={"Content-Type": "application/sdp"}) as answer:
                assert answer.status == 201
                found = re.findall(r"a=candidate:(?:\S+ ){4}(\S+)", await answer.text())
            # Sockets are opened at the address at which the page is served, and nowhere else.
            assert set(found) == {"127.0.0.1"}
            await silent.peer.close()
        before = reader.sequences[-1]
        await comes_true(lambda: reader.sequences[-1] > before + 5)
        assert reader.shows(RED) and sender.peer.connectionState == "connected"
        await comes_true(lambda: source._offering is None)
        assert source.status is None and source._session is not None


async def test_offers_that_make_no_sense_change_nothing() -> None:
    source, sdp = BrowserCameraSource(), {"Content-Type": "application/sdp"}
    async with serving(source) as (url, reader), sending(url, Canvas(RED)) as sender, aiohttp.ClientSession() as session:
        await comes_true(lambda: reader.shows(RED))
        listener = aiortc.RTCPeerConnection(aiortc.RTCConfiguration(iceServers=[]))
        listener.addTransceiver("audio", direction="sendrecv")
        await listener.setLocalDescription(await listener.createOffer())
        malformed = (b"v=0", b"\xff\xfe not sdp", b"", b"v=0\r\nm=video x y\r\n", listener.localDescription.sdp.encode())
        too_large = (b"x" * (LONGEST_OFFER_BYTES + 1), sdp, 413)
        for body, headers, status in (
            *((each, sdp, 400) for each in malformed),
            too_large,
            (b"{}", {"Content-Type": "application/json"}, 415),
        ):
            async with session.post(url + "/whip", data=body, headers=headers) as answer:
                assert answer.status == status and "expected" in await answer.text(), body[:30]
        async with session.patch(url + sender.location, data=b"") as answer:
            assert answer.status == 405
        before = reader.sequences[-1]
        await comes_true(lambda: reader.sequences[-1] > before + 2)
        await listener.close()


def test_orientations_and_poses_become_ours() -> None:
    """A phone held upright towards the north has its screen's z to the south: turned about x by 90 degrees. Its camera looks north."""
    known = CameraKnowledge().told(json.dumps({"orientation": [math.sin(math.pi / 4), 0, 0, math.cos(math.pi / 4)]}))
    np.testing.assert_allclose(known.camera_from_world, np.eye(4), atol=1e-12)
    # Flat on a table, screen up, its top to the north, the camera looks down (+y of ours), the picture's top is north (+z).
    flat = CameraKnowledge().told('{"orientation": [0, 0, 0, 1]}').camera_from_world
    np.testing.assert_allclose(flat[:3, :3] @ np.array([(0, 1, 0), (0, 0, 1)]).T, np.array([(0, 0, 1), (0, -1, 0)]).T, atol=1e-12)
    # A camera that WebXR turned 90 degrees to the left (about y up) looks along -x; what lies there is ahead of it.
    pose = CameraKnowledge().told(json.dumps({"pose": [0, 0, -1, 0, 0, 1, 0, 0, 1, 0, 0, 0, 0, 0, 0, 1]})).camera_from_world
    np.testing.assert_allclose(pose @ (-2, 0, 0, 1), (0, 0, 2, 1), atol=1e-12)


def test_messages_keep_what_they_do_not_name() -> None:
    known = CameraKnowledge().told('{"focusDistance": 2}').told('{"orientation": [0, 0, 0, 1]}')
    assert known.lens.focus_distance_m == 2.0 and known.camera_from_world is not None
    assert known.told('{"focusDistance": "infinity"}').lens.focus_distance_m == math.inf
    assert known.told('{"focusDistance": null, "orientation": null}') == CameraKnowledge()


def test_messages_that_make_no_sense_are_refused() -> None:
    for text in (
        '{"other": 1}', '{"focusDistance": true}', '{"focusDistance": NaN}', '{"focusDistance": "near"}', '{"pose": [1, 2]}',
        '{"pose": [2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}', '{"pose": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}',
        '{"pose": [1, 0, 0, 5, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}', '{"orientation": [0, 0, 0, 2]}',
        '{"orientation": [0, 0, 0, Infinity]}', '{"orientation": "north"}', "[" * 4000,
    ):  # fmt: skip
        with pytest.raises(InputError, match="expected"):
            CameraKnowledge().told(text)

"""JPEG through the WebSocket from a FrameSink: encoded once, one credit, failures told."""

import asyncio
import json
from threading import Event
from typing import Any

import aiohttp
import cv2
import numpy as np
import pytest

from tests.scenes.made_viewfinder import LENS_RGB, SQUARE, MadeControls, made_frame, made_viewfinder
from tests.scenes.waiting import in_time
from viewfinder.frames import frame_header
from viewfinder.server import jpeg_stream
from viewfinder.server.jpeg_stream import JpegStream, jpeg_message


def unpacked(message: bytes) -> tuple[dict[str, Any], np.ndarray]:
    length = int.from_bytes(message[:4], "big")
    return json.loads(message[4 : 4 + length]), cv2.imdecode(np.frombuffer(message[4 + length :], np.uint8), cv2.IMREAD_COLOR)


def test_a_message_is_a_header_and_the_picture() -> None:
    controls = MadeControls()
    frame = made_frame(controls, 7)
    header, bgr = unpacked(jpeg_message(frame, 85))
    assert (header["sequence"], header["focus_distance_m"], header["f_number"], header["tracking"]) == (7, 2.0, 2.0, 0.9)
    assert header["captured_ms"] == 1000 * frame.captured_s
    assert list(header["stages_ms"]) == ["composite", "jpeg"] and header["stages_ms"]["composite"] == 1.25
    # Flat colours survive JPEG within the rounding of YCbCr.
    np.testing.assert_allclose(bgr[40:56, 72:88].reshape(-1, 3).mean(axis=0), LENS_RGB["fifty"][::-1], atol=3)
    controls.values["focus"] = float("inf")
    assert frame_header(made_frame(controls, 8))["focus_distance_m"] is None


def test_pictures_come_one_by_one_and_only_as_long_as_somebody_waits() -> None:
    async def work() -> None:
        async with made_viewfinder() as made, aiohttp.ClientSession() as session:
            await asyncio.sleep(0.2)
            assert made.pictures.shown == 0 and not made.jpeg.wants_frame
            async with session.ws_connect(made.url + "stream") as stream:
                sequences = []
                for _ in range(10):
                    header, bgr = unpacked((await stream.receive(timeout=5)).data)
                    assert bgr.shape == (96, 160, 3)
                    sequences.append(header["sequence"])
                    # The credit is one: nothing more comes before the acknowledgement.
                    with pytest.raises(TimeoutError):
                        await stream.receive(timeout=0.03)
                    await stream.send_json({"ack": header["sequence"]})
                assert np.all(np.diff(sequences) > 0)
            before = made.pictures.shown
            # 12, not 10: the last acknowledgement asked for one more, and a picture may be on its way while that is heard.
            assert before <= 12
            await asyncio.sleep(0.2)
            assert made.pictures.shown <= before + 1 and not made.jpeg.wants_frame

    in_time(work)


def test_three_viewers_share_one_encoding(monkeypatch: pytest.MonkeyPatch) -> None:
    encoded: list[int] = []
    original = jpeg_stream.jpeg_message

    def counting(frame: Any, quality: int) -> bytes:
        encoded.append(frame.sequence)
        return original(frame, quality)

    monkeypatch.setattr(jpeg_stream, "jpeg_message", counting)

    async def work() -> None:
        jpeg = JpegStream()
        jpeg.broadcaster.open()
        viewers = [asyncio.create_task(jpeg.broadcaster.next_message()) for _ in range(3)]
        await asyncio.sleep(0)
        assert jpeg.wants_frame
        jpeg.show(made_frame(MadeControls(), 3))
        messages = await asyncio.gather(*viewers)
        assert messages[0] is messages[1] is messages[2]
        assert encoded == [3]
        assert not jpeg.wants_frame
        # Nobody waits: a picture that comes all the same is not encoded.
        jpeg.show(made_frame(MadeControls(), 4))
        await asyncio.sleep(0.2)
        assert encoded == [3]
        jpeg.close()

    in_time(work)


def test_a_picture_that_nobody_waited_for_is_not_kept_for_later() -> None:
    async def work() -> None:
        jpeg = JpegStream()
        jpeg.broadcaster.open()
        jpeg.show(made_frame(MadeControls(), 4))
        while jpeg._newest.waiting:
            await asyncio.sleep(0.01)
        viewer = asyncio.create_task(jpeg.broadcaster.next_message())
        await asyncio.sleep(0.15)
        assert not viewer.done() and jpeg.wants_frame
        jpeg.show(made_frame(MadeControls(), 9))
        assert unpacked(await viewer)[0]["sequence"] == 9
        jpeg.close()

    in_time(work)


def test_a_failure_reaches_those_who_are_here_and_those_who_come_until_pictures_come_again() -> None:
    async def work() -> None:
        async with made_viewfinder() as made, aiohttp.ClientSession() as session:
            async with session.ws_connect(made.url + "stream") as stream:
                await stream.receive(timeout=5)
                made.jpeg.fail("the camera was unplugged")
                assert await stream.receive_json(timeout=5) == {"failure": "the camera was unplugged"}
                async with session.ws_connect(made.url + "stream") as later:
                    assert await later.receive_json(timeout=5) == {"failure": "the camera was unplugged"}
                    assert (await later.receive(timeout=5)).type is aiohttp.WSMsgType.BINARY
            async with session.ws_connect(made.url + "stream") as stream:
                assert (await stream.receive(timeout=5)).type is aiohttp.WSMsgType.BINARY

    in_time(work)


def test_a_picture_from_before_a_failure_never_follows_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """It would say that all is well again; here it is being encoded when the camera fails. The next picture is one of those that do."""
    encoding, failed = Event(), Event()
    original = jpeg_stream.jpeg_message

    def slow(frame: Any, quality: int) -> bytes:
        encoding.set()
        assert failed.wait(5.0)
        return original(frame, quality)

    monkeypatch.setattr(jpeg_stream, "jpeg_message", slow)

    async def work() -> None:
        jpeg = JpegStream()
        jpeg.broadcaster.open()
        viewer = asyncio.create_task(jpeg.broadcaster.next_message())
        await asyncio.sleep(0)
        jpeg.show(made_frame(MadeControls(), 3))
        assert await asyncio.to_thread(encoding.wait, 5.0)
        jpeg.fail("the camera was unplugged")
        failed.set()
        while not jpeg.wants_frame:
            await asyncio.sleep(0.01)
        assert not viewer.done() and jpeg.broadcaster.failure == "the camera was unplugged"
        jpeg.show(made_frame(MadeControls(), 9))
        assert unpacked(await viewer)[0]["sequence"] == 9 and jpeg.broadcaster.failure is None
        jpeg.close()

    in_time(work)


def test_too_many_viewers_and_floods_are_refused() -> None:
    async def work() -> None:
        async with made_viewfinder() as made, aiohttp.ClientSession() as session:
            sockets = [await session.ws_connect(made.url + "stream") for _ in range(16)]
            with pytest.raises(aiohttp.WSServerHandshakeError, match="503"):
                await session.ws_connect(made.url + "stream")
            for socket in sockets[1:]:
                await socket.close()
            for _ in range(700):
                if sockets[0].closed:
                    break
                await sockets[0].send_json({"ack": -1})
            while (message := await sockets[0].receive(timeout=5)).type is aiohttp.WSMsgType.BINARY:
                pass
            assert (message.type, message.data) == (aiohttp.WSMsgType.CLOSE, aiohttp.WSCloseCode.POLICY_VIOLATION)

    in_time(work)


def test_the_matte_is_a_grey_picture() -> None:
    async def work() -> None:
        async with made_viewfinder() as made, aiohttp.ClientSession() as session, session.get(made.url + "matte") as answer:
            matte = cv2.imdecode(np.frombuffer(await answer.read(), np.uint8), cv2.IMREAD_UNCHANGED)
            assert answer.content_type == "image/png" and matte.shape == (96, 160)
            assert matte[SQUARE].min() == 255 and matte.astype(int).sum() == 255 * 32 * 32

    in_time(work)

"""The server's stream and its controls: JPEG encoded once with one credit; what messages may say, what they do, and that a bad one changes
nothing."""

import asyncio
import json
import math
import time
from collections.abc import Iterator
from contextlib import closing
from threading import Event
from typing import Any
from unittest.mock import Mock

import aiohttp
import cv2
import numpy as np
import pytest

from mrbokeh.system.errors import InputError
from tests.support.made_viewfinder import LENS_RGB, SQUARE, MadeControls, made_frame, made_viewfinder
from tests.support.waiting import comes_true
from viewfinder.frames import frame_header
from viewfinder.server import jpeg_stream
from viewfinder.server.controls import (
    Capture,
    Choose,
    Dispatcher,
    FocusAtDistance,
    FocusAtPoint,
    MoveObject,
    SetFNumber,
    ShowObject,
    Switch,
    control_message,
)
from viewfinder.server.jpeg_stream import JpegStream, jpeg_message
from viewfinder.server.sessions import Role


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


async def test_pictures_come_one_by_one_and_only_as_long_as_somebody_waits() -> None:
    async with made_viewfinder() as made, aiohttp.ClientSession() as session:
        await asyncio.sleep(0.2)
        assert made.pictures.shown == 0 and not made.jpeg.wants_frame
        async with session.ws_connect(made.url + "stream") as stream:
            sequences = []
            for _ in range(6):
                header, bgr = unpacked((await stream.receive(timeout=5)).data)
                assert bgr.shape == (96, 160, 3)
                sequences.append(header["sequence"])
                # The credit is one: nothing more comes before the acknowledgement.
                with pytest.raises(TimeoutError):
                    await stream.receive(timeout=0.03)
                await stream.send_json({"ack": header["sequence"]})
            assert np.all(np.diff(sequences) > 0)
        before = made.pictures.shown
        # 8, not 6: the last acknowledgement asked for one more, and a picture may be on its way while that is heard.
        assert before <= 8
        await asyncio.sleep(0.2)
        assert made.pictures.shown <= before + 1 and not made.jpeg.wants_frame


@pytest.fixture
def jpeg() -> Iterator[JpegStream]:
    stream = JpegStream()
    yield stream
    stream.close()


async def test_three_viewers_share_one_encoding(jpeg: JpegStream, monkeypatch: pytest.MonkeyPatch) -> None:
    counting = Mock(side_effect=jpeg_stream.jpeg_message)
    monkeypatch.setattr(jpeg_stream, "jpeg_message", counting)
    jpeg.broadcaster.open()
    viewers = [asyncio.create_task(jpeg.broadcaster.next_message()) for _ in range(3)]
    await asyncio.sleep(0)
    assert jpeg.wants_frame
    jpeg.show(made_frame(MadeControls(), 3))
    messages = await asyncio.gather(*viewers)
    assert messages[0] is messages[1] is messages[2] and not jpeg.wants_frame
    # Nobody waits: a picture that comes all the same is not encoded, nor kept for later.
    jpeg.show(made_frame(MadeControls(), 4))
    await comes_true(lambda: not jpeg._newest.waiting)
    viewer = asyncio.create_task(jpeg.broadcaster.next_message())
    await asyncio.sleep(0.1)
    assert [each.args[0].sequence for each in counting.call_args_list] == [3] and not viewer.done() and jpeg.wants_frame
    jpeg.show(made_frame(MadeControls(), 9))
    assert unpacked(await viewer)[0]["sequence"] == 9


async def test_a_failure_reaches_those_who_are_here_and_those_who_come_until_pictures_come_again() -> None:
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


async def test_a_picture_from_before_a_failure_never_follows_it(jpeg: JpegStream, monkeypatch: pytest.MonkeyPatch) -> None:
    """It would say that all is well again; here it is being encoded when the camera fails. The next picture is one of those that do."""
    encoding, failed, original = Event(), Event(), jpeg_stream.jpeg_message

    def slow(frame: Any, quality: int) -> bytes:
        encoding.set()
        assert failed.wait(5.0)
        return original(frame, quality)

    monkeypatch.setattr(jpeg_stream, "jpeg_message", slow)
    jpeg.broadcaster.open()
    viewer = asyncio.create_task(jpeg.broadcaster.next_message())
    await asyncio.sleep(0)
    jpeg.show(made_frame(MadeControls(), 3))
    assert await asyncio.to_thread(encoding.wait, 5.0)
    jpeg.fail("the camera was unplugged")
    failed.set()
    await comes_true(lambda: jpeg.wants_frame)
    assert not viewer.done() and jpeg.broadcaster.failure == "the camera was unplugged"
    jpeg.show(made_frame(MadeControls(), 9))
    assert unpacked(await viewer)[0]["sequence"] == 9 and jpeg.broadcaster.failure is None


async def test_too_many_viewers_and_floods_are_refused() -> None:
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


async def test_the_matte_is_a_grey_picture() -> None:
    async with made_viewfinder() as made, aiohttp.ClientSession() as session, session.get(made.url + "matte") as answer:
        matte = cv2.imdecode(np.frombuffer(await answer.read(), np.uint8), cv2.IMREAD_UNCHANGED)
        assert answer.content_type == "image/png" and matte.shape == (96, 160)
        assert matte[SQUARE].min() == 255 and matte.astype(int).sum() == 255 * 32 * 32


GOOD = [
    ({"focus": {"distance_m": 2.5}}, FocusAtDistance(2.5), ("focus", 2.5)),
    ({"focus": {"distance_m": None}}, FocusAtDistance(math.inf), ("focus", math.inf)),
    ({"focus": {"at": [0.25, 1]}}, FocusAtPoint(0.25, 1.0), ("at", 0.25, 1.0)),
    ({"f_number": 2}, SetFNumber(2.0), ("f_number", 2.0)),
    ({"lens": "eighty"}, Choose("lens", "eighty"), ("lens", "eighty")),
    ({"renderer": "scatter"}, Choose("renderer", "scatter"), ("renderer", "scatter")),
    ({"view": "coc"}, Choose("view", "coc"), ("view", "coc")),
    ({"object": {"name": "lantern", "move_m": [0.1, -0.2]}}, MoveObject("lantern", (0.1, -0.2)), ("move", "lantern", 0.1, -0.2)),
    ({"object": {"name": "lantern", "visible": False}}, ShowObject("lantern", False), ("show", "lantern", False)),
    ({"capture": {}}, Capture(), ("capture",)),
    ({"record": True}, Switch("record", True), ("recording", True)),
    ({"smoothing": False}, Switch("smoothing", False), ("smoothing", False)),
]
MALFORMED = [
    *(None, [], 3, "focus", {}, {"focus": {"distance_m": 1}, "lens": "fifty"}, {"unknown": 1}, {"__class__": {}}),
    *({"focus": bad} for bad in (3, None, {}, {"distance_m": "2"}, {"distance_m": True}, {"distance_m": -1}, {"distance_m": 10**400})),
    *({"focus": bad} for bad in ({"distance_m": 1, "at": [0, 0]}, {"at": [0.5]}, {"at": [0.5, 1.01]}, {"at": [None, 0]}, {"at": "ab"})),
    *({"f_number": bad} for bad in (0, -2, "2.8", None, True, [2], 1e9)),
    *({"lens": bad} for bad in (None, 7, "", "x" * 81, "a\nb", "a\0b", ["fifty"], {"name": "fifty"})),
    *({"object": bad} for bad in ({}, {"name": "lantern"}, {"name": "lantern", "move_m": [1]}, {"name": "lantern", "visible": 1})),
    *(
        {"object": bad}
        for bad in ({"name": "lantern", "move_m": [1e3, 0]}, {"name": 3, "visible": True}, {"name": "x", "visible": True, "y": 1})
    ),
    *({"capture": bad} for bad in (None, True, {"path": "/etc/passwd"}, [])),
    *({verb: bad} for verb in ("record", "smoothing") for bad in (1, "true", None)),
]
# Well-formed, but of things that are not there; also names that would be paths.
UNKNOWN = [
    *({kind: name} for kind in ("lens", "renderer", "view") for name in ("absent", "../../etc/passwd", "/dev/video0", "fifty ")),
    {"object": {"name": "ghost", "move_m": [0, 0]}},
    {"object": {"name": "../lantern", "visible": True}},
]
NO_JSON = ["", "no json", "[" * 600, '{"f_number": NaN}', '{"f_number": Infinity}', '{"f_number": 2', '"\\ud800"', "\x00"]


async def test_each_message_is_read_and_carried_out() -> None:
    for value, message, asked in GOOD:
        assert control_message(value) == message
        controls = MadeControls()
        with closing(Dispatcher(controls)) as dispatcher:
            answer = await dispatcher.answer(json.dumps(value), Role.CONTROL, "here")
        assert answer["done"] == next(iter(value)) and controls.asked[0] == asked


def test_malformed_messages_are_named() -> None:
    for value in MALFORMED:
        with pytest.raises(InputError, match=r"^expected .*, got ") as problem:
            control_message(value)
        assert len(str(problem.value)) < 300


async def test_what_makes_no_sense_changes_nothing_whichever_way_it_comes() -> None:
    texts = NO_JSON + [json.dumps(value) for value in MALFORMED + UNKNOWN]
    async with made_viewfinder() as made, aiohttp.ClientSession() as session:
        for text in texts:
            # The limit per address has tests of its own.
            made.site.dispatcher._limit._left.clear()
            async with session.post(made.url + "control", data=text.encode("utf-8", "surrogatepass")) as answer:
                expected = 413 if len(text) > 1024 else 400
                assert answer.status == expected, text
                assert list(await answer.json()) == ["error"]
        async with session.ws_connect(made.url + "stream") as stream:
            await stream.receive(timeout=5)  # without its acknowledgement no other picture comes
            for text in texts:
                made.site.dispatcher._limit._left.clear()
                if len(text) < 1024:
                    await stream.send_str(text)
                    assert list(await stream.receive_json(timeout=5)) == ["error"], text
            await stream.send_bytes(b"\0\1\2")
            await stream.send_json({"f_number": 2.8})
            assert await stream.receive_json(timeout=5) == {"done": "f_number"}
        assert made.controls.asked == [("f_number", 2.8)]


async def test_answers_tell_what_was_found_and_what_cannot_be() -> None:
    async with made_viewfinder() as made, aiohttp.ClientSession() as session:

        async def post(message: Any) -> tuple[int, Any]:
            async with session.post(made.url + "control", json=message) as answer:
                return answer.status, await answer.json()

        assert await post({"focus": {"at": [0.2, 0.3]}}) == (200, {"done": "focus", "focus_distance_m": 1.5})
        assert await post({"capture": {}}) == (200, {"done": "capture", "bundle": "bundle_0001"})
        assert await post({"focus": {"distance_m": 0.1}}) == (400, {"error": "the lens cannot focus at 0.1 m: choose 0.3 m or more"})
        assert await post({"focus": {"at": [0.9, 0.3]}}) == (400, {"error": "there is no depth there: tap another place"})
        status, answer = await post({"lens": "none such"})
        assert status == 400 and "choose one of fifty, eighty" in answer["error"]
        async with session.get(made.url + "state") as state:
            shown = await state.json()
        assert (shown["focus_distance_m"], shown["lens"], shown["transports"], shown["matte"]) == (1.5, "fifty", ["jpeg"], True)


async def test_a_control_that_breaks_says_so_and_the_next_one_works(caplog: pytest.LogCaptureFixture) -> None:
    class Broken(MadeControls):
        def capture(self) -> str:
            raise OSError("/secret/path is full")

    dispatcher = Dispatcher(Broken())
    answer = await dispatcher.answer('{"capture": {}}', Role.CONTROL, "here")
    # The page learns nothing of this machine's paths.
    assert answer == {"error": "this failed in the viewfinder; see its terminal"}
    assert await dispatcher.answer('{"record": true}', Role.CONTROL, "here") == {"done": "record"}
    dispatcher.close()
    assert "/secret/path" in caplog.text


async def test_messages_are_carried_out_in_order_and_only_so_many_wait() -> None:
    class Slow(MadeControls):
        def set_f_number(self, f_number: float) -> None:
            time.sleep(0.02)
            super().set_f_number(f_number)

    with closing(Dispatcher(controls := Slow())) as dispatcher:
        texts = [json.dumps({"f_number": 1 + i}) for i in range(12)]
        answers = await asyncio.gather(*(dispatcher.answer(text, Role.CONTROL, "here") for text in texts))
    assert answers[:8] == [{"done": "f_number"}] * 8 and all("still busy" in answer["error"] for answer in answers[8:])
    assert controls.asked == [("f_number", 1.0 + i) for i in range(8)]


async def test_a_flood_of_messages_is_refused() -> None:
    with closing(Dispatcher(controls := MadeControls())) as dispatcher:
        answers = [await dispatcher.answer('{"record": true}', Role.CONTROL, "one") for _ in range(200)]
        # 80 at once and 40 per second; 200 take well below two seconds.
        assert 40 < sum("too many" in answer.get("error", "") for answer in answers) <= 120
        assert await dispatcher.answer('{"record": true}', Role.CONTROL, "another") == {"done": "record"}
    assert 81 <= len(controls.asked) < 162

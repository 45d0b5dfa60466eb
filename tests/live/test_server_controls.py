"""Control messages: what they may say, what they then do, and that a bad one changes nothing whichever way it came."""

import asyncio
import json
import math
import time
from typing import Any

import aiohttp
import pytest

from mrbokeh.system.errors import InputError
from tests.scenes.made_viewfinder import MadeControls, made_viewfinder
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
from viewfinder.server.sessions import Role

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


@pytest.mark.parametrize(("value", "message", "asked"), GOOD)
async def test_each_message_is_read_and_carried_out(value: Any, message: Any, asked: tuple[Any, ...]) -> None:
    assert control_message(value) == message
    controls = MadeControls()
    dispatcher = Dispatcher(controls)
    answer = await dispatcher.answer(json.dumps(value), Role.CONTROL, "here")
    assert answer["done"] == next(iter(value))
    dispatcher.close()
    assert controls.asked[0] == asked


@pytest.mark.parametrize("value", MALFORMED)
def test_malformed_messages_are_named(value: Any) -> None:
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

    controls = Slow()
    dispatcher = Dispatcher(controls)
    texts = [json.dumps({"f_number": 1 + i}) for i in range(12)]
    answers = await asyncio.gather(*(dispatcher.answer(text, Role.CONTROL, "here") for text in texts))
    assert answers[:8] == [{"done": "f_number"}] * 8
    assert all("still busy" in answer["error"] for answer in answers[8:])
    assert controls.asked == [("f_number", 1.0 + i) for i in range(8)]
    dispatcher.close()


async def test_a_flood_of_messages_is_refused() -> None:
    controls = MadeControls()
    dispatcher = Dispatcher(controls)
    answers = [await dispatcher.answer('{"record": true}', Role.CONTROL, "one") for _ in range(200)]
    refused = sum("too many" in answer.get("error", "") for answer in answers)
    # 80 at once and 40 per second; 200 take well below two seconds.
    assert 40 < refused <= 120
    assert await dispatcher.answer('{"record": true}', Role.CONTROL, "another") == {"done": "record"}
    dispatcher.close()
    assert 81 <= len(controls.asked) < 162

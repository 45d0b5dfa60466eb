"""`mrbokeh serve` as compositors meet it: a process of its own, asked by the client that hosts carry."""

import http.client
import json
import signal
import stat
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mrbokeh
from mrbokeh.commands.serve import Blurring, _answered
from mrbokeh.hosts.client import Refused, ask, blurred
from mrbokeh.images.exr_io import ExrPart, read_exr, write_exr
from mrbokeh.images.image_io import write_image, write_layer
from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import lens_to_json, write_lens
from tests.hosts.conftest import started
from tests.support.command_line import mrbokeh as command

SIZE = (36, 48)
LENS = Lens(50.0, 1.4, 2.0, 36.0)


@pytest.fixture
def scene(tmp_path: Path) -> tuple[np.ndarray, np.ndarray]:
    """A card at 1 m before a wall at 4 m, as arrays and in files."""
    rgb = np.random.default_rng(0).uniform(0.0, 1.0, (*SIZE, 3)).astype(np.float32)
    depth_m = np.full(SIZE, 4.0, np.float32)
    depth_m[10:26, 12:30] = 1.0
    write_image(tmp_path / "sharp.exr", rgb, half=False)
    write_exr(tmp_path / "z.exr", ExrPart({"Z": depth_m}))
    write_lens(tmp_path / "lens.json", LENS)
    return rgb, depth_m


def test_the_bits_are_those_of_the_command(connection: str, tmp_path: Path, scene: tuple[np.ndarray, np.ndarray]) -> None:
    rgb, depth_m = scene
    given = ("--rgb", tmp_path / "sharp.exr", "--depth", tmp_path / "z.exr", "--lens", tmp_path / "lens.json")
    done = command("render", *given, "--f-number", 2, "--focus", 1, "--renderer", "low-rank", "--out", tmp_path / "command.exr")
    assert done.returncode == 0, done.stderr
    wanted = read_exr(tmp_path / "command.exr")[0].stacked("RGB")
    request: dict[str, Any] = {"what": "render", "f_number": 2, "focus": 1, "renderer": "low-rank"}
    files = {"picture": str(tmp_path / "sharp.exr"), "depth": str(tmp_path / "z.exr"), "lens": str(tmp_path / "lens.json")}
    answer = ask({**request, **files, "out": str(tmp_path / "served.exr")}, connection)
    assert answer["out"] == str(tmp_path / "served.exr") and answer["size"] == [48, 36] and 0.0 < answer["seconds"] < 60.0
    assert answer["facts"] == {"focal_length_mm": 50.0, "f_number": 2.0, "focus_distance_m": 1.0, "sensor_width_mm": 36.0}
    np.testing.assert_array_equal(read_exr(tmp_path / "served.exr")[0].stacked("RGB"), wanted)
    # Through memory all 32 bits come back, which EXR rounds to 16; the lens goes as its description.
    result, _ = blurred(rgb, depth_m, lens=lens_to_json(LENS), connection=connection, **request)
    np.testing.assert_array_equal(result.astype(np.float16).astype(np.float32), wanted)
    np.testing.assert_array_equal(result, mrbokeh.render(rgb, depth_m, Lens(50.0, 2.0, 2.0, 36.0), focus=1.0, renderer="low-rank"))
    # One EXR with both, as Blender names its channels; the focus on a pixel of the card, which is at 1 m.
    planes = {f"ViewLayer.Combined.{name}": rgb[..., i] for i, name in enumerate("RGB")}
    write_exr(tmp_path / "both.exr", ExrPart({**planes, "ViewLayer.Combined.A": np.ones_like(depth_m), "ViewLayer.Depth.Z": depth_m}))
    both = {"picture": str(tmp_path / "both.exr"), "lens": str(tmp_path / "lens.json"), "out": str(tmp_path / "served.exr")}
    ask({**request, **both, "focus": [20, 20], "overwrite": True}, connection)
    np.testing.assert_array_equal(read_exr(tmp_path / "served.exr")[0].stacked("RGB"), wanted)


def test_layers_are_composited(connection: str, tmp_path: Path, scene: tuple[np.ndarray, np.ndarray]) -> None:
    rgb, depth_m = scene
    layer = Layer(np.full((*SIZE, 3), 0.4, np.float32), np.full(SIZE, 0.5, np.float32), np.full(SIZE, 2.0, np.float32))
    write_layer(tmp_path / "layer.exr", layer, half=False)
    wanted = mrbokeh.composite(rgb, layer, LENS, depth_m=depth_m)
    files = {"depth": str(tmp_path / "z.exr"), "lens": str(tmp_path / "lens.json"), "insert": [str(tmp_path / "layer.exr")]}
    request = {"what": "composite", "picture": str(tmp_path / "sharp.exr"), "out": str(tmp_path / "put_in.exr"), **files}
    ask(request, connection)
    np.testing.assert_array_equal(read_exr(tmp_path / "put_in.exr")[0].stacked("RGB"), wanted.astype(np.float16).astype(np.float32))


def test_two_at_once_wait_for_one_another(connection: str, scene: tuple[np.ndarray, np.ndarray]) -> None:
    """And each caller gets its own: a nearer focus and a farther one."""
    rgb, depth_m = scene
    with ThreadPoolExecutor(4) as callers:
        asked = [callers.submit(blurred, rgb, depth_m, what="render", focus=focus, connection=connection) for focus in (1, 4, 1, 4)]
        found = [each.result()[0] for each in asked]
    for result, focus in zip(found, (1.0, 4.0, 1.0, 4.0), strict=True):
        np.testing.assert_array_equal(result, mrbokeh.render(rgb, depth_m, Lens.default(), focus=focus))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"what": "guess"}, "what: expected"),
        ({"pixels": 3}, "unknown .'pixels'"),
        ({"picture": "none.exr"}, "there is no such file"),
        ({"picture": {"memory": __file__, "shape": [1], "dtype": "float32"}}, "begins with mrbokeh-"),
        ({"depth": "none.exr"}, "there is none"),
        ({"depth": "sharp.exr"}, "expected depth in a channel"),
        ({"lens": "none.json"}, "expected a lens"),
        ({"lens": {"focal_length_mm": -1}}, "lens of the request"),
        ({"f_number": "two"}, "expected a number"),
        ({"f_number": -2}, "must be above 0"),
        ({"focus": 0.01}, "cannot focus at 0.01 m"),
        ({"focus": [900, 900]}, "cannot focus at pixel"),
        ({"renderer": "magic"}, "expected a renderer"),
        ({"out": "a.bmp"}, "expected a name that ends in"),
        ({"out": "sharp.exr"}, "is read and would be written over"),
        ({"out": "nan.exr"}, "exists already"),
        ({"picture": "nan.exr"}, "NaN"),
    ],
)
def test_mistakes_are_one_sentence(
    change: dict[str, Any], said: str, connection: str, tmp_path: Path, scene: tuple[np.ndarray, np.ndarray]
) -> None:
    write_image(tmp_path / "nan.exr", np.where(scene[0] > 0.5, np.float32(np.nan), scene[0]))
    request = {"what": "render", "picture": "sharp.exr", "depth": "z.exr", "lens": "lens.json", "out": "new.exr", **change}
    placed = {
        key: str(tmp_path / value) if isinstance(value, str) and value.endswith((".exr", ".json", ".bmp")) else value
        for key, value in request.items()
    }
    with pytest.raises(Refused, match=said) as refused:
        ask(placed, connection)
    assert "\n" not in str(refused.value) and "fault of mrbokeh" not in str(refused.value) and not (tmp_path / "new.exr").exists()
    assert "mrbokeh" in ask({}, connection)


@pytest.mark.parametrize("key", ["picture", "depth", "lens", "f_number", "focus", "insert", "slice", "at_pixel", "height", "mode", "out"])
def test_values_that_nobody_means_are_no_faults(key: str, tmp_path: Path, scene: tuple[np.ndarray, np.ndarray]) -> None:
    """Refused by what the key expects, else in the end, for what is inserted has no colour; in this process, for there are many."""
    scene[0].tofile(tmp_path / "mrbokeh-rgb")
    memory = {"memory": str(tmp_path / "mrbokeh-rgb"), "shape": [10**9, 10**9], "dtype": "float32"}
    request = {"what": "composite", "depth": str(tmp_path / "z.exr"), "lens": "fast-50", "insert": [str(tmp_path / "z.exr")]}
    request |= {"picture": str(tmp_path / "sharp.exr"), "out": str(tmp_path / "o.exr")}
    blurring = Blurring()
    for value in (True, -1, 1e300, float("nan"), 10**400, "\0", "a" * 5000, [], ["a", "b"], [[1, 2, 3]], {"a": 1}, memory, str(tmp_path)):
        status, answer = _answered(blurring, {**request, key: value})
        assert status == 400 and "\n" not in answer["error"], (value, answer)


def test_strangers_and_broken_requests_are_sent_away(connection: str) -> None:
    """Without the token, or by another name (a page in a browser that a name server led here), or with something that is no JSON."""
    told = json.loads(Path(connection).read_text())
    right = {"Authorization": f"Bearer {told['token']}"}
    assert stat.S_IMODE(Path(connection).stat().st_mode) == 0o600

    def status(body: bytes, headers: dict[str, str]) -> tuple[int, str]:
        caller = http.client.HTTPConnection("127.0.0.1", told["port"], timeout=10)
        caller.request("POST", "/", body, headers)
        answer = caller.getresponse()
        return answer.status, json.loads(answer.read())["error"]

    assert status(b"{}", {})[0] == status(b"{}", {"Authorization": "Bearer x"})[0] == 403
    assert status(b"{}", {**right, "Host": "evil.example"})[0] == 403
    for body in (b"{", b"[]", b"\xff", b"[" * 100_000):
        assert status(body, right)[0] == 400
    assert status(b"", {**right, "Content-Length": "999999999"})[0] == 400
    assert "mrbokeh" in ask({}, connection)


def test_one_server_by_one_file_and_only_where_a_file_may_be(connection: str, tmp_path: Path) -> None:
    done = command("serve", "--connection", connection)
    assert done.returncode == 2 and "another `mrbokeh serve` is running" in done.stderr
    (tmp_path / "mine.json").write_text('{"a": 1}')
    done = command("serve", "--connection", tmp_path / "mine.json")
    assert done.returncode == 2 and "is no connection file" in done.stderr and (tmp_path / "mine.json").read_text() == '{"a": 1}'
    port = json.loads(Path(connection).read_text())["port"]
    done = command("serve", "--port", port, "--connection", tmp_path / "other.json")
    assert done.returncode == 2 and f"cannot listen at port {port}" in done.stderr and not (tmp_path / "other.json").exists()
    with pytest.raises(Refused, match="start `mrbokeh serve`"):
        ask({}, str(tmp_path / "none.json"))


def test_ctrl_c_ends_it_within_two_seconds_in_the_middle_of_a_picture(tmp_path: Path) -> None:
    """The exact renderer, at f/1.4 on 1600x1200 px, works for minutes."""
    path = tmp_path / "server.json"
    path.write_text(json.dumps({"format": "mrbokeh-server", "port": 1, "token": "of one that was killed"}))
    server = started(path)
    with pytest.raises(Refused, match="what: expected"):
        ask({"what": "guess"}, str(path))
    rgb, depth_m = np.full((1200, 1600, 3), 0.5, np.float32), np.full((1200, 1600), 4.0, np.float32)
    with ThreadPoolExecutor(1) as callers:
        asked = callers.submit(blurred, rgb, depth_m, what="render", renderer="scatter", focus=0.3, f_number=1.4, connection=str(path))
        time.sleep(0.6)
        assert not asked.done()
        server.send_signal(signal.SIGINT)
        begun_s = time.monotonic()
        said, _ = server.communicate(timeout=5)
        assert time.monotonic() - begun_s < 2.0 and server.returncode == 130 and not path.exists()
        assert "refused: what: expected" in said and "stopped: 0 pictures blurred" in said
        with pytest.raises(Refused, match="ended before it had"):
            asked.result(timeout=5)

"""`mrbokeh viewfinder` and `mrbokeh viewfinder board` as their user meets them: refusals, starting, ending, and what they leave behind."""

import inspect
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from importlib import import_module
from pathlib import Path
from threading import enumerate as threads
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import aiohttp
import numpy as np
import pytest
from typer.main import get_command
from typer.testing import CliRunner

from mrbokeh.cli import SUB_COMMANDS
from mrbokeh.commands.doctor import SHOWN
from mrbokeh.images.image_io import write_layer
from mrbokeh.images.layer import clear
from mrbokeh.optics.camera import camera_to_json
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.system.atomic_files import write_json
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.charuco.board import CharucoBoard, CharucoGrid, read_board, write_board
from tests.support.command_line import mrbokeh, printed_by
from tests.support.layer_viewfinder import control, watching
from tests.support.phone_on_camera import PHONE
from tests.support.refusals import refused
from tests.support.renderer_banks import bank_folder
from tests.support.thin_lens_board import Shot, camera_over, display_bgr, photograph
from viewfinder.app.live_compositor import LiveCompositor
from viewfinder.app.opening import read_lenses, renderers_of
from viewfinder.app.running import Preparing, opened
from viewfinder.cli import app, board_command
from viewfinder.frames import CameraFrame
from viewfinder.options import TrackingOptions, ViewfinderOptions
from viewfinder.server.access import Access

ROOT = Path(__file__).resolve().parents[2]
DOC = ROOT / "docs" / "viewfinder.md"
BOARD = CharucoBoard((CharucoGrid((6, 4), 30.0, 22.0),))
LENS = Lens(35.0, 2.8, 1.0, 23.5)
WIDTH_PX, HEIGHT_PX = 480, 270


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """With layer.exr, lens.json, board.json, pose.json, and bad.json, which is none of them; bad.toml is no scene."""
    write_layer(tmp_path / "layer.exr", clear(HEIGHT_PX, WIDTH_PX))
    write_lens(tmp_path / "lens.json", LENS)
    write_board(tmp_path / "board.json", BOARD)
    write_json(tmp_path / "pose.json", camera_to_json(PHONE))
    write_json(tmp_path / "bad.json", {"what": 1})
    (tmp_path / "bad.toml").write_text('[[object]]\nname = "lamp"\nglb = "none.glb"\n')
    (tmp_path / "rig.json").write_text("{}")
    return tmp_path


GIVEN = "--layer layer.exr --lens lens.json"
# What the command line says (after --source test) and what the refusal must say. The camera must not be opened before.
REFUSED = {
    "": "either --scene SCENE.toml or --layer", f"{GIVEN} --scene bad.toml": "either --scene SCENE.toml or --layer",
    "--layer layer.exr": "expected a lens, got none", "--layer layer.exr --lens none.json": "none.json",
    "--layer layer.exr --lens bad.json": "bad.json", "--layer none.exr --lens lens.json": "none.exr",
    "--scene bad.toml --lens lens.json": "none.glb",
}  # fmt: skip
REFUSED |= {f"{GIVEN} {more}": sentence for more, sentence in {
    "--scene-renderer vulkan": "--scene-renderer: expected one of auto, wgpu, embree",
    "--scene-renderer embree": "leave --scene-renderer out",
    "--max-rate -1": "--max-rate: expected a positive number", "--renderer magic": "--renderer: expected one of polygon",
    "--renderer polygon --renderer none.onnx": "no such file", "--renderer here": "--renderer: expected one of",
    "--board bad.json": "bad.json", "--pose bad.json": "expected width_px", "--camera none.json": "none.json",
    "--board board.json --pose pose.json": "got --board and --pose: give one",
    "--opentrackio 5000 --freed 5001": "got --opentrackio and --freed: give one",
    "--lens-table a.csv": "--lens-table is for the encoders of --freed",
    "--lens-table a.csv --opentrackio 5000": "--lens-table is for the encoders of --freed",
    "--metres-per-unit 2": "--metres-per-unit is the scale of a --map",
    "--map here --metres-per-unit -2": "--metres-per-unit: expected a number above 0", "--rig rig.json": "--rig is for --phone",
    "--phone-camera pose.json": "--phone-camera is for --phone", "--phone 0 --phone-camera pose.json": "--phone needs --rig RIG.json",
    "--phone 0 --rig rig.json": "--phone needs --phone-camera CAMERA.json",
    "--phone 0 --rig rig.json --phone-camera pose.json": "--phone needs --board",
    "--phone 0 --rig rig.json --phone-camera pose.json --board board.json": "not a phone rig",
    "--phone test --rig rig.json --phone-camera pose.json --board board.json": "are both test",
    "--phone 0 --rig rig.json --phone-camera pose.json --freed 5000": "--freed and --phone",
    "--delay 20": "--delay is for poses that come from elsewhere",
    "--board board.json --delay 20": "--delay is for poses that come from elsewhere", "--smooth": "--smooth needs a track",
    "--smooth --pose pose.json": "--smooth needs a track",
    "--focus-from luck": "--focus-from: expected one of hand, tracking, source, board",
    "--focus-from board": "--focus-from board needs --board", "--focus-from tracking": "--focus-from tracking needs a tracking system",
    "--focus-from tracking --freed 5000": "needs --lens-table", "--interface eth0": "--interface eth0 is for --lan",
    "--tls-key key.pem": "--tls-key is for --tls", "--tls none.pem": "there is no certificate file none.pem",
    "--lan --interface nowhere0": "there is no interface 'nowhere0'",
}.items()}  # fmt: skip


@pytest.fixture
def in_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command runs there in this process; the checks of the tests do not know typer's Context."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr(app.registered_callback, "callback", inspect.unwrap(app.registered_callback.callback))  # type: ignore[union-attr]


@pytest.mark.usefixtures("in_folder")
def test_what_cannot_be_is_refused_before_a_camera_is_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    def opens(*_: object) -> None:
        raise RuntimeError("a camera was opened")

    monkeypatch.setattr("viewfinder.app.opening.open_source", opens)
    for line, sentence in REFUSED.items():
        refused = CliRunner().invoke(app, ["--source", "test", *shlex.split(line)]).exception
        assert isinstance(refused, InputError) and sentence in str(refused) and "\n" not in str(refused), (line, refused)
    with pytest.raises(RuntimeError, match="a camera was opened"):
        printed_by(app, "--source", "test", *shlex.split(f"{GIVEN} --board board.json --focus-from board --smooth"))


def test_a_bank_among_the_lenses_brings_its_renderer(folder: Path) -> None:
    """Alone it is spread by the renderers that are named; beside other lenses the page switches to it by its name."""
    bank, lens = bank_folder(folder / "heart.bank", LENS), folder / "lens.json"
    book, brought = read_lenses([bank, lens], None)
    assert book.names == ["heart.bank", "lens"] and book.lens.facts == LENS.facts
    made: dict[str, Any] = {name: make() for name, make in renderers_of([], [bank, lens], brought).items()}
    assert {name: each.bank is not None for name, each in made.items()} == {"heart.bank": True, "polygon": False}
    (laplacian,) = renderers_of(["laplacian"], [bank], brought).values()
    spread: Any = laplacian()
    assert spread.bank is not None
    refused("is for --renderer polygon", renderers_of, ["lrdm"], [bank], brought)


@pytest.mark.usefixtures("in_folder")
def test_a_refusal_is_one_sentence_and_code_2() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        for more, sentence in (("--renderer magic", "--renderer: expected one of polygon"), (f"--port {port}", "another one with --port")):
            done = mrbokeh("viewfinder", "--source", "test", *shlex.split(f"{GIVEN} {more}"))
            assert (done.returncode, done.stdout) == (2, "")
            assert done.stderr.startswith("error: ") and sentence in done.stderr and "Traceback" not in done.stderr


@contextmanager
def command(folder: Path, *words: str, before: str = "") -> Iterator["subprocess.Popen[str]"]:
    """`mrbokeh viewfinder` with the layer and the lens of the folder, run in it; before: Python that runs first."""
    arguments = ["viewfinder", "--source", "test", *shlex.split(GIVEN), "--port", "0", *words]
    program = f"import sys; sys.argv = ['mrbokeh', *{arguments!r}]\n{before}\nfrom mrbokeh.cli import main; main()"
    environment, streams = os.environ | {"PYTHONPATH": str(ROOT)}, {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-u", "-c", program], cwd=folder, env=environment, text=True, **streams) as process:
        try:
            yield process
        finally:
            process.kill()


_SLOW_CAMERA = """
import time, viewfinder.app.opening as opening
def slowly(*_):
    print("opening", flush=True)
    time.sleep(60)
opening.open_source = slowly
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGINT for another process")
def test_ctrl_c_while_it_starts_ends_it_cleanly(folder: Path) -> None:
    """While the camera is being opened; the tracker's and the layer's threads run by then."""
    with command(folder, "--board", "board.json", before=_SLOW_CAMERA) as process:
        assert process.stdout.readline() == "opening\n"
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=30)
    assert (process.returncode, output, errors) == (0, "viewfinder stopped\n", "")


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGTERM for another process")
async def test_the_command_serves_until_it_is_stopped_and_writes_to_the_captures_only(folder: Path) -> None:
    """A capture and a recording, and nothing else is new in the folder where it ran."""
    before = {path.name for path in folder.iterdir()}
    with command(folder, "--captures", "shots/today") as process:
        url = next(word for word in process.stdout.readline().split() if word.startswith("http://"))
        assert url.startswith("http://127.0.0.1:")
        async with watching(url) as viewer, aiohttp.ClientSession() as session:
            assert (await viewer.frame()).bgr.shape == (HEIGHT_PX, WIDTH_PX, 3)
            async with session.get(url) as page:
                assert "viewport" in await page.text()
            for message in ({"record": True}, {"capture": {}}, {"record": False}):
                assert (await control(url, message))[0] == 200
            process.send_signal(signal.SIGTERM)
            while (await viewer.stream.receive(timeout=5)).type is aiohttp.WSMsgType.BINARY:
                pass
            assert viewer.stream.close_code == aiohttp.WSCloseCode.GOING_AWAY
        output, errors = process.communicate(timeout=30)
    assert (process.returncode, errors) == (0, "")
    assert re.fullmatch(r"saved viewfinder-\d{8}-\d{6}\.mp4 \(\d+ s\)\nviewfinder stopped\n", output)
    assert {path.name for path in folder.iterdir()} == before | {"shots"}
    assert [path.name for path in (folder / "shots").iterdir()] == ["today"]
    assert "" in {path.suffix for path in (folder / "shots" / "today").iterdir()}, "the bundle is a folder"


def test_a_part_that_fails_closes_those_before_it(folder: Path) -> None:
    """The layer's and the board's threads run when the camera turns out not to be there; the overlays when the tracker fails."""
    before = set(threads())
    good = ViewfinderOptions("none.mkv", layer=folder / "layer.exr", lenses=(folder / "lens.json",), captures=folder)
    by_board = replace(good, tracking=TrackingOptions(board=folder / "board.json"))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        by_freed = replace(good, tracking=TrackingOptions(freed=taken.getsockname()[1]))
        in_board = replace(good, tracking=TrackingOptions(board=folder / "bad.json"))
        for options, sentence in ((by_board, "none of them"), (by_freed, "cannot listen"), (in_board, "bad.json")):
            with pytest.raises(InputError, match=sentence), opened(options, Access()):
                pass
            assert set(threads()) <= before
    with opened(replace(by_board, source="test"), Access()):
        assert {"board detection", "static layer", "capture", "composite"} <= {each.name for each in threads()}
    assert set(threads()) <= before


def test_a_browser_camera_behind_a_layer_can_be_sent(folder: Path) -> None:
    options = ViewfinderOptions("whip", layer=folder / "layer.exr", lenses=(folder / "lens.json",), captures=folder)
    with opened(options, Access()) as running:
        assert "whip" in running.site.parts


def test_a_board_to_print(tmp_path: Path) -> None:
    """The markers span six blurs: at f/2.8 and half a dioptre from the focus the blur of this lens is 17 px of 1280."""
    write_lens(tmp_path / "lens.json", LENS)
    words = ["--lens", tmp_path / "lens.json", "--near", "0.8", "--far", "1.2", "--out", tmp_path / "board.pdf"]
    told = printed_by(board_command, *words)
    assert "print it at 100 %" in told and "blurs" in told and (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")
    marker_px = LENS.focused_at(1.2).focal_px(1280) * read_board(tmp_path / "board.json").grids[0].marker_mm / 1000 / 0.8
    assert marker_px >= 6.0 * abs(float(LENS.coc_px(0.8, 1280)))
    refused("--overwrite", printed_by, board_command, *words)
    printed_by(board_command, *words, "--overwrite")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("--out board.png", "ends in .pdf"),
        ("--out board.pdf --near 2 --far 1", "2"), ("--out board.pdf --paper napkin", "napkin"),
        ("--out board.pdf --lens lens.json --near 0.2 --far 30", "no paper holds a board"),
    ],
)  # fmt: skip
def test_boards_that_cannot_be(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: str, sentence: str) -> None:
    monkeypatch.chdir(tmp_path)
    write_lens(tmp_path / "lens.json", replace(LENS, f_number=1.0))
    refused(re.escape(sentence), printed_by, board_command, *words.split())
    assert [path.name for path in tmp_path.iterdir()] == ["lens.json"]


@cache
def board_picture(f_number: float) -> np.ndarray:
    lens = replace(LENS.focused_at(FOCUS_M), f_number=f_number)
    camera = camera_over(BOARD, lens, WIDTH_PX, HEIGHT_PX, 0.45, 35.0)
    return display_bgr(photograph(BOARD, Shot(lens, camera), 48))


FOCUS_M = 1 / 1.5
"""The board lies at 2.0 to 2.4 dioptres."""


def test_focus_from_the_blur_of_the_board_follows_the_page(folder: Path) -> None:
    """Two photographs with the same focus, the second stopped down by two stops, which the page is told, by f-number or by lens.

    Told wrongly, half the blur would mean half the way: about 1.85 in place of 1.5 dioptres. (What is left is 0.01 at f/2.8 and 0.09
    at f/5.6, for these pictures are sharper than the camera that the solver expects.) The lens's files have the focus, as it breathes.
    """
    lenses = {2.8: folder / "lens.json", 5.6: folder / "stopped.json"}
    for f_number, path in lenses.items():
        write_lens(path, replace(LENS.focused_at(FOCUS_M), f_number=f_number))
    tracking = TrackingOptions(board=folder / "board.json")
    files = {"layer": folder / "layer.exr", "lenses": tuple(lenses.values()), "captures": folder}
    with opened(ViewfinderOptions("test", tracking=tracking, focus_from=("board",), **files), Access()) as running:
        controls = running.site.controls
        assert controls.state()["focus_from"] is None, "before the first picture"
        running.pipeline.__exit__()  # while it prepares, it composites in a thread of its own, and one tracker takes frames of one thread
        steps: list[tuple[float, Callable[[], None]]] = [
            (2.8, lambda: None), (5.6, lambda: controls.set_f_number(5.6)), (2.8, lambda: controls.set_lens("lens")),
        ]  # fmt: skip
        for f_number, tell in steps:
            tell()
            state = solved(running, board_picture(f_number))
            assert state["focus_from"] == "blur of the board" and state["f_number"] == f_number
            assert 1 / state["focus_distance_m"] == pytest.approx(1 / FOCUS_M, abs=0.12)
        controls.focus_at_distance(3.0)
        assert solved(running, board_picture(5.6))["focus_distance_m"] != 3.0, "the board was named first"


def solved(running: Any, bgr: np.ndarray) -> dict[str, Any]:
    """The state once the focus came from the board, but not from an answer of an earlier picture."""
    blur, deadline_s = running.compositor.focus._sources[0].blur, time.monotonic() + 20.0
    sequence, old = 0, blur.answer
    for forgotten in (True, False):
        # The change of the lens arrives with a picture; then the answer is a new one.
        while time.monotonic() < deadline_s:
            sequence += 1
            running.compositor(CameraFrame(bgr, time.monotonic(), sequence), 0)
            if forgotten or (blur.answer is not None and blur.answer is not old):
                break
            time.sleep(0.02)
    running.compositor(CameraFrame(bgr, time.monotonic(), sequence + 1), 0)
    return running.site.controls.state()


def test_every_command_of_the_guide_is_one() -> None:
    """Parsed as the command line would be: unknown options, missing ones and values of a wrong kind are refused. Nothing is run."""
    blocks = re.findall(r"^```sh\n(.*?)^```", DOC.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    joined = [line.split(" # ")[0].strip() for block in blocks for line in block.replace("\\\n", "").splitlines()]
    lines = [line for line in joined if line.startswith("mrbokeh ")]
    assert len(lines) >= 15
    for line in lines:
        words = shlex.split(line)[1:]
        name = words.pop(0)
        parsed = get_command(import_module(SUB_COMMANDS[name].module).app)
        while words and words[0] in getattr(parsed, "commands", {}):
            name = words.pop(0)
            parsed = parsed.commands[name]  # type: ignore[attr-defined]
        parsed.make_context(name, words)


def test_the_guide_names_every_option() -> None:
    text, group = DOC.read_text(encoding="utf-8"), get_command(app)
    options = {option for parameter in group.params for option in parameter.opts if option.startswith("--")}
    missing = {option for option in options - {"--help", "--renderer"} if option not in text}
    assert not missing, missing


def test_a_busy_machine_has_frames_and_not_only_seconds_to_show_its_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    """After the scene is drawn: 5 seconds and 100 frames without anything virtual, then nobody waits for it any longer."""
    now_s, nothing = 0.0, SimpleNamespace(rgb=np.zeros((0, 0, 3)))
    monkeypatch.setattr("time.monotonic", lambda: now_s)
    compositor = Mock(spec=LiveCompositor, overlays=SimpleNamespace(status=SimpleNamespace(busy=True)), last=None)
    preparing = Preparing(compositor)
    now_s = 60.0
    assert preparing(), "it is still drawn"
    compositor.overlays.status.busy = False
    for _ in range(100):
        now_s += 1.0
        compositor.last = SimpleNamespace(overlay=nothing)
        assert preparing() and preparing()
    compositor.last = SimpleNamespace(overlay=nothing)
    assert not preparing()
    # A fast machine has its 100 frames and more within the seconds: these count then.
    compositor.overlays.status.busy = True
    assert preparing(), "another scene is drawn"
    compositor.overlays.status.busy = False
    for _ in range(150):
        compositor.last = SimpleNamespace(overlay=nothing)
        now_s += 4.9 / 150
        assert preparing()
    now_s += 0.2
    assert not preparing()


@pytest.mark.usefixtures("in_folder")
def test_the_demo_is_shown_before_anybody_watches_and_ends_with_ctrl_c() -> None:
    """The shipped clip, board, lens and cake; the terminal says when the scene lies over a frame, which happens without a viewer."""
    command = [sys.executable, "-m", "mrbokeh.cli", "viewfinder", "--demo", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout is not None
        told = []
        for line in process.stdout:
            told.append(line.strip())
            if line.startswith(SHOWN):
                process.send_signal(signal.SIGINT)
    assert process.returncode == 0 and SHOWN in told and told[-1] == "viewfinder stopped", told
    done = mrbokeh(*command[3:], "--source", "test")
    assert done.returncode == 2 and "give one of them" in done.stderr

"""Every option of every command with values that nobody means, made from its type: one sentence, exit code 2, and no file lost."""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.main import get_command

from mrbokeh.cli import SUB_COMMANDS
from mrbokeh.images.image_io import write_image, write_layer
from mrbokeh.images.layer import Layer, opaque
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.stacks.focal_stack import FocalStack, Slice, write_focal_stack, write_merged
from tests.support.command_line import mrbokeh

LONGEST_S = 240
"""Wall time of one case, on a busy machine too: two of matchmove solve the whole clip."""
LIVE = Path(__file__).resolve().parents[2] / "mrbokeh" / "demo_data" / "live"
ALIEN = LIVE.parent / "objects" / "alien.glb"
SHARP = "--rgb sharp.exr --depth sharp.exr --lens lens.json"
BASES = {
    "render": f"{SHARP} --out out.exr",
    "composite": "photo.png --lens lens.json --depth sharp.exr --layer layer.exr --out out.exr",
    "video": f"{LIVE}/clip.mp4 --layer wide.exr --lens lens.json --frames 0 --out out.mp4",
    "transfer": "sharp.exr --depth sharp.exr --lens lens.json --out out.exr",
    "tilt-shift": "photo.png --out out.exr",
    "dataset synthesize": "stack --slices 2 --workers 1 --out set",
    "refocus": "stack --focus 1.5 --out refocused",
    "check": "photo.png",
    "lens new": "new.json --focal-length 50 --f-number 2 --focus 1",
    "lens coc": "lens.json 1 2",
    "lens show": "lens.json --out lens.png",
    "lens psf": "simple --diameter 8 --counts 3 --out bank",
    "lens export": "kept_bank --out kernels",
    "lens fit": "stack --out fitted.json",
    "lens match": "photo.png --focal-length 50 --f-number 2 --sensor-width 36 --out matched.json",
    "track convert": "camera.json out.chan",
    "track clip": f"{LIVE}/clip.mp4 --board {LIVE}/board.json --calibrate --out track.json",
    "capture plan": "lens.json --near 0.5 --far 3 --image-width 640",
    "capture solve": "photo.png --out solved.json",
    "capture ingest": "photographs --out scene",
    "capture process": "photographs --out scene",
    "capture merge": "stack",
    "capture scale": "stack --ruler 1,1,20,20,0.1",
    "capture report": "stack",
    "capture dataset": "stack --licence CC0 --out set",
    "capture matchmove": f"{LIVE}/clip.mp4 --out track.json",
    "train fit": "stack --minutes 0.05 --out run",
    "train evaluate": "none.onnx stack --out evaluation",
    "train export": "kept_run --out lens.onnx",
    "train ablate": "stack --out table",
    "train doctor": "kept_run",
    "viewfinder board": "--out board.pdf",
    "studio": "missing.jpg",
    "host": "blender --out addons",
}
"""Arguments with which each command would work, or is refused late; commands that are not here get none."""
ENDLESS = {"viewfinder", "capture shoot", "capture cameras"}
"""Commands that go on for ever or ask cameras: their options are tried with a required one missing."""
OF_KIND = {
    "integer": ("x", "-99999999", "99999999999", "1.5"),
    "float": ("x", "nan", "-1e9", "1e300"),
    "path": ("missing/none.exr", "folder", "loop.exr", "empty.json", "junk.exr", "junk.png", "junk.json"),
    "text": ("", "nonsense,;:", "1:2:100000000", "nan,nan", "9" * 2000, "-1"),
}
NEVER_ACCEPTED = {("integer", "x"), ("integer", "1.5"), ("float", "x")}


def commands() -> Iterator[tuple[str, Any]]:
    for name, each in SUB_COMMANDS.items():
        command: Any = get_command(import_module(each.module).app)
        if getattr(command, "commands", None) and name != "viewfinder":
            yield from ((f"{name} {sub}", command.commands[sub]) for sub in command.commands)
        else:
            yield name, command
            yield from ((f"{name} {sub}", each) for sub, each in getattr(command, "commands", {}).items())


def kind_of(parameter: Any) -> str:
    annotation = str(parameter.type_descriptor.annotation)
    return next((kind for word, kind in (("Path", "path"), ("float", "float"), ("int", "integer")) if word in annotation), "text")


def cases() -> list[tuple[str, str, str, str]]:
    """Return (command, option, kind, value) of all options that take a value."""
    return [
        (name, parameter.opts[0], kind, value)
        for name, command in commands()
        for parameter in command.params
        if name != "demo" and parameter.param_type_name == "option" and not parameter.is_flag and parameter.opts[0] != "--help"
        for kind in (kind_of(parameter),)
        for value in OF_KIND[kind]
    ]


def make_inputs(folder: Path) -> None:
    rgb, ones = np.random.default_rng(0).uniform(0.1, 0.5, (24, 32, 3)).astype(np.float32), np.ones((24, 32), np.float32)
    write_layer(folder / "sharp.exr", opaque(rgb, ones))
    write_layer(folder / "layer.exr", Layer(0.5 * rgb, 0.5 * ones, 2 * ones))
    whole = np.ones((360, 640), np.float32)
    write_layer(folder / "wide.exr", Layer(0.2 * np.dstack([whole] * 3), 0.5 * whole, 2 * whole))
    write_image(folder / "photo.png", rgb)
    write_lens(folder / "lens.json", Lens(50.0, 2.0, 1.0, 36.0))
    (folder / "stack").mkdir()
    slices = tuple(Slice(f"{index}.exr", 1.0 + index) for index in range(3))
    for each in slices:
        write_image(folder / "stack" / each.path, rgb)
    write_merged(folder / "stack", rgb, np.ones_like(ones), ones, 1.5 * ones)
    write_focal_stack(FocalStack(folder / "stack", slices, Lens(50.0, 2.0, 1.0, 36.0), registered=True, merged=True))
    (folder / "photographs").mkdir()
    for index in range(3):
        write_image(folder / "photographs" / f"{index}.png", cv2.GaussianBlur(rgb, None, 0.5 + index))
    for words in ("lens psf simple --diameter 8 --counts 3 --out kept_bank", "train fit stack --minutes 0.05 --out kept_run"):
        assert mrbokeh(*(folder / word if word.startswith(("kept", "stack")) else word for word in words.split())).returncode == 0
    (folder / "folder").mkdir()
    (folder / "loop.exr").symlink_to("loop.exr")
    (folder / "empty.json").touch()
    for name in ("junk.exr", "junk.png", "junk.json"):
        (folder / name).write_bytes(np.random.default_rng(1).bytes(500))


@contextmanager
def within(seconds: int) -> Iterator[None]:
    def late(*_: object) -> None:
        raise TimeoutError(f"more than {seconds} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def judged(there: Path, name: str, option: str, kind: str, value: str) -> str:
    """Return what is wrong with the answer to a value, '' if nothing is."""
    base = [] if name in ENDLESS else BASES.get(name, "").split()
    words = [*name.split(), *base, option, value]
    kept = set(there.rglob("*"))
    try:
        with within(LONGEST_S):
            done = mrbokeh(*words)
    except TimeoutError as error:
        return str(error)
    except BaseException as error:
        return f"{type(error).__name__}: {error}"
    there_now = set(there.rglob("*"))
    for made in sorted(there_now - kept):
        shutil.rmtree(made) if made.is_dir() and not made.is_symlink() else made.unlink(missing_ok=True)
    if kept - there_now:
        return f"lost {kept - there_now}"
    if done.returncode not in (0, 2):
        return f"exit code {done.returncode}: {done.stderr.strip()[-300:]}"
    if "Traceback" in done.stderr or "fault of mrbokeh" in done.stderr:
        return done.stderr.strip()[-300:]
    if done.returncode == 0 and (kind, value) in NEVER_ACCEPTED:
        return "accepted"
    return "" if done.returncode == 0 or done.stderr.strip() else "no word"


def try_all(folder: Path) -> None:
    """Print the number of cases, and what is wrong with each that is."""
    make_inputs(folder)
    os.chdir(folder)
    tried = cases()
    print(len(tried))
    for case in tried:
        if told := judged(folder, *case):
            print(*case, told.replace("\n", " "))


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="no SIGALRM there")
def test_no_value_of_any_option_makes_a_command_stumble(tmp_path: Path) -> None:
    """In a process of its own, where annotations are not checked and warnings are no errors, as for users."""
    script = "import sys; from pathlib import Path; from tests.project.test_bad_options import try_all; try_all(Path(sys.argv[1]))"
    done = subprocess.run([sys.executable, "-c", script, tmp_path], cwd=LIVE.parents[2], capture_output=True, text=True)
    count, *wrong = done.stdout.splitlines()
    assert done.returncode == 0 and int(count) >= 1500, done.stderr
    assert not wrong, "\n".join(wrong)

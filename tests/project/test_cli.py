"""The command line as a user meets it: help with examples, one sentence for a mistake, completion, missing extras."""

import inspect
import os
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from mrbokeh.cli import SUB_COMMANDS
from mrbokeh.images.image_io import read_layer, write_layer
from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.system.errors import EXTRA_OF_MODULE, FAULT
from tests.support.command_line import mrbokeh
from viewfinder.cli import app as viewfinder

COMMANDS = [
    ["capture"], ["capture", "ingest"], ["capture", "merge"], ["capture", "plan"], ["capture", "cameras"],
    ["capture", "shoot"], ["capture", "poses"], ["capture", "scale"], ["capture", "depth"], ["capture", "report"],
    ["capture", "dataset"], ["capture", "process"], ["train"], ["train", "fit"], ["train", "evaluate"], ["train", "export"],
    ["train", "ablate"], ["train", "doctor"],
    ["lens"], ["lens", "new"], ["lens", "coc"], ["lens", "show"], ["lens", "psf"], ["lens", "export"],
    ["lens", "fit"], ["lens", "match"], ["render"], ["composite"], ["video"], ["refocus"], ["transfer"], ["tilt-shift"],
    ["dataset"], ["dataset", "synthesize"],
    ["check"], ["serve"], ["host"], ["track"], ["track", "clip"], ["track", "convert"],
    ["capture", "matchmove"],
    ["viewfinder"], ["viewfinder", "board"], ["viewfinder", "calibrate-phone"], ["studio"], ["demo"], ["doctor"],
]  # fmt: skip


def started(*arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """As mrbokeh, in a process of its own."""
    command = [sys.executable, "-m", "mrbokeh.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env=os.environ | {"COLUMNS": "200", "NO_COLOR": "1"} | environment)


def small_layer(path: Path) -> None:
    alpha = np.zeros((24, 32), np.float32)
    alpha[8:16, 10:22] = 1.0
    write_layer(path, Layer(np.repeat(alpha[..., None], 3, 2), alpha, np.where(alpha > 0, 2.0, np.inf).astype(np.float32)))


def test_the_list_of_commands() -> None:
    shown = mrbokeh("--help").stdout
    assert all(name in shown for name in SUB_COMMANDS) and mrbokeh("--version").stdout.startswith("mrbokeh ")


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_help_of_every_command(command: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    # This group looks at its context, which typer types more loosely than the checks of annotations here.
    group = viewfinder.registered_callback
    monkeypatch.setattr(group, "callback", inspect.unwrap(group.callback))  # type: ignore[union-attr]
    done = mrbokeh(*command, "--help")
    assert done.returncode == 0, done.stderr
    is_group = "COMMAND [ARGS]" in done.stdout
    assert is_group or "Example: mrbokeh " + " ".join(command) in " ".join(done.stdout.split()), "an example in the help"


def test_a_mistake_is_one_sentence_and_a_code(tmp_path: Path) -> None:
    done = started("lens", "show", tmp_path / "none.json", "--out", tmp_path / "a.png")
    assert done.returncode == 2 and done.stderr.startswith("error: expected a lens file")
    assert "Traceback" not in done.stderr and not (tmp_path / "a.png").exists()


def test_an_unknown_command_and_an_unknown_renderer_are_refused(tmp_path: Path) -> None:
    done = mrbokeh("nonsense")
    assert done.returncode == 2 and "nonsense" in done.stderr
    small_layer(tmp_path / "layer.exr")
    write_lens(tmp_path / "lens.json", Lens(50.0, 2.0, 1.0, 36.0))
    paths = ("--layer", tmp_path / "layer.exr", "--lens", tmp_path / "lens.json", "--out", tmp_path / "o.exr")
    done = mrbokeh("render", *paths, "--renderer", "magic")
    assert done.returncode == 2 and "expected a renderer" in done.stderr


def test_a_missing_extra_names_the_pip_command(tmp_path: Path) -> None:
    """A torch that is not installed, as seen by a fresh interpreter: a finder that refuses the name."""
    (tmp_path / "sitecustomize.py").write_text(
        "import sys\n"
        "class Refuse:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'torch':\n"
        "            raise ModuleNotFoundError('No module named torch', name='torch')\n"
        "sys.meta_path.insert(0, Refuse())\n"
    )
    (tmp_path / "run").mkdir()
    done = started("train", "export", tmp_path / "run", "--out", tmp_path / "a.onnx", PYTHONPATH=f"{tmp_path}:{Path.cwd()}")
    assert done.returncode == 2 and f"pip install -e '{Path.cwd()}[train]'" in done.stderr


def test_extras_are_those_of_the_package() -> None:
    import tomllib

    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    listed = {dep.split(">")[0]: extra for extra, deps in project["optional-dependencies"].items() for dep in deps}
    assert all(listed[module] == extra for module, extra in EXTRA_OF_MODULE.items())


def test_shell_completion(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first as a shell asks: by a program of that name, in a process of its own."""
    script = [sys.executable, "-c", "import sys; sys.argv[0] = 'mrbokeh'; from mrbokeh.cli import main; main()"]
    for words, expected in (
        ("mrbokeh ", "composite"), ("mrbokeh capture ", "ingest"), ("mrbokeh render --renderer ", "low-rank"),
        ("mrbokeh composite --mode ", "between"), ("mrbokeh capture merge --prefer ", "near"), ("mrbokeh lens psf ", "physical"),
    ):  # fmt: skip
        asked = {"_MRBOKEH_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(len(words.split()))}
        here = words != "mrbokeh "
        monkeypatch.setattr(sys.modules["__main__"], "__package__", "")  # a program that was not started as `python -m`
        done = mrbokeh(**asked) if here else subprocess.run(script, capture_output=True, text=True, env=os.environ | asked)
        assert expected in done.stdout.split()


def test_lens_and_render_from_end_to_end(tmp_path: Path) -> None:
    lens, layer, out = tmp_path / "lens.json", tmp_path / "layer.exr", tmp_path / "out.exr"
    small_layer(layer)
    assert mrbokeh("lens", "new", lens, "--focal-length", 50, "--f-number", 2, "--focus", 1, "--blades", 5).returncode == 0
    assert mrbokeh("lens", "show", lens, "--out", tmp_path / "lens.png").returncode == 0
    coc = mrbokeh("lens", "coc", lens, 0.5, 1, "inf", "--image-width", 32).stdout
    assert "0.5 m: -" in coc and "1 m: +0.00 px" in coc and "inf m: +" in coc
    done = mrbokeh("render", "--layer", layer, "--lens", lens, "--out", out, "--focus", 0.4, "--alpha-out")
    assert done.returncode == 0, done.stderr
    blurred, sharp = read_layer(out), read_layer(layer)
    assert blurred.alpha.sum() == pytest.approx(sharp.alpha.sum(), rel=2e-3)  # half float
    assert (blurred.alpha > 0).sum() > (sharp.alpha > 0).sum()
    again = mrbokeh("render", "--layer", layer, "--lens", lens, "--out", out)
    assert again.returncode == 2 and "--overwrite" in again.stderr


def test_doctor_names_what_is_there_and_what_is_not() -> None:
    shown = mrbokeh("doctor").stdout
    assert all(name in shown for name in ("rawpy", "torch", "onnxruntime", "exiftool", "CUDA"))


def test_doctor_says_what_to_do_about_a_second_opencv(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two packages of OpenCV write into one folder: which one is imported nobody knows."""
    from mrbokeh.commands import doctor

    installed = {doctor.OPENCV: "5.0", "opencv-python": "5.0"}
    monkeypatch.setattr(doctor, "_version", installed.get)
    found = next(each for each in doctor.findings() if each.name == doctor.OPENCV)
    assert found.found is None and "pip uninstall -y opencv-python opencv-contrib-python-headless" in found.remedy
    del installed["opencv-python"]
    assert next(each for each in doctor.findings() if each.name == doctor.OPENCV).found == "5.0"


def test_a_fault_of_ours_is_one_sentence_with_its_traceback_in_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mrbokeh.cli.app", Mock(side_effect=ZeroDivisionError("division by zero\nin a loop")))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    done = mrbokeh("render", "--rgb", "a.exr")
    (kept,) = tmp_path.iterdir()
    told = done.stderr
    assert done.returncode == FAULT and "a fault of mrbokeh (ZeroDivisionError: division by zero)" in told and str(kept) in told
    assert "Traceback" not in told and "mrbokeh render --rgb a.exr" in kept.read_text() and "in a loop" in kept.read_text()
    with pytest.raises(ZeroDivisionError):
        mrbokeh("--debug", "render")


def test_a_full_disk_and_a_full_memory_are_no_faults_of_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    for error, said in ((OSError(28, "No space left on device"), "no space left"), (MemoryError(), "not enough memory")):
        monkeypatch.setattr("mrbokeh.cli.app", Mock(side_effect=error))
        done = mrbokeh()
        assert done.returncode == 2 and said in done.stderr

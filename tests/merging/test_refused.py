"""A command that refuses leaves nothing of a scene that it has begun, and all of one that was there."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from capture.cli import app
from capture.stacks.ingest import ingest
from capture.stacks.session import undone_when_refused
from capture.stacks.slice_files import DiskFullError
from mrbokeh.stacks.focal_stack import FocalStack, read_focal_stack, write_focal_stack
from mrbokeh.system.errors import InputError
from tests.support.made_photographs import make_raw_photo, make_shoot, only_stack, scene_rgb

Kept = Callable[[Sequence[FocalStack]], bool]


def refused(command: str, photographs: Path, scene: Path) -> str:
    """What the command raises."""
    result = CliRunner().invoke(app, [command, str(photographs), "--out", str(scene)])
    assert isinstance(result.exception, InputError), result.output
    return str(result.exception)


def one_photograph(folder: Path) -> Path:
    make_raw_photo(folder / "0.dng", scene_rgb(24, 32), 0.6)
    return folder


@pytest.mark.parametrize("there", [True, False])
def test_one_photograph_is_refused_and_leaves_nothing(there: bool, tmp_path: Path) -> None:
    """A folder that was there stays, with what it held; and ingest alone makes a stack of one photograph, which may get more."""
    shoot, scene = one_photograph(tmp_path / "shoot"), tmp_path / "scene"
    if there:
        scene.mkdir()
        (scene / "notes.txt").write_text("mine")
    assert "has 1 slice: merging needs at least 2" in refused("process", shoot, scene)
    assert [each.name for each in shoot.iterdir()] == ["0.dng"]
    assert scene.is_dir() == there and [each.name for each in tmp_path.rglob("*.txt")] == there * ["notes.txt"]
    assert not there or [each.name for each in scene.iterdir()] == ["notes.txt"]
    assert len(only_stack(ingest([shoot], scene))) == 1


def test_stacks_that_may_be_merged_later_stay(tmp_path: Path) -> None:
    """One view with a single photograph must not cost the work on another, which is merged once the first is mended."""
    make_shoot(tmp_path / "shoot" / "b")
    one_photograph(tmp_path / "shoot" / "a")
    assert "a has 1 slice" in refused("process", tmp_path / "shoot", tmp_path / "scene")
    assert [len(read_focal_stack(tmp_path / "scene" / name)) for name in ("a", "b")] == [1, 5]


@pytest.mark.parametrize("command", ["ingest", "process"])
def test_photographs_that_cannot_be_used_leave_nothing(command: str, tmp_path: Path) -> None:
    """Neither a choice of white balance nor of exposure, which later photographs would share."""
    shoot = one_photograph(tmp_path / "shoot")
    (shoot / "0.dng").write_text("just a text")
    assert "could be used" in refused(command, shoot, tmp_path / "scene")
    assert not (tmp_path / "scene").exists()


def test_what_was_there_stays(tmp_path: Path) -> None:
    """One photograph more, in a folder of its own: refused, but the stack of the run before is kept, and so is the new one."""
    scene = tmp_path / "scene"
    before = only_stack(ingest([make_shoot(tmp_path / "first")], scene))
    write_focal_stack(replace(before, merged=True))
    refused("process", one_photograph(tmp_path / "second"), scene)
    assert read_focal_stack(scene / "first").merged and (scene / "second" / "slices" / "00.exr").is_file()


@pytest.mark.parametrize(
    ("error", "is_kept", "left"),
    [
        (InputError("refused"), lambda stacks: stacks[0].merged, False),
        (InputError("refused"), lambda stacks: len(stacks[0]) == 5, True),
        (DiskFullError("full"), lambda stacks: stacks[0].merged, True),
        (KeyboardInterrupt(), lambda stacks: stacks[0].merged, True),
    ],
)
def test_work_to_go_on_with_stays(error: BaseException, is_kept: Kept, left: bool, tmp_path: Path) -> None:
    """What the caller says, a full disk, Ctrl-C."""
    scene = tmp_path / "scene"

    def stopped() -> None:
        with undone_when_refused(scene, is_kept):
            ingest([make_shoot(tmp_path / "shoot")], scene)
            raise error

    with pytest.raises(type(error)):
        stopped()
    assert scene.exists() == left

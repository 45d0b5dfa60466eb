"""A report that was interrupted goes on: what was found of a stack is kept until the stack, the width or the renderer changes."""

import gc
import os
import pathlib
import shutil
import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from capture.commands.report import report_command
from capture.report import report_cache, stack_view
from capture.report.examination import examine
from capture.report.findings import FocusCurve, SliceFindings, StackFindings, findings_document, findings_from
from capture.report.picture_sharpness import PictureFindings
from capture.report.registration_check import NeighbourDisplacement
from capture.report.scene_report import examine_stack, report_scene
from capture.report.slice_fit import Change, SliceFit
from capture.report.stack_section import ExaminedStack
from capture.report.stack_view import Reblur
from mrbokeh.images.camera_rgb import write_camera_rgb
from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import FocalStack, read_focal_stack, write_focal_stack
from mrbokeh.system.atomic_files import read_json, write_json
from tests.support.command_line import printed_by
from tests.support.traced_focal_stack import HEIGHT_PX, WIDTH_PX, TracedStack, traced, write_stack

NAMES = ("view_0", "view_1")
SLICES = 3


@dataclass
class Counting:
    """The picture as it is, for blur does not matter here; stopped before a rendering it raises what Ctrl-C does."""

    calls: int = 0
    stop_before: int | None = None

    def render(self, layers: Sequence[Layer], lens: Lens) -> Layer:  # noqa: ARG002
        if self.calls == self.stop_before:
            raise KeyboardInterrupt
        self.calls += 1
        return layers[0]


OF_STACK = 3 * SLICES
"""Renderings of a stack: each slice, and with blur a pixel smaller and larger."""


def short() -> TracedStack:
    return replace(traced(), slices=traced().slices[:SLICES])


def scene_in(folder: Path) -> Path:
    for name in NAMES:
        write_stack(folder / "scene" / name, short())
    return folder / "scene"


def report(scene: Path, *, width: int = 160, name: str = "none", overwrite: bool = False) -> int:
    """Writes it and tells how many renderings that took."""
    renderer = Counting()
    report_scene(scene, Reblur(renderer, name), width, overwrite=overwrite)
    return renderer.calls


def pages(scene: Path) -> tuple[bytes, bytes]:
    return (scene / "report.html").read_bytes(), (scene / "report.json").read_bytes()


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return scene_in(tmp_path)


@pytest.fixture(scope="module")
def reported_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    scene = scene_in(tmp_path_factory.mktemp("reported"))
    assert report(scene) == 2 * OF_STACK
    return scene


@pytest.fixture
def reported(reported_once: Path, tmp_path: Path) -> Path:
    """A copy of its own, with the times of the files."""
    return shutil.copytree(reported_once, tmp_path / "scene")


def test_an_examination_reads_each_slice_once_and_is_read_back_exactly(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is clipped in any slice is known when all have been seen, and is not read for."""
    opened: list[str] = []
    read = stack_view.read_slice
    monkeypatch.setattr(stack_view, "read_slice", lambda path: (opened.append(path.name), read(path))[1])
    stack = read_focal_stack(scene / "view_0")
    examine(stack_view.StackView(stack, 160), Reblur(Counting(), "none"))
    assert opened == [Path(each.path).name for each in stack.slices]
    # Also what is not finite, for which JSON has no number.
    stack: FocalStack = read_focal_stack(scene / "view_0")
    fit = SliceFit(*(Change(0.1 * k, float("inf") if k == 3 else 1.0 / (3.0 + k)) for k in range(7)))
    slices = (SliceFindings(0, 1.0 / 3.0, 0.0, 0.5, 7.25, float("inf"), 20.1, fit), SliceFindings(1, 1.5, 0.0, 1.0))
    curve = FocusCurve(np.array([1 / 3, 2 / 3]), 0.7, 0.1, 0.2)
    pairs = (NeighbourDisplacement(0, 0.1 / 3.0, 0.02, (3, 4)), NeighbourDisplacement(1, None, float("inf"), (160, 107)))
    picture = PictureFindings(1.0 / 7.0, 1.0 / 300.0, None, float("inf"), 1.0 / 3.0, (320, 214))
    findings = StackFindings(stack, (160, 107), (320, 214), slices, curve, 0.01, None, picture, pairs)
    write_json(scene / "there.json", findings_document(findings))
    text = (scene / "there.json").read_text(encoding="utf-8")
    assert "Infinity" not in text and "NaN" not in text
    back = findings_from(read_json(scene / "there.json", "findings"), stack)
    np.testing.assert_array_equal(back.curve.shares, findings.curve.shares)
    assert replace(back, curve=findings.curve) == findings


def test_an_interrupted_report_goes_on_and_a_finished_one_costs_nothing(reported: Path, tmp_path: Path) -> None:
    """Stopped in the second stack: the first is not rendered again, and the pages are those of a report that was not stopped."""
    before, stopped = pages(reported), scene_in(tmp_path / "other")
    with pytest.raises(KeyboardInterrupt):
        report_scene(stopped, Reblur(Counting(stop_before=OF_STACK + 4), "none"), 160)
    assert not (stopped / "report.html").exists()
    assert report(stopped) == OF_STACK
    assert pages(stopped) == before
    for overwrite, renderings in ((False, 0), (True, 2 * OF_STACK)):
        assert report(stopped, overwrite=overwrite) == renderings
        assert pages(stopped) == before
    assert not list(stopped.rglob("*.part*"))


def touch(name: str) -> Callable[[Path], None]:
    """Another time, a second later."""

    def touched(stack: Path) -> None:
        path = stack / name
        os.utime(path, ns=(path.stat().st_atime_ns, path.stat().st_mtime_ns + 10**9))

    return touched


def registered_otherwise(stack: Path) -> None:
    write_json(stack / "registration.json", {"correlations": [0.9] * (SLICES - 1)})


def picture_lost(stack: Path) -> None:
    next((stack / "report").glob("*.jpg")).unlink()


def spoiled(stack: Path) -> None:
    (stack / "report" / "found.json").write_text('{"signature": ', encoding="utf-8")


def test_whatever_findings_depend_on_is_looked_at(reported: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert report(reported, width=80) == 2 * OF_STACK
    for change in (touch("stack.json"), touch("depth.exr"), touch("registered/02.exr"), registered_otherwise, picture_lost, spoiled):
        change(reported / "view_0")
        assert [report(reported, width=80) for _ in range(2)] == [OF_STACK, 0], change
    assert report(reported, width=80, name="other") == 2 * OF_STACK
    monkeypatch.setattr(report_cache, "VERSION", report_cache.VERSION + 1)
    assert report(reported, width=80, name="other") == 2 * OF_STACK


def test_only_a_stack_that_changed_is_examined_again_and_masks_without_a_rendering(reported: Path) -> None:
    """A board that was found later: in exclusion.exr, beside what moved, which is known already."""
    stack = read_focal_stack(reported / "view_0")
    before = stack.exclusions()
    assert not before["board"].any()
    outline = [[10.0, 10.0], [60.0, 10.0], [60.0, 50.0], [10.0, 50.0]]
    path = reported / "reconstruction" / "scale.json"
    write_json(path, {"metres_per_unit": 1.0, "answers": [{"method": "board", "metres_per_unit": 1.0, "outlines_px": {"view_0": outline}}]})
    later = stack.exclusion_path.stat().st_mtime_ns + 10**9
    os.utime(path, ns=(later, later))
    assert report(reported) == 0
    after = stack.exclusions()
    assert after["board"][20:40, 20:50].all()
    np.testing.assert_array_equal(after["moving"], before["moving"])
    # An all-in-focus picture a tenth darker: the slices of that stack are 1/0.9 as bright against it, those of the other as they were.
    stack = read_focal_stack(reported / "view_1")
    write_camera_rgb(stack.all_in_focus_path, np.float32(0.9) * stack.all_in_focus_camera_rgb(), None, half=False)
    before = read_json(reported / "report.json", "the report")["stacks"]
    assert report(reported) == OF_STACK
    after = read_json(reported / "report.json", "the report")["stacks"]
    assert after["view_0"] == before["view_0"]
    for old, new in zip(before["view_1"]["slices"], after["view_1"]["slices"], strict=True):
        assert new["gain"] == pytest.approx(old["gain"] / 0.9, rel=1e-3)


def held_bytes() -> int:
    """All that Python holds but its table of names, which grows now and then in whichever pathlib call adds one to it."""
    gc.collect()
    filters = [tracemalloc.Filter(False, each.__file__) for each in (pathlib, tracemalloc)]
    return sum(each.size for each in tracemalloc.take_snapshot().filter_traces(filters).statistics("filename"))


@pytest.mark.slow
def test_finished_stacks_hold_neither_pictures_nor_maps(reported: Path) -> None:
    """What a finished stack holds is far less than a single map of its pixels, 4 bytes each."""

    def again() -> list[ExaminedStack]:
        return [examine_stack(read_focal_stack(reported / name), Reblur(Counting(), "none"), 160, overwrite=True) for name in NAMES]

    tracemalloc.start()
    try:
        again()  # what code that runs for the first time keeps for good is not what a stack holds
        before = held_bytes()
        examined = again()
        held = held_bytes() - before
    finally:
        tracemalloc.stop()
    assert all(len(each.pictures) > 5 for each in examined)
    assert held / len(examined) < 4 * WIDTH_PX * HEIGHT_PX, held


def test_the_command_tells_what_was_kept(tmp_path: Path) -> None:
    """Examined, kept, examined again. Without a lens nothing is rendered."""
    write_focal_stack(replace(write_stack(tmp_path / "view_0", short()), lens=None))
    told = [printed_by(report_command, tmp_path, *more) for more in ([], [], ["--overwrite"])]
    assert ["1 of 1 stacks were examined before" in each for each in told] == [False, True, False]

"""Merging whole stacks: the shipped RAW stack against its truth, a photographed stack without distances, and bad input."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.merging.merge import merge_scene
from capture.stacks.grouping import Grouping
from capture.stacks.ingest import IngestSettings, ingest
from capture.stacks.stack_ingest import Development
from mrbokeh.demo.plan import DATA
from mrbokeh.errors import InputError
from mrbokeh.exr_io import read_exr
from mrbokeh.focal_stack import FocalStack, Slice, read_focal_stack, write_focal_stack
from mrbokeh.image_io import read_image, write_image
from mrbokeh.image_metrics import psnr

VIEW = "view_1"


def ingested(sources: list[Path], out: Path, max_width_px: int | None = None) -> None:
    ingest(sources, out, IngestSettings(Grouping.folder, Development(None, False, max_width_px), None, False))


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> FocalStack:
    scene = tmp_path_factory.mktemp("desk")
    ingested([DATA / "raw_stack" / VIEW], scene)
    return merge_scene(scene)[0]


def test_all_in_focus_of_the_raw_stack(desk: FocalStack) -> None:
    """38 dB, linear and clipped to 1, is what the project wants of this stack; no single slice comes near."""
    truth = read_image(DATA / "raw_stack" / "truth" / VIEW / "all_in_focus.exr")
    assert psnr(desk.all_in_focus(), truth) >= 38.0
    assert max(psnr(rgb, truth) for rgb in desk.iter_rgb()) < 34.0


def test_depth_of_the_raw_stack(desk: FocalStack) -> None:
    true_depth_m = read_exr(DATA / "raw_stack" / "truth" / VIEW / "depth.exr")[0].stacked(["Z"])[..., 0]
    textured = desk.depth_confidence() >= 0.3
    error = np.abs(desk.depth_m() / true_depth_m - 1.0)
    assert textured.mean() > 0.6
    assert np.median(error[textured]) < 0.03
    assert np.median(error[textured]) < np.median(error[~textured]), "confidence knows where depth is worse"


def test_registration_of_the_raw_stack_is_the_breathing_of_its_lens(desk: FocalStack) -> None:
    """Thin lens: magnification goes with the image distance; on a tripod nothing else moves, so the prior stands."""
    truth = json.loads((DATA / "raw_stack" / "truth.json").read_text())
    expected = truth["focal_px"][0] / np.array(truth["focal_px"])
    assert desk.reference == 0, "the nearest focus sees the narrowest field"
    np.testing.assert_allclose([each.scale for each in desk.slices], expected, atol=1e-4)
    assert desk.camera is not None and desk.camera.focal_px[0] == pytest.approx(truth["focal_px"][0], rel=1e-3)


def test_merging_again_starts_from_the_ingested_slices(desk: FocalStack) -> None:
    before = desk.all_in_focus()
    stamp = desk.all_in_focus_path.stat().st_mtime_ns
    merge_scene(desk.folder)
    assert desk.all_in_focus_path.stat().st_mtime_ns == stamp, "merged already"
    again = merge_scene(desk.folder, overwrite=True)[0]
    np.testing.assert_array_equal(again.all_in_focus(), before)


def test_photographs_without_distances_give_an_index(tmp_path: Path) -> None:
    folder = tmp_path / "board"
    folder.mkdir()
    for path in sorted((DATA / "pcb_oblique").glob("*.jpg")):
        (folder / path.name).write_bytes(path.read_bytes())
    ingested([folder], tmp_path / "scene", 512)
    stack = merge_scene(tmp_path / "scene")[0]
    assert not stack.is_metric
    with pytest.raises(InputError, match="focus distances are unknown"):
        stack.depth_m()
    index = stack.focus_index()
    assert index.min() >= 0 and index.max() <= 6
    # The connector in front (bottom middle) is sharp in the first slices, the board's far end (upper left) in the last.
    assert np.median(index[310:340, 100:260]) < 1.0 < 3.0 < np.median(index[20:100, 10:120])
    sharpness = [cv2.Laplacian(np.sqrt(np.maximum(rgb, 0)), cv2.CV_32F).var() for rgb in (*stack.iter_rgb(), stack.all_in_focus())]
    assert sharpness[-1] > max(sharpness[:-1]), "sharper than every slice"


def test_a_sheet_shows_what_came_out(desk: FocalStack) -> None:
    sheet = read_image(desk.folder / "merge.png")
    # Five pictures of 320 px with gaps; the last shows depth in colours, so red and blue differ there.
    assert sheet.shape[1] == 5 * 324
    assert np.abs(sheet[30:200, 4 * 324 : -8, 0] - sheet[30:200, 4 * 324 : -8, 2]).mean() > 0.1


def test_two_slices_are_no_stack(tmp_path: Path) -> None:
    for i in range(2):
        write_image(tmp_path / f"slices/{i}.exr", np.ones((64, 64, 3), np.float32))
    write_focal_stack(FocalStack(tmp_path, tuple(Slice(f"slices/{i}.exr", 1.0 + i) for i in range(2))))
    with pytest.raises(InputError, match="at least 3"):
        merge_scene(tmp_path)
    assert not read_focal_stack(tmp_path).merged

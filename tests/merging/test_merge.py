"""Merging whole stacks: the shipped RAW stack against its truth, a photographed stack without distances, and bad input."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.merging.merge import merge_scene
from capture.merging.registration.registration_file import read_registration, write_registration
from capture.merging.second_pass import first_pass_path, keep_first_pass, second_pass
from capture.stacks.grouping import Grouping
from capture.stacks.ingest import IngestSettings, ingest
from capture.stacks.stack_ingest import Development
from mrbokeh.demo.plan import DATA
from mrbokeh.images.camera_rgb import read_camera_rgb
from mrbokeh.images.exr_io import read_exr
from mrbokeh.images.image_io import read_image, write_image
from mrbokeh.images.image_metrics import depth_edge_mask, psnr
from mrbokeh.optics.aperture import Aperture
from mrbokeh.stacks.focal_stack import DEPTH_SOURCE, FROM_FOCUS, FocalStack, Slice, read_focal_stack, write_focal_stack
from tests.support.refusals import refused

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


def test_lamps_that_the_sensor_nearly_holds_keep_their_shape(desk: FocalStack) -> None:
    """The desk's lamps are 4 px wide and at most 2.6 times the sensor's white: photographed better than any disc drawn for them."""
    truth = read_image(DATA / "raw_stack" / "truth" / VIEW / "all_in_focus.exr")
    near_lamps = cv2.dilate((truth.max(axis=2) > 0.9).astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    # Photographed they have 24.9 dB; two of 25 drawn anew by mistake made it 23.7 dB.
    assert psnr(desk.all_in_focus(), truth, mask=near_lamps) > 24.4


def test_depth_of_the_raw_stack(desk: FocalStack) -> None:
    true_depth_m = read_exr(DATA / "raw_stack" / "truth" / VIEW / "depth.exr")[0].stacked(["Z"])[..., 0]
    textured = desk.depth_confidence() >= 0.3
    error = np.abs(desk.depth_m() / true_depth_m - 1.0)
    assert textured.mean() > 0.6
    assert np.median(error[textured]) < 0.03
    assert np.median(error) < 0.008, "surfaces are evened out by what is sure of them: 0.0085 before"
    assert np.median(error[textured]) < np.median(error[~textured]), "confidence knows where depth is worse"


def test_near_things_are_as_wide_as_they_are(desk: FocalStack) -> None:
    """Beside an edge the window of the focus energy sees only the sharp near side: before edges were moved, 64 % of the pixels up
    to 4 px outside near things had their depth.
    """
    truth = 1.0 / read_exr(DATA / "raw_stack" / "truth" / VIEW / "depth.exr")[0].stacked(["Z"])[..., 0]
    window = np.ones((9, 9), np.uint8)
    near, far = cv2.dilate(truth, window), cv2.erode(truth, window)
    middle, jump = (near + far) / 2, near - far > 0.15 * np.ptp(truth)
    outside, inside = jump & (truth < middle), jump & (truth > middle)
    taken = 1.0 / desk.depth_m() > middle
    assert taken[outside].mean() < 0.2
    assert taken[inside].mean() > 0.8


def test_registration_of_the_raw_stack_is_the_breathing_of_its_lens(desk: FocalStack) -> None:
    """Thin lens: magnification goes with the image distance; on a tripod nothing else moves, so the prior stands."""
    truth = json.loads((DATA / "raw_stack" / "truth.json").read_text())
    expected = truth["focal_px"][0] / np.array(truth["focal_px"])
    assert desk.reference == 0, "the nearest focus sees the narrowest field"
    np.testing.assert_allclose([each.scale for each in desk.slices], expected, atol=1e-4)
    assert desk.camera is not None and desk.camera.focal_px[0] == pytest.approx(truth["focal_px"][0], rel=1e-3)


def test_what_is_merged_stays(desk: FocalStack) -> None:
    stamp = desk.all_in_focus_path.stat().st_mtime_ns
    merge_scene(desk.folder)
    assert desk.all_in_focus_path.stat().st_mtime_ns == stamp


def test_registered_slices_keep_camera_rgb_and_masks(desk: FocalStack) -> None:
    """The far slices see a wider field, so that all of the reference has data; lights in focus are full."""
    assert desk.rec709_from_camera is not None
    masks = [desk.slice_masks(index) for index in range(len(desk))]
    assert all(each.valid[8:-8, 8:-8].all() for each in masks)
    assert any(each.saturated.any() for each in masks)
    np.testing.assert_allclose(desk.slice_rgb(4), desk.to_rec709(desk.slice_camera_rgb(4)), atol=1e-6)


def test_an_interrupted_merge_goes_on_with_what_is_there(desk: FocalStack) -> None:
    before, registered = desk.all_in_focus(), desk.folder / "registered"
    stamps = {path.name: path.stat().st_mtime_ns for path in (desk.folder / "registration.json", *sorted(registered.iterdir())[1:])}
    (registered / "00.exr").unlink()
    ingested = tuple(replace(each, path=str(each.metadata["ingested"])) for each in desk.slices)
    write_focal_stack(replace(desk, slices=ingested, merged=False))
    np.testing.assert_array_equal(merge_scene(desk.folder)[0].all_in_focus(), before)
    after = {path.name: path.stat().st_mtime_ns for path in (desk.folder / "registration.json", *sorted(registered.iterdir())[1:])}
    assert after == stamps, "neither registered nor resampled again"
    assert (registered / "00.exr").is_file()


def test_a_registration_is_used_again(desk: FocalStack, tmp_path: Path) -> None:
    """A given registration is applied, not found: one that shifts slice 3 by 5 px shifts that slice's picture by 5 px."""
    scene = tmp_path / "again"
    shutil.copytree(desk.folder, scene)
    found = read_registration(scene / "registration.json")
    transforms = list(found.reference_from_slice)
    transforms[3] = transforms[3] + np.array([[0.0, 0.0, 5.0], [0.0, 0.0, 0.0]])
    write_registration(tmp_path / "shifted.json", replace(found, reference_from_slice=tuple(transforms)))
    shifted = merge_scene(scene, overwrite=True, registration=tmp_path / "shifted.json")[0]
    np.testing.assert_allclose(shifted.slice_rgb(3)[20:-20, 25:-15], desk.slice_rgb(3)[20:-20, 20:-20], atol=2e-3)
    np.testing.assert_allclose(read_registration(scene / "registration.json").reference_from_slice[3], transforms[3])


@pytest.mark.slow
def test_a_stack_too_large_to_be_held_is_read_again(desk: FocalStack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Streaming from files gives what holding in memory gives: both hold half floats."""
    monkeypatch.setattr("capture.merging.registration.registered_slices.LARGEST_HELD_BYTES", 0.0)
    scene = tmp_path / "streamed"
    shutil.copytree(desk.folder, scene)
    np.testing.assert_array_equal(merge_scene(scene, overwrite=True)[0].all_in_focus(), desk.all_in_focus())


def test_a_registration_of_pictures_of_another_size_is_refused(desk: FocalStack, tmp_path: Path) -> None:
    scene = tmp_path / "other"
    shutil.copytree(desk.folder, scene)
    write_registration(tmp_path / "half.json", replace(read_registration(scene / "registration.json"), size_px=(272, 180)))
    refused(r"\(272, 180\).*\(544, 360\)", merge_scene, scene, overwrite=True, registration=tmp_path / "half.json")


def test_slices_out_of_order_are_refused(tmp_path: Path) -> None:
    write_focal_stack(FocalStack(tmp_path, tuple(Slice(f"slices/{i}.exr", distance) for i, distance in enumerate((1.0, 3.0, 2.0)))))
    refused("not in the order of their focus", merge_scene, tmp_path)


def test_a_registration_of_another_stack_is_refused(desk: FocalStack, tmp_path: Path) -> None:
    found = read_registration(desk.folder / "registration.json")
    fewer = replace(found, reference_from_slice=found.reference_from_slice[:4], correlations=found.correlations[:3], residuals_px=())
    write_registration(tmp_path / "four.json", fewer)
    refused("4", merge_scene, desk.folder, overwrite=True, registration=tmp_path / "four.json")


def test_a_second_pass_with_true_depth_keeps_the_first_and_merging_again_starts_from_ingested_slices(
    desk: FocalStack, tmp_path: Path
) -> None:
    folder = tmp_path / VIEW
    shutil.copytree(desk.folder, folder)
    stack = read_focal_stack(folder)
    truth = read_image(DATA / "raw_stack" / "truth" / VIEW / "all_in_focus.exr")
    true_depth_m = read_exr(DATA / "raw_stack" / "truth" / VIEW / "depth.exr")[0].stacked(["Z"])[..., 0]
    assert stack.lens is not None
    stack = replace(stack, lens=replace(stack.lens, aperture=Aperture.disc().obstructed(0.5)))
    stored = second_pass(stack, true_depth_m)
    write_image(stack.all_in_focus_path, stack.all_in_focus_camera_rgb(), half=False)  # the same numbers, without their primaries
    np.testing.assert_array_equal(second_pass(stack, true_depth_m), stored, err_msg="it works on what is stored")
    second = stack.to_rec709(stored)
    # Measured 40.64; the first pass has 40.75 since plain places follow their surroundings, and had 40.69 before.
    assert psnr(second, truth) > max(40.6, psnr(stack.all_in_focus(), truth) - 0.15)
    edges = depth_edge_mask(true_depth_m, 3)
    assert psnr(second, truth, mask=edges) > 37.3, "where the first pass had 36.1 dB before it blended in bands, and has 37.6 dB since"
    keep_first_pass(stack)
    write_focal_stack(replace(stack, lens=desk.lens, metadata=stack.metadata | {DEPTH_SOURCE: "neighbours"}))
    write_image(stack.all_in_focus_path, np.zeros_like(second))
    np.testing.assert_array_equal(read_camera_rgb(first_pass_path(stack, stack.all_in_focus_path)), desk.all_in_focus_camera_rgb())
    again = merge_scene(folder, overwrite=True)[0]
    assert not (folder / "first_pass").exists(), "a new first pass takes its place"
    np.testing.assert_array_equal(again.all_in_focus(), desk.all_in_focus())
    assert again.metadata[DEPTH_SOURCE] == FROM_FOCUS == desk.metadata[DEPTH_SOURCE]


def test_a_stack_without_a_merge_has_no_second_pass(tmp_path: Path) -> None:
    stack = FocalStack(tmp_path, tuple(Slice(f"{i}.exr", 1.0 + i) for i in range(3)))
    refused("capture merge", second_pass, stack, np.ones((4, 4), np.float32))


def test_photographs_without_distances_give_an_index_and_guessed_metres(tmp_path: Path) -> None:
    folder = tmp_path / "board"
    folder.mkdir()
    for path in sorted((DATA / "pcb_oblique").glob("*.jpg")):
        (folder / path.name).write_bytes(path.read_bytes())
    ingested([folder], tmp_path / "scene", 384)
    stack = merge_scene(tmp_path / "scene")[0]
    assert stack.is_metric and not stack.metres_known, "blur is solved from the slices, metres are guessed"
    assert pytest.approx(min(each for each in stack.focus_distances_m if each is not None)) == 1.0
    assert np.isfinite(stack.depth_m()).all()
    index = stack.focus_index()
    assert index.min() >= 0 and index.max() <= 6
    # The connector in front (bottom middle) is sharp in the first slices, the board's far end (upper left) in the last.
    assert np.median(index[232:255, 75:195]) < 1.0 < 3.0 < np.median(index[15:75, 8:90])
    sharpness = [cv2.Laplacian(np.sqrt(np.maximum(rgb, 0)), cv2.CV_32F).var() for rgb in (*stack.iter_rgb(), stack.all_in_focus())]
    assert sharpness[-1] > max(sharpness[:-1]), "sharper than every slice"


def test_a_sheet_shows_what_came_out(desk: FocalStack) -> None:
    sheet = read_image(desk.folder / "merge.png")
    # Five pictures of 320 px with gaps; the last shows depth in colours, so red and blue differ there.
    assert sheet.shape[1] == 5 * 324
    assert np.abs(sheet[30:200, 4 * 324 : -8, 0] - sheet[30:200, 4 * 324 : -8, 2]).mean() > 0.1


def test_one_slice_is_no_stack(tmp_path: Path) -> None:
    write_image(tmp_path / "slices/0.exr", np.ones((64, 64, 3), np.float32))
    write_focal_stack(FocalStack(tmp_path, (Slice("slices/0.exr", 1.0),)))
    refused("at least 2", merge_scene, tmp_path)
    assert not read_focal_stack(tmp_path).merged

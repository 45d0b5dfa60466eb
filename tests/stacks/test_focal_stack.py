import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.images.camera_rgb import write_camera_rgb, write_masks
from mrbokeh.images.color import rec709_from_XYZ
from mrbokeh.images.image_io import write_image
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import FocalStack, Slice, find_focal_stacks, read_focal_stack, write_focal_stack, write_merged
from tests.support.refusals import refused


def stack_in(folder: Path, distances_m: tuple[float | None, ...] = (0.6, 0.9, 1.8)) -> FocalStack:
    slices = tuple(Slice(f"slices/{i:02d}.exr", d, 1.0 + 0.01 * i, {"iso": 100}) for i, d in enumerate(distances_m))
    for i, each in enumerate(slices):
        write_image(folder / each.path, np.full((4, 6, 3), float(i), np.float32))
    stack = FocalStack(folder, slices, Lens(35.0, 2.8, 0.6, 23.5), Camera(6, 4, (9.0, 9.0), (3.0, 2.0)), metadata={"source": "test"})
    write_focal_stack(stack)
    return stack


def test_round_trip(tmp_path: Path) -> None:
    stack = stack_in(tmp_path)
    again = read_focal_stack(tmp_path)
    assert again.slices == stack.slices
    assert (again.focus_distances_m, again.metadata, len(again)) == ((0.6, 0.9, 1.8), {"source": "test"}, 3)
    assert again.lens is not None and again.lens.focal_length_mm == 35.0
    assert again.camera is not None and again.camera.focal_px == (9.0, 9.0)
    assert [float(rgb.max()) for rgb in again.iter_rgb()] == [0.0, 1.0, 2.0]


def test_focus_at_infinity_is_written_in_plain_json(tmp_path: Path) -> None:
    stack_in(tmp_path, (0.6, 0.9, float("inf")))
    json.loads((tmp_path / "stack.json").read_text(), parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert read_focal_stack(tmp_path).focus_distances_m[-1] == float("inf")


def test_slices_are_read_only_when_asked_for(tmp_path: Path) -> None:
    stack_in(tmp_path)
    (tmp_path / "slices" / "01.exr").unlink()
    stack = read_focal_stack(tmp_path)
    assert stack.slice_rgb(0).shape == (4, 6, 3)
    refused(r"01\.exr", stack.slice_rgb, 1)


def test_merged_pictures_come_back(tmp_path: Path) -> None:
    stack = stack_in(tmp_path)
    planes = [np.full((4, 6), value, np.float32) for value in (1.5, 0.7, 1.2)]
    write_merged(tmp_path, np.full((4, 6, 3), 0.25, np.float32), *planes)
    write_focal_stack(replace(stack, merged=True))
    merged = read_focal_stack(tmp_path)
    np.testing.assert_array_equal(merged.all_in_focus(), 0.25)
    for plane, read in zip(planes, (merged.focus_index(), merged.depth_confidence(), merged.depth_m()), strict=True):
        np.testing.assert_array_equal(read, plane)
    assert merged.depth_valid().all() and not merged.depth_valid(0.8).any()


def test_coc_of_a_registered_slice_grows_with_its_scale(tmp_path: Path) -> None:
    stack = stack_in(tmp_path)
    depth_m = np.full((4, 6), 1.2, np.float32)
    expected = stack.lens_of(2).coc_px(1.2, 6) * stack.slices[2].scale
    np.testing.assert_allclose(stack.coc_px(2, depth_m), expected, rtol=1e-6)


def test_what_is_unknown_is_said(tmp_path: Path) -> None:
    stack = stack_in(tmp_path, (0.6, None, 1.8))
    assert not stack.is_metric
    refused("focus distances are unknown", stack.depth_m)
    refused("capture merge", stack.all_in_focus)
    refused(r"lens\.toml", stack.lens_of, 1)


def test_folders_that_are_no_stacks_are_named(tmp_path: Path) -> None:
    refused("capture process", find_focal_stacks, tmp_path)
    refused("there is no folder .*nix", find_focal_stacks, tmp_path / "nix")
    (tmp_path / "stack.json").write_text('{"format": "mrbokeh-focal-stack", "version": 99}')
    refused("version 99", read_focal_stack, tmp_path)
    (tmp_path / "stack.json").write_text('{"format": "mrbokeh-focal-stack", "version": 2}')
    refused("incomplete", read_focal_stack, tmp_path)


def test_stacks_of_a_scene_are_found_by_name(tmp_path: Path) -> None:
    for name in ("b", "a"):
        stack_in(tmp_path / name)
    assert [stack.folder.name for stack in find_focal_stacks(tmp_path)] == ["a", "b"]


# Linear Rec.709 from the balanced RGB of a plausible camera: rows sum to 1, strong negative parts.
MATRIX = ((1.7, -0.6, -0.1), (-0.3, 1.6, -0.3), (0.05, -0.55, 1.5))


def test_pictures_are_kept_in_camera_rgb_and_given_in_rec709(tmp_path: Path) -> None:
    """Grey stays grey; the camera's pure green is the matrix' middle column."""
    camera_rgb = np.zeros((2, 3, 3), np.float32)
    camera_rgb[0], camera_rgb[1] = 0.5, (0.0, 1.0, 0.0)
    write_camera_rgb(tmp_path / "0.exr", camera_rgb, MATRIX, half=False)
    write_merged(tmp_path, 2 * camera_rgb, *[np.ones((2, 3), np.float32)] * 3, MATRIX)
    write_focal_stack(FocalStack(tmp_path, (Slice("0.exr", 1.0),), merged=True, rec709_from_camera=MATRIX))
    stack = read_focal_stack(tmp_path)
    assert stack.rec709_from_camera == MATRIX
    for stored, converted, factor in (
        (stack.slice_camera_rgb(0), stack.slice_rgb(0), 1.0),
        (stack.all_in_focus_camera_rgb(), stack.all_in_focus(), 2.0),
    ):
        np.testing.assert_array_equal(stored, factor * camera_rgb)
        np.testing.assert_allclose(converted[0], factor * 0.5, rtol=1e-6)
        np.testing.assert_allclose(converted[1], np.broadcast_to(factor * np.array(MATRIX)[:, 1], (3, 3)), rtol=1e-6)
    np.testing.assert_array_equal(next(stack.iter_camera_rgb()), camera_rgb)
    np.testing.assert_array_equal(next(stack.iter_rgb()), stack.slice_rgb(0))


def test_files_state_the_primaries_of_the_camera(tmp_path: Path) -> None:
    """RGB to XYZ as OpenEXR's documentation derives it from chromaticities must be the camera's: D65 white, the same matrix."""
    import OpenEXR

    write_camera_rgb(tmp_path / "a.exr", np.ones((2, 2, 3), np.float32), MATRIX)
    with OpenEXR.File(str(tmp_path / "a.exr")) as file:
        xy = np.array(file.header()["chromaticities"]).reshape(4, 2)
    assert xy[3] == pytest.approx([0.3127, 0.3290], abs=1e-4)
    XYZ = np.column_stack([xy / xy[:, 1:], (1.0 - xy.sum(axis=1)) / xy[:, 1]])[:, [0, 2]]
    primaries, white = np.insert(XYZ, 1, 1.0, axis=1)[:3].T, np.insert(XYZ, 1, 1.0, axis=1)[3]
    XYZ_from_file = primaries * np.linalg.solve(primaries, white)
    np.testing.assert_allclose(rec709_from_XYZ @ XYZ_from_file, MATRIX, atol=2e-4)
    write_camera_rgb(tmp_path / "b.exr", np.ones((2, 2, 3), np.float32), None)
    with OpenEXR.File(str(tmp_path / "b.exr")) as file:
        assert "chromaticities" not in file.header(), "Rec.709 is what EXR takes without them"


def test_masks_travel_with_slices(tmp_path: Path) -> None:
    stack = stack_in(tmp_path)
    plain = stack.slice_masks(0)
    assert not plain.saturated.any() and plain.valid.all()
    share, valid = np.zeros((4, 6), np.float32), np.ones((4, 6), bool)
    share[1, 2], share[2, 2], valid[:, 5] = 1.0, 0.0625, False
    write_camera_rgb(tmp_path / stack.slices[1].path, np.ones((4, 6, 3), np.float32), None, saturated=share, valid=valid)
    masks = stack.slice_masks(1)
    assert np.argwhere(masks.saturated).tolist() == [[1, 2], [2, 2]], "a sixteenth of a full pixel is enough to be wrong"
    np.testing.assert_array_equal(masks.valid, valid)
    np.testing.assert_array_equal(stack.slice_rgb(1), 1.0)


def test_exclusions_are_named(tmp_path: Path) -> None:
    stack = stack_in(tmp_path)
    assert stack.exclusions() == {}
    moving = np.zeros((4, 6), bool)
    moving[2, 3] = True
    write_masks(stack.exclusion_path, {"moving": moving, "border": ~moving})
    read = stack.exclusions()
    assert set(read) == {"moving", "border"}
    np.testing.assert_array_equal(read["moving"], moving)
    np.testing.assert_array_equal(read["border"], ~moving)


def test_stacks_of_the_first_version_are_refused_with_advice(tmp_path: Path) -> None:
    """They hold Rec.709 without saying so."""
    stack_in(tmp_path)
    document = json.loads((tmp_path / "stack.json").read_text())
    del document["rec709_from_camera"]
    (tmp_path / "stack.json").write_text(json.dumps(document | {"version": 1}))
    refused(r"version 1: run `mrbokeh capture ingest` on the photographs again", read_focal_stack, tmp_path)


def test_a_calibrated_slice_blurs_as_it_was_found_to(tmp_path: Path) -> None:
    """4 px per dioptre at 100 px width is 2 at 50; registration by 1.1 enlarges it; half a dioptre off gives half of that."""
    found = {"px_per_dioptre": 4.0, "px_per_dioptre_width_px": 100}
    lens = Lens(50.0, 2.0, 1.0, 36.0)
    stack = FocalStack(tmp_path, (Slice("a.exr", 1.0, 1.1, found), Slice("b.exr", 1.0)), lens)
    assert stack.coc_px_per_dioptre(0, 50) == pytest.approx(2.2, rel=1e-9)
    depth_m = np.full((3, 50), 2.0)
    np.testing.assert_allclose(stack.coc_px(0, depth_m), 1.1, rtol=1e-6)
    assert stack.lens_of(0).focal_length_mm == 50.0
    assert stack.lens_of(1) == lens

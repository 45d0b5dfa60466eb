import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.camera import Camera
from mrbokeh.errors import InputError
from mrbokeh.focal_stack import FocalStack, Slice, find_focal_stacks, read_focal_stack, write_focal_stack, write_merged
from mrbokeh.image_io import write_image
from mrbokeh.lens import Lens


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
    with pytest.raises(InputError, match=r"01\.exr"):
        stack.slice_rgb(1)


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
    with pytest.raises(InputError, match="focus distances are unknown"):
        stack.depth_m()
    with pytest.raises(InputError, match="capture merge"):
        stack.all_in_focus()
    with pytest.raises(InputError, match=r"lens\.toml"):
        stack.lens_of(1)


def test_folders_that_are_no_stacks_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="capture ingest"):
        find_focal_stacks(tmp_path)
    (tmp_path / "stack.json").write_text('{"format": "mrbokeh-focal-stack", "version": 99}')
    with pytest.raises(InputError, match="version 99"):
        read_focal_stack(tmp_path)
    (tmp_path / "stack.json").write_text('{"format": "mrbokeh-focal-stack", "version": 1}')
    with pytest.raises(InputError, match="incomplete"):
        read_focal_stack(tmp_path)


def test_stacks_of_a_scene_are_found_by_name(tmp_path: Path) -> None:
    for name in ("b", "a"):
        stack_in(tmp_path / name)
    assert [stack.folder.name for stack in find_focal_stacks(tmp_path)] == ["a", "b"]

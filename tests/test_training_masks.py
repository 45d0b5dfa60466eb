"""Pixels without data and pixels that something excludes do not count in training."""

from pathlib import Path

import numpy as np

from mrbokeh.camera_rgb import write_camera_rgb, write_masks
from mrbokeh.focal_stack import FocalStack, Slice, write_focal_stack, write_merged
from mrbokeh.lens import Lens
from training.dataset import read_pair

SIZE = (4, 6)
MATRIX = ((1.7, -0.6, -0.1), (-0.3, 1.6, -0.3), (0.05, -0.55, 1.5))


def make_stack(folder: Path, valid: np.ndarray) -> FocalStack:
    plane, rgb = np.ones(SIZE, np.float32), np.full((*SIZE, 3), 0.5, np.float32)
    rgb[0] = (0.0, 1.0, 0.0)
    write_camera_rgb(folder / "0.exr", rgb, MATRIX, valid=valid, half=False)
    write_merged(folder, rgb, plane, plane, plane, MATRIX)
    stack = FocalStack(folder, (Slice("0.exr", 1.0),), Lens(35.0, 2.0, 1.0, 36.0), registered=True, merged=True, rec709_from_camera=MATRIX)
    write_focal_stack(stack)
    return stack


def test_borders_and_named_exclusions_have_no_weight(tmp_path: Path) -> None:
    valid = np.ones(SIZE, bool)
    valid[:, 0] = False
    stack = make_stack(tmp_path, valid)
    np.testing.assert_array_equal(read_pair(stack, 0).weight, valid)
    moving, saturated = np.zeros(SIZE, bool), np.zeros(SIZE, bool)
    moving[2, 3], saturated[3, 3] = True, True
    write_masks(stack.exclusion_path, {"moving": moving, "saturated": saturated})
    np.testing.assert_array_equal(read_pair(stack, 0).weight, valid & ~moving)


def test_pairs_are_rec709(tmp_path: Path) -> None:
    pair = read_pair(make_stack(tmp_path, np.ones(SIZE, bool)), 0)
    np.testing.assert_allclose(pair.target[0, 0], np.array(MATRIX)[:, 1], rtol=1e-6)
    np.testing.assert_array_equal(pair.all_in_focus, pair.target)
    np.testing.assert_allclose(pair.target[1:], 0.5, rtol=1e-6)

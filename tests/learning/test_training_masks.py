"""Pixels without data and pixels that something excludes do not count in training."""

from pathlib import Path

import numpy as np

from mrbokeh.images.camera_rgb import write_camera_rgb, write_masks
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import FocalStack, Slice, write_focal_stack, write_merged
from training.data.dataset import read_pair
from training.data.pairs import WHERE_TRUTH_IS_KNOWN

SIZE = (4, 6)
MATRIX = ((1.7, -0.6, -0.1), (-0.3, 1.6, -0.3), (0.05, -0.55, 1.5))


def make_stack(folder: Path, valid: np.ndarray, saturated: np.ndarray | None = None) -> FocalStack:
    plane, rgb = np.ones(SIZE, np.float32), np.full((*SIZE, 3), 0.5, np.float32)
    rgb[0] = (0.0, 1.0, 0.0)
    write_camera_rgb(folder / "0.exr", rgb, MATRIX, valid=valid, saturated=saturated, half=False)
    write_merged(folder, rgb, plane, plane, plane, MATRIX)
    stack = FocalStack(folder, (Slice("0.exr", 1.0),), Lens(35.0, 2.0, 1.0, 36.0), registered=True, merged=True, rec709_from_camera=MATRIX)
    write_focal_stack(stack)
    return stack


def test_borders_and_named_exclusions_have_no_weight(tmp_path: Path) -> None:
    valid = np.ones(SIZE, bool)
    valid[:, 0] = False
    stack = make_stack(tmp_path, valid)
    np.testing.assert_array_equal(read_pair(stack, 0).weight, valid)
    named = {name: np.zeros(SIZE, bool) for name in ("moving", "border", "board", "low_confidence", "saturated")}
    for row, mask in enumerate(named.values()):
        mask[min(row, 3), 1 + row] = True
    write_masks(stack.exclusion_path, named)
    saturated = named.pop("saturated")
    counted = valid & ~np.logical_or.reduce(list(named.values()))
    assert (saturated & counted).any(), "saturated in some other slice: this one measured it"
    np.testing.assert_array_equal(read_pair(stack, 0).weight, counted)
    with_guesses = read_pair(stack, 0, WHERE_TRUTH_IS_KNOWN).weight
    np.testing.assert_array_equal(with_guesses, counted | (valid & named["low_confidence"]))


def test_saturated_pixels_of_the_slice_have_no_weight(tmp_path: Path) -> None:
    """A pixel of which a hundredth came from full photosites is less bright than it was."""
    saturated = np.zeros(SIZE, np.float32)
    saturated[1, 2], saturated[2, 2] = 0.01, 1.0
    stack = make_stack(tmp_path, np.ones(SIZE, bool), saturated)
    np.testing.assert_array_equal(read_pair(stack, 0).weight, saturated == 0)
    assert read_pair(stack, 0, WHERE_TRUTH_IS_KNOWN).weight.all()


def test_pairs_are_rec709(tmp_path: Path) -> None:
    pair = read_pair(make_stack(tmp_path, np.ones(SIZE, bool)), 0)
    np.testing.assert_allclose(pair.target[0, 0], np.array(MATRIX)[:, 1], rtol=1e-6)
    np.testing.assert_array_equal(pair.all_in_focus, pair.target)
    np.testing.assert_allclose(pair.target[1:], 0.5, rtol=1e-6)

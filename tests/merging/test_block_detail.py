"""Fine detail by blocks, on waves whose blur is known, and that ingest, merging and the report mean the same by it."""

import cv2
import numpy as np
import pytest
from jaxtyping import Float32

from capture.merging import focus_volume
from capture.report import picture_sharpness
from capture.stacks.slice_looks import BLOCK_PX, DETAIL_SIGMA_PX, block_means, detail_of_blocks
from mrbokeh.images.color import srgb_to_linear

PERIOD_PX, AMPLITUDE = 8.0, 0.1
Plane = Float32[np.ndarray, "height width"]


def wave(height: int = 8 * BLOCK_PX + 5, width: int = 9 * BLOCK_PX + 7) -> Plane:
    """About 0.5, of whole periods in each block."""
    columns = 0.5 + AMPLITUDE * np.cos(2.0 * np.pi * np.arange(width) / PERIOD_PX)
    return np.broadcast_to(columns, (height, width)).astype(np.float32)


def test_a_wave_loses_what_a_gaussian_takes() -> None:
    """A Gaussian leaves exp(-2 (pi sigma / period)^2) of a wave, 0.50 here; the rest has the root mean square amplitude / sqrt(2). At the
    sides the wave is mirrored, which is no wave."""
    found = detail_of_blocks(wave())
    left = np.exp(-2.0 * (np.pi * DETAIL_SIGMA_PX / PERIOD_PX) ** 2)
    assert found.shape == (8, 9) and found.dtype == np.float32
    np.testing.assert_allclose(found[:, 1:-1], AMPLITUDE * (1.0 - left) / np.sqrt(2.0), rtol=1e-3)


def test_callers_choose_encoding_and_border() -> None:
    """Merging takes square roots of light and all blocks, the report sRGB and no blocks at the border: one plane, one answer."""
    plain, grey = detail_of_blocks(wave()), np.repeat(wave()[..., None], 3, axis=2)
    np.testing.assert_allclose(focus_volume.block_detail(grey), plain, rtol=1e-5)
    border = picture_sharpness.BORDER_BLOCKS
    np.testing.assert_allclose(picture_sharpness.block_detail(srgb_to_linear(grey)), plain[border:-border, border:-border], rtol=1e-4)


@pytest.mark.parametrize(("height", "width", "blocks"), [(BLOCK_PX, BLOCK_PX, (1, 1)), (2 * BLOCK_PX - 1, 49, (1, 2)), (10, 5, (1, 1))])
def test_what_does_not_fill_a_block_is_cut_off(height: int, width: int, blocks: tuple[int, int]) -> None:
    """A plane smaller than a block is one."""
    plane = np.random.default_rng(0).random((height, width), np.float32)
    found = block_means(plane)
    assert found.shape == blocks
    assert found[0, 0] == pytest.approx(plane[:BLOCK_PX, :BLOCK_PX].mean(), rel=1e-5)
    assert picture_sharpness.block_detail(cv2.merge([plane] * 3)).shape == (height // BLOCK_PX, width // BLOCK_PX)

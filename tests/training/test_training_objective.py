"""What training strives for: every term against a number that can be worked out by hand, over the pixels that count."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from mrbokeh.images.camera_rgb import write_camera_rgb, write_masks
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import FocalStack, Slice, write_focal_stack, write_merged
from training.data.batches import Batch
from training.data.dataset import read_pair
from training.data.pairs import WHERE_TRUTH_IS_KNOWN
from training.fitting.objective import gaussian, judged, loss, mean_square_error
from training.fitting.settings import TrainSettings
from training.networks.network import TileGrid, assemble, split

SCALE = 4.0  # errors are halved: 2 / SCALE
LARGEST_COC_PX = 12.0
SIGMA_PX = LARGEST_COC_PX / 2.0
PUBLISHED = TrainSettings()
ENERGY, EDGE = replace(PUBLISHED, energy_weight=1.0), replace(PUBLISHED, edge_weight=1.0)


def batch_of(target: Tensor, weight: Tensor | None = None, saturated: Tensor | None = None) -> Batch:
    plane = torch.zeros_like(target[:, :1])
    weight = torch.ones_like(plane) if weight is None else weight
    return Batch(target, plane, target, weight, torch.cat([plane, plane], dim=1), torch.tensor([[1.4, 50.0]]), saturated)


def noise(seed: int = 0, size: tuple[int, int] = (40, 50)) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).random((1, 3, *size), np.float32))


def light(at: tuple[int, int], radiance: float = 100.0, size_px: int = 96) -> Tensor:
    picture = torch.zeros(1, 3, size_px, size_px)
    picture[:, :, at[0], at[1]] = radiance
    return picture


def term(result: Tensor, batch: Batch, settings: TrainSettings) -> float:
    """A term alone, times the number of values: a sum of squares in radiance."""
    difference = judged(result, batch, SCALE, LARGEST_COC_PX, settings) - mean_square_error(result, batch, SCALE, settings)
    return float(difference) * result.numel() * (SCALE / 2.0) ** 2


@dataclass
class Fixed:
    """A network that says always the same."""

    tiles: Tensor
    grid: TileGrid | None

    def __call__(self, *_inputs: Tensor | None) -> Tensor:
        return self.tiles if self.grid is None else assemble(self.tiles, self.grid)

    def tile_outputs(self, *_inputs: Tensor | None) -> Tensor:
        return self.tiles


def test_the_published_loss_is_the_mean_square_error_to_the_last_bit() -> None:
    result, batch = noise(1), batch_of(noise(0), (noise(2)[:, :1] > 0.3).float())
    error = (result - batch.target) * (2.0 / SCALE)
    weight = batch.weight.expand_as(error)
    expected = (weight * error.square()).sum() / weight.sum().clamp(min=1e-6)
    assert torch.equal(loss(Fixed(result, None), batch, SCALE, LARGEST_COC_PX, PUBLISHED), expected)


@pytest.mark.parametrize("weighting", ["uniform", "relative"])
@pytest.mark.parametrize("scope", ["picture", "tile"])
def test_equal_pictures_have_no_loss(weighting: str, scope: str) -> None:
    settings = replace(PUBLISHED, energy_weight=2.0, edge_weight=3.0, loss_weighting=weighting, loss_scope=scope)
    picture, grid = noise(0), TileGrid(40, 50, 20, 8)
    network = Fixed(split(picture, grid), grid)
    assert float(loss(network, batch_of(picture), SCALE, LARGEST_COC_PX, settings)) < 1e-12


def test_the_energy_term_sees_light_that_is_lost_and_hardly_light_that_moved() -> None:
    """A tenth of a light of 100 is missing. Under a Gaussian g the sum of squares is 10^2 sum g^2 = 10^2 / (4 pi sigma^2), per channel;
    it ends at 18.5 px, so that its amplitude is greater by what is missing beyond, along both axes."""
    missing = term(0.9 * light((48, 48)), batch_of(light((48, 48))), ENERGY)
    inside = math.erf(18.5 / SIGMA_PX / math.sqrt(2.0))
    assert missing == pytest.approx(3 * 10.0**2 / (4.0 * np.pi * SIGMA_PX**2) / inside**4, rel=1e-3)
    # By d pixels: 2 (1 - exp(-d^2 / 4 sigma^2)) times 100^2 sum g^2. One pixel of the 12 of the largest blur is then about as bad as
    # a tenth of the light; the mean square error has the move 200 times as bad (2 to 0.1^2).
    batch, moved, dimmed = batch_of(light((48, 48))), light((48, 49)), 0.9 * light((48, 48))
    expected = 3 * 100.0**2 / (4.0 * np.pi * SIGMA_PX**2) * 2.0 * (1.0 - np.exp(-1.0 / (4.0 * SIGMA_PX**2)))
    assert term(moved, batch, ENERGY) == pytest.approx(expected, rel=2e-2)
    assert term(moved, batch, ENERGY) < 1.5 * term(dimmed, batch, ENERGY)
    square = [float(mean_square_error(each, batch, SCALE, PUBLISHED)) for each in (moved, dimmed)]
    assert square[0] == pytest.approx(200.0 * square[1], rel=1e-4)


def test_the_energy_term_is_the_mean_of_what_counts_in_a_gaussian_window() -> None:
    """An error of 0.3 everywhere is a local mean of 0.3 everywhere, whichever pixels do not count, to the border of the picture."""
    weight = (noise(3)[:, :1] > 0.4).float()
    batch = batch_of(noise(0), weight)
    both = float(judged(batch.target + 0.3, batch, SCALE, LARGEST_COC_PX, ENERGY))
    assert both == pytest.approx(2.0 * 0.15**2, rel=1e-4)
    nonsense = torch.where(weight > 0, batch.target + 0.3, torch.full_like(batch.target, 50.0))
    assert float(judged(nonsense, batch, SCALE, LARGEST_COC_PX, ENERGY)) == pytest.approx(both, rel=1e-5)
    # Sum 1, and a second moment of sigma^2 along each axis but for what lies beyond 3 sigma (2.7 % of the moment).
    window, offsets = gaussian(light((48, 48), 1.0)[:, :1], SIGMA_PX)[0, 0], torch.arange(96) - 48.0
    assert float(window.sum()) == pytest.approx(1.0, rel=1e-5)
    assert float(window.sum(dim=0) @ offsets.square()) == pytest.approx(SIGMA_PX**2, rel=0.04)


def test_the_edge_term_sees_a_blurred_edge_where_it_counts() -> None:
    """A step of 1 comes out as a ramp over 4 pixels. The slopes differ by 3/4 once and by 1/4 three times: 9/16 + 3/16 = 3/4 for each
    of the rows; counted are all pairs of neighbours, right and down."""
    height, width = 6, 20
    sharp, ramp = (np.arange(width) >= 10).astype(np.float32), np.clip((np.arange(width) - 7) / 4.0, 0.0, 1.0).astype(np.float32)
    target, result = (torch.from_numpy(np.broadcast_to(each, (1, 3, height, width)).copy()) for each in (sharp, ramp))
    batch = batch_of(target)
    found = float(judged(result, batch, SCALE, LARGEST_COC_PX, EDGE) - mean_square_error(result, batch, SCALE, EDGE))
    pairs = height * (width - 1) + (height - 1) * width
    assert found == pytest.approx(0.75 * height / pairs * (2.0 / SCALE) ** 2, rel=1e-4)
    assert term(target + 0.7, batch, EDGE) == pytest.approx(0.0, abs=1e-4), "brighter everywhere is no edge"
    batch = batch_of(noise(0), torch.ones(1, 1, 40, 50))
    batch.weight[:, :, :, 20:] = 0.0
    result = batch.target + 0.2
    result[:, :, :, 20:] += 30.0
    assert term(result, batch, EDGE) == pytest.approx(0.0, abs=1e-4)


def test_a_full_photosite_says_at_least_so_bright() -> None:
    """Slice 1.0 everywhere, full on the left half: 3.0 is an error of 0 there and of 2 elsewhere, 0.5 an error of 0.5 in both."""
    target, saturated = torch.ones(1, 3, 8, 8), torch.zeros(1, 1, 8, 8, dtype=torch.bool)
    saturated[..., :4] = True
    one_sided = batch_of(target, saturated=saturated)
    unit = (2.0 / SCALE) ** 2
    assert float(mean_square_error(3.0 * target, one_sided, SCALE, PUBLISHED)) == pytest.approx(0.5 * 2.0**2 * unit)
    assert float(mean_square_error(0.5 * target, one_sided, SCALE, PUBLISHED)) == pytest.approx(0.5**2 * unit)
    everything = batch_of(target, saturated=torch.ones_like(saturated))
    assert float(judged(7.0 * target, everything, SCALE, LARGEST_COC_PX, replace(ENERGY, edge_weight=1.0))) == 0.0


GRID = TileGrid(20, 32, 20, 8)  # two tiles, side by side, 12 px apart: they share columns 12 to 19


def test_tiles_that_disagree_are_judged_apart_each_by_its_own_pixels() -> None:
    """One tile says 1 too much and the other 1 too little: where they overlap their mean is right, which only the picture sees."""
    target = noise(0, (20, 32))
    tiles = split(target, GRID)
    sides = torch.tensor([1.0, 1.0, 1.0, -1.0, -1.0, -1.0])[None, :, None, None]
    network, batch, unit = Fixed(tiles + sides, GRID), batch_of(target), (2.0 / SCALE) ** 2
    per_tile = replace(PUBLISHED, loss_scope="tile")
    assert float(loss(network, batch, SCALE, LARGEST_COC_PX, PUBLISHED)) == pytest.approx(24 / 32 * unit, rel=1e-5)
    assert float(loss(network, batch, SCALE, LARGEST_COC_PX, per_tile)) == pytest.approx(unit, rel=1e-5)
    agreeing = Fixed(tiles + 1.0, GRID)
    assert float(loss(agreeing, batch, SCALE, LARGEST_COC_PX, PUBLISHED)) == pytest.approx(unit, rel=1e-5)
    assert float(loss(agreeing, batch, SCALE, LARGEST_COC_PX, per_tile)) == pytest.approx(unit, rel=1e-5)
    # Of the right tile only the column 25 counts, and is wrong by 1; the left one is right, so the mean over tiles is a half of 1.
    # With nothing that counts in the right tile it has no say.
    batch = batch_of(target, torch.ones(1, 1, 20, 32))
    batch.weight[..., 12:] = 0.0
    batch.weight[..., 25] = 1.0
    tiles = split(target, GRID).clone()
    tiles[:, 3:, :, 13] += 1.0
    settings, unit = replace(PUBLISHED, loss_scope="tile"), (2.0 / SCALE) ** 2
    assert float(loss(Fixed(tiles, GRID), batch, SCALE, LARGEST_COC_PX, settings)) == pytest.approx(0.5 * unit, rel=1e-5)
    batch.weight[..., 25] = 0.0
    tiles[:, :3] += 1.0
    assert float(loss(Fixed(tiles, GRID), batch, SCALE, LARGEST_COC_PX, settings)) == pytest.approx(unit, rel=1e-5)


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


def test_borders_exclusions_and_saturated_pixels_have_no_weight(tmp_path: Path) -> None:
    plain = read_pair(make_stack(tmp_path / "plain", np.ones(SIZE, bool)), 0)
    np.testing.assert_allclose(plain.target[0, 0], np.array(MATRIX)[:, 1], rtol=1e-6, err_msg="pairs are Rec.709")
    np.testing.assert_array_equal(plain.all_in_focus, plain.target)
    np.testing.assert_allclose(plain.target[1:], 0.5, rtol=1e-6)
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
    # A pixel of which a hundredth came from full photosites is less bright than it was.
    saturated = np.zeros(SIZE, np.float32)
    saturated[1, 2], saturated[2, 2] = 0.01, 1.0
    stack = make_stack(tmp_path / "saturated", np.ones(SIZE, bool), saturated)
    np.testing.assert_array_equal(read_pair(stack, 0).weight, saturated == 0)
    assert read_pair(stack, 0, WHERE_TRUTH_IS_KNOWN).weight.all()

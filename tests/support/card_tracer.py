"""The mean over lens points of exactly displaced cards: arrays, sample points and threads round the compiled loops."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int, Int8, Int16

from mrbokeh.optics.aperture import Aperture
from tests.support.cards import Card, Lamp, TexelGrid

# An opening of no size: with planes of no blur the lens point does not matter, the aperture still spreads the samples.
PINHOLE = Aperture.blades(4)
_BLOCKS = 64
_ROWS_PER_PIECE = 8
# A lamp has this share of `positions` as rays for every pixel of its blur: it is brighter than the cards, but flat.
_LAMP_RAYS_SHARE = 0.15


@dataclass(frozen=True, eq=False)
class PackedCards:
    """Cards and lamps as arrays for compiled code, front first.

    solid: (K, rows, columns) distance fields; colour: (K, rows, columns, 3); cells: (K, H, W) lamp index per pixel, -1 where
    none; lamps: (L, 7) card, x, y, radius, red, green, blue.
    """

    solid: Float32[np.ndarray, "cards rows columns"]
    colour: Float32[np.ndarray, "cards rows columns 3"]
    cells: Int16[np.ndarray, "cards cell_rows cell_columns"]
    lamps: Float64[np.ndarray, "lamps 7"]

    @classmethod
    def of(cls, cards: Sequence[Card], lamps: Sequence[Lamp], grid: TexelGrid) -> "PackedCards":
        size = (grid.height_px + 2 * grid.margin_px, grid.width_px + 2 * grid.margin_px)
        cells = np.full((len(cards), *size), -1, np.int16)
        for index, lamp in enumerate(lamps):
            low_x, high_x = (int(np.floor(lamp.x_px + side * lamp.radius_px)) + grid.margin_px for side in (-1, 1))
            low_y, high_y = (int(np.floor(lamp.y_px + side * lamp.radius_px)) + grid.margin_px for side in (-1, 1))
            cells[lamp.card, low_y : high_y + 1, low_x : high_x + 1] = index
        rows = [(lamp.card, lamp.x_px, lamp.y_px, lamp.radius_px, *lamp.radiance_rgb) for lamp in lamps]
        return cls(
            np.stack([card.solid for card in cards]).astype(np.float32),
            np.stack([card.colour for card in cards]).astype(np.float32),
            cells,
            np.array(rows, np.float64).reshape(-1, 7),
        )

    def only(self, card: int) -> "PackedCards":
        """One card and its lamps."""
        lamps = self.lamps.copy()
        lamps[:, 0] = np.where(lamps[:, 0] == card, 0, -1)
        return PackedCards(self.solid[card : card + 1], self.colour[card : card + 1], self.cells[card : card + 1], lamps)


def trace(
    packed: PackedCards, grid: TexelGrid, planes: Float64[np.ndarray, "cards 3"], aperture: Aperture, positions: int
) -> Float32[np.ndarray, "height width 4"]:
    """Return mean RGB and coverage seen through the aperture; planes (K, 3) give each card's CoC as a + bx x + by y.

    positions: lens points per pixel for the cards; lamps are followed with as many rays as give their discs the same.
    """
    reach = reach_of(packed, grid, planes, aperture.unit_radius)
    result = _trace_cards(packed, grid, planes, aperture, positions, reach, np.zeros((0, 0, 0)))
    if np.any(packed.lamps[:, 0] >= 0):
        result += _trace_lamps(packed, grid, planes, aperture, positions, reach)
    return result.astype(np.float32)


def card_coverage(packed: PackedCards, grid: TexelGrid, positions: int) -> Float64[np.ndarray, "height width cards"]:
    """Share of every pixel that each card fills in the sharp picture."""
    coverage = np.zeros((grid.height_px, grid.width_px, len(packed.solid)))
    planes = np.zeros((len(packed.solid), 3))
    _trace_cards(packed, grid, planes, PINHOLE, positions, reach_of(packed, grid, planes, PINHOLE.unit_radius), coverage)
    return coverage


def lens_samples(
    aperture: Aperture, positions: int, blocks: int, seed: int = 7
) -> tuple[Float64[np.ndarray, "samples 5"], Int[np.ndarray, " starts"]]:
    """Blocks of at least `positions` points each on average: lens point (2), second point in the unit square (2), weight.

    Scrambled Sobol points in four dimensions; those outside the opening are left out, which keeps the others even.
    """
    from scipy.stats import qmc

    raw = _raw_count(aperture, positions)
    points = qmc.Sobol(4, seed=seed).random(raw * blocks)
    lens = (2.0 * points[:, :2] - 1.0) * aperture.unit_radius
    weight = transmission(aperture, lens)
    samples = np.column_stack([lens, points[:, 2:], weight])
    counts = np.count_nonzero(weight.reshape(blocks, raw), axis=1)
    return samples[weight != 0], np.concatenate([[0], np.cumsum(counts)])


def transmission(aperture: Aperture, points: Float64[np.ndarray, "points 2"]) -> Float64[np.ndarray, " points"]:
    """Sum of the weights of the outlines round every lens point."""
    from tests.support import _card_tracer_numba

    return _card_tracer_numba.transmission(*aperture.packed(), points)


def _raw_count(aperture: Aperture, positions: int) -> int:
    """Return the power of two at which the points within the opening are at least `positions` with a little to spare."""
    side = (np.arange(256) + 0.5) / 128.0 - 1.0
    probe = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2) * aperture.unit_radius
    share = float(np.count_nonzero(transmission(aperture, probe))) / len(probe)
    return 1 << int(np.ceil(np.log2(positions / share)))


def reach_of(
    packed: PackedCards, grid: TexelGrid, planes: Float64[np.ndarray, "cards 3"], unit_radius: float
) -> Int8[np.ndarray, "height width cards"]:
    """Return for every pixel and card whether no ray, some or all rays of the pixel meet it: what the compiled loop may skip.

    A distance field changes by at most a pixel per pixel, so its value in the middle of the rays' footprint tells.
    """
    from tests.support._card_tracer_numba import ALL, OUT, SOME

    x, y = np.arange(grid.width_px) + 0.5, np.arange(grid.height_px)[:, None] + 0.5
    inside = slice(grid.margin_px * grid.density, -grid.margin_px * grid.density)
    result = np.full((grid.height_px, grid.width_px, len(packed.solid)), SOME, np.int8)
    for k, plane in enumerate(planes):
        blur_px = 0.5 * abs(plane[0] + plane[1] * x + plane[2] * y) * unit_radius
        # A slanted card is met at places of another blur: of the blur at the pixel by this factor at most.
        footprint_px = blur_px / (1.0 - 0.5 * unit_radius * float(np.hypot(plane[1], plane[2]))) + 2.0
        middle = packed.solid[k, inside, inside][:: grid.density, :: grid.density]
        lamp_near = np.zeros(middle.shape, bool)
        for _, lamp_x, lamp_y, radius_px, *_ in packed.lamps[packed.lamps[:, 0] == k]:
            lamp_near |= np.hypot(x - lamp_x, y - lamp_y) < footprint_px + radius_px
        result[..., k][(middle < -footprint_px) & ~lamp_near] = OUT
        result[..., k][(middle > footprint_px) & ~lamp_near] = ALL
    return result


def _trace_cards(
    packed: PackedCards,
    grid: TexelGrid,
    planes: Float64[np.ndarray, "cards 3"],
    aperture: Aperture,
    positions: int,
    reach: Int8[np.ndarray, "height width cards"],
    coverage: Float64[np.ndarray, "_ _ _"],
) -> Float64[np.ndarray, "height width 4"]:
    """Trace the cards with black lamps, in pieces of rows; each pixel has its own samples, so threads change nothing."""
    from tests.support._card_tracer_numba import trace_rows

    samples, starts = lens_samples(aperture, positions, _BLOCKS)
    result = np.zeros((grid.height_px, grid.width_px, 4))
    arrays = (planes, packed.solid, packed.colour, packed.cells, packed.lamps, reach, (grid.margin_px, grid.density), samples, starts)

    def run(top: int) -> None:
        trace_rows(result, coverage, (top, min(top + _ROWS_PER_PIECE, grid.height_px)), *arrays)

    with ThreadPoolExecutor() as pool:
        list(pool.map(run, range(0, grid.height_px, _ROWS_PER_PIECE)))
    return result


def _trace_lamps(
    packed: PackedCards,
    grid: TexelGrid,
    planes: Float64[np.ndarray, "cards 3"],
    aperture: Aperture,
    positions: int,
    reach: Int8[np.ndarray, "height width cards"],
) -> Float64[np.ndarray, "height width 4"]:
    """Trace the light of the lamps, one after the other: rays in proportion to the area over which a lamp spreads."""
    from tests.support._card_tracer_numba import add_lamp

    arrays = (planes, packed.solid, packed.cells, packed.lamps, reach, (grid.margin_px, grid.density))
    samples_of: dict[int, Float64[np.ndarray, "samples 5"]] = {}
    light = np.zeros((grid.height_px, grid.width_px, 4))
    for index, (card, x, y, radius_px, *_) in enumerate(packed.lamps):
        if card < 0:
            continue
        blur_px = 0.5 * abs(planes[int(card)] @ np.array([1.0, x, y])) * aperture.unit_radius
        rays = 1 << int(np.ceil(np.log2(_LAMP_RAYS_SHARE * positions * np.pi * (blur_px + radius_px + 1.0) ** 2)))
        if rays not in samples_of:
            samples_of[rays] = _on_unit_disc(lens_samples(aperture, rays, 1, seed=11)[0])
        add_lamp(light, index, *arrays, samples_of[rays])
    return light


def _on_unit_disc(samples: Float64[np.ndarray, "samples 5"]) -> Float64[np.ndarray, "samples 5"]:
    """Return the second points moved from the unit square to the unit disc, area for area."""
    radius, angle_rad = np.sqrt(samples[:, 2]), 2.0 * np.pi * samples[:, 3]
    return np.column_stack([samples[:, :2], radius * np.cos(angle_rad), radius * np.sin(angle_rad), samples[:, 4]])

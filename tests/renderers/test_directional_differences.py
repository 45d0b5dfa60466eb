"""Sparse differenced kernels: the counts of the paper's Table 1, and that summing brings the kernel back."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.polygon.directional_differences import Direction, Taps, downwards, edge_profile, polygon_corners
from mrbokeh.renderers.polygon.rectification import PAPER_DIRECTIONS, rectify_aperture
from mrbokeh.system.errors import InputError

Corners = list[tuple[int, int]]


def differenced_kernel(corners: Sequence[tuple[int, int]]) -> dict[Direction, Taps]:
    """Return K'' of the paper's Eq. 4, by direction, for a polygon with its corners on the lattice, x turning towards y."""
    grouped: dict[Direction, Taps] = {}
    for here, there in zip(corners, (*corners[1:], corners[0]), strict=True):
        direction = downwards((there[0] - here[0], there[1] - here[1]))
        if direction[0] == 0:
            continue
        taps = grouped.setdefault(direction, {})
        for (x, y), weight in edge_profile(direction).items():
            for end, sign in ((here, 1.0), (there, -1.0)):
                place = (end[0] + x, end[1] + y)
                taps[place] = taps.get(place, 0.0) + sign * weight * (1 if direction[0] > 0 else -1)
    return grouped


def polygon(half: Corners) -> Corners:
    """A polygon symmetric about the origin from its first half of corners."""
    return [*half, *((-x, -y) for x, y in half)]


def hexagon(r: int) -> Corners:
    """Upright sides and slanted ones at 45 degrees, which a picture scaled in height by tan 30 makes regular (Section 6.4)."""
    return polygon([(0, -2 * r), (r, -r), (r, r)])


def octagon(r: int) -> Corners:
    b = round(0.4142 * r)
    return polygon([(-b, -r), (b, -r), (r, -b), (r, b)])


def dodecagon(r: int) -> Corners:
    """Directions (1, 0), (2, 1), (1, 2), (0, 1), in proportions near the regular one."""
    k = max(1, round(0.26 * r))
    return polygon([(-k, -4 * k), (k, -4 * k), (3 * k, -3 * k), (4 * k, -k), (4 * k, k), (3 * k, 3 * k)])


def hexadecagon(r: int) -> Corners:
    k = max(1, r // 6)
    return polygon([(-k, -5 * k), (k, -5 * k), (3 * k, -4 * k), (4 * k, -3 * k), (5 * k, -k), (5 * k, k), (4 * k, 3 * k), (3 * k, 4 * k)])


def summed_back(grouped: dict[Direction, Taps], size: int) -> np.ndarray:
    """The paper's Eq. 9 for one pixel in the middle, by its Eq. 13."""
    total = np.zeros((size, size))
    for (dx, dy), taps in grouped.items():
        plane = np.zeros((size, size))
        for (x, y), weight in taps.items():
            plane[y + size // 2, x + size // 2] = weight
        for y in range(size):
            for x in range(size) if dx > 0 else range(size - 1, -1, -1):
                if y - dy >= 0 and 0 <= x - dx < size:
                    plane[y, x] += plane[y - dy, x - dx]
        total += plane
    return np.cumsum(total, axis=0)


@pytest.mark.parametrize("shape", [hexagon, octagon, dodecagon, hexadecagon])
def test_covered_area_comes_back(shape) -> None:  # type: ignore[no-untyped-def]
    """Against the exact coverage of Aperture.rasterize, whose kernels are centred on a pixel: shift by half a pixel."""
    corners = np.array(shape(12), float)
    extent = np.abs(corners).max() + 1.0
    psf = Aperture((((corners - 0.5) / extent).astype(float),), (1.0,)).rasterize(2 * extent).kernel
    size = 2 * (psf.shape[0] // 2 + 4) + 1
    expected = np.pad(psf, (size - psf.shape[0]) // 2)
    kernel = summed_back(differenced_kernel(shape(12)), size)
    np.testing.assert_allclose(kernel / kernel.sum(), expected, atol=1e-12)
    assert kernel.max() == pytest.approx(1.0)


def test_profiles_of_the_papers_directions() -> None:
    """Areas of triangles and trapezoids that a line of slope 0, 1, 1/2 and 2 cuts from pixels."""
    assert edge_profile((1, 0)) == {(0, 0): 1.0}
    assert edge_profile((1, 1)) == {(0, 0): 0.5, (0, 1): 0.5}
    assert edge_profile((-1, 1)) == {(-1, 0): 0.5, (-1, 1): 0.5}
    assert edge_profile((2, 1)) == {(0, 0): 0.75, (0, 1): 0.25, (1, 0): 0.25, (1, 1): 0.75}
    assert edge_profile((1, 2)) == {(0, 0): 0.25, (0, 1): 0.5, (0, 2): 0.25}
    assert edge_profile((0, 1)) == {}


@given(st.integers(-6, 6), st.integers(-6, 6))
def test_every_column_of_a_profile_is_one_pixel_high(dx: int, dy: int) -> None:
    if (dx, dy) == (0, 0):
        with pytest.raises(InputError):
            downwards((dx, dy))
        return
    run = abs(downwards((dx, dy))[0])
    columns: dict[int, float] = {}
    for (x, _), weight in edge_profile((dx, dy)).items():
        columns[x] = columns.get(x, 0.0) + weight
    assert len(columns) == run
    np.testing.assert_allclose(list(columns.values()), 1.0, atol=1e-12)


APERTURES = {
    "octagon": Aperture.blades(8, np.pi / 8),
    "hexagon": Aperture.blades(6),
    "disc": Aperture.disc(),
    "heart": Aperture.heart(),
    "star": Aperture.star(),
    "ring": Aperture.ring(0.5),
}


@pytest.mark.parametrize("name", APERTURES)
def test_corners_span_the_lattice_and_know_their_area(name: str) -> None:
    rectified = rectify_aperture(APERTURES[name])
    corners = polygon_corners(rectified, PAPER_DIRECTIONS)
    for before, after in zip(corners.before, corners.after, strict=True):
        (ax, ay), (bx, by) = corners.direction[before], corners.direction[after]
        assert abs(ax * by - ay * bx) == 1
    area = sum(
        weight * abs(np.dot(x, np.roll(y, -1)) - np.dot(np.roll(x, -1), y)) / 2
        for (x, y), weight in zip((outline.T for outline in rectified.outlines), rectified.weights, strict=True)
    )
    assert corners.area[0] == pytest.approx(area, rel=1e-9)
    assert abs(corners.area[1]) < 8.0, "blunted tips cost a few square pixels at any size"


def test_a_convex_polygon_of_all_directions_needs_no_inserted_edges() -> None:
    corners = polygon_corners(rectify_aperture(APERTURES["disc"]), PAPER_DIRECTIONS)
    assert len(corners.slope) == 16
    np.testing.assert_array_equal(corners.shift, 0.0)


def test_an_unrectified_outline_is_refused() -> None:
    with pytest.raises(InputError, match="rectify it first"):
        polygon_corners(Aperture.disc(), PAPER_DIRECTIONS)

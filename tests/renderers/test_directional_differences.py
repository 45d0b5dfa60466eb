"""Profiles of edges, as areas that a line cuts from pixels, and the corners of rectified outlines."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.polygon.directional_differences import downwards, edge_profile, polygon_corners
from mrbokeh.renderers.polygon.rectification import PAPER_DIRECTIONS, rectify_aperture
from mrbokeh.system.errors import InputError


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
    "octagon": Aperture.blades(8, np.pi / 8), "hexagon": Aperture.blades(6), "disc": Aperture.disc(), "heart": Aperture.heart(),
    "star": Aperture.star(), "ring": Aperture.ring(0.5),
}  # fmt: skip


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


def test_convex_polygons_need_no_inserted_edges_and_unrectified_ones_are_refused() -> None:
    corners = polygon_corners(rectify_aperture(APERTURES["disc"]), PAPER_DIRECTIONS)
    assert len(corners.slope) == 16
    np.testing.assert_array_equal(corners.shift, 0.0)
    with pytest.raises(InputError, match="rectify it first"):
        polygon_corners(Aperture.disc(), PAPER_DIRECTIONS)

"""Openings of known area, symmetry and centroid."""

from collections.abc import Callable

import numpy as np
import pytest

from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.aperture_shapes import area, blades, centroid, net_area
from mrbokeh.system.errors import InputError


def light(aperture: Aperture) -> float:
    return net_area((aperture.outlines, aperture.weights))


def middle(aperture: Aperture) -> np.ndarray:
    return centroid((aperture.outlines, aperture.weights))


def width(aperture: Aperture) -> float:
    return float(np.ptp(np.concatenate(aperture.outlines)[:, 0]))


def smooth_disc(size: int, centre: tuple[float, float], radius: float) -> np.ndarray:
    """A disc with an edge one pixel wide, as a drawing program makes it."""
    y, x = np.mgrid[:size, :size] + 0.5
    return np.clip(radius + 0.5 - np.hypot(x - centre[0], y - centre[1]), 0.0, 1.0)


@pytest.mark.parametrize("count", [3, 4, 5, 8, 11])
@pytest.mark.parametrize("curvature", [0.0, 0.2, 0.7, 1.0, -0.3, -0.55])
def test_blades_have_the_area_of_a_polygon_with_circular_segments(count: int, curvature: float) -> None:
    """n corners on the unit circle, and on each side a segment R^2 (phi - sin phi) / 2 of a circle of radius R = 1 / |curvature|."""
    expected = count / 2 * np.sin(2 * np.pi / count)
    if curvature:
        angle = 2 * np.arcsin(abs(curvature) * np.sin(np.pi / count))
        expected += np.sign(curvature) * count / curvature**2 * (angle - np.sin(angle)) / 2
    assert area(blades(count, 0.4, curvature)) == pytest.approx(expected, abs=6e-3)  # a 64-gon in the unit circle lacks 0.005


def test_the_vertices_of_curved_blades_lie_on_circles_of_their_radius_inwards_too() -> None:
    """The first blade of a pentagon of curvature 1/2 (McGraw Fig. 7 left): distance 2 from its centre beyond the middle."""
    outline = blades(5, 0.0, 0.5)
    first = outline[: len(outline) // 5 + 1]
    chord_middle = 0.5 * (first[0] + first[-1])
    apothem, half_chord = np.hypot(*chord_middle), 0.5 * np.hypot(*(first[-1] - first[0]))
    centre = chord_middle / apothem * (apothem - np.sqrt(2.0**2 - half_chord**2))
    np.testing.assert_allclose(np.hypot(*(first - centre).T), 2.0, rtol=1e-12)
    np.testing.assert_allclose(np.hypot(*blades(5, 0.0, 1.0).T), 1.0, rtol=1e-12)
    # The unit square's diagonal is 2; four quarter discs of radius 1 between its corners leave 4 - pi.
    assert area(blades(4, 0.0, -1.0)) == pytest.approx(4 - np.pi, rel=1e-2)


@pytest.mark.parametrize("inner", [0.1, 0.6, 0.95])
def test_a_ring_has_the_area_of_two_discs(inner: float) -> None:
    assert light(Aperture.ring(inner)) == pytest.approx(np.pi * (1 - inner**2), rel=1e-12)
    assert Aperture.ring(0.0).weights == (1.0,)


def test_a_stop_takes_away_only_what_it_covers() -> None:
    """The corners of a triangle reach 1, its sides come to 1/2: a stop of 0.8 leaves the three corners."""
    corners = Aperture.blades(3).obstructed(0.8)
    angle = 2 * np.arccos(0.5 / 0.8)
    covered = np.pi * 0.8**2 - 3 * 0.8**2 / 2 * (angle - np.sin(angle))
    assert light(corners) == pytest.approx(3 / 4 * np.sqrt(3) - covered, rel=5e-3)
    assert corners.rasterize(60.0).kernel.min() > -1e-15


@pytest.mark.parametrize(("points", "inner"), [(5, 0.4), (6, 0.577), (3, 1.0)])
def test_a_star_has_the_area_of_its_triangles(points: int, inner: float) -> None:
    assert light(Aperture.star(points, inner)) == pytest.approx(points * inner * np.sin(np.pi / points), rel=1e-12)
    np.testing.assert_allclose(Aperture.star(points, inner).outlines[0][0], [0.0, -1.0], atol=1e-15)


def test_a_heart_has_the_area_of_its_curve_is_symmetric_and_stays_in_place() -> None:
    """Green's theorem: the curve encloses 180 pi and is 32 wide."""
    heart = Aperture.heart()
    assert light(heart) / width(heart) ** 2 == pytest.approx(180 * np.pi / 32**2, rel=3e-3)
    outline = heart.outlines[0]
    np.testing.assert_allclose(np.sort(outline[:, 0]), np.sort(-outline[:, 0]), atol=1e-12)
    np.testing.assert_allclose(middle(heart), 0.0, atol=1e-12)
    np.testing.assert_allclose(outline[np.argmax(outline[:, 1])], [0.0, 1.0], atol=1e-12)
    assert heart.unit_radius == pytest.approx(1.0)
    kernel = heart.rasterize(41.0).kernel
    offsets = np.arange(len(kernel)) - len(kernel) // 2
    np.testing.assert_allclose([(kernel.sum(0) * offsets).sum(), (kernel.sum(1) * offsets).sum()], 0.0, atol=1e-3)


@pytest.mark.parametrize("squeeze", [0.75, 1.33, 2.0])
def test_squeeze_divides_the_width(squeeze: float) -> None:
    squeezed = Aperture.disc().squeezed(squeeze)
    assert light(squeezed) == pytest.approx(np.pi / squeeze, rel=1e-12)
    assert width(squeezed) == pytest.approx(width(Aperture.disc()) / squeeze)


def test_neutral_changes_return_the_same_aperture_and_turns_go_from_x_to_y() -> None:
    disc = Aperture.disc()
    assert disc.squeezed(1.0) is disc and disc.rotated(0.0) is disc and disc.obstructed(0.0) is disc
    np.testing.assert_allclose(Aperture.blades(5).rotated(0.3).outlines[0], Aperture.blades(5, 0.3).outlines[0], atol=1e-15)


REFUSED = [
    *((Aperture.blades, (count, 0.0, curvature), "curvature") for count, curvature in ((6, 1.01), (3, -0.6), (6, -1.01), (6, np.nan))),
    *((Aperture.star, of, "star") for of in ((2,), (5, 0.0))),
    (Aperture.disc().squeezed, (0.0,), "squeeze"),
    *((Aperture.from_picture, (each,), "traced from a picture") for each in (np.zeros((9, 9)), np.full((9, 9), np.nan), -np.ones((9, 9)))),
    *((Aperture.from_outline, (each,), "expected|at least 3 points") for each in ("M nonsense", "", "M0 0 L1 1", "L1 1 2 3")),
    *((Aperture.from_outline, ([[0.0, 0.0], [1.0, 1.0], *more],), "expected|at least 3 points") for more in ([], [[2.0, 2.0]])),
]


@pytest.mark.parametrize(("make", "of", "said"), REFUSED)
def test_openings_that_cannot_be_are_refused(make: Callable[..., Aperture], of: tuple, said: str) -> None:
    with pytest.raises(InputError, match=said):
        make(*of)


def test_drawn_discs_rings_and_bars_are_traced() -> None:
    traced = Aperture.from_picture(smooth_disc(100, (43.2, 55.7), 30.4))
    radii = np.hypot(*traced.outlines[0].T)
    assert radii.min() > 1 - 0.25 / 30.4 and radii.max() == pytest.approx(1.0)
    assert light(traced) == pytest.approx(np.pi, rel=1e-2)
    traced = Aperture.from_picture(smooth_disc(128, (64.0, 64.0), 50.0) - smooth_disc(128, (64.0, 64.0), 20.0))
    assert traced.weights == (1.0, -1.0)
    assert area(traced.outlines[1]) / area(traced.outlines[0]) == pytest.approx((20 / 50) ** 2, rel=2e-2)
    # Two bars of 10 x 40 and 20 x 40 pixels: the light's centroid divides their distance 1 : 2.
    picture = np.zeros((40, 80), np.float32)
    picture[:, :10] = picture[:, 60:] = 3.0
    traced = Aperture.from_picture(picture)
    assert traced.weights == (1.0, 1.0)
    lefts = sorted(float(outline[:, 0].mean()) for outline in traced.outlines)
    assert -lefts[0] / lefts[1] == pytest.approx(2.0, rel=0.02)
    np.testing.assert_allclose(middle(traced), 0.0, atol=1e-12)


def test_grey_is_rendered_by_levels() -> None:
    """Transmission growing linearly over 160 px: its centroid lies at 2/3 of the length, and half of the levels pass at half of it."""
    ramp = np.repeat(np.linspace(0.0, 1.0, 160)[None], 40, axis=0)
    traced = Aperture.from_picture(ramp, levels=8)
    assert traced.weights == (1 / 8,) * 8
    right = max(outline[:, 0].max() for outline in traced.outlines)
    starts = np.sort([outline[:, 0].min() for outline in traced.outlines])
    np.testing.assert_allclose(np.diff(starts), np.diff(starts).mean(), rtol=1e-6)
    assert right / (right - starts[0] + np.diff(starts).mean() / 2) == pytest.approx(1 / 3, abs=0.005)


def test_outlines_have_their_areas_whatever_they_are_written_as() -> None:
    """A parabola over its chord: 2/3 of base times height; the cubic with both controls 1 above the chord's ends: 3/5."""
    circle = Aperture.from_outline("M 30 50 a 20 20 0 1 0 40 0 a 20,20 0 1 0 -40,0 z")
    assert light(circle) / width(circle) ** 2 == pytest.approx(np.pi / 4, rel=2e-3)
    parabola = Aperture.from_outline("M0 0Q1 2 2 0Z")
    assert light(parabola) / width(parabola) ** 2 == pytest.approx(1 / 3, rel=2e-3)
    cubic = Aperture.from_outline("m0,0 c0,1 1,1 1,0 z")
    assert light(cubic) / width(cubic) ** 2 == pytest.approx(0.6, rel=3e-3)
    framed = Aperture.from_outline("M0 0H4V4H0Z M1 1h2v2h-2z")
    assert framed.weights == (1.0, -1.0)
    assert light(framed) / width(framed) ** 2 == pytest.approx(12 / 16)
    points = [[0.0, 0.0], [4.0, 0.0], [0.0, 3.0]]
    by_points, by_path = Aperture.from_outline(points), Aperture.from_outline("M0 0 4 0 0 3Z")
    np.testing.assert_allclose(by_points.outlines[0], by_path.outlines[0], atol=1e-15)
    np.testing.assert_allclose(middle(by_points), 0.0, atol=1e-12)
    bow_tie = Aperture.from_outline([[-1.0, -1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, 1.0]])
    assert bow_tie.weights == (1.0, 1.0) and light(bow_tie) == pytest.approx(2 / 2)  # two triangles of area 1, corners at sqrt(2)

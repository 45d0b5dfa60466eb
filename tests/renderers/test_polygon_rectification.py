"""Rectified kernels against a geometry library, against enumeration, and against the claims of Moroto et al. 2021, Section 4 and 6.1."""

from collections.abc import Iterator

import numpy as np
import pytest
import shapely
from shapely import Polygon, affinity

from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.polygon.outlines import Outline, area, centroid
from mrbokeh.renderers.polygon.rectification import (
    PAPER_DIRECTIONS,
    _unit_steps,
    rectify,
    rectify_aperture,
    same_area_and_centroid,
    smallest_polygon,
)
from mrbokeh.system.errors import InputError


def area_excess(rectified: Outline, outline: Outline) -> float:
    """Return how much larger the rectified polygon is than its outline, as a share of the outline's area (0 = equal)."""
    return abs(area(rectified)) / abs(area(outline)) - 1.0


EIGHTHS = ((1, 0), (0, 1), (1, 1), (1, -1))
UPRIGHT = ((1, 0), (0, 1))
MIRRORS = {"x": np.diag([-1.0, 1.0]), "y": np.diag([1.0, -1.0]), "diagonal": np.array([[0.0, 1.0], [1.0, 0.0]])}
QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])


def polar(radii: np.ndarray, offset_rad: float = 0.0) -> np.ndarray:
    angles_rad = offset_rad + 2.0 * np.pi * np.arange(len(radii)) / len(radii)
    return radii[:, None] * np.stack([np.cos(angles_rad), np.sin(angles_rad)], axis=1)


def heart(count: int, shift: float = 0.0) -> np.ndarray:
    t = 2.0 * np.pi * (np.arange(count) + shift) / count
    upwards = 13 * np.cos(t) - 5 * np.cos(2 * t) - 2 * np.cos(3 * t) - np.cos(4 * t)
    return np.stack([16 * np.sin(t) ** 3, -upwards], axis=1) / 17.0


def clover(count: int) -> np.ndarray:
    return polar(0.55 + 0.45 * np.cos(4 * 2.0 * np.pi * np.arange(count) / count))


def pentagram(count: int) -> np.ndarray:
    """The outline of the five-pointed star, tip up, with vertices along its straight sides; inner radius (3 - sqrt 5) / 2."""
    tips = polar(np.where(np.arange(10) % 2 == 0, 1.0, (3.0 - np.sqrt(5.0)) / 2.0), -np.pi / 2)
    share = np.arange(count) * 10 / count
    near = share.astype(int)
    return tips[near] + (share - near)[:, None] * (tips[(near + 1) % 10] - tips[near])


FIGURE_6 = {
    "circle": polar(np.ones(64)), "hexagon": polar(np.ones(6)), "small heart": heart(24), "large heart": heart(200),
    "clover": clover(370), "pentagram": pentagram(1072),
}  # fmt: skip
SMALL = {
    "dart": np.array([[-1.0, -0.93], [0.04, -0.31], [1.07, -0.9], [0.13, 1.21]]),
    "blunt heart": np.array([[0.0, -0.43], [0.52, -0.97], [1.03, -0.41], [0.0, 1.07], [-1.03, -0.41], [-0.52, -0.97]]),
    "cup": np.array([[-1.0, -0.8], [-0.41, -0.72], [-0.33, 0.21], [0.37, 0.13], [0.45, -0.9], [1.1, -0.7], [0.7, 0.9], [-0.9, 1.0]]),
    "tilted pentagon": polar(np.ones(5), 0.2),
}
UPSHAPE = np.array([[0.0, 0.0], [5.0, 0.0], [5.0, 4.0], [3.0, 4.0], [3.0, 1.0], [2.0, 2.0], [2.0, 4.0], [0.0, 4.0]])


def is_along(polygon: np.ndarray, directions: tuple[tuple[int, int], ...]) -> bool:
    edges = np.roll(polygon, -1, axis=0) - polygon
    edges /= np.hypot(*edges.T)[:, None]
    steps = np.array(directions) / np.hypot(*np.transpose(directions))[:, None]
    return bool((np.abs(edges[:, :1] * steps[:, 1] - edges[:, 1:] * steps[:, 0]).min(axis=1) < 1e-7).all())


def encloses(polygon: np.ndarray, outline: np.ndarray) -> bool:
    """All but rounding of the outline's area lies within."""
    return bool(Polygon(polygon).is_valid and Polygon(outline).difference(Polygon(polygon)).area < 1e-7 * Polygon(outline).area)


def is_image(polygon: np.ndarray, element: np.ndarray) -> bool:
    centred = polygon - np.array(Polygon(polygon).centroid.coords[0])
    distances = np.hypot(*np.moveaxis((centred @ element.T)[:, None] - centred[None], 2, 0))
    return bool((distances.min(axis=1) < 1e-9).all())


@pytest.mark.slow
@pytest.mark.parametrize("name", FIGURE_6)
def test_the_shapes_of_figure_6_are_enclosed_ever_more_tightly(name: str) -> None:
    """Section 6.1: "the approximation of the input kernel steadily improves as the number of output edges N increases"."""
    excesses: dict[float, list[float]] = {-1.0: [], np.inf: []}
    for symmetry_cost, found in excesses.items():
        for max_edges in (4, 6, 8, 10, 12, 14, 16, 20):
            polygon = rectify(FIGURE_6[name], max_edges=max_edges, symmetry_cost=symmetry_cost)
            assert len(polygon) <= max_edges and is_along(polygon, PAPER_DIRECTIONS) and encloses(polygon, FIGURE_6[name])
            found.append(area_excess(polygon, FIGURE_6[name]))
        assert (np.diff(found) < 1e-9).all() and found[6] < 0.9 * found[1]
    assert (np.array(excesses[np.inf]) > np.array(excesses[-1.0]) - 1e-9).all(), "nothing is smaller than the smallest"


def lines_that_touch(outline: np.ndarray, directions: tuple[tuple[int, int], ...]) -> list[tuple[int, float, np.ndarray]]:
    """(vertex, order there, direction), found by asking the geometry library about points just ahead, behind and to the right."""
    inside, near = Polygon(outline), 1e-4
    steps = [sign * np.array(step) / np.hypot(*step) for step in directions for sign in (1.0, -1.0)]
    found = []
    for i, vertex in enumerate(outline):
        inwards, outwards = vertex - outline[i - 1], outline[(i + 1) % len(outline)] - vertex
        points_out = inwards[0] * outwards[1] > inwards[1] * outwards[0]
        for step in steps:
            aside = near**2 * np.array([step[1], -step[0]])
            ahead, back = (not inside.contains(shapely.Point(vertex + sign * near * step + aside)) for sign in (1.0, -1.0))
            if (ahead and back) if points_out else (ahead or back):
                turned = np.arctan2(inwards[0] * step[1] - inwards[1] * step[0], inwards @ step)
                found.append((i, turned if points_out else float(ahead), step))
    return sorted(found, key=lambda line: line[:2])


def enumerated(outline: np.ndarray, directions: tuple[tuple[int, int], ...], max_edges: int) -> Iterator[np.ndarray]:
    """Every polygon around the outline whose edges, in order, each contain the vertex that their line touches."""
    lines = lines_that_touch(outline, directions)
    corner: dict[tuple[int, int], np.ndarray] = {}
    for i, (at_i, _, along_i) in enumerate(lines):
        for j, (at_j, _, along_j) in enumerate(lines):
            matrix = np.stack([along_i, along_j], axis=1)
            if abs(np.linalg.det(matrix)) > 1e-9:
                ahead, back = np.linalg.solve(matrix, outline[at_j] - outline[at_i])
                if min(ahead, back) > -1e-9:
                    corner[i, j] = outline[at_i] + ahead * along_i

    def walks(walk: list[int]) -> Iterator[list[int]]:
        if len(walk) > 2 and (walk[-1], walk[0]) in corner:
            yield walk
        if len(walk) < max_edges:
            for following in range(walk[-1] + 1, len(lines)):
                if (walk[-1], following) in corner:
                    yield from walks([*walk, following])

    for first in range(len(lines)):
        for walk in walks([first]):
            polygon = np.array([corner[walk[k - 1], walk[k]] for k in range(len(walk))])
            if Polygon(polygon).is_valid and encloses(polygon, outline):
                yield polygon


@pytest.mark.slow
@pytest.mark.parametrize(("name", "directions", "max_edges"), [
    ("dart", PAPER_DIRECTIONS, 4), ("dart", EIGHTHS, 5), ("dart", EIGHTHS, 7),
    ("blunt heart", PAPER_DIRECTIONS, 4), ("blunt heart", EIGHTHS, 7), ("blunt heart", UPRIGHT, 8),
    ("cup", EIGHTHS, 5), ("cup", EIGHTHS, 7), ("cup", UPRIGHT, 8),
    ("tilted pentagon", PAPER_DIRECTIONS, 5), ("tilted pentagon", EIGHTHS, 8),
])  # fmt: skip
def test_no_enumerated_polygon_is_smaller(name: str, directions: tuple[tuple[int, int], ...], max_edges: int) -> None:
    outline = SMALL[name]
    smallest = min(Polygon(polygon).area for polygon in enumerated(outline, directions, max_edges))
    polygon = rectify(outline, directions, max_edges, symmetry_cost=-1.0)
    assert Polygon(polygon).area == pytest.approx(smallest, rel=1e-9)
    if name == "blunt heart":
        alike = [candidate for candidate in enumerated(outline, directions, max_edges) if is_image(candidate, MIRRORS["x"])]
        smallest_alike = min(Polygon(candidate).area for candidate in alike)
        symmetric = rectify(outline, directions, max_edges, symmetry_cost=np.inf)
        assert is_image(symmetric, MIRRORS["x"]) and Polygon(symmetric).area == pytest.approx(smallest_alike, rel=1e-9)


@pytest.mark.parametrize("sides", [5, 6, 7, 64])
def test_a_convex_outline_gets_all_supporting_half_planes(sides: int) -> None:
    outline = polar(np.ones(sides), 0.3)
    expected = affinity.scale(Polygon(outline).envelope, 9, 9)
    for x, y in PAPER_DIRECTIONS:
        along = np.array([x, y]) / np.hypot(x, y)
        across = outline @ np.array([-along[1], along[0]])
        strip = [[-9, across.min()], [9, across.min()], [9, across.max()], [-9, across.max()]]
        expected = expected.intersection(Polygon(np.array(strip) @ np.array([along, [-along[1], along[0]]])))
    for max_edges in (2 * len(PAPER_DIRECTIONS), 40):
        polygon = Polygon(rectify(outline, max_edges=max_edges, symmetry_cost=-1.0))
        assert polygon.symmetric_difference(expected).area < 1e-9


@pytest.mark.parametrize("cost", [-1.0, 0.05])
@pytest.mark.parametrize("sides", [3, 6, 9, 64, "any"])
def test_the_tangents_of_a_convex_outline_are_what_the_walk_finds(sides: int | str, cost: float) -> None:
    points = np.random.default_rng(5).standard_normal((20, 2)) if isinstance(sides, str) else polar(np.ones(sides))
    outline = np.array(shapely.MultiPoint(points).convex_hull.exterior.coords[:-1])
    shape = outline - centroid(outline)
    shape = (shape if area(shape) > 0.0 else shape[::-1]) / np.abs(shape).max()
    walked = smallest_polygon(shape, _unit_steps(PAPER_DIRECTIONS, 16), 16, cost)
    assert walked is not None
    assert Polygon(walked).symmetric_difference(Polygon(rectify(shape, symmetry_cost=cost))).area < 1e-9


def test_the_circle_is_circumscribed_and_symmetry_kept_without_mirrors() -> None:
    """Area n tan(pi / n) of the regular polygon around the unit circle; (1, 2) lies at 26.57 and not 22.5 degrees, so only 4 and 8."""
    circle = polar(np.ones(64))
    assert Polygon(rectify(circle, UPRIGHT, 4)).area == pytest.approx(4.0, rel=1e-12)
    assert Polygon(rectify(circle, EIGHTHS, 12)).area == pytest.approx(8.0 * np.tan(np.pi / 8.0), rel=1e-12)
    pinwheel = polar(np.tile([1.0, 0.8, 0.5, 0.55], 4), 0.1)
    propeller = polar(np.tile([1.0, 0.7, 0.3, 0.35], 2), 0.1)
    for max_edges in (8, 12, 16):
        assert is_image(rectify(pinwheel, max_edges=max_edges, symmetry_cost=np.inf), QUARTER)
        assert is_image(rectify(propeller, max_edges=max_edges, symmetry_cost=np.inf), QUARTER @ QUARTER)
    assert not is_image(rectify(propeller, max_edges=12, symmetry_cost=np.inf), QUARTER)
    outline = heart(150, shift=0.37) + np.array([3.0, -2.0])
    polygon = rectify(outline, max_edges=12)
    assert is_image(polygon, MIRRORS["x"]) and encloses(polygon, outline) and is_along(polygon, PAPER_DIRECTIONS)
    assert not is_image(rectify(outline, ((1, 0), (0, 1), (1, 1)), 12), MIRRORS["x"]), "directions that have no such mirror"


@pytest.mark.slow
@pytest.mark.parametrize(("name", "elements"), [
    ("circle", [*MIRRORS.values(), QUARTER]), ("hexagon", [MIRRORS["x"], MIRRORS["y"]]), ("small heart", [MIRRORS["x"]]),
    ("large heart", [MIRRORS["x"]]), ("clover", [*MIRRORS.values(), QUARTER]), ("pentagram", [MIRRORS["x"]]),
])  # fmt: skip
@pytest.mark.parametrize("max_edges", [8, 12, 14, 16])
def test_what_is_symmetric_stays_symmetric(name: str, elements: list[np.ndarray], max_edges: int) -> None:
    """Unlike the large heart at N = 14 and the pentagram of the paper's Fig. 6 (c, d)."""
    everything = rectify(FIGURE_6[name], max_edges=max_edges, symmetry_cost=np.inf)
    assert all(is_image(everything, element) for element in elements)
    smallest = area_excess(rectify(FIGURE_6[name], max_edges=max_edges, symmetry_cost=-1.0), FIGURE_6[name])
    assert area_excess(rectify(FIGURE_6[name], max_edges=max_edges), FIGURE_6[name]) <= smallest + 0.05 + 1e-9, "the default's promise"
    if max_edges == 16:
        assert all(is_image(rectify(FIGURE_6[name]), element) for element in elements), "by default, too"


@pytest.mark.parametrize("outline", [
    UPSHAPE, UPSHAPE[::-1] * 0.1 + 0.3, np.array([[2, 1], [1, 2], [-1, 2], [-2, 1], [-2, -1], [-1, -2], [1, -2], [2, -1]]) / 3.0,
])  # fmt: skip
def test_what_is_rectified_already_comes_back_exactly(outline: np.ndarray) -> None:
    assert np.array_equal(rectify(outline), outline)
    halved = np.insert(outline, 1, 0.5 * (outline[0] + outline[1]), axis=0)
    assert np.array_equal(rectify(halved, max_edges=8), outline), "a vertex on the middle of a side does not count"
    worn = np.vstack([outline, 0.5 * (outline[0] + outline[-1]) + 1e-5])
    polygon = rectify(worn, max_edges=8, symmetry_cost=-1.0)
    assert Polygon(polygon).symmetric_difference(Polygon(outline)).area < 2e-4, "nor does a dent too small for the edges left"
    assert np.sign(shapely.LinearRing(polygon).is_ccw - 0.5) == np.sign(shapely.LinearRing(outline).is_ccw - 0.5)


@pytest.mark.parametrize("seed", range(8))
def test_ragged_outlines(seed: int) -> None:
    rng = np.random.default_rng(seed)
    outline = polar(1.0 - 0.6 * rng.random(int(rng.integers(5, 40))), rng.random()) * (0.01 + 30 * rng.random()) + rng.normal(size=2)
    found = []
    for max_edges in (4, 5, 9, 16, 30):
        polygon = rectify(outline, max_edges=max_edges)
        assert len(polygon) <= max_edges and is_along(polygon, PAPER_DIRECTIONS) and encloses(polygon, outline)
        found.append(area_excess(polygon, outline))
        assert area_excess(rectify(outline @ QUARTER.T, max_edges=max_edges), outline) == pytest.approx(found[-1], rel=1e-6)
    assert (np.diff(found) < 1e-9).all()


def test_corners_that_would_overlap_close_a_gap_and_a_notch_may_narrow_to_a_point() -> None:
    """Slanted edges around the upright walls (3 high, 2 apart) reach 1.5 into the gap: the smallest closed walk crosses itself."""
    slanted = ((1, 1), (1, -1))
    right = [[1.0, 4.0], [1.5, 4.5], [5.0, 1.0], [0.0, -4.0]]
    cup = np.array([[0.0, 0.0], [1.0, 1.0], *right, *([-x, y] for x, y in right[-2::-1]), [-1.0, 1.0]])
    for max_edges in (8, 12):
        smallest = min(Polygon(polygon).area for polygon in enumerated(cup[::-1], slanted, max_edges))
        for symmetry_cost in (-1.0, np.inf):
            polygon = rectify(cup, slanted, max_edges, symmetry_cost=symmetry_cost)
            assert encloses(polygon, cup) and Polygon(polygon).area == pytest.approx(smallest, rel=1e-9)
    # A square of 5 less a notch with a waist of 1: two triangles, 3 wide and 1.5 high, meet in the middle of the waist.
    right = [[4.0, 0.0], [5.0, 0.0], [5.0, 5.0]]
    waist = [[4.0, 3.0], [4.0, 2.0], [3.0, 2.0], [3.0, 1.0], [4.0, 1.0]]
    outline = np.array([*waist, *right, *([5.0 - x, y] for x, y in [*waist, *right][::-1])])
    assert Polygon(rectify(outline, EIGHTHS, 10)).area == pytest.approx(25.0 - 2 * 2.25, rel=1e-12)


def test_fitted_kernels_and_apertures_pass_the_same_light_in_the_same_place() -> None:
    outline = heart(100)
    for polygon in (rectify(outline, max_edges=8, fit="area"), same_area_and_centroid(rectify(outline, max_edges=8), outline)):
        assert is_along(polygon, PAPER_DIRECTIONS) and area_excess(polygon, outline) == pytest.approx(0.0, abs=1e-12)
        np.testing.assert_allclose(Polygon(polygon).centroid.coords[0], Polygon(outline).centroid.coords[0], atol=1e-12)
    ring = Aperture.disc().obstructed(0.4)
    rectified = rectify_aperture(ring, max_edges=12)
    assert rectified.weights == ring.weights
    for got, given in zip(rectified.outlines, ring.outlines, strict=True):
        assert len(got) == 12 and is_along(got, PAPER_DIRECTIONS)
        assert Polygon(got).area == pytest.approx(Polygon(given).area, rel=1e-12)
        np.testing.assert_allclose(Polygon(got).centroid.coords[0], [0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(("outline", "directions", "max_edges", "message"), [
    (polar(np.ones(7)), PAPER_DIRECTIONS, 2, "at least 3 edges"), (polar(np.ones(7)), UPRIGHT, 3, "at most 3 edges"),
    (polar(np.ones(7)), ((1, 2), (-2, -4)), 8, "not parallel"), (polar(np.ones(7)), ((0, 0), (1, 0)), 8, "not both 0"),
    (np.array([[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]]), UPRIGHT, 8, "enclose an area"),
    (np.array([[0.0, 0.0], [2.0, 2.0], [2.0, 0.0], [0.0, 1.0]]), UPRIGHT, 8, "cross itself"),
    (np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]]), UPRIGHT, 8, "lie on a line"),
    (np.array([[0.0, 0.0], [1.0, np.nan], [2.0, 0.0]]), UPRIGHT, 8, "finite"),
])  # fmt: skip
def test_what_cannot_be_rectified_is_named(
    outline: np.ndarray, directions: tuple[tuple[int, int], ...], max_edges: int, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        rectify(outline, directions, max_edges)

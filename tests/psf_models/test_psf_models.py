"""Models of PSFs in closed form: rays against the closed form, the capsule against area sampling, sums, places and symmetry."""

from functools import cache

import numpy as np
import pytest
from jaxtyping import Float

from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.psf_bank import Axis
from mrbokeh.psf_models.base import PsfModel, sobol_blocks
from mrbokeh.psf_models.build import PAPER_COUNTS, Combined
from mrbokeh.psf_models.simple_lens import SimpleLens, Stylized, banded_edges
from mrbokeh.system.errors import InputError

RAYS = 1 << 20
ODD_LENS = Aperture(Aperture.heart().outlines, (1.0,), spherical_aberration=0.6, axial_chromatic=(0.1, 0.0, -0.1))


def logo() -> Float[np.ndarray, "height width 3"]:
    """An uneven coloured picture with holes and a spot far off, as a logo is."""
    rng = np.random.default_rng(5)
    picture = np.zeros((60, 80, 3), np.float32)
    picture[10:40, 20:70] = 0.2 + rng.random((30, 50, 3))
    picture[22:28, 30:50] = 0.0
    picture[52, 5] = 3.0
    return picture


MODELS: dict[str, tuple[PsfModel, list[list[float]]]] = {
    "disc": (SimpleLens(), [[23.7, 23.7]]),
    "disc over a cell": (SimpleLens(), [[20.0, 23.0]]),
    "ring": (SimpleLens(Aperture.ring(0.5)), [[31.0, 31.0]]),
    "blades over a cell": (SimpleLens(Aperture.blades(5, 0.3)), [[14.0, 17.0]]),
    "odd lens behind": (SimpleLens(ODD_LENS), [[24.0, 25.0]]),
    "odd lens in front": (SimpleLens(ODD_LENS), [[-25.0, -24.0]]),
    "odd lens through the focus": (SimpleLens(ODD_LENS), [[-4.0, 6.0]]),
    "capsule": (Combined(), [[12.3, 12.3], [17.9, 17.9]]),
    "capsule over a cell": (Combined(), [[9.0, 12.0], [6.0, 9.0]]),
    "logo": (Stylized(logo()), [[40.3, 40.3]]),
    "logo over a cell": (Stylized(logo()), [[30.0, 34.0]]),
}


@cache
def kernel_of(name: str, rays: int) -> tuple[np.ndarray, np.ndarray]:
    """(kernel in float64, the box)."""
    model, ends = MODELS[name]
    box = np.array(ends)
    return model.kernel(box, rays, 1).astype(np.float64), box


def centroid(kernel: np.ndarray) -> np.ndarray:
    """(x, y) of the light in pixels from the middle, by channel."""
    places = np.arange(len(kernel)) - len(kernel) // 2
    return np.stack([kernel.sum(axis=0).T @ places, kernel.sum(axis=1).T @ places]) / kernel.sum(axis=(0, 1))


@pytest.mark.parametrize("name", MODELS)
def test_rays_agree_with_the_closed_form(name: str) -> None:
    """A million rays over n pixels miss by the noise of chance or less: independent rays would leave sqrt(2 n / (pi N)) of the light.

    (Mean absolute deviation of n counts of mean N / n, summed, over N.) Of a quarter of them, the rest is less by a factor
    between 2, that of chance, and 4. The closed form averages steps of up to a pixel over a box: 0.3 % more is allowed.
    """
    closed, _ = kernel_of(name, 0)
    missed = [np.abs(kernel_of(name, rays)[0] - closed).sum(axis=(0, 1)).max() for rays in (RAYS, RAYS // 4)]
    lit = int((closed.max(axis=2) > 0.0).sum())
    largest_weight = 2.0  # the odd lens weights rays by up to 1.6, and rays that miss the opening do not count
    assert missed[0] < largest_weight * np.sqrt(2.0 * lit / (np.pi * RAYS)) + 0.003
    assert missed[0] < missed[1] or missed[1] < 0.004


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("rays", [0, RAYS // 4])
def test_no_light_is_lost_and_none_is_negative(name: str, rays: int) -> None:
    kernel, _ = kernel_of(name, rays)
    np.testing.assert_allclose(kernel.sum(axis=(0, 1)), 1.0, atol=2e-6)
    assert kernel.min() >= 0.0


@pytest.mark.parametrize("name", MODELS)
def test_kernels_are_odd_and_cut_nothing_off(name: str) -> None:
    """A model may leave a border, but of the pixels that it leaves out none would have been lit: twice the box fits as well."""
    kernel, box = kernel_of(name, 0)
    assert kernel.shape[0] == kernel.shape[1] and kernel.shape[0] % 2 == 1
    assert kernel.shape[0] >= np.abs(box).max(axis=1).sum() - 1.0


@pytest.mark.parametrize("name", MODELS)
def test_the_average_over_a_box_is_the_mean_of_its_points(name: str) -> None:
    """Section 5.4 as written: the closed form at many places of the box, by plain summation; edges lie within a pixel's smoothing."""
    model, _ = MODELS[name]
    averaged, box = kernel_of(name, 0)
    steps = 40
    parts = [axis.between(low, high, (np.arange(steps) + 0.5) / steps) for axis, (low, high) in zip(model.axes, box, strict=True)]
    places = np.stack(np.meshgrid(*parts), axis=-1).reshape(-1, len(parts))
    total = np.zeros_like(averaged)
    for place in places:
        exact = model.exact(place)
        assert exact is not None
        border = (len(total) - len(exact)) // 2
        total += np.pad(exact, ((border, border), (border, border), (0, 0))) / len(places)
    assert np.abs(total - averaged).sum(axis=(0, 1)).max() < 0.004


@pytest.mark.parametrize(("diameter_px", "motion_px"), [(10.0, 7.0), (3.0, 20.0), (20.0, 2.0), (1.5, 0.7), (7.3, 30.2), (31.0, 31.0)])
def test_the_capsule_against_area_sampling(diameter_px: float, motion_px: float) -> None:
    """The share of the shutter in which a disc covers a point, averaged over 24 x 24 points of each pixel.

    The rim crosses a pixel within 1 / 24 of it: relative to the middle a sample count is off by less than 1 %.
    """
    kernel = Combined().exact(np.array([diameter_px, motion_px]))[..., 0].astype(np.float64)
    size, fine = len(kernel), 24
    places = (np.arange(size * fine) + 0.5) / fine - 0.5 * size
    x, y = np.meshgrid(places, places)
    half = np.sqrt(np.maximum((0.5 * diameter_px) ** 2 - y**2, 0.0))
    covered = np.minimum(x + 0.5 * motion_px, half) - np.maximum(x - 0.5 * motion_px, -half)
    profile = np.clip(covered, 0.0, None) / motion_px / (np.pi * (0.5 * diameter_px) ** 2)
    expected = profile.reshape(size, fine, size, fine).mean(axis=(1, 3))
    np.testing.assert_allclose(kernel, expected, atol=0.01 * expected.max())
    assert np.abs(kernel - expected).sum() < 0.004


def test_limits_of_the_capsule_and_boxes_of_no_size() -> None:
    """Without motion a disc, without defocus a line of even light, with neither the pixel itself."""
    model = Combined()
    still, disc = model.exact(np.array([21.0, 0.0])), SimpleLens().exact(np.array([21.0]))
    np.testing.assert_allclose(np.pad(still[..., 0], 1), disc[..., 0], atol=0.01 * float(disc.max()))
    line = model.exact(np.array([0.0, 9.0]))[..., 0]
    np.testing.assert_allclose(line[4], 1.0 / 9.0, rtol=2e-4, err_msg="a thousandth of a pixel stands for none")
    assert line[3].sum() == 0.0
    np.testing.assert_array_equal(model.exact(np.array([0.0, 0.0])), np.ones((1, 1, 1), np.float32))
    np.testing.assert_array_equal(model.exact(np.array([0.5, 0.4])), np.ones((1, 1, 1), np.float32))
    for model, ends in MODELS.values():
        point = np.array(ends)[:, 0]
        np.testing.assert_allclose(model.kernel(np.stack([point, point], axis=1), 0, 0), model.exact(point), atol=1e-7)


@pytest.mark.parametrize("name", ["disc", "ring", "capsule over a cell"])
@pytest.mark.parametrize("rays", [0, RAYS])
def test_the_centroid_stays_in_place(name: str, rays: int) -> None:
    """Of a million rays the centroid is off by less than chance would: 3 times the radius over the root of their number."""
    kernel, box = kernel_of(name, rays)
    assert np.abs(centroid(kernel)).max() < (1e-5 if rays == 0 else 3.0 * 0.5 * box.sum(axis=0).max() / np.sqrt(RAYS))


@pytest.mark.parametrize("rays", [0, RAYS])
def test_the_centroid_of_a_stylized_psf_stays_in_place(rays: int) -> None:
    """But for what moves to the middle of its pixel: chance leaves 1 / sqrt(12) over the root of 600 pixels, 0.012 px; twice that."""
    kernel = Stylized(np.repeat(logo()[..., :1], 3, axis=2)).kernel(np.array([[44.0, 44.0]]), rays, 1)
    assert np.abs(centroid(kernel.astype(np.float64))).max() < 0.024


@pytest.mark.parametrize("aperture", [Aperture.star(5), Aperture.ring(0.4), ODD_LENS.seen(1), Aperture.heart().squeezed(1.5)])
def test_the_opening_that_rays_see_is_made_of_its_polygons(aperture: Aperture) -> None:
    """The bands of edges against the library's point-in-polygon for each outline in turn."""
    from shapely import Polygon, contains_xy

    from mrbokeh.psf_models._rays_numba import opening_at

    extent = aperture.unit_radius
    places = extent * (2.0 * np.random.default_rng(2).random((3000, 2)) - 1.0)
    outlines = zip(aperture.outlines, aperture.weights, strict=True)
    expected = sum(weight * contains_xy(Polygon(outline), *places.T) for outline, weight in outlines)
    edges, starts = banded_edges(aperture, extent)
    seen = [opening_at(float(x), float(y), edges, starts, extent) for x, y in places]
    np.testing.assert_allclose(seen, expected, atol=1e-12)


def test_in_front_of_the_focus_a_lens_is_seen_turned_and_sides_that_differ_have_signed_diameters() -> None:
    """The bank's half turn is what the opening does at a negative diameter; a symmetric opening needs none."""
    heart = SimpleLens(Aperture.heart())
    assert heart.near_side_turned and not SimpleLens().near_side_turned and not SimpleLens(Aperture.blades(6)).near_side_turned
    behind, in_front = heart.exact(np.array([19.0])), heart.exact(np.array([-19.0]))
    np.testing.assert_allclose(in_front, behind[::-1, ::-1], atol=1e-7)
    assert np.abs(in_front - behind).max() > 0.5 * behind.max()
    # Over-corrected: bright rims behind, bright middle in front; red is the wider behind, the narrower in front.
    model = SimpleLens(Aperture(Aperture.disc().outlines, (1.0,), spherical_aberration=0.8, axial_chromatic=(0.1, 0.0, -0.1)))
    assert model.axes == (Axis("diameter_px", -512.0, 512.0, 2.0),) and model.channels == 3 and not model.near_side_turned
    behind, in_front = model.exact(np.array([40.0])), model.exact(np.array([-40.0]))
    middle = len(behind) // 2
    assert behind[middle, middle, 1] < 0.5 * behind[middle, middle + 18, 1]
    assert in_front[middle, middle, 1] > 2.0 * in_front[middle, middle + 18, 1]
    widths = [[int((kernel[middle, :, channel] > 0).sum()) for channel in range(3)] for kernel in (behind, in_front)]
    assert widths[0] == [45, 41, 37] and widths[1] == [37, 41, 45]  # 1.1, 1 and 0.9 times 40, in whole and begun pixels


def test_a_stylized_psf_is_the_picture_and_its_colours_differ_in_scale_only() -> None:
    """Enlarged so that a pixel of the picture covers 4 x 4 pixels: sums over these are the picture, upright as it was given."""
    picture = np.repeat(logo()[..., :1], 3, axis=2)
    picture[52, 5] = 0.0
    y, x = np.nonzero(picture[..., 0])
    light = picture[..., 0] / picture.sum(axis=(0, 1))[0]
    origin = np.array([light.sum(axis=0) @ (np.arange(80) + 0.5), light.sum(axis=1) @ (np.arange(60) + 0.5)])
    reach = np.hypot(np.abs(x + 0.5 - origin[0]) + 0.5, np.abs(y + 0.5 - origin[1]) + 0.5).max()
    kernel = Stylized(picture, chromatic=(0.0, 0.0, 0.0)).exact(np.array([2.0 * 4.0 * reach]))[..., 1]
    row, column = (np.round(len(kernel) / 2 + 4.0 * (corner - place)).astype(int) for corner, place in ((10, origin[1]), (20, origin[0])))
    seen = kernel[row : row + 120, column : column + 200].reshape(30, 4, 50, 4).sum(axis=(1, 3))
    assert np.corrcoef(seen.ravel(), light[10:40, 20:70].ravel())[0, 1] > 0.9
    # Second moments about the centroid go with the square of the scale, less the pixel's own 1/12 on both sides.
    picture = np.repeat(logo()[..., :1], 3, axis=2)
    model = Stylized(picture, chromatic=(0.2, 0.0, -0.2))
    kernel = model.exact(np.array([60.0])).astype(np.float64)
    places = np.arange(len(kernel)) - len(kernel) // 2
    spread = kernel.sum(axis=0).T @ places**2 - 1.0 / 12.0
    np.testing.assert_allclose(np.sqrt(spread / spread[1]), [1.2, 1.0, 0.8], rtol=1e-3)
    plain = Stylized(picture, chromatic=(0.0, 0.0, 0.0)).exact(np.array([60.0]))
    np.testing.assert_array_equal(plain[..., 0], plain[..., 2])


@pytest.mark.parametrize("dimensions", [2, 3, 5])
def test_quasi_random_points_fill_the_cube_evenly(dimensions: int) -> None:
    """Means of n points are nearer to 1/2 than a tenth of sqrt(1 / (12 n)), which chance leaves; means of products of two shares
    are nearer to 1/4 than half of sqrt(7 / (144 n))."""
    count = 1 << 17
    points = np.concatenate(list(sobol_blocks(dimensions, count, 7)))
    assert points.shape == (count, dimensions) and points.min() >= 0.0 and points.max() < 1.0
    products = (points[:, :, None] * points[:, None, :]).mean(axis=0)
    expected = np.where(np.eye(dimensions, dtype=bool), 1.0 / 3.0, 0.25)
    assert np.abs(points.mean(axis=0) - 0.5).max() < 0.1 / np.sqrt(12.0 * count)
    assert np.abs(products - expected).max() < 0.5 * np.sqrt(7.0 / 144.0 / count)


def test_a_number_of_rays_that_is_no_power_of_two_is_kept() -> None:
    blocks = list(sobol_blocks(2, 70_000, 1))
    assert sum(map(len, blocks)) == 70_000
    np.testing.assert_array_equal(np.concatenate(list(sobol_blocks(2, 100, 1))), blocks[0][:100])


def test_the_zoo_has_the_numbers_of_table_1() -> None:
    """Samples 100, 400 and 200; exponents 2.0, (2.0, 1.0) and 1.5; pictures of 512 pixels."""
    from mrbokeh.psf_models.build import bank_head

    zoo = [(SimpleLens(), 100, (2.0,)), (Combined(counts=PAPER_COUNTS), 400, (2.0, 1.0)), (Stylized(logo()), 200, (1.5,))]
    for model, samples, exponents in zoo:
        head = bank_head(model, 0, 0)
        assert len(head.grid) == pytest.approx(samples, rel=0.03)
        assert tuple(axis.exponent for axis in model.axes) == exponents
        largest = model.exact(np.array([axis.high for axis in model.axes]))
        assert largest is not None and abs(len(largest) - 512) <= 10


def test_what_a_model_refuses() -> None:
    with pytest.raises(InputError, match="cat_eye"):
        SimpleLens(Aperture(Aperture.disc().outlines, (1.0,), cat_eye=0.5))
    with pytest.raises(InputError, match="longest motion"):
        Combined(motion_px=0.0)
    with pytest.raises(InputError, match="some light in each"):
        Stylized(logo() * np.array([1.0, 1.0, 0.0], np.float32))
    with pytest.raises(InputError, match="within"):
        Stylized(logo(), chromatic=(1.0, 0.0, 0.0))

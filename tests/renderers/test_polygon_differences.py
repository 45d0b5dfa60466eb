"""Polygonal differences against a plain twin, against exact kernels, and the physics of a scatter."""

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from mrbokeh.images.image_metrics import psnr
from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.polygon import polygon_differences
from mrbokeh.renderers.polygon.directional_differences import PolygonCorners, edge_profile, polygon_corners
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from mrbokeh.renderers.polygon.rectification import PAPER_DIRECTIONS, rectify_aperture
from mrbokeh.renderers.scatter_reference import scatter
from mrbokeh.system.errors import InputError

APERTURES = {
    "octagon": Aperture.blades(8, np.pi / 8), "disc": Aperture.disc(), "7 blades": Aperture.blades(7, 0.1, 0.3),
    "heart": Aperture.heart(), "ring": Aperture.ring(0.5),
}  # fmt: skip
SUMS_ONLY = PolygonDifferences(exact_below_px=6.0, exact_highlights=False, precision="double")
"""Every kernel of 7 px or more goes through the sums."""
RECTIFIED = PolygonDifferences(exact_highlights=False, precision="double")
"""As by default, but for highlights."""
DEFAULT = PolygonDifferences()


def plain_kernel(corners: PolygonCorners, diameter_px: float) -> np.ndarray:
    """The kernel that the sums make, dense and slow: every corner as four impulses, then the paper's Eq. 12 and 11."""
    radius = float(np.copysign(np.sqrt(0.25 * diameter_px**2 + corners.growth), diameter_px))
    offset = radius * corners.slope + np.sign(radius) * corners.shift + corners.origin
    line = np.floor(offset).astype(int)
    share = offset - line
    size = 2 * (int(abs(diameter_px) * 0.55) + 6) + 1
    planes: dict[tuple[int, int], np.ndarray] = {}
    for before, after, weight in zip(corners.before, corners.after, corners.weight, strict=True):
        (ax, ay), (bx, by) = corners.direction[before], corners.direction[after]
        det = ax * by - ay * bx
        for i in (0, 1):
            for j in (0, 1):
                impulse = weight * abs(1 - i - share[before]) * abs(1 - j - share[after])
                a, b = line[before] + i, line[after] + j
                x, y = (-b * ax + a * bx) // det + size // 2, (-b * ay + a * by) // det + size // 2
                for (dx, dy), sign in (((ax, ay), -1.0), ((bx, by), 1.0)):
                    planes.setdefault((dx, dy), np.zeros((size, size)))[y, x] += sign * np.sign(dx) * impulse
    kernel = np.zeros((size, size))
    for (dx, dy), plane in planes.items():
        if dx == 0:
            continue
        for y in range(size):
            for x in range(size) if dx > 0 else range(size - 1, -1, -1):
                if y - dy >= 0 and 0 <= x - dx < size:
                    plane[y, x] += plane[y - dy, x - dx]
        for (x, y), weight in edge_profile((dx, dy)).items():
            kernel += weight * np.roll(plane, (y, x), axis=(0, 1))
    area = corners.area[0] * radius**2 + corners.area[1] + (corners.curvature * share * (1.0 - share)).sum()
    return np.cumsum(kernel, axis=0) / area


@cache
def corners_of(name: str) -> PolygonCorners:
    return polygon_corners(rectify_aperture(APERTURES[name]), PAPER_DIRECTIONS)


def plain_scatter(values: np.ndarray, coc_px: np.ndarray, name: str) -> np.ndarray:
    """Dense kernels, pixel by pixel, in float64."""
    margin = 40
    total = np.zeros((values.shape[0] + 2 * margin, values.shape[1] + 2 * margin, values.shape[2]))
    for y, x in np.argwhere(np.any(values != 0, axis=-1)):
        kernel = plain_kernel(corners_of(name), float(coc_px[y, x]))
        reach = kernel.shape[0] // 2
        rows, columns = slice(y + margin - reach, y + margin + reach + 1), slice(x + margin - reach, x + margin + reach + 1)
        total[rows, columns] += kernel[..., None] * values[y, x].astype(np.float64)
    return total[margin:-margin, margin:-margin]


def picture(height: int, width: int, channels: int = 4, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.0, 1.0, (height, width, channels)).astype(np.float32)


def waves(height: int, width: int, low_px: float, high_px: float) -> np.ndarray:
    """Diameters that vary smoothly between both, and on top by a pixel of noise."""
    y, x = np.mgrid[:height, :width]
    wave = 0.5 + 0.5 * np.sin(x / 17.0) * np.cos(y / 13.0)
    noise = np.random.default_rng(5).uniform(-0.5, 0.5, wave.shape)
    return np.clip(low_px + (high_px - low_px) * wave + noise, low_px, high_px).astype(np.float32)


def point(size: int, diameter_px: float, aperture: Aperture, renderer: PolygonDifferences = SUMS_ONLY) -> np.ndarray:
    values = np.zeros((size, size, 1), np.float32)
    values[size // 2, size // 2] = 1.0
    return renderer.sum_kernels(values, np.full((size, size), diameter_px, np.float32), aperture)[..., 0].astype(np.float64)


@pytest.mark.parametrize(("name", "side"), [("heart", 1.0), ("heart", -1.0), ("ring", 1.0), ("octagon", -1.0)])
def test_the_plain_twin_agrees(name: str, side: float) -> None:
    """Signed light, so that nothing is set to 0; the result is rounded to float32, the impulses are not."""
    values = (picture(9, 12) - 0.5).astype(np.float32)
    coc_px = np.float32(side) * waves(9, 12, 8.0, 26.0)
    expected = plain_scatter(values, coc_px, name)
    np.testing.assert_allclose(SUMS_ONLY.sum_kernels(values, coc_px, APERTURES[name]), expected, atol=6e-8 * np.abs(expected).max())
    single = PolygonDifferences(exact_below_px=6.0, exact_highlights=False, precision="single")
    np.testing.assert_allclose(single.sum_kernels(values, coc_px, APERTURES[name]), expected, atol=1e-6)


@pytest.mark.parametrize(("name", "least_db"), [("octagon", 57.5), ("disc", 60.5), ("7 blades", 58.5), ("heart", 51.5), ("ring", 56.0)])
def test_near_the_exact_kernels_of_the_true_aperture(name: str, least_db: float) -> None:
    """Noise in [0, 1] under noisy diameters; the rest is rectification and corners between lattice points."""
    values, coc_px = picture(70, 90), waves(70, 90, 0.0, 30.0)
    exact = scatter(values.astype(np.float64), coc_px, APERTURES[name]).astype(np.float32)
    assert psnr(DEFAULT.sum_kernels(values, coc_px, APERTURES[name]), exact) > least_db


@pytest.mark.parametrize("diameter_px", [8.0, 9.0, 13.0, 16.0, 21.5, 40.0, -33.3])
def test_rims_are_where_they_belong(diameter_px: float) -> None:
    """Off the exact coverage of the octagon by at most 0.16 of a pixel anywhere, and in all by a few hundredths of its rim."""
    kernel, psf = point(61, diameter_px, APERTURES["octagon"]), APERTURES["octagon"].rasterize(diameter_px).kernel
    exact, squares = np.pad(psf, (61 - psf.shape[0]) // 2), (np.indices((61, 61)) - 30) ** 2
    assert np.abs(kernel - exact).max() < 0.16 * exact.max()
    assert np.abs(kernel - exact).sum() < 0.5 / abs(diameter_px)
    assert (kernel * squares).sum() == pytest.approx((exact * squares).sum(), rel=0.01)


@pytest.mark.parametrize("name", APERTURES)
def test_light_is_kept_and_stays_in_place(name: str) -> None:
    """Shapes with a centre of symmetry do not move at all, others by a small share of a pixel as their rim crosses pixels.
    Where a tip or a narrow ring dips below 0 beside its rim, that is cut off, which adds up to 0.3 % of light."""
    aperture, symmetric = APERTURES[name], name in ("octagon", "disc", "ring")
    for diameter_px in (2.0, 3.3, 7.1, 8.6, 12.5, -17.0, 24.4, 45.9):
        kernel = point(75, diameter_px, aperture, RECTIFIED)
        psf = aperture.rasterize(diameter_px).kernel
        for axis in (0, 1):
            places = np.arange(75) - 37
            drift = (kernel.sum(axis=1 - axis) * places).sum()
            true = (psf.sum(axis=1 - axis) * (np.arange(psf.shape[0]) - psf.shape[0] // 2)).sum()
            assert drift == pytest.approx(true, abs=1e-5 if symmetric else 0.08)
        assert kernel.sum() == pytest.approx(1.0, abs=1e-5 if name == "octagon" else 3e-3)
        assert kernel.min() >= 0.0


@pytest.mark.parametrize("name", APERTURES)
@pytest.mark.parametrize("diameter_px", [5.0, 20.7, -31.0])
def test_a_lamp_shows_the_true_aperture(name: str, diameter_px: float) -> None:
    """By default highlights are not rectified: the kernel of Aperture.rasterize to float32."""
    psf = APERTURES[name].rasterize(diameter_px).kernel
    kernel = point(51, diameter_px, APERTURES[name], DEFAULT)
    np.testing.assert_allclose(kernel, np.pad(psf, (51 - psf.shape[0]) // 2), atol=2e-3 * psf.max() if abs(diameter_px) < 16 else 1e-6)


def test_what_is_in_focus_stays_bit_for_bit() -> None:
    values, coc_px = picture(40, 300), np.zeros((40, 300), np.float32)
    coc_px[:, :100] = np.linspace(-1.0, 1.0, 100)
    np.testing.assert_array_equal(DEFAULT.sum_kernels(values, coc_px, APERTURES["disc"]), values)
    coc_px[:, 200:] = 25.0
    np.testing.assert_array_equal(RECTIFIED.sum_kernels(values, coc_px, APERTURES["disc"])[:, :180], values[:, :180])
    np.testing.assert_allclose(DEFAULT.sum_kernels(values, coc_px, APERTURES["disc"])[:, :180], values[:, :180], atol=1e-7)


@pytest.mark.parametrize("name", APERTURES)
def test_an_even_field_stays_even(name: str) -> None:
    """Look beyond half the largest kernel from the border: what a pixel loses to others it gets from others, to single precision."""
    values = np.full((120, 110, 4), 0.7, np.float32)
    for coc_px in (6.5, 23.4, -37.0):
        inside = DEFAULT.sum_kernels(values, np.full((120, 110), coc_px, np.float32), APERTURES[name])[25:-25, 25:-25]
        np.testing.assert_allclose(inside, 0.7, rtol=1e-5)


@pytest.mark.parametrize("renderer", [SUMS_ONLY, DEFAULT], ids=["sums only", "default"])
def test_a_moved_picture_gives_a_moved_result_and_brighter_light_changes_exponents_alone(renderer: PolygonDifferences) -> None:
    """Move lamps too, by steps that are no multiples of any tile. Four times the light is a power of two: no rounding differs, and
    highlights, told by ratios, stay the same pixels."""
    values, coc_px, heart = np.zeros((120, 130, 4), np.float32), np.zeros((120, 130), np.float32), APERTURES["heart"]
    values[30:70, 40:80], coc_px[30:70, 40:80] = picture(40, 40), waves(40, 40, 0.0, 22.0)
    values[50, 60] = values[33, 43] = values[31, 66] = 1e3
    result = renderer.sum_kernels(values, coc_px, heart)
    moved = renderer.sum_kernels(np.roll(values, (5, 11), (0, 1)), np.roll(coc_px, (5, 11), (0, 1)), heart)
    np.testing.assert_allclose(moved, np.roll(result, (5, 11), (0, 1)), rtol=2e-6, atol=2e-6)
    np.testing.assert_array_equal(renderer.sum_kernels(4.0 * values, coc_px, heart), 4.0 * result)


@pytest.mark.parametrize("name", ["octagon", "heart"])
@pytest.mark.parametrize(("from_px", "to_px", "renderer"), [(0.95, 1.5, DEFAULT), (5.9, 7.1, SUMS_ONLY), (12.0, 13.0, SUMS_ONLY)])
def test_a_focus_pull_does_not_pop(name: str, from_px: float, to_px: float, renderer: PolygonDifferences) -> None:
    """A hundredth of a pixel of diameter moves a rim by half of that, so the light in a pixel of the rim by 0.005 of the kernel's
    level, a little more at corners, and all light by twice 0.01 over the diameter. Into focus, from whole kernels to sums (6 to
    7 px), and on."""
    kernels = [point(41, float(diameter_px), APERTURES[name], renderer) for diameter_px in np.arange(from_px, to_px, 0.01)]
    changes = [np.abs(b - a) for a, b in pairwise(kernels)]
    assert max(change.max() for change in changes) < 0.03 * (1.0 if from_px < 1.0 else kernels[0].max())
    assert max(change.sum() for change in changes) < 0.06 / from_px


def test_lights_of_1e5_leave_their_surroundings_alone() -> None:
    """Error below 1e-4 of the local signal, beside and behind lights of 1e5 under small and large kernels. Against the plain
    twin in float64, so that all light goes through the sums."""
    values, coc_px = 0.1 * picture(20, 26), waves(20, 26, 8.0, 24.0)
    values[5, 8:12] = values[14, 18] = values[9, 22] = 1e5
    coc_px[14, 18] = 8.0
    expected = plain_scatter(values, coc_px, "octagon")
    automatic = PolygonDifferences(exact_below_px=6.0, exact_highlights=False)
    error = np.abs(automatic.sum_kernels(values, coc_px, APERTURES["octagon"]) - expected)
    assert (error / expected).max() < 1e-6
    single = PolygonDifferences(exact_below_px=6.0, exact_highlights=False, precision="single")
    assert (np.abs(single.sum_kernels(values, coc_px, APERTURES["octagon"]) - expected) / expected).max() > 1e-3, "why it is not used here"


@pytest.mark.parametrize("precision", ["single", "double"])
def test_the_same_bits_for_any_number_of_threads(precision) -> None:  # type: ignore[no-untyped-def]
    values, coc_px = picture(300, 200), waves(300, 200, 0.0, 30.0)
    values[200:210, 40] = 500.0
    one, three = (PolygonDifferences(threads=n, precision=precision).sum_kernels(values, coc_px, APERTURES["disc"]) for n in (1, 3))
    np.testing.assert_array_equal(one, three)
    np.testing.assert_array_equal(one, PolygonDifferences(precision=precision).sum_kernels(values, coc_px, APERTURES["disc"]))


def test_calls_from_several_threads_do_not_meet() -> None:
    pictures = [(picture(60 + 20 * i, 200, seed=i), waves(60 + 20 * i, 200, 0.0, 10.0 + 5.0 * i)) for i in range(4)]
    renderer = PolygonDifferences(threads=2)
    alone = [renderer.sum_kernels(values, coc_px, APERTURES["disc"]) for values, coc_px in pictures]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda each: renderer.sum_kernels(*each, APERTURES["disc"]), 3 * pictures))
    for expected, result in zip(3 * alone, together, strict=True):
        np.testing.assert_array_equal(result, expected)


def test_bands_and_parts_leave_no_seams(monkeypatch: pytest.MonkeyPatch) -> None:
    values, coc_px = picture(200, 700, seed=3), waves(200, 700, 0.0, 12.0)
    whole = DEFAULT.sum_kernels(values, coc_px, APERTURES["disc"])
    monkeypatch.setattr(polygon_differences, "BAND_ROWS", 16)
    monkeypatch.setattr(polygon_differences, "RING_BYTES", 1)
    np.testing.assert_allclose(DEFAULT.sum_kernels(values, coc_px, APERTURES["disc"]), whole, atol=2e-6)


def test_a_band_between_lights_may_be_dark() -> None:
    """700x1600 px are bands of 384 rows and more, of which the middle ones hold no light: the parts together are the whole."""
    top, bottom = np.zeros((2, 1600, 700, 4), np.float32)
    top[:100], bottom[-100:] = picture(100, 700, seed=1), picture(100, 700, seed=2)
    coc_px = np.full((1600, 700), 9.0, np.float32)
    both = DEFAULT.sum_kernels(top + bottom, coc_px, APERTURES["disc"])
    apart = [DEFAULT.sum_kernels(each, coc_px, APERTURES["disc"]) for each in (top, bottom)]
    np.testing.assert_allclose(both, apart[0] + apart[1], atol=2e-6)


def test_pixels_without_light_have_no_say_and_light_beyond_the_border_is_lost() -> None:
    values, coc_px = np.zeros((300, 300, 4), np.float32), np.full((300, 300), np.nan, np.float32)
    values[140:160, 100:130], coc_px[140:160, 100:130] = picture(20, 30), waves(20, 30, 0.0, 25.0)
    coc_px[0, 0], coc_px[0, 1] = np.inf, 1e6
    inside = np.s_[120:180, 80:150]
    result = DEFAULT.sum_kernels(values, coc_px, APERTURES["disc"])
    small = DEFAULT.sum_kernels(np.ascontiguousarray(values[inside]), np.nan_to_num(coc_px[inside]), APERTURES["disc"])
    np.testing.assert_allclose(result[inside], small, atol=2e-6)
    assert result.sum() == pytest.approx(values.sum(), rel=1e-5)
    assert not DEFAULT.sum_kernels(np.zeros_like(values), coc_px, APERTURES["disc"]).any()
    values, coc_px = picture(50, 40), np.full((50, 40), 30.0, np.float32)
    padded = np.pad(values, ((20, 20), (20, 20), (0, 0)))
    expected = DEFAULT.sum_kernels(padded, np.full(padded.shape[:2], 30.0, np.float32), APERTURES["octagon"])[20:-20, 20:-20]
    np.testing.assert_allclose(DEFAULT.sum_kernels(values, coc_px, APERTURES["octagon"]), expected, atol=2e-6)


def test_mistakes_are_named() -> None:
    with pytest.raises(InputError, match="finite circle of confusion"):
        DEFAULT.sum_kernels(picture(10, 10), np.full((10, 10), np.nan, np.float32), APERTURES["disc"])
    for wrong in ({"exact_below_px": 0.5}, {"halve_from_px": 10.0}):
        with pytest.raises(InputError, match=next(iter(wrong))):
            PolygonDifferences(**wrong)


def test_sparse_light_is_spread_like_any() -> None:
    """A curved band of light and a few islands, worked through in narrow parts, and the rest of the picture: together the whole."""
    values, coc_px = picture(240, 300), waves(240, 300, 5.0, 24.0)
    y, x = np.mgrid[:240, :300]
    sparse = (np.abs(y - 120 - 70 * np.sin(x / 50.0)) < 8) | (np.hypot(y - 24, x - 240) < 9) | (np.hypot(y - 220, x - 20) < 5)
    octagon = APERTURES["octagon"]
    parts = [
        RECTIFIED.sum_kernels(np.where(mask[..., None], values, 0.0).astype(np.float32), coc_px, octagon) for mask in (sparse, ~sparse)
    ]
    np.testing.assert_allclose(parts[0] + parts[1], RECTIFIED.sum_kernels(values, coc_px, octagon), atol=3e-7)
    assert 0.0 < sparse.mean() < 0.2


@pytest.mark.parametrize(("step", "margin"), [(96, 5), (33, 20), (500, 12)])
@pytest.mark.parametrize("lit", [0.02, 0.1, 1.0])
def test_parts_hold_all_light_once_and_are_as_small_as_can_be(step: int, margin: int, lit: float) -> None:
    """Rows 8 to 150 of 211 columns of tiles: every lit tile is in the part of its column of `step` px, parts of a column lie
    more than two margins apart, and each begins and ends with light on all four sides."""
    occupied = np.random.default_rng(step).uniform(size=(19, 27)) < lit
    parts = polygon_differences.parts_of(occupied, 8, 150, 211, step, margin).tolist()
    pixels = np.kron(occupied, np.ones((8, 8), bool))[:150, :211]
    pixels[:8] = False
    held = np.zeros(pixels.shape, int)
    for first, end, left, right in parts:
        held[first:end, left:right] += 1
        assert left // step == (right - 1) // step
        assert all(edge.any() for edge in (pixels[first, left:right], pixels[end - 1, left:right], pixels[first:end, left]))
        assert pixels[first:end, right - 1].any()
    assert held.max() == 1 and (held[pixels] == 1).all()
    for one, following in pairwise(parts):
        assert one[2] // step != following[2] // step or (following[0] - (one[1] - 8)) > 2 * margin

"""The low-rank filter against the exact scatter, and what it promises by itself."""

from itertools import pairwise

import cv2
import numpy as np
import pytest

from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.kernels.low_rank_kernel import decompose
from mrbokeh.renderers.low_rank import exact_scatter as _low_rank_exact
from mrbokeh.renderers.low_rank.low_rank_filter import LowRankFilter, depth_edge_mask, tilt_shift
from mrbokeh.renderers.scatter_reference import scatter
from mrbokeh.system.errors import InputError

HEIGHT_PX, WIDTH_PX = 150, 190
SLOPE = np.tile(np.linspace(1.0, 36.0, WIDTH_PX, dtype=np.float32), (HEIGHT_PX, 1))
MAPS = {
    "even": np.full((HEIGHT_PX, WIDTH_PX), 20.3, np.float32),
    "slope": SLOPE,
    "through the focus": 2.0 * SLOPE - 37.0,
    "two planes": np.where(np.arange(WIDTH_PX) < 90, -25.0, 17.0).astype(np.float32) * np.ones((HEIGHT_PX, 1), np.float32),
    "any": np.random.default_rng(5).uniform(-20.0, 20.0, (HEIGHT_PX, WIDTH_PX)).astype(np.float32),
}
APERTURES = {"disc": Aperture.disc(), "5 blades": Aperture.blades(5, 0.3), "ring": Aperture.disc().obstructed(0.5)}


def noise(channels: int = 4, seed: int = 0) -> np.ndarray:
    """White noise, the hardest texture for a kernel's error: every frequency counts alike."""
    return np.random.default_rng(seed).uniform(0.0, 1.0, (HEIGHT_PX, WIDTH_PX, channels)).astype(np.float32)


def exact(values: np.ndarray, coc_px: np.ndarray, aperture: Aperture) -> np.ndarray:
    return scatter(values.astype(np.float64), coc_px, aperture)


def psnr(image: np.ndarray, truth: np.ndarray) -> float:
    return float(-10.0 * np.log10(np.mean((image - truth) ** 2)))


def point(value: float = 1.0, size_px: int = 81) -> np.ndarray:
    values = np.zeros((size_px, size_px, 2), np.float32)
    values[size_px // 2, size_px // 2] = value
    return values


@pytest.mark.parametrize(
    ("name", "aperture"),
    [*((name, "5 blades") for name in MAPS), ("through the focus", "ring"), ("any", "ring"), ("two planes", "disc"), ("slope", "disc")],
)
def test_it_agrees_with_the_exact_scatter(name: str, aperture: str) -> None:
    """48 dB on white noise of range 1; with the default error of 0.1 theory says 0.1 * 0.29 / (0.44 d) for a disc: 53 dB at 20 px."""
    result = LowRankFilter().sum_kernels(noise(), MAPS[name], APERTURES[aperture])
    truth = exact(noise(), MAPS[name], APERTURES[aperture])
    assert psnr(result, truth) > 48.0
    np.testing.assert_allclose(result.sum(), truth.sum(), rtol=1e-4)


def test_a_photograph_comes_closer_than_noise_and_an_even_field_stays_even() -> None:
    """A short sum errs most at high frequencies: 70 dB are reached (64 with twice the error and no least rank), on noise 48 and more."""
    smooth = cv2.GaussianBlur(noise(), (0, 0), 1.5)
    assert psnr(LowRankFilter().sum_kernels(smooth, SLOPE, Aperture.disc()), exact(smooth, SLOPE, Aperture.disc())) > 65.0
    even = LowRankFilter().sum_kernels(np.full((HEIGHT_PX, WIDTH_PX, 1), 0.7, np.float32), MAPS["even"], APERTURES["5 blades"])
    np.testing.assert_allclose(even[15:-15, 15:-15], 0.7, rtol=2e-6)


def test_a_lower_target_comes_closer_and_kernels_are_kept_between_calls() -> None:
    truth = exact(noise(), MAPS["even"], Aperture.disc())
    reached = [psnr(LowRankFilter(error).sum_kernels(noise(), MAPS["even"], Aperture.disc()), truth) for error in (0.2, 0.1, 0.03, 0.0)]
    assert reached == sorted(reached) and reached[-1] > 120.0
    renderer = LowRankFilter()
    renderer.sum_kernels(noise(), MAPS["even"], Aperture.disc())
    (kept,) = renderer._kernels.values()
    renderer.sum_kernels(noise(), MAPS["even"], Aperture.disc())
    assert list(renderer._kernels.values()) == [kept] and renderer._kernels.popitem()[1] is kept
    np.testing.assert_allclose(kept.dense(), decompose(Aperture.disc().rasterize(float(np.float32(20.3))).kernel, 0.1, min_rank=4).dense())


@pytest.mark.parametrize("coc_px", [-33.3, -5.2, 1.4, 9.0, 13.7, 40.0])
def test_a_point_keeps_its_energy_centroid_and_shape(coc_px: float) -> None:
    """A point is far above its surroundings: it is spread by the exact kernel, within its circle of confusion."""
    result = LowRankFilter().sum_kernels(point(1e5), np.full((81, 81), coc_px, np.float32), Aperture.blades(7))
    psf = Aperture.blades(7).rasterize(coc_px)
    inside = slice(40 - psf.radius_px, 41 + psf.radius_px)
    np.testing.assert_allclose(result[inside, inside, 0], 1e5 * psf.kernel, atol=1e-6 * 1e5 * psf.kernel.max())
    assert result.astype(np.float64).sum() == pytest.approx(2e5, rel=1e-6)
    result[inside, inside] = 0.0
    assert not result.any()


@pytest.mark.parametrize("own_kernels", [1024, 0])
def test_points_of_many_diameters_keep_to_their_circles(own_kernels: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """With own kernels exactly; with tabulated ones the rims are off by a hundredth of a tap at most."""
    monkeypatch.setattr(_low_rank_exact, "_MOST_OWN_KERNELS", own_kernels)
    values = np.zeros((200, 200, 1), np.float32)
    values[20::40, 20::40] = 1.0
    coc_px = np.linspace(11.0, 38.0, 200 * 200, dtype=np.float32).reshape(200, 200)
    result, truth = LowRankFilter().sum_kernels(values, coc_px, Aperture.disc()), exact(values, coc_px, Aperture.disc())
    largest_tap_near = cv2.dilate(truth[..., 0], np.ones((39, 39)))
    assert (np.abs(result - truth)[..., 0] <= (0.01 if own_kernels == 0 else 1e-6) * largest_tap_near).all()
    outside = truth[..., 0] == 0 if own_kernels else cv2.dilate(truth[..., 0], np.ones((3, 3))) == 0
    assert np.abs(result[outside]).max() < 1e-9


def test_pictures_without_highlights_add_up_whatever_their_channels_and_signs() -> None:
    a, b = noise(seed=1), noise(seed=2)
    apart = LowRankFilter().sum_kernels(a, SLOPE, Aperture.disc()) + LowRankFilter().sum_kernels(b, SLOPE, Aperture.disc())
    np.testing.assert_allclose(LowRankFilter().sum_kernels(a + b, SLOPE, Aperture.disc()), apart, atol=2e-6)
    values = noise(19) - np.float32(0.5)
    result = LowRankFilter().sum_kernels(values, SLOPE, Aperture.disc())
    assert psnr(result, exact(values, SLOPE, Aperture.disc())) > 48.0 and result.min() < -0.01


def test_doubled_light_gives_doubled_results_bit_for_bit_and_they_move_with_the_picture() -> None:
    """Multiply by a power of two, which changes exponents alone, and highlights are told by ratios, so that they stay the same pixels."""
    bright = noise() ** 12 * 100.0
    one, two = (LowRankFilter().sum_kernels(np.float32(scale) * bright, SLOPE, Aperture.disc()) for scale in (1.0, 2.0))
    np.testing.assert_array_equal(two, np.float32(2.0) * one)
    values, coc_px, steps, inside = np.zeros_like(noise()), np.zeros_like(SLOPE), (7, -13), np.s_[40:100, 40:120]
    values[inside], coc_px[inside] = noise()[inside] ** 6, SLOPE[inside]
    still = LowRankFilter().sum_kernels(values, coc_px, Aperture.blades(5))
    moved = LowRankFilter().sum_kernels(np.roll(values, steps, (0, 1)), np.roll(coc_px, steps, (0, 1)), Aperture.blades(5))
    np.testing.assert_allclose(moved, np.roll(still, steps, (0, 1)), atol=1e-6)


@pytest.mark.parametrize("per_pixel", [False, True])
def test_the_number_of_threads_changes_nothing(per_pixel: bool) -> None:
    values = noise(3) ** 12
    results = []
    for threads in (1, 2, 5):
        cv2.setNumThreads(threads)
        results.append(LowRankFilter(per_pixel=per_pixel, threads=threads).sum_kernels(values, MAPS["through the focus"], Aperture.disc()))
    cv2.setNumThreads(-1)
    np.testing.assert_array_equal(results[0], results[1])
    np.testing.assert_array_equal(results[0], results[2])


@pytest.mark.parametrize("contrast", [30.0, 1e3, 1e5])
def test_a_lamp_leaves_the_dark_beside_it_alone(contrast: float) -> None:
    """A panel of light in a dim textured room: nothing negative, and even next to it the light is right to 10 % of what is there."""
    values = 0.5 + noise(1)
    values[50:90, 60:120] *= contrast
    coc_px = MAPS["even"]
    result, truth = LowRankFilter().sum_kernels(values, coc_px, Aperture.disc()), exact(values, coc_px, Aperture.disc())
    inside = np.s_[20:-20, 20:-20]
    assert result.min() > 0.0
    np.testing.assert_allclose(result[inside], truth[inside], rtol=0.1)


@pytest.mark.parametrize(("angle_rad", "diameter_px"), [(0.0, 12.0), (0.4, 33.0), (np.pi / 4, 12.0)])
@pytest.mark.parametrize("aperture", APERTURES)
def test_an_edge_is_right_to_three_thousandths(angle_rad: float, diameter_px: float, aperture: str) -> None:
    y, x = np.mgrid[:HEIGHT_PX, :WIDTH_PX]
    values = ((x - 95) * np.cos(angle_rad) + (y - 75) * np.sin(angle_rad) > 0).astype(np.float32)[..., None]
    coc_px = np.full(values.shape[:2], diameter_px, np.float32)
    result = LowRankFilter().sum_kernels(values, coc_px, APERTURES[aperture])
    assert result.min() >= 0.0
    error = np.abs(result - exact(values, coc_px, APERTURES[aperture]))[40:-40, 40:-40].max()
    assert error < (0.006 if aperture == "ring" else 0.003)


def test_a_focus_pull_does_not_pop() -> None:
    """A hundredth of a pixel of blur changes the picture by a hundredth of what a pixel does, across every level."""
    values = noise(1)
    flat = [LowRankFilter().sum_kernels(values, SLOPE + np.float32(0.01 * step), Aperture.disc()) for step in range(3)]
    whole = LowRankFilter().sum_kernels(values, SLOPE + np.float32(1.0), Aperture.disc())
    inside = np.s_[:, 40:-20]
    for one, next_one in pairwise(flat):
        assert np.abs(next_one - one)[inside].max() < 0.03 * np.abs(whole - flat[0])[inside].max()


def test_pixels_without_light_have_no_say() -> None:
    values, coc_px = noise().copy(), SLOPE.copy()
    values[30:60], coc_px[30:45], coc_px[45:60] = 0.0, np.nan, np.inf
    result = LowRankFilter().sum_kernels(values, coc_px, Aperture.disc())
    np.testing.assert_array_equal(result, LowRankFilter().sum_kernels(values, np.where(np.isfinite(coc_px), coc_px, 90.0), Aperture.disc()))
    with pytest.raises(InputError, match="finite circle of confusion"):
        LowRankFilter().sum_kernels(noise(), coc_px, Aperture.disc())


def test_edges_of_depth_are_masked_as_far_as_the_blur_reaches() -> None:
    """The mask reaches at least one radius and at most two (rounded up to a power of two) plus the edge itself."""
    lit = np.ones((40, 120), bool)
    mask = depth_edge_mask(np.where(np.arange(120) < 60, 6.0, 20.0).astype(np.float32) * np.ones((40, 1), np.float32), lit, 1.0)
    columns = np.flatnonzero(mask.any(axis=0))
    assert mask.all(axis=0)[columns].all()
    assert 60 - 3 - 4 <= columns.min() <= 60 - 3 and 60 + 10 <= columns.max() <= 60 + 17
    assert not depth_edge_mask(SLOPE, np.ones(SLOPE.shape, bool), 1.0).any(), "a slope is no edge"
    lit[:, 100:] = False
    assert depth_edge_mask(np.full((40, 120), 8.0, np.float32), lit, 1.0)[:, 95:100].all(), "where light ends, too"


@pytest.mark.parametrize(("name", "least_db"), [("even", 48.0), ("slope", 43.0), ("two planes", 48.0), ("through the focus", 40.0)])
def test_the_paper_s_passes_agree_where_the_blur_changes_slowly(name: str, least_db: float) -> None:
    result = LowRankFilter(per_pixel=True).sum_kernels(noise(), MAPS[name], Aperture.disc())
    truth = exact(noise(), MAPS[name], Aperture.disc())
    assert psnr(result, truth) > least_db
    np.testing.assert_allclose(result.sum(), truth.sum(), rtol=2e-3)


def test_tilt_shift_is_the_exact_scatter_shared_out_and_refuses_what_it_cannot_blur() -> None:
    """A band in focus, blur growing to 24 px above and below; at rank 3, as in the paper."""
    rgb = cv2.GaussianBlur(noise(3), (0, 0), 1.5)
    coc_px = np.tile(np.abs(np.linspace(-24.0, 24.0, HEIGHT_PX, dtype=np.float32))[:, None], (1, WIDTH_PX))
    result = tilt_shift(rgb, coc_px, Aperture.blades(8, np.pi / 8))
    around = ((13, 13), (13, 13))
    wide = np.pad(np.dstack([rgb, np.ones_like(coc_px)]), (*around, (0, 0)), "symmetric")
    truth = exact(wide, np.pad(coc_px, around, "symmetric"), Aperture.blades(8, np.pi / 8))[13:-13, 13:-13]
    assert psnr(result, truth[..., :3] / truth[..., 3:]) > 58.0
    np.testing.assert_allclose(tilt_shift(np.full_like(rgb, 0.3), coc_px, Aperture.disc()), 0.3, rtol=1e-5)
    rgb, coc_px = noise(3), SLOPE
    with pytest.raises(InputError, match="map of diameters"):
        tilt_shift(rgb, coc_px[:-1], Aperture.disc())
    with pytest.raises(InputError, match="finite"):
        tilt_shift(rgb, np.full_like(coc_px, np.nan), Aperture.disc())
    with pytest.raises(InputError, match="rank of at least 1"):
        tilt_shift(rgb, coc_px, Aperture.disc(), rank=0)

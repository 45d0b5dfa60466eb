"""A real lens, ray by ray: Snell's law, circles of confusion, vignetting, colour."""

from functools import cache
from math import inf

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mrbokeh.optics.lens import Lens
from mrbokeh.optics.psf_grid import NestedGrid
from mrbokeh.psf_models import _lens_beam
from mrbokeh.psf_models import _physical_lens_numba as compiled
from mrbokeh.psf_models._lens_beam import BANDS_UM, GREEN_UM
from mrbokeh.psf_models._physical_lens_numba import trace_ray
from mrbokeh.psf_models.base import centred, sobol_blocks
from mrbokeh.psf_models.lens_prescription import LensPrescription, Surface, index_at
from mrbokeh.psf_models.physical_lens import PhysicalLens, biconvex_lens
from mrbokeh.psf_models.simple_lens import SimpleLens
from mrbokeh.system.errors import InputError

RAYS = 1 << 15


def pair(rim_mm: float = 30.0) -> LensPrescription:
    """Two cemented achromats with the stop between them, f/4: a lens with rims well in front of and behind its iris."""
    half = (Surface(60.0, 6.0, 1.6204, rim_mm, 60.3), Surface(-60.0, 2.0, 1.62, rim_mm, 36.4), Surface(300.0, 12.0, 1.0, rim_mm))
    behind = (Surface(-300.0, 2.0, 1.62, rim_mm, 36.4), Surface(60.0, 6.0, 1.6204, rim_mm, 60.3), Surface(-60.0, 0.0, 1.0, rim_mm))
    return LensPrescription("pair", (*half, Surface(inf, 12.0, 1.0, 10.0, is_stop=True), *behind))


@cache
def lens(rim_mm: float = 30.0) -> PhysicalLens:
    return PhysicalLens(pair(rim_mm), focus_distance_m=2.0, image_width_px=2000)


def at(depth_m: float, eccentricity: float = 0.0) -> np.ndarray:
    return np.array([[depth_m, depth_m], [eccentricity, eccentricity]])


def snell_in_the_open(prescription: LensPrescription, position: np.ndarray, direction: np.ndarray, wavelength_um: float, with_rims: bool):
    """The plain twin of `trace_ray`: intersect by the quadratic formula about the centre of curvature, turn by angles."""
    index, vertex = 1.0, 0.0
    for surface in prescription.surfaces:
        behind = float(index_at(surface.index, surface.abbe_number, wavelength_um))
        if np.isinf(surface.radius_mm):
            position = position + (vertex - position[2]) / direction[2] * direction
            normal = np.array([0.0, 0.0, 1.0])
        else:
            centre = np.array([0.0, 0.0, vertex + surface.radius_mm])
            along = (centre - position) @ direction
            root = surface.radius_mm**2 - ((centre - position) @ (centre - position) - along**2)
            if root < 0.0:
                return None
            position = position + (along - np.sign(surface.radius_mm) * np.sqrt(root)) * direction
            normal = (centre - position) / surface.radius_mm
        if with_rims and np.hypot(*position[:2]) > 0.5 * surface.diameter_mm:
            return None
        cosine = direction @ normal
        aside = direction - cosine * normal
        sine = np.linalg.norm(aside)
        new_sine = sine * index / behind
        if new_sine > 1.0:
            return None
        if sine > 0.0:
            direction = np.cos(np.arcsin(new_sine)) * normal + new_sine * aside / sine
        index, vertex = behind, vertex + surface.distance_mm
    return position, direction


def random_rays(count: int, seed: int) -> np.ndarray:
    """Rays that start 40 mm before the pair and aim at its front surface, up to 20 degrees off the axis."""
    rng = np.random.default_rng(seed)
    start = np.column_stack([rng.uniform(-8, 8, (count, 2)), np.full(count, -40.0)])
    target = np.column_stack([rng.uniform(-6, 6, (count, 2)), np.zeros(count)])
    direction = target - start
    return np.hstack([start, direction / np.linalg.norm(direction, axis=1, keepdims=True)])


@pytest.mark.parametrize("with_rims", [True, False])
def test_compiled_tracing_is_the_plain_one(with_rims: bool) -> None:
    table, passed = pair(16.0).optics_table(), 0
    for ray in random_rays(300, 1):
        expected = snell_in_the_open(pair(16.0), ray[:3], ray[3:], 0.5, with_rims)
        got = ray.copy()
        assert trace_ray(table, 0, 1.0, got, 0.5, with_rims) == (expected is not None)
        if expected is not None:
            passed += 1
            assert_allclose(got, np.concatenate(expected), atol=1e-9)
    assert passed > (20 if with_rims else 250)


def test_rays_go_back_their_way_and_total_reflection_blocks() -> None:
    forward, back = pair(30.0).optics_table(), pair(30.0).reversed_table()
    length_mm, passed = forward[-1, 0], 0
    for ray in random_rays(200, 3):
        out = ray.copy()
        if trace_ray(forward, 0, 1.0, out, 0.5, True):
            passed += 1
            home = out * [1, 1, -1, -1, -1, 1] + [0, 0, length_mm, 0, 0, 0]
            assert trace_ray(back, 0, 1.0, home, 0.5, True)
            home = home * [1, 1, -1, -1, -1, 1] + [0, 0, length_mm, 0, 0, 0]
            assert_allclose(home[3:], ray[3:], atol=1e-10)
            assert_allclose(np.cross(home[:3] - ray[:3], ray[3:]), 0.0, atol=1e-8)  # on the same line
    assert passed > 50
    # From glass of 1.7 into air beyond arcsin(1 / 1.7) = 36 degrees.
    table = np.array([[0.0, 0.0, 400.0, 1.0, 0.0]])
    for degrees, passes in ((35.9, True), (36.1, False)):
        angle = np.deg2rad(degrees)
        ray = np.array([0.0, 0.0, -1.0, np.sin(angle), 0.0, np.cos(angle)])
        assert trace_ray(table, 0, 1.7, ray, 0.55, True) == passes


def light_on_axis(model: PhysicalLens, depth_m: float) -> np.ndarray:
    return model.kernel(at(depth_m), RAYS, 5)[:, :, 1].astype(np.float64)


def mean_square_radius_px2(kernel: np.ndarray) -> float:
    places = np.arange(len(kernel)) - len(kernel) // 2
    return float((kernel * (places[:, None] ** 2 + places**2)).sum() / kernel.sum()) - 1.0 / 6.0  # the pixel's own spread


def relative_error_of_coc(depth_m: float, f_number: float) -> float:
    """Diameter on the axis against the thin lens. An even disc of diameter c has the mean square radius c^2 / 8. The pair is
    symmetric about its stop, so that its pupils lie in its principal planes, as in a thin lens."""
    model = PhysicalLens(pair(), focus_distance_m=2.0, image_width_px=round(750 * f_number), f_number=f_number)
    thin = Lens(model.lens.focal_length_mm, f_number, 2.0, 36.0)
    expected_px = abs(float(thin.coc_px(depth_m, round(750 * f_number))))
    assert expected_px > 30.0
    return float(np.sqrt(8.0 * mean_square_radius_px2(light_on_axis(model, depth_m)))) / expected_px - 1.0


@pytest.mark.parametrize("depth_m", [0.7, 1.2, 8.0, 50.0])
def test_far_from_focus_on_the_axis_the_blur_is_the_thin_lens_circle_of_confusion(depth_m: float) -> None:
    """Within 1 % at f/32, and what is left is spherical aberration: its defocus grows with the square of the aperture."""
    error = relative_error_of_coc(depth_m, 32.0)
    assert abs(error) < 0.01
    assert relative_error_of_coc(depth_m, 11.0) == pytest.approx(error * (32.0 / 11.0) ** 2, rel=0.25)


@pytest.mark.parametrize("depth_m", [0.8, 1.2, 6.0, 50.0])
def test_on_the_axis_at_a_small_aperture_the_kernel_is_the_disc_of_the_thin_lens(depth_m: float) -> None:
    """Compare the bi-convex lens at f/64, of glass without dispersion, with the kernel of the thin lens's circle of confusion.

    Spherical aberration, which at f/32 changes the diameter by 2 %, here changes it by half a per cent, and of a disc's light twice
    that comes to lie elsewhere; the pupil lies 0.4 mm before the principal plane.
    """
    width_px, f_number = 30_000, 64.0
    small = biconvex_lens(50.0, 8.0, abbe_number=inf).stopped_down(f_number)
    kernel = PhysicalLens(small, focus_distance_m=2.0, image_width_px=width_px).kernel(at(depth_m), 1 << 18, 0)
    coc_px = abs(float(Lens(50.0, f_number, 2.0, 36.0).coc_px(depth_m, width_px)))
    disc = SimpleLens().exact(np.array([coc_px]))
    assert coc_px > 8.0
    assert_allclose(kernel[..., 0], kernel[..., 2], atol=1e-6)
    size = max(len(kernel), len(disc))
    elsewhere = centred(kernel.astype(np.float64).mean(axis=2), size) - centred(disc[..., 0].astype(np.float64), size)
    assert 0.5 * np.abs(elsewhere).sum() < 2.0 * 0.005


@pytest.mark.parametrize("eccentricity", [0.0, 0.6, 0.9])
def test_light_is_kept(eccentricity: float) -> None:
    """A kernel sums to its open share in each colour, or to 1 where vignetting is left to others."""
    model = lens(22.0)
    kernel = model.kernel(at(6.0, eccentricity), RAYS, 1)
    share = min(1.0, model.throughput(6.0, eccentricity))
    assert kernel.dtype == np.float32 and kernel.min() >= 0.0 and len(kernel) % 2 == 1
    assert_allclose(kernel.sum(axis=(0, 1), dtype=np.float64), share, rtol=0.005)
    even = PhysicalLens(pair(22.0), image_width_px=2000, vignetting=False).kernel(at(6.0, eccentricity), RAYS, 1)
    assert_allclose(even.sum(axis=(0, 1), dtype=np.float64), 1.0, rtol=1e-5)


def test_on_the_axis_everything_is_round() -> None:
    """The raw landings are: same spread along x and y, none between them, no displacement (quasi-random, so to 1 %)."""
    model = lens()
    (x, y), weight = landings(model, 6.0, 0.0)
    assert abs(np.average(x, weights=weight)) < 0.01 * x.max()
    assert np.average(x * x, weights=weight) == pytest.approx(np.average(y * y, weights=weight), rel=0.01)
    kernel = model.kernel(at(6.0), 1 << 18, 1)
    assert_allclose(kernel, kernel.transpose(1, 0, 2), atol=0.1 * kernel.max())
    assert np.abs(kernel - kernel.transpose(1, 0, 2)).sum() < 0.03 * kernel.sum()


def landings(model: PhysicalLens, depth_m: float, eccentricity: float, colour: int = 1) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Green rays in pixels of the picture over the whole pupil: `trace` covers b >= 0, a second time with b turned over."""
    per_mm = np.array([0.001 / depth_m])
    window = model.beam.window(per_mm, np.array([eccentricity]))
    shares = np.random.default_rng(0).random((40000, 3))
    chiefs = model.beam.chief_rays(eccentricity, eccentricity)
    places, weights = model.beam.trace(chiefs, window, shares, np.full(40000, per_mm[0]), np.zeros(40000))
    lit = weights[:, colour] > 0.0
    x, y = -places[lit, colour, 0] / model.mm_per_px, -places[lit, colour, 1] / model.mm_per_px
    return (np.concatenate([x, x]), np.concatenate([y, -y])), np.concatenate([weights[lit, colour]] * 2)


def test_kernels_are_mirror_images_about_the_field_and_the_chief_ray_lands_where_it_should() -> None:
    """Only half of the pupil is traced: rays on its other half, traced in the open, land at the mirrored places."""
    model = lens()
    kernel = model.kernel(at(6.0, 0.7), RAYS, 1)
    assert_allclose(kernel, kernel[::-1], atol=1e-7)
    chief = model.beam.chief_ray(0.7)
    source = chief[[1, 2]] - (6000.0 + chief[2] - model.beam.front_mm) / chief[4] * chief[[3, 4]]
    for a, b in ((0.0, 2.0), (3.0, 1.0), (-2.0, 3.0)):
        ends = []
        for side in (1.0, -1.0):
            target = np.array([chief[1] + a * chief[4], side * b, chief[2] - a * chief[3]])
            direction = target - [source[0], 0.0, source[1]]
            place, heading = snell_in_the_open(model.lens, target, direction / np.linalg.norm(direction), GREEN_UM, True)
            ends.append(place + (model.beam.sensor_at_mm - place[2]) / heading[2] * heading)
        assert_allclose(ends[0], ends[1] * [1, -1, 1], atol=1e-9)
        assert_allclose(landed_at(model, chief, 6.0, a, b), ends[0][:2], atol=1e-8)
    # The ray through a = b = 0 is the chief ray of whatever depth: it meets the sensor at the eccentricity asked for.
    for eccentricity in (0.0, 0.3, 1.0):
        chief = model.beam.chief_ray(eccentricity)
        for depth_m in (0.7, 2.0, 100.0):
            assert_allclose(landed_at(model, chief, depth_m, 0.0, 0.0), [-eccentricity * 0.5 * np.hypot(36.0, 24.0), 0.0], atol=1e-8)


def landed_at(model: PhysicalLens, chief: np.ndarray, depth_m: float, a: float, b: float, wavelength_um: float = GREEN_UM) -> np.ndarray:
    landing, beam = np.empty(2), model.beam
    point = (beam.table, chief[1:], beam.front_mm, 0.001 / depth_m, a, b, wavelength_um, beam.sensor_at_mm)
    assert compiled.trace_point(*point, np.empty(6), landing) > 0.0
    return landing


def blocked_and_free(model: PhysicalLens, depth_m: float, eccentricity: float, steps: int) -> float:
    """Cross-section of the beam in mm^2, counted on a square grid of rays with the plain tracer."""
    chief = model.beam.chief_ray(eccentricity)
    source = chief[[1, 2]] - (1000.0 * depth_m + chief[2] - model.beam.front_mm) / chief[4] * chief[[3, 4]]
    grid = (np.arange(steps) + 0.5) / steps * 24.0 - 12.0
    free = 0
    for a in grid:
        for b in grid[steps // 2 :]:
            target = np.array([chief[1] + a * chief[4], b, chief[2] - a * chief[3]])
            direction = target - [source[0], 0.0, source[1]]
            free += snell_in_the_open(model.lens, target, direction / np.linalg.norm(direction), BANDS_UM[1, 0], True) is not None
    return 2.0 * free * (24.0 / steps) ** 2 / chief[4]


@pytest.mark.slow
def test_open_share_is_the_count_of_unblocked_rays() -> None:
    """The grid of 120 x 120 rays finds an area of about 100 mm^2 to 1 %."""
    model = lens(22.0)
    axis = blocked_and_free(model, 6.0, 0.0, 120)
    for eccentricity in (0.5, 0.9):
        counted = blocked_and_free(model, 6.0, eccentricity, 120) / axis
        assert model.throughput(6.0, eccentricity) == pytest.approx(counted, abs=0.015)


def test_cat_eyes_close_towards_the_corner_but_wide_rims_close_nothing() -> None:
    """Open share and width along the field fall, width across stays longer: the opening is a cat's eye."""
    model = lens(16.0)
    shares = [model.throughput(20.0, each) for each in (0.0, 0.25, 0.5, 0.75, 1.0)]
    assert shares[0] == 1.0 and (np.diff(shares) <= 0.005).all() and shares[-1] < 0.5
    widths = []
    for eccentricity in (0.0, 0.9):
        kernel = model.kernel(at(20.0, eccentricity), RAYS, 0)[:, :, 1]
        lit = kernel > 0.02 * kernel.max()
        widths.append((np.ptp(np.nonzero(lit.any(axis=0))[0]) + 1, np.ptp(np.nonzero(lit.any(axis=1))[0]) + 1))
    assert abs(widths[0][0] - widths[0][1]) <= 1
    assert widths[1][0] < 0.8 * widths[1][1]
    # With rims far outside the beam only the iris is left: the projected pupil stays open within a few per cent.
    assert lens(30.0).throughput(20.0, 0.4) == pytest.approx(1.0, abs=0.03)
    model = PhysicalLens(pair(), focus_distance_m=2.0, image_width_px=1000, f_number=11.0)
    kernel = model.kernel(at(2.0), RAYS, 0)
    middle = len(kernel) // 2
    assert_allclose(kernel[middle, middle], 1.0, atol=0.01)


@pytest.mark.parametrize(("depth_m", "side"), [(20.0, 1.0), (1.05, -1.0)])
def test_behind_the_focus_the_pupil_is_upright_in_front_it_is_turned(depth_m: float, side: float) -> None:
    """A ray through the right (x > 0) of the pupil ends on the right of the picture, which is the sensor turned by half a turn,
    if its source lies behind the focus, and on the left if in front; the kernel off the axis shows the same."""
    model = lens(16.0)
    assert -landed_at(model, model.beam.chief_ray(0.0), depth_m, 3.0, 0.0)[0] * side > 5.0 * model.mm_per_px
    (x, _), _ = landings(model, depth_m, 0.9)
    kernel = model.kernel(at(depth_m, 0.9), RAYS, 0)[:, :, 1]
    columns = np.nonzero(kernel.any(axis=0))[0] - len(kernel) // 2
    assert_allclose([columns.min(), columns.max()], [np.round(x.min()), np.round(x.max())], atol=1)


def focus_of(model: LensPrescription, wavelength_um: float) -> float:
    """Where a ray parallel to the axis at 1 mm meets it, from the first vertex."""
    ray = np.array([1.0, 0.0, -10.0, 0.0, 0.0, 1.0])
    assert trace_ray(model.optics_table(), 0, 1.0, ray, wavelength_um, True)
    return float(ray[2] - ray[0] * ray[5] / ray[3])


def test_blue_focuses_nearer_than_red_and_fringes_turn_over_at_the_focus() -> None:
    """The single lens: focal lengths differ by f / V between the F and C lines, 50 / 64.17 mm = 0.78 mm."""
    single = biconvex_lens(50.0, 8.0)
    blue, green, red = (focus_of(single, each) for each in (0.48613, 0.55, 0.65627))
    assert blue < green < red
    assert red - blue == pytest.approx(50.0 / 64.17, rel=0.02)
    achromat = focus_of(pair(), 0.65627) - focus_of(pair(), 0.48613)
    assert abs(achromat) < 0.5 * (red - blue)
    # Behind the focus blue, which focuses nearer to the lens, is the wider disc; in front red is.
    model = PhysicalLens(biconvex_lens(50.0, 8.0), focus_distance_m=2.0, image_width_px=6000)
    for depth_m, wider in ((20.0, 2), (1.2, 0)):
        kernel = model.kernel(at(depth_m), RAYS, 0)
        spread = [mean_square_radius_px2(kernel[:, :, colour].astype(np.float64)) for colour in range(3)]
        assert int(np.argmax(spread)) == wider and int(np.argmin(spread)) == 2 - wider


def test_wavelengths_are_spread_over_their_band() -> None:
    """A triangle between middle - half and middle + half: shares 0, 1/8, 1/2, 7/8 lie at -1, -1/2, 0 and 1/2 of the half width."""
    model = PhysicalLens(focus_distance_m=2.0)
    shares = np.array([[0.9, 0.3, share] for share in (0.0, 0.125, 0.5, 0.875)])
    chiefs, window, per_mm = model.beam.chief_rays(0.4, 0.4), np.array([-4.0, 4.0, 4.0]), 1.0 / 5000.0
    places, weights = model.beam.trace(chiefs, window, shares, np.full(4, per_mm), np.zeros(4))
    for colour, (middle_um, half_um) in enumerate(BANDS_UM):
        for row, tent in enumerate((-1.0, -0.5, 0.0, 0.5)):
            landing = landed_at(model, chiefs[0], 5.0, 3.2, 1.2, middle_um + tent * half_um)
            assert_allclose(places[row, colour], landing - [chiefs[0, 0], 0.0], atol=1e-12)
    assert len(np.unique(places[:, :, 0])) == 12 and weights.min() > 0.0


@pytest.mark.slow
def test_prefiltering_is_the_mean_over_the_box() -> None:
    model = lens()
    box = np.array([[3.0, 4.0], [0.3, 0.5]])
    whole = model.kernel(box, 1 << 17, 0).astype(np.float64)
    total = np.zeros_like(whole)
    for depth_m in 3.0 + (np.arange(8) + 0.5) / 8.0:
        for eccentricity in 0.3 + 0.2 * (np.arange(4) + 0.5) / 4.0:
            part = model.kernel(at(depth_m, eccentricity), 1 << 13, 0)
            margin = (len(whole) - len(part)) // 2
            total[margin : len(whole) - margin, margin : len(whole) - margin] += part / 32.0
    assert np.abs(whole - total).sum() / 3.0 < 0.06 * whole.sum() / 3.0
    assert whole.sum() == pytest.approx(total.sum(), rel=0.01)


@pytest.mark.slow
def test_rays_are_spread_more_evenly_than_chance_would() -> None:
    """Compare with four times as many rays of another seed: half a million rays miss a third of what as many pseudo-random ones do.

    Measured: 0.0025 of the light against 0.018. An additive recurrence over the five dimensions (square roots of primes) leaves
    streaks and 0.0083, and hardly less with more rays.
    """
    model, rays, box = PhysicalLens(pair(), image_width_px=1000), 1 << 19, np.array([[0.65, 0.66], [0.0, 0.01]])
    truth = model.landed(box, 4 * rays, sobol_blocks(5, 4 * rays, 1))
    random = model.landed(box, rays, np.random.default_rng(0).random((8, rays // 8, 5)))
    even = model.landed(box, rays, sobol_blocks(5, rays, 0))
    missed, by_chance = (np.abs(each - truth).sum() / truth.sum() for each in (even, random))
    assert missed < by_chance / 3.0


def test_chunks_leave_no_seam_and_off_the_axis_the_simple_lens_smears() -> None:
    """Rays come in chunks of 65,536; a kernel of 100,000 differs from one of 65,536 by noise only."""
    few, many = lens().kernel(at(6.0), 65536, 0), lens().kernel(at(6.0), 100000, 0)
    assert few.shape == many.shape and np.abs(few - many).sum() < 0.06 * few.sum()
    # Table 1: 4,000 samples, exponents 2.5 and 1.2.
    model = lens()
    assert len(NestedGrid(model.counts)) == pytest.approx(4000, abs=5)
    assert [axis.exponent for axis in model.axes] == [2.5, 1.2] and model.turns == "field" and model.channels == 3
    # Coma, astigmatism and a curved field: in focus in the middle, a blur of many pixels in the corner.
    model = PhysicalLens(focus_distance_m=2.0, f_number=8.0)
    middle, corner = (mean_square_radius_px2(model.kernel(at(2.0, each), RAYS, 0)[:, :, 1].astype(np.float64)) for each in (0.0, 1.0))
    assert corner > 25.0 * middle


@pytest.fixture
def few_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Find how far a lens reaches, 10 halvings of the field, with 4096 rays each: 41 of them are the hundredth that counts as black."""
    monkeypatch.setattr(_lens_beam, "_AREA_RAYS", 1 << 12)


@pytest.mark.usefixtures("few_rays")
def test_a_bank_ends_where_the_lens_goes_black() -> None:
    """Rims of 12 mm on both sides of the stop leave nothing for the corners of a sensor twice as large as the lens is made for."""
    model = PhysicalLens(pair(12.0), sensor_mm=(72.0, 48.0))
    field = model.axes[1]
    assert 0.2 < field.high < 1.0
    assert model.throughput(100.0, field.high) == pytest.approx(0.01, abs=0.02)
    with pytest.raises(InputError, match=r"no light passes|no ray"):
        model.kernel(at(2.0, min(1.0, field.high + 0.1)), RAYS, 0)


def test_mistakes_are_named() -> None:
    for wrong, said in (
        (lambda: lens().kernel(at(0.001), RAYS, 0), "expected depths in front of the lens"),
        (lambda: lens().kernel(at(2.0), 0, 0), "at least one ray"),
        (lambda: PhysicalLens(focus_distance_m=0.02), "cannot focus"),
        (lambda: PhysicalLens(image_width_px=0), "pixels must be a positive"),
        (lambda: PhysicalLens(pair(), image_width_px=60000).kernel(at(0.2), RAYS, 0), "light lands"),
    ):
        with pytest.raises(InputError, match=said):
            wrong()
    assert lens().exact(np.array([2.0, 0.0])) is None


@pytest.mark.usefixtures("few_rays")
@pytest.mark.parametrize("name", ["dgauss.50mm", "wide.22mm", "fisheye.10mm"])
def test_published_lenses_pass_light_as_far_as_they_reach(shared_data, name: str) -> None:
    """The axes end at the corner or before it; there still is light there, and less than in the middle."""
    model = PhysicalLens(shared_data / "lens" / "prescriptions" / f"{name}.dat")
    depth, field = model.axes
    assert (depth.name, field.name) == ("depth_m", "eccentricity") and 0.5 < field.high <= 1.0
    kernel = model.kernel(np.array([[10.0, 20.0], [0.9 * field.high, field.high]]), RAYS, 0)
    assert 0.0 < kernel.sum() / 3.0 < 0.8
    # The 155.9 degree fisheye is black in the corners of the full frame, whose image circle would be 10 mm x 1.36 rad.
    assert (field.high < 1.0) == (name == "fisheye.10mm")

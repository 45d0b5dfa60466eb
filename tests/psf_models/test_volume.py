"""Scattering: free paths, the phase function, energy and the shape of single scattering against integrals."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import dblquad, quad
from scipy.stats import kstest

from mrbokeh.psf_models import _rays_numba as compiled
from mrbokeh.psf_models.volume import Volume
from mrbokeh.system.errors import InputError

RAYS = 1 << 17


def at(distance_m: float) -> np.ndarray:
    return np.array([[distance_m, distance_m]])


def traced(distance_m: float, **medium: float) -> tuple[np.ndarray, np.ndarray]:
    return Volume(**medium).trace(np.full(RAYS, distance_m), seed=1)


def phase(anisotropy: float, cosine: np.ndarray | float) -> np.ndarray | float:
    """Henyey and Greenstein (1941), per cosine (integrated over the azimuth)."""
    return 0.5 * (1.0 - anisotropy**2) / (1.0 + anisotropy**2 - 2.0 * anisotropy * cosine) ** 1.5


def way_out_m(radius_m: float, start_m: np.ndarray | float, cosine: np.ndarray | float) -> np.ndarray | float:
    """From a point start_m from the middle of a ball to its surface, at an angle from the radius."""
    return -start_m * cosine + np.sqrt(radius_m**2 - start_m**2 * (1.0 - cosine**2))


# A test with a seed cannot fail by chance twice; the p-value below which it fails is that of one run in a thousand.
@pytest.mark.parametrize(("density", "majorant"), [(0.9, 0.9), (0.9, 2.7), (0.2, 5.0)])
def test_woodcock_gives_exponential_free_paths(density: float, majorant: float) -> None:
    state = np.array([12345], np.uint64)
    paths = np.array([compiled.free_path(state, density, majorant) for _ in range(20000)])
    assert compiled.free_path(state, 0.0, 1.0) == np.inf, "without a medium paths do not end"
    assert kstest(paths, "expon", args=(0.0, 1.0 / density)).pvalue > 1e-3
    assert paths.mean() == pytest.approx(1.0 / density, rel=0.03)


@pytest.mark.parametrize("anisotropy", [-0.5, 0.0, 0.5, 0.8, 0.95])
def test_mean_cosine_is_the_anisotropy(anisotropy: float) -> None:
    """That is what g means; the middles of even shares integrate the inverted distribution to 1e-4."""
    shares = (np.arange(20000) + 0.5) / 20000
    cosines = np.array([compiled.scattering_cosine(anisotropy, share) for share in shares])
    assert cosines.mean() == pytest.approx(anisotropy, abs=1e-3)
    assert (np.diff(cosines) >= 0.0).all() and cosines.min() >= -1.0 and cosines.max() <= 1.0
    for share in (0.1, 0.5, 0.9):
        below = quad(lambda cosine: phase(anisotropy, cosine), -1.0, compiled.scattering_cosine(anisotropy, share))[0]
        assert below == pytest.approx(share, abs=1e-6)


def test_turning_keeps_the_angle_and_the_length_and_has_no_preferred_side() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        new, cosine = direction.copy(), rng.uniform(-1.0, 1.0)
        compiled.turn(new, cosine, rng.uniform(0.0, 2.0 * np.pi))
        assert np.linalg.norm(new) == pytest.approx(1.0, abs=1e-12) and new @ direction == pytest.approx(cosine, abs=1e-9)
    # Over a full turn of the azimuth what is across the old direction cancels, for directions on both sides of the pole.
    for direction in (np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0]), np.array([0.6, -0.48, 0.64])):
        total = np.zeros(3)
        for azimuth in np.arange(16) / 16.0 * 2.0 * np.pi:
            new = direction.copy()
            compiled.turn(new, 0.3, azimuth)
            total += new / 16.0
        assert_allclose(total, 0.3 * direction, atol=1e-12)


def test_random_numbers_are_even_and_photons_independent() -> None:
    state = np.zeros(1, np.uint64)
    first = []
    for photon in range(20000):
        compiled.start_photon(state, 3, photon)
        first.append((compiled.uniform(state), compiled.uniform(state)))
    numbers = np.array(first)
    assert kstest(numbers[:, 0], "uniform").pvalue > 1e-3 and kstest(numbers[:, 1], "uniform").pvalue > 1e-3
    assert abs(np.corrcoef(numbers[:, 0], numbers[:, 1])[0, 1]) < 0.03
    assert abs(np.corrcoef(numbers[1:, 0], numbers[:-1, 0])[0, 1]) < 0.03


@pytest.mark.parametrize(("medium", "distance_m"), [({"density_per_m": 0.0}, 5.0), ({}, 0.0)])
def test_without_scattering_a_point_stays_a_point(medium: dict, distance_m: float) -> None:
    model = Volume(**medium)
    kernel = model.kernel(at(distance_m), 1000, 0)
    assert_allclose(kernel, np.ones((1, 1, 3)))
    assert_allclose(model.exact(np.array([distance_m])), kernel)
    assert Volume().exact(np.array([1.0])) is None


@pytest.mark.parametrize("distance_m", [0.3, 1.0, 3.0])
def test_what_was_not_scattered_follows_beer_and_lambert(distance_m: float) -> None:
    """exp(-density distance), within four standard errors."""
    expected = np.exp(-0.9 * distance_m)
    cosines, collisions = traced(distance_m)
    assert (collisions == 0).mean() == pytest.approx(expected, abs=4.0 * np.sqrt(expected * (1.0 - expected) / RAYS))
    assert (cosines[collisions == 0] == 1.0).all() and (cosines >= -1e-9).all()


@pytest.mark.parametrize(("anisotropy", "distance_m"), [(0.8, 0.5), (0.8, 2.0), (0.0, 1.0)])
def test_single_scattering_is_its_integral(anisotropy: float, distance_m: float) -> None:
    """Share of light scattered once: density exp(-density s) along the first flight, the phase function, exp(-density way out)."""

    def light(cosine: float, start_m: float) -> float:
        return 0.9 * np.exp(-0.9 * (start_m + way_out_m(distance_m, start_m, cosine))) * phase(anisotropy, cosine)

    expected = dblquad(light, 0.0, distance_m, -1.0, 1.0)[0]
    _, collisions = traced(distance_m, anisotropy=anisotropy)
    assert (collisions == 1).mean() == pytest.approx(expected, abs=4.0 * np.sqrt(expected / RAYS))


def test_single_scattering_is_seen_at_the_angle_of_its_integral() -> None:
    """Of the light scattered once, the share that the camera sees within 10 degrees of the source.

    A photon that leaves at an angle psi from the normal after being scattered at s by theta: d sin(psi) = s sin(theta).
    """
    distance_m = 2.0
    start_m = (np.arange(800)[:, None] + 0.5) / 800 * distance_m
    cosine = (np.arange(8000) + 0.5) / 4000 - 1.0
    light = 0.9 * np.exp(-0.9 * (start_m + way_out_m(distance_m, start_m, cosine))) * phase(0.8, cosine)
    light *= start_m * np.sqrt(1.0 - cosine**2) <= distance_m * np.sin(np.deg2rad(10.0))
    expected = light.sum() * (distance_m / 800) * (2.0 / 8000)
    seen, collisions = traced(distance_m)
    counted = ((collisions == 1) & (seen > np.cos(np.deg2rad(10.0)))).mean()
    assert counted == pytest.approx(expected, abs=4.0 * np.sqrt(expected / RAYS))


@pytest.mark.parametrize("albedo", [1.0, 0.9, 0.5])
def test_energy_of_straight_walks_is_analytic(albedo: float) -> None:
    """With g = 1 paths stay straight, collisions are Poisson with mean tau, and albedo^n sums to exp(-(1 - albedo) tau)."""
    tau, cosines, collisions = 1.8, np.empty(RAYS), np.empty(RAYS, np.int64)
    compiled.trace_photons(0, 1, np.full(RAYS, 2.0), 0.9, 1.2, 1.0, cosines, collisions)
    assert_allclose(cosines, 1.0, atol=1e-9)
    assert collisions.mean() == pytest.approx(tau, rel=0.02)
    assert (albedo**collisions).mean() == pytest.approx(np.exp(-(1.0 - albedo) * tau), rel=0.01)


def test_a_volume_that_does_not_turn_light_is_no_volume() -> None:
    """Let g go towards 1: there are collisions, but light goes straight on: hardly any leaves the middle pixel."""
    for anisotropy, least, most in ((0.5, 0.3, 1.0), (1.0 - 1e-9, 0.0, 1e-3)):
        model = Volume(density_per_m=0.9, anisotropy=anisotropy, albedo=(1.0, 1.0, 1.0), size_px=513)
        kernel = model.kernel(at(1.0), RAYS, 0)
        assert least <= 1.0 - kernel[len(kernel) // 2, len(kernel) // 2, 1] < most


def test_absorption_darkens_colours_where_they_absorb() -> None:
    model = Volume(size_px=129, focal_px=200.0)
    near, far = (model.kernel(at(distance_m), RAYS, 0) for distance_m in (0.5, 4.0))
    for kernel in (near, far):
        light = kernel.sum(axis=(0, 1), dtype=np.float64)
        assert_allclose(light[:2], 1.0, rtol=1e-5)
        assert light[2] < 1.0
    assert far[:, :, 2].sum() < near[:, :, 2].sum()
    # The whole is what would be seen without absorption: a grey medium is darker, not scaled back to 1.
    light = Volume(albedo=(0.5, 0.5, 0.5), size_px=65, focal_px=50.0).kernel(at(1.0), RAYS, 0).sum(axis=(0, 1), dtype=np.float64)
    assert_allclose(light, light[0])
    assert light[0] < 0.8


def test_kernels_are_round_and_fade_outwards() -> None:
    kernel = Volume(size_px=129, focal_px=200.0).kernel(at(2.0), RAYS, 0)
    assert_allclose(kernel, kernel[::-1], atol=1e-9)
    assert_allclose(kernel, kernel[:, ::-1], atol=1e-9)
    assert_allclose(kernel, kernel.transpose(1, 0, 2), atol=1e-9)
    places = np.arange(129) - 64
    radius = np.hypot(places[:, None], places)
    rings = [kernel[:, :, 0][(radius >= low) & (radius < low + 8)].mean() for low in range(0, 64, 8)]
    assert (np.diff(rings) < 0.0).all()


def test_rings_are_the_photons_turned_at_random() -> None:
    """The plain twin: every photon at its own random azimuth, counted in pixels; sums over 9 x 9 pixels agree within noise."""
    model, rng = Volume(size_px=81, focal_px=60.0), np.random.default_rng(0)
    cosines, _ = model.trace(np.full(RAYS, 2.0), 1)
    cosines = cosines[cosines > 0.0]
    radius, angle = 60.0 * np.sqrt(1.0 - cosines**2) / cosines, rng.uniform(0.0, 2.0 * np.pi, len(cosines))
    edges = np.arange(82) - 40.5
    plain = np.histogram2d(radius * np.sin(angle), radius * np.cos(angle), (edges, edges))[0]
    kernel = model.kernel(at(2.0), RAYS, 1)[:, :, 0]
    blocks = [array.reshape(9, 9, 9, 9).sum(axis=(1, 3)) for array in (plain, kernel * plain.sum())]
    assert (np.abs(blocks[0] - blocks[1]) < 5.0 * np.sqrt(blocks[1] + 1.0)).all()


def test_prefiltering_is_the_mean_over_distances_and_the_majorant_changes_nothing_but_time() -> None:
    model = Volume(size_px=65, focal_px=60.0)
    whole = model.kernel(np.array([[1.0, 2.0]]), 1 << 18, 0)
    parts = [model.kernel(at(each), 1 << 16, 5) for each in 1.0 + (np.arange(8) + 0.5) / 8.0]
    assert np.abs(whole - np.mean(parts, axis=0)).sum() < 0.04 * whole.sum()
    tight, loose = (Volume(size_px=65, focal_px=60.0, majorant_per_m=each).kernel(at(2.0), 1 << 18, 0) for each in (0.9, 2.0))
    assert np.abs(tight - loose).sum() < 0.03 * tight.sum()


@pytest.mark.parametrize(("wrong", "sentence"), [
    ({"density_per_m": -1.0}, "density"), ({"anisotropy": 1.0}, "between -1 and 1"), ({"albedo": (1.0, 1.0, 1.1)}, "albedos"),
    ({"size_px": 64}, "odd width"), ({"majorant_per_m": 0.5}, "majorant"), ({"focal_px": 0.0}, "focal length"),
])  # fmt: skip
def test_mistakes_are_named(wrong: dict, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        Volume(**wrong)
    with pytest.raises(InputError, match="at least one ray"):
        Volume().kernel(at(1.0), 0, 0)

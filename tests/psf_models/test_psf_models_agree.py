"""The models of the zoo against one another, wherever two of them describe the same thing."""

from functools import cache
from math import inf

import numpy as np
import pytest
from jaxtyping import Float

from mrbokeh.optics.lens import Lens
from mrbokeh.psf_models.base import PsfModel, centred
from mrbokeh.psf_models.build import Combined
from mrbokeh.psf_models.physical_lens import PhysicalLens, biconvex_lens
from mrbokeh.psf_models.simple_lens import SimpleLens, Stylized
from mrbokeh.psf_models.volume import Volume

RAYS = 1 << 18
DIAMETERS_PX = [0.7, 3.3, 12.0, 45.6, 120.0]


@cache
def disc_picture(size: int = 512) -> Float[np.ndarray, "height width 3"]:
    """A white disc that touches the border, pixels by their coverage (16 x 16 points each)."""
    places = (np.arange(16 * size) + 0.5) / 16.0 - 0.5 * size
    inside = (places[:, None] ** 2 + places**2 <= (0.5 * size) ** 2).astype(np.float32)
    return np.repeat(inside.reshape(size, 16, size, 16).mean(axis=(1, 3))[..., None], 3, axis=2)


def apart(first: np.ndarray, second: np.ndarray) -> float:
    """Share of the light that lies elsewhere: half the L1 distance of the mean of the colours."""
    size = max(len(first), len(second))
    light = [centred(each.astype(np.float64).mean(axis=2), size) for each in (first, second)]
    return float(0.5 * np.abs(light[0] - light[1]).sum())


def rim_share(radius_px: float, change_px: float) -> float:
    """Of a disc's light, what comes to lie elsewhere when its radius changes by change_px: twice that over the radius."""
    return 2.0 * change_px / radius_px


@pytest.mark.parametrize("diameter_px", DIAMETERS_PX)
def test_a_combined_blur_without_motion_is_a_simple_lens(diameter_px: float) -> None:
    """The simple lens has a polygon for a disc: to a pixel its rim is the same within 0.15 % of the radius."""
    simple, combined = SimpleLens().exact(np.array([diameter_px])), Combined().exact(np.array([diameter_px, 0.0]))
    assert apart(simple, combined) < 0.0015 * 2.0


@pytest.mark.parametrize("diameter_px", DIAMETERS_PX)
def test_a_stylized_disc_without_colour_errors_is_a_simple_lens(diameter_px: float) -> None:
    """The farthest corner of a lit pixel lies at the circle's radius, that of the disc of 256 px up to a diagonal of a pixel within."""
    model = Stylized(disc_picture(), chromatic=(0.0, 0.0, 0.0))
    stylized, simple = model.exact(np.array([diameter_px])), SimpleLens().exact(np.array([diameter_px]))
    assert apart(stylized, simple) < rim_share(256.0, 1.42) + 0.003
    np.testing.assert_allclose(stylized[..., 0], stylized[..., 2], atol=1e-7)


@pytest.mark.parametrize("depth_m", [0.8, 1.2, 6.0, 50.0])
def test_a_physical_lens_on_the_axis_at_a_small_aperture_is_a_simple_lens(depth_m: float) -> None:
    """The bi-convex lens at f/64, of glass without dispersion, against the disc of the thin lens's circle of confusion.

    Spherical aberration, which at f/32 changes the diameter by 2 %, here changes it by
    half a per cent; the pupil lies 0.4 mm before the principal plane.
    """
    width_px, f_number = 30_000, 64.0
    lens = biconvex_lens(50.0, 8.0, abbe_number=inf).stopped_down(f_number)
    model = PhysicalLens(lens, focus_distance_m=2.0, image_width_px=width_px)
    coc_px = abs(float(Lens(50.0, f_number, 2.0, 36.0).coc_px(depth_m, width_px)))
    assert coc_px > 8.0
    kernel = model.kernel(np.array([[depth_m, depth_m], [0.0, 0.0]]), RAYS, 0)
    np.testing.assert_allclose(kernel[..., 0], kernel[..., 2], atol=1e-6)
    assert apart(kernel, SimpleLens().exact(np.array([coc_px]))) < rim_share(1.0, 0.005)


def scattered(density_per_m: float, anisotropy: float = 0.8) -> float:
    """Light beyond the middle pixel at 1 m."""
    model = Volume(density_per_m=density_per_m, anisotropy=anisotropy, albedo=(1.0, 1.0, 1.0), size_px=513)
    kernel = model.kernel(np.array([[1.0, 1.0]]), 1 << 19, 0)
    middle = len(kernel) // 2
    return float(1.0 - kernel[middle, middle, 1])


def test_a_thinner_and_thinner_volume_is_no_volume() -> None:
    """No more than what collides at all, 1 - exp(-density), comes off; in a thin medium half the density scatters half."""
    shares = [scattered(density) for density in (0.04, 0.02, 0.01)]
    for share, density in zip(shares, (0.04, 0.02, 0.01), strict=True):
        assert 0.0 < share < 1.0 - np.exp(-density)
    assert shares[0] / shares[1] == pytest.approx(2.0, rel=0.06) and shares[1] / shares[2] == pytest.approx(2.0, rel=0.06)
    delta = Volume(density_per_m=0.0).exact(np.array([1.0]))
    assert delta is not None and apart(Volume(density_per_m=1e-7).kernel(np.array([[1.0, 1.0]]), 1 << 16, 0), delta) < 1e-4


def test_a_volume_that_does_not_turn_light_is_no_volume() -> None:
    """g towards 1: collisions, but straight on."""
    assert scattered(0.9, 0.5) > 0.3 and scattered(0.9, 1.0 - 1e-9) < 1e-3


@pytest.mark.parametrize(
    ("model", "coords"),
    [(SimpleLens(), [0.0]), (Combined(), [0.0, 0.0]), (Stylized(disc_picture(64)), [0.0]), (Volume(), [0.0])],
    ids=["simple", "combined", "stylized", "volume"],
)
def test_in_focus_at_rest_and_without_a_way_every_model_is_the_point_itself(model: PsfModel, coords: list[float]) -> None:
    kernel = model.exact(np.array(coords))
    assert kernel is not None
    point = centred(np.ones((1, 1, kernel.shape[2]), np.float32), len(kernel))
    np.testing.assert_allclose(kernel, point, atol=1e-6)

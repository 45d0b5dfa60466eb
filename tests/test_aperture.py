import numpy as np
import pytest
from shapely import Polygon, box

from mrbokeh.aperture import Aperture
from mrbokeh.errors import InputError

APERTURES = {
    "disc": Aperture.disc(),
    "triangle": Aperture.blades(3, 0.1),
    "hexagon": Aperture.blades(6),
    "heptagon": Aperture.blades(7, 0.5),
}


def coverage_by_clipping(aperture: Aperture, diameter_px: float) -> np.ndarray:
    """The slow twin: every pixel's square clipped against every outline by a geometry library."""
    size = aperture.rasterize(diameter_px).kernel.shape[0]
    kernel = np.zeros((size, size))
    for outline, weight in zip(aperture.outlines, aperture.weights, strict=True):
        polygon = Polygon(outline * diameter_px / 2 + size / 2)
        kernel += weight * np.array([[polygon.intersection(box(x, y, x + 1, y + 1)).area for x in range(size)] for y in range(size)])
    return kernel / kernel.sum()


@pytest.mark.parametrize("name", APERTURES)
@pytest.mark.parametrize("diameter_px", [-9.3, 0.4, 1.7, 6.0, 12.25])
def test_rasterized_areas_are_exact(name: str, diameter_px: float) -> None:
    kernel = APERTURES[name].rasterize(diameter_px).kernel
    np.testing.assert_allclose(kernel, coverage_by_clipping(APERTURES[name], diameter_px), atol=1e-12)


def test_a_ring_is_its_outer_less_its_inner_outline() -> None:
    ring = Aperture.disc(48).obstructed(0.5)
    kernel = ring.rasterize(20.0).kernel
    np.testing.assert_allclose(kernel, coverage_by_clipping(ring, 20.0), atol=1e-12)
    assert abs(kernel[10, 10]) < 1e-15 and kernel[10, 2] > 0, "dark in the middle, light on the rim"


@pytest.mark.parametrize("diameter_px", [-14.0, 0.0, 0.3, 0.99, 1.4, 25.7])
def test_the_sum_is_one(diameter_px: float) -> None:
    for aperture in APERTURES.values():
        np.testing.assert_allclose(aperture.rasterize(diameter_px).kernel.sum(), 1.0, rtol=1e-12)


def test_below_one_pixel_it_is_the_identity_and_grows_smoothly_from_there() -> None:
    blades = Aperture.blades(6)
    assert blades.rasterize(0.0).kernel.tolist() == [[1.0]]
    assert blades.rasterize(0.999).kernel.tolist() == [[1.0]]
    centres = [blades.rasterize(diameter_px).kernel.max() for diameter_px in np.arange(0.9, 2.0, 0.01)]
    assert np.abs(np.diff(centres)).max() < 0.02


def test_the_disc_has_the_area_of_the_disc() -> None:
    assert Polygon(Aperture.disc().outlines[0]).area == pytest.approx(np.pi, rel=1e-12)


def test_a_disc_has_the_second_moment_of_a_disc() -> None:
    """Variance along one axis is r^2 / 4; area-averaging over pixels adds 1/12."""
    kernel = Aperture.disc().rasterize(20.0).kernel
    offsets = np.arange(kernel.shape[0]) - kernel.shape[0] // 2
    assert (kernel.sum(0) * offsets**2).sum() == pytest.approx(10**2 / 4 + 1 / 12, rel=1e-3)


def test_malformed_apertures_are_refused() -> None:
    with pytest.raises(InputError, match="one weight per outline"):
        Aperture((np.zeros((3, 2)),), ())
    with pytest.raises(InputError, match="at least 3 vertices"):
        Aperture((np.zeros((2, 2)),), (1.0,))
    with pytest.raises(InputError, match="3 blades"):
        Aperture.blades(2)
    with pytest.raises(InputError, match="below 1"):
        Aperture.disc().obstructed(1.0)

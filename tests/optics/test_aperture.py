from dataclasses import replace

import numpy as np
import pytest
from shapely import Polygon, box

from mrbokeh.optics._aperture_numba import _shown_diameter_px
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.psf import shown_diameter_px
from mrbokeh.system.errors import InputError

SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
APERTURES = {
    "disc": Aperture.disc(), "triangle": Aperture.blades(3, 0.1), "hexagon": Aperture.blades(6),
    "heptagon": Aperture.blades(7, 0.5), "curved": Aperture.blades(5, 0.3, curvature=0.5),
    "hollow": Aperture.blades(5, 0.3, curvature=-0.8), "ring": Aperture.ring(0.6), "star": Aperture.star(5, 0.4),
    "heart": Aperture.heart(), "anamorphic": Aperture.blades(6).squeezed(2.0),
}  # fmt: skip
REACHING_OUT = {
    "square": Aperture((SQUARE,), (1.0,)), "displaced disc": Aperture((Aperture.disc().outlines[0] + [0.3, -0.1],), (1.0,)),
    "wide": Aperture.disc().squeezed(0.5), "disc": Aperture.disc(),
}  # fmt: skip


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


@pytest.mark.parametrize("name", APERTURES)
def test_in_front_of_the_focus_it_is_mirrored(name: str) -> None:
    behind, in_front = (APERTURES[name].rasterize(diameter_px).kernel for diameter_px in (17.3, -17.3))
    np.testing.assert_allclose(in_front, behind[::-1, ::-1], atol=1e-15)


@pytest.mark.parametrize("diameter_px", [-14.0, 0.0, 0.3, 0.99, 1.4, 25.7])
def test_the_sum_is_one_and_no_light_is_negative(diameter_px: float) -> None:
    for aperture in (APERTURES | REACHING_OUT).values():
        kernel = aperture.rasterize(diameter_px).kernel
        np.testing.assert_allclose(kernel.sum(), 1.0, rtol=1e-12)
        assert kernel.min() > -1e-15


@pytest.mark.parametrize("name", APERTURES | REACHING_OUT)
def test_up_to_one_pixel_it_is_the_identity_and_grows_smoothly_from_there(name: str) -> None:
    aperture = (APERTURES | REACHING_OUT)[name]
    for diameter_px in (0.0, 0.5, -0.999, 1.0):
        assert aperture.rasterize(diameter_px).kernel.tolist() == [[1.0]]
    kernels = [aperture.rasterize(diameter_px).kernel for diameter_px in np.arange(0.9, 3.5, 0.01)]
    padded = [np.pad(kernel, (9 - len(kernel)) // 2) for kernel in kernels]
    # Where the edges of the opening sweep over pixels, light moves by at most its change of area, about 2 diameter_step / diameter.
    assert np.abs(np.diff(padded, axis=0)).sum(axis=(1, 2)).max() < 0.06


@pytest.mark.parametrize("unit_radius", [0.5, 1.0, 1.0016, 1.2, 1.5])
def test_the_diameter_that_is_drawn(unit_radius: float) -> None:
    """Continuous where it starts (filling the pixel) and where it ends, growing throughout; numpy and numba agree."""
    diameters_px = np.linspace(-6.0, 6.0, 1201)
    drawn_px = shown_diameter_px(diameters_px, unit_radius)
    np.testing.assert_allclose(drawn_px, [_shown_diameter_px(d, unit_radius) for d in diameters_px], rtol=1e-14)
    true_size = np.abs(diameters_px) >= max(1 + 4 * (unit_radius - 1), 1.0) + 1e-9
    np.testing.assert_array_equal(drawn_px[true_size], diameters_px[true_size])
    assert float(shown_diameter_px(1.0 + 1e-9, unit_radius)) * max(unit_radius, 1.0) == pytest.approx(1.0, abs=1e-6)
    above = drawn_px[diameters_px > 1.0]
    assert np.diff(above).min() > 0.0 and np.diff(above).max() < 0.0126, "at most 1.25 times as fast as without"


def test_it_is_printed_in_a_line() -> None:
    assert repr(replace(Aperture.ring(0.5), cat_eye=0.3)) == "Aperture(2 outlines of 128 vertices, cat_eye=0.3)"


def test_the_disc_has_its_area_and_malformed_apertures_are_refused() -> None:
    assert Polygon(Aperture.disc().outlines[0]).area == pytest.approx(np.pi, rel=1e-12)
    for wrong, said in (
        (lambda: Aperture((np.zeros((3, 2)),), ()), "one weight per outline"),
        (lambda: Aperture((np.zeros((2, 2)),), (1.0,)), "at least 3 vertices"),
        (lambda: Aperture.blades(2), "3 to 100 blades"),
        (lambda: Aperture.disc().obstructed(1.0), "below 1"),
        (lambda: Aperture((SQUARE * np.nan,), (1.0,)), "finite numbers"),
        (lambda: Aperture.disc().rasterize(np.nan), "finite diameter"),
        *((lambda weights=weights: Aperture((SQUARE, SQUARE), weights), "must let light through") for weights in WITHOUT_LIGHT),
    ):
        with pytest.raises(InputError, match=said):
            wrong()


WITHOUT_LIGHT = ((1.0, -1.0), (1.0, -2.0), (-1.0, 0.5), (0.0, 0.0))

"""LensPrescription: the spherical surfaces of a real lens, their glass, and its first-order optics.

Glass. Indices n_d and Abbe numbers of catalogue glasses: Schott's catalogue, checked against its indices at the C and F lines
(tests/psf_models/test_lens_prescription.py). Cauchy's two terms through n_d and V meet those to 1e-4 for V above 40 and to 5e-4 for the
densest flints. Indices of a lens come from its table, and so do its Abbe numbers if the table has them.

If it has none, as those of the published double Gauss, wide-angle and fisheye, they are estimated. Of the double Gauss (Tronnier, US
2,673,491) the Abbe numbers are known from Kolb et al. 1995: 47.1, 47.1, 30.1, 38.0, 57.3, 48.0. From the edges of the Abbe diagram alone
they come out as 55.3, 55.3, 30.1, 38.3, 55.7, 54.6, and blue is focused 0.22 mm behind red, when it is 0.07 mm in front of it. With the
edges mixed until blue and red meet (`mrbokeh.psf_models.physical_lens`) they are 53.0, 53.0, 30.9, 39.2, 53.5, 51.8. Red and blue
kernels at f/2, focused at 2 m, then differ from those of the known glass by 2 to 3 % of their light at 0.7 m (edges alone: 10 to 21 %) and
by 17 to 25 % at 20 m (63 to 95 %). No published numbers were found for the other two lenses.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from math import inf, isfinite

import numpy as np
from jaxtyping import Float, Float64

from mrbokeh.system.errors import InputError

# Fraunhofer lines in micrometres; n_d is the index a prescription states, V = (n_d - 1) / (n_F - n_C) the Abbe number.
LINE_C_UM, LINE_D_UM, LINE_F_UM = 0.65627, 0.58756, 0.48613

# (n_d, V) of glasses of the Schott catalogue along the two edges of the Abbe diagram. Upper edge: FK5, BK7, SK5, SK16,
# LAK22, LAK9, LAK34, LASF44, LASF31A. Lower edge: FK5, BK7, KF9, LLF1, LF5, F2, SF2, SF5, SF15, SF10, SF11, SF6, SF57.
_CROWNS = (
    (1.48749, 70.41), (1.51680, 64.17), (1.58913, 61.27), (1.62041, 60.32), (1.65113, 55.89),
    (1.69100, 54.71), (1.72916, 54.50), (1.80420, 46.50), (1.88300, 40.76),
)  # fmt: skip
_FLINTS = (
    (1.48749, 70.41), (1.51680, 64.17), (1.52346, 51.54), (1.54814, 45.75), (1.58144, 40.85), (1.62004, 36.37), (1.64769, 33.85),
    (1.67270, 32.21), (1.69895, 30.07), (1.72825, 28.41), (1.78472, 25.76), (1.80518, 25.43), (1.84666, 23.83),
)  # fmt: skip


def estimated_abbe_number(index: float, is_positive: bool, mix: float = 0.0) -> float:
    """Estimate the Abbe number of a glass of which only n_d is known, from the sign of its element's power.

    Lenses are freed from colour by collecting elements of low and diverging elements of high dispersion (Kingslake and
    Johnson, Lens Design Fundamentals, 2010, chapter 5), so the glass of a positive element is taken from the upper (crown)
    edge of the Abbe diagram of the Schott catalogue at its index and that of a negative one from the lower (flint) edge,
    linear between catalogue glasses and constant beyond them. mix: 0 to 1, how far from its own edge towards the other one
    the dispersion lies.
    """
    crown, flint = (float(np.interp(index, edge[:, 0], edge[:, 1])) for edge in map(np.array, (_CROWNS, _FLINTS)))
    own, other = (crown, flint) if is_positive else (flint, crown)
    return 1.0 / ((1.0 - mix) / own + mix / other)


def cauchy_coefficients(index: float, abbe_number: float) -> tuple[float, float]:
    """Return (A, B in um^2) of n(wavelength) = A + B / wavelength^2 through n_d and V; B is 0 for an infinite V (air)."""
    if not (index >= 1.0 and abbe_number > 0.0):
        raise InputError(f"expected a refractive index of at least 1 and a positive Abbe number, got {index:g} and {abbe_number:g}")
    slope_um2 = (index - 1.0) / (abbe_number * (LINE_F_UM**-2 - LINE_C_UM**-2))
    return index - slope_um2 / LINE_D_UM**2, slope_um2


def index_at(index: float, abbe_number: float, wavelength_um: Float[np.ndarray, "*batch"] | float) -> Float[np.ndarray, "*batch"]:
    """Return the refractive index at wavelengths in micrometres, by Cauchy's formula with two terms."""
    constant, slope_um2 = cauchy_coefficients(index, abbe_number)
    return np.asarray(constant + slope_um2 / np.square(wavelength_um))


Matrix = Float64[np.ndarray, "2 2"]


@dataclass(frozen=True)
class Paraxial:
    """First-order optics of a row of surfaces by ray transfer matrices (Born and Wolf, Principles of Optics, 4.4).

    Matrices act on (height, index times slope). Positions z in mm from the first vertex towards the sensor.
    vertices_mm (N,), curvatures_per_mm (N,), indices (N + 1,): the media in front of, between and behind the surfaces.
    """

    vertices_mm: Float64[np.ndarray, " surfaces"]
    curvatures_per_mm: Float64[np.ndarray, " surfaces"]
    indices: Float64[np.ndarray, " media"]

    def between(self, first: int, last: int) -> Matrix:
        """Return the matrix from just before surface `first` to the vertex of surface `last`, which does not refract; N is behind the last
        one.
        """
        matrix, surfaces = np.eye(2), len(self.vertices_mm)
        for i in range(first, last):
            power = (self.indices[i + 1] - self.indices[i]) * self.curvatures_per_mm[i]
            matrix = np.array([[1.0, 0.0], [-power, 1.0]]) @ matrix
            if i + 1 < surfaces:
                gap_mm = self.vertices_mm[i + 1] - self.vertices_mm[i]
                matrix = np.array([[1.0, gap_mm / self.indices[i + 1]], [0.0, 1.0]]) @ matrix
        return matrix

    @cached_property
    def _system(self) -> Matrix:
        return self.between(0, len(self.vertices_mm))

    @property
    def focal_length_mm(self) -> float:
        """Return the effective focal length: inf without power, negative for a diverging lens."""
        power = self._system[1, 0]
        return float(-1.0 / power) if power != 0.0 else np.inf

    @property
    def front_principal_mm(self) -> float:
        """Return z of the front principal plane, from which distances to the scene count."""
        return float((self._system[1, 1] - 1.0) / self._system[1, 0])

    @property
    def rear_principal_mm(self) -> float:
        """Return z of the rear principal plane, from which the image distance counts."""
        return float(self.vertices_mm[-1] + (1.0 - self._system[0, 0]) / self._system[1, 0])

    def sensor_mm(self, focus_distance_m: float) -> float:
        """Return z of the sensor that is in focus at a distance (from the front principal plane, metres, inf allowed)."""
        focal_mm, distance_mm = self.focal_length_mm, focus_distance_m * 1000.0
        if not distance_mm > focal_mm:
            raise InputError(
                f"a lens of {focal_mm:.4g} mm cannot focus at {focus_distance_m:g} m: expected more than {focal_mm / 1000.0:.4g} m"
            )
        return self.rear_principal_mm + 1.0 / (1.0 / focal_mm - 1.0 / distance_mm)

    def heights_of_axial_beam(self) -> Float64[np.ndarray, " surfaces"]:
        """Return the heights at the surfaces of a ray that comes in parallel to the axis at height 1."""
        return np.array([self.between(0, i)[0, 0] for i in range(len(self.vertices_mm))])

    def entrance_pupil_mm(self, stop: int, stop_diameter_mm: float) -> tuple[float, float]:
        """Return (z, diameter) of the stop's image through what lies in front of it."""
        matrix = self.between(0, stop)
        return float(matrix[0, 1] / matrix[0, 0]), float(stop_diameter_mm / abs(matrix[0, 0]))

    def exit_pupil_mm(self, stop: int, stop_diameter_mm: float) -> tuple[float, float]:
        """Return (z, diameter) of the stop's image through what lies behind it."""
        matrix = self.between(stop, len(self.vertices_mm))
        return float(self.vertices_mm[-1] - matrix[0, 1] / matrix[1, 1]), float(stop_diameter_mm / abs(matrix[1, 1]))


@dataclass(frozen=True)
class Surface:
    """Surface of a lens, met by light that travels from the scene to the sensor.

    radius_mm: positive where the centre of curvature lies on the sensor's side, inf is flat. distance_mm: along the axis to
    the next surface (0 for the last one). index: n_d of the medium behind the surface. diameter_mm: of the clear aperture.
    abbe_number: of the medium behind it, inf does not disperse. is_stop: the iris, which refracts nothing.
    """

    radius_mm: float
    distance_mm: float
    index: float
    diameter_mm: float
    abbe_number: float = inf
    is_stop: bool = False

    def __post_init__(self) -> None:
        if not (isfinite(self.distance_mm) and self.distance_mm >= 0.0):
            raise InputError(f"expected a distance of at least 0 mm to the next surface, got {self.distance_mm:g}")
        if not 1.0 <= self.index < 5.0:
            raise InputError(f"expected a refractive index from 1 to 5 behind a surface, got {self.index:g}")
        if not 0.0 < self.diameter_mm <= 2.0 * abs(self.radius_mm):
            raise InputError(
                f"expected an aperture diameter above 0 that fits on a sphere of radius {self.radius_mm:g} mm, got {self.diameter_mm:g} mm"
            )

    @property
    def curvature_per_mm(self) -> float:
        return 0.0 if self.is_stop else 1.0 / self.radius_mm


@dataclass(frozen=True)
class LensPrescription:
    """Surfaces from the scene to the sensor, in air. Positions z are in mm from the vertex of the first one, towards the sensor."""

    name: str
    surfaces: tuple[Surface, ...]

    def __post_init__(self) -> None:
        if len([each for each in self.surfaces if not each.is_stop]) < 2:
            raise InputError(f"a lens needs at least two refracting surfaces, {self.name} has fewer")
        if sum(each.is_stop for each in self.surfaces) > 1:
            raise InputError(
                f"a lens has one stop, {self.name} has several: a radius of 0 stands for the stop, write a flat surface as inf"
            )
        if self.surfaces[-1].index != 1.0:
            raise InputError(f"expected air (index 1) behind the last surface of {self.name}, got {self.surfaces[-1].index:g}")
        if not self.paraxial.focal_length_mm > 0.0:
            raise InputError(f"{self.name} forms no image on a sensor: its focal length is {self.paraxial.focal_length_mm:g} mm")

    @cached_property
    def vertices_mm(self) -> Float64[np.ndarray, " surfaces"]:
        """Return z of each surface on the axis."""
        return np.cumsum([0.0, *(each.distance_mm for each in self.surfaces[:-1])])

    @cached_property
    def stop(self) -> int:
        """Return the index of the stop: the surface marked so, else the rim that limits the axial beam from infinity."""
        marked = [i for i, each in enumerate(self.surfaces) if each.is_stop]
        if marked:
            return marked[0]
        heights = np.abs(self.paraxial.heights_of_axial_beam())
        return int(np.argmax(heights / [each.diameter_mm for each in self.surfaces]))

    @cached_property
    def paraxial(self) -> Paraxial:
        """Return the first-order optics at the d line."""
        return self.paraxial_at(LINE_D_UM)

    def paraxial_at(self, wavelength_um: float) -> Paraxial:
        """Return the first-order optics at a wavelength in micrometres."""
        curvatures = np.array([each.curvature_per_mm for each in self.surfaces])
        indices = [float(index_at(each.index, each.abbe_number, wavelength_um)) for each in self.surfaces]
        return Paraxial(self.vertices_mm, curvatures, np.array([1.0, *indices]))

    @property
    def focal_length_mm(self) -> float:
        return self.paraxial.focal_length_mm

    @property
    def axial_colour_mm(self) -> float:
        """Return how far red (C line) is focused behind blue (F line), for light from infinity; below 0 in front of it."""
        red, blue = (self.paraxial_at(line_um).sensor_mm(inf) for line_um in (LINE_C_UM, LINE_F_UM))
        return red - blue

    @property
    def entrance_pupil_mm(self) -> tuple[float, float]:
        """Return (z, diameter) of the stop's image as seen from the scene."""
        return self.paraxial.entrance_pupil_mm(self.stop, self.surfaces[self.stop].diameter_mm)

    @property
    def exit_pupil_mm(self) -> tuple[float, float]:
        """Return (z, diameter) of the stop's image as seen from the sensor."""
        return self.paraxial.exit_pupil_mm(self.stop, self.surfaces[self.stop].diameter_mm)

    @property
    def f_number(self) -> float:
        return self.focal_length_mm / self.entrance_pupil_mm[1]

    def stopped_down(self, f_number: float) -> "LensPrescription":
        """Return the lens with its iris closed to an f-number, at least that of the open lens."""
        if not (isfinite(f_number) and f_number >= self.f_number * (1.0 - 1e-9)):
            raise InputError(f"{self.name} opens to f/{self.f_number:.3g} only: expected an f-number of at least that, got {f_number:g}")
        stop = self.surfaces[self.stop]
        closed = replace(stop, diameter_mm=stop.diameter_mm * self.f_number / f_number)
        return replace(self, surfaces=(*self.surfaces[: self.stop], closed, *self.surfaces[self.stop + 1 :]))

    def optics_table(self) -> Float64[np.ndarray, "surfaces 5"]:
        """Return the table for tracing: z of the vertex, curvature, squared aperture radius, Cauchy's A and B of the medium behind."""
        rows = [
            (z, each.curvature_per_mm, (0.5 * each.diameter_mm) ** 2, *cauchy_coefficients(each.index, each.abbe_number))
            for z, each in zip(self.vertices_mm, self.surfaces, strict=True)
        ]
        return np.array(rows, np.float64)

    def reversed_table(self) -> Float64[np.ndarray, "surfaces 5"]:
        """Return `optics_table` of the reversed lens: z counts from its last vertex towards the scene, in the path of light sent back."""
        table, last = self.optics_table(), self.vertices_mm[-1]
        media = np.concatenate([[[1.0, 0.0]], table[:-1, 3:]])
        return np.column_stack([last - table[:, 0], -table[:, 1], table[:, 2], media])[::-1].copy()

"""LensPrescription: the spherical surfaces of a real lens."""

from dataclasses import dataclass, replace
from functools import cached_property
from math import inf, isfinite

import numpy as np
from jaxtyping import Float64

from mrbokeh.psf_models.glass import LINE_C_UM, LINE_D_UM, LINE_F_UM, cauchy_coefficients, index_at
from mrbokeh.psf_models.paraxial import Paraxial
from mrbokeh.system.errors import InputError


@dataclass(frozen=True)
class Surface:
    """One surface, met by light that travels from the scene to the sensor.

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
        """z of each surface on the axis."""
        return np.cumsum([0.0, *(each.distance_mm for each in self.surfaces[:-1])])

    @cached_property
    def stop(self) -> int:
        """Which surface is the stop: the one marked so, else the rim that limits the axial beam from infinity."""
        marked = [i for i, each in enumerate(self.surfaces) if each.is_stop]
        if marked:
            return marked[0]
        heights = np.abs(self.paraxial.heights_of_axial_beam())
        return int(np.argmax(heights / [each.diameter_mm for each in self.surfaces]))

    @cached_property
    def paraxial(self) -> Paraxial:
        """First-order optics at the d line."""
        return self.paraxial_at(LINE_D_UM)

    def paraxial_at(self, wavelength_um: float) -> Paraxial:
        """First-order optics at a wavelength in micrometres."""
        curvatures = np.array([each.curvature_per_mm for each in self.surfaces])
        indices = [float(index_at(each.index, each.abbe_number, wavelength_um)) for each in self.surfaces]
        return Paraxial(self.vertices_mm, curvatures, np.array([1.0, *indices]))

    @property
    def focal_length_mm(self) -> float:
        return self.paraxial.focal_length_mm

    @property
    def axial_colour_mm(self) -> float:
        """How far behind the focus of blue (F line) that of red (C line) lies, for light from infinity; below 0 in front of it."""
        red, blue = (self.paraxial_at(line_um).sensor_mm(inf) for line_um in (LINE_C_UM, LINE_F_UM))
        return red - blue

    @property
    def entrance_pupil_mm(self) -> tuple[float, float]:
        """(z, diameter) of the stop's image as seen from the scene."""
        return self.paraxial.entrance_pupil_mm(self.stop, self.surfaces[self.stop].diameter_mm)

    @property
    def exit_pupil_mm(self) -> tuple[float, float]:
        """(z, diameter) of the stop's image as seen from the sensor."""
        return self.paraxial.exit_pupil_mm(self.stop, self.surfaces[self.stop].diameter_mm)

    @property
    def f_number(self) -> float:
        return self.focal_length_mm / self.entrance_pupil_mm[1]

    def stopped_down(self, f_number: float) -> "LensPrescription":
        """With the iris closed to an f-number, at least that of the open lens."""
        if not (isfinite(f_number) and f_number >= self.f_number * (1.0 - 1e-9)):
            raise InputError(f"{self.name} opens to f/{self.f_number:.3g} only: expected an f-number of at least that, got {f_number:g}")
        stop = self.surfaces[self.stop]
        closed = replace(stop, diameter_mm=stop.diameter_mm * self.f_number / f_number)
        return replace(self, surfaces=(*self.surfaces[: self.stop], closed, *self.surfaces[self.stop + 1 :]))

    def optics_table(self) -> Float64[np.ndarray, "surfaces 5"]:
        """For tracing: z of the vertex, curvature, squared radius of the aperture, Cauchy's A and B of the medium behind."""
        rows = [
            (z, each.curvature_per_mm, (0.5 * each.diameter_mm) ** 2, *cauchy_coefficients(each.index, each.abbe_number))
            for z, each in zip(self.vertices_mm, self.surfaces, strict=True)
        ]
        return np.array(rows, np.float64)

    def reversed_table(self) -> Float64[np.ndarray, "surfaces 5"]:
        """`optics_table` of the lens turned round: z counts from its last vertex towards the scene, in the path of light sent back."""
        table, last = self.optics_table(), self.vertices_mm[-1]
        media = np.concatenate([[[1.0, 0.0]], table[:-1, 3:]])
        return np.column_stack([last - table[:, 0], -table[:, 1], table[:, 2], media])[::-1].copy()

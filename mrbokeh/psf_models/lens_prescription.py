"""LensPrescription: the spherical surfaces of a real lens, read from the tables in which lens designs are published."""

from dataclasses import dataclass, replace
from functools import cached_property
from math import inf, isfinite, sqrt
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from mrbokeh.errors import InputError
from mrbokeh.psf_models.glass import LINE_D_UM, cauchy_coefficients, estimated_abbe_number, index_at
from mrbokeh.psf_models.paraxial import Paraxial

_COLUMNS = "radius, distance to the next surface, index behind it, [Abbe number,] aperture diameter, in mm"


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


def read_prescription(path: Path | str) -> LensPrescription:
    """A table of surfaces from the scene to the sensor, one per line, `#` begins a comment.

    Columns, in mm: radius (0: the stop; inf: flat), distance to the next surface, index n_d behind it (0: as before),
    aperture diameter; with five columns the Abbe number stands before the aperture (the order of Kolb et al. 1995).
    Where it is missing it is estimated (mrbokeh.psf_models.glass). InputError names the line that is not understood.
    """
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"expected a table of lens surfaces ({_COLUMNS}) at {path}, but it cannot be read: {error}") from None
    rows = [(number, line.split("#")[0].split()) for number, line in enumerate(lines, 1)]
    rows = [(number, words) for number, words in rows if words]
    surfaces: list[Surface] = []
    for number, words in rows:
        try:
            surfaces.append(_surface(words, surfaces[-1].index if surfaces else 1.0, surfaces[-1].abbe_number if surfaces else inf))
        except InputError as error:
            raise InputError(f"{path}, line {number}: {error}") from None
    return LensPrescription(path.stem, with_estimated_abbe_numbers(surfaces))


def _surface(words: list[str], index_before: float, abbe_before: float) -> Surface:
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        raise InputError(f"expected numbers ({_COLUMNS}), got {' '.join(words)!r}") from None
    if len(numbers) not in (4, 5) or any(np.isnan(numbers)):
        raise InputError(f"expected 4 or 5 numbers ({_COLUMNS}), got {' '.join(words)!r}")
    radius_mm, distance_mm, index, diameter_mm = (*numbers[:3], numbers[-1])
    is_stop = radius_mm == 0.0 and index in (0.0, index_before)
    if radius_mm == 0.0 and not is_stop:
        raise InputError(f"a radius of 0 is the stop and cannot change the index to {index:g}: write a flat surface as inf")
    abbe = numbers[3] if len(numbers) == 5 and index not in (0.0, 1.0) else inf
    if index == 0.0:
        index, abbe = index_before, abbe_before
    return Surface(inf if is_stop else radius_mm, distance_mm, index, diameter_mm, abbe, is_stop)


def with_estimated_abbe_numbers(surfaces: list[Surface]) -> tuple[Surface, ...]:
    """Give glass (index above 1.01) without an Abbe number one by its index and the power (n - 1)(1/R1 - 1/R2) of its element."""
    done = list(surfaces)
    for i, each in enumerate(surfaces):
        if each.index > 1.01 and not isfinite(each.abbe_number):
            front = next((before for before in surfaces[i::-1] if not before.is_stop), each)
            back = next((behind for behind in surfaces[i + 1 :] if not behind.is_stop), each)
            is_positive = front.curvature_per_mm >= back.curvature_per_mm
            done[i] = replace(each, abbe_number=estimated_abbe_number(each.index, is_positive))
    return tuple(done)


def biconvex_lens(
    focal_length_mm: float = 50.0, f_number: float = 4.0, edge_mm: float = 1.0, index: float = 1.5168, abbe_number: float = 64.17
) -> LensPrescription:
    """The simple bi-convex spherical lens of Leimkuehler et al. 2018: two equal radii, by default of BK7, no iris but its rims.

    The paper states no numbers. Radius R and thickness t follow from the thick lensmaker's formula
    1/f = (n - 1)(2/R - (n - 1) t / (n R^2)) with t just leaving `edge_mm` at the rim.
    """
    semi_mm, thickness_mm, radius_mm = 0.5 * focal_length_mm / f_number, 0.0, 0.0
    for _ in range(50):
        if thickness_mm >= index * focal_length_mm or radius_mm < 0.0:
            break
        radius_mm = focal_length_mm * (index - 1.0) * (1.0 + sqrt(1.0 - thickness_mm / (index * focal_length_mm)))
        if radius_mm <= semi_mm:
            raise InputError(f"one bi-convex lens of index {index:g} cannot have f/{f_number:g}: choose a larger f-number")
        thickness_mm = edge_mm + 2.0 * (radius_mm - sqrt(radius_mm**2 - semi_mm**2))
    front = Surface(radius_mm, thickness_mm, index, 2.0 * semi_mm, abbe_number)
    return LensPrescription("biconvex", (front, Surface(-radius_mm, 0.0, 1.0, 2.0 * semi_mm)))

"""Paraxial: first-order optics of a row of surfaces by ray transfer matrices (Born and Wolf, Principles of Optics, 4.4)."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64

from mrbokeh.system.errors import InputError

Matrix = Float64[np.ndarray, "2 2"]


@dataclass(frozen=True)
class Paraxial:
    """Matrices act on (height, index times slope). Positions z in mm from the first vertex towards the sensor.

    vertices_mm (N,), curvatures_per_mm (N,), indices (N + 1,): the media in front of, between and behind the surfaces.
    """

    vertices_mm: Float64[np.ndarray, " surfaces"]
    curvatures_per_mm: Float64[np.ndarray, " surfaces"]
    indices: Float64[np.ndarray, " media"]

    def between(self, first: int, last: int) -> Matrix:
        """From just before surface `first` to the vertex of surface `last`, which is not refracted at; N is behind the last one."""
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
        """Effective focal length, inf without power, negative for a diverging lens."""
        power = self._system[1, 0]
        return float(-1.0 / power) if power != 0.0 else np.inf

    @property
    def front_principal_mm(self) -> float:
        """z of the front principal plane, from which distances to the scene count."""
        return float((self._system[1, 1] - 1.0) / self._system[1, 0])

    @property
    def rear_principal_mm(self) -> float:
        """z of the rear principal plane, from which the image distance counts."""
        return float(self.vertices_mm[-1] + (1.0 - self._system[0, 0]) / self._system[1, 0])

    def sensor_mm(self, focus_distance_m: float) -> float:
        """z of the sensor that is in focus at a distance (from the front principal plane, metres, inf allowed)."""
        focal_mm, distance_mm = self.focal_length_mm, focus_distance_m * 1000.0
        if not distance_mm > focal_mm:
            raise InputError(
                f"a lens of {focal_mm:.4g} mm cannot focus at {focus_distance_m:g} m: expected more than {focal_mm / 1000.0:.4g} m"
            )
        return self.rear_principal_mm + 1.0 / (1.0 / focal_mm - 1.0 / distance_mm)

    def heights_of_axial_beam(self) -> Float64[np.ndarray, " surfaces"]:
        """Heights at the surfaces of a ray that comes in parallel to the axis at height 1."""
        return np.array([self.between(0, i)[0, 0] for i in range(len(self.vertices_mm))])

    def entrance_pupil_mm(self, stop: int, stop_diameter_mm: float) -> tuple[float, float]:
        """(z, diameter) of the stop's image through what lies in front of it."""
        matrix = self.between(0, stop)
        return float(matrix[0, 1] / matrix[0, 0]), float(stop_diameter_mm / abs(matrix[0, 0]))

    def exit_pupil_mm(self, stop: int, stop_diameter_mm: float) -> tuple[float, float]:
        """(z, diameter) of the stop's image through what lies behind it."""
        matrix = self.between(stop, len(self.vertices_mm))
        return float(self.vertices_mm[-1] - matrix[0, 1] / matrix[1, 1]), float(stop_diameter_mm / abs(matrix[1, 1]))

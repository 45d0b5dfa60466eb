"""Lens: the thin lens that tells how large a point's blur is; the only place where millimetres meet metres."""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from mrbokeh.aperture import Aperture
from mrbokeh.errors import InputError

MM_PER_M = 1000.0


@dataclass(frozen=True)
class Lens:
    """A thin lens focused at a distance, in front of a sensor.

    focus_distance_m: from the lens (front principal plane) to the plane in focus; inf is allowed.
    """

    focal_length_mm: float
    f_number: float
    focus_distance_m: float
    sensor_width_mm: float
    aperture: Aperture = field(default_factory=Aperture.disc)

    def __post_init__(self) -> None:
        if min(self.focal_length_mm, self.f_number, self.sensor_width_mm) <= 0:
            raise InputError(
                f"a lens needs positive focal_length_mm, f_number and sensor_width_mm, but came with "
                f"{self.focal_length_mm}, {self.f_number}, {self.sensor_width_mm}"
            )
        if not self.focus_distance_m * MM_PER_M > self.focal_length_mm:
            raise InputError(
                f"a lens of {self.focal_length_mm} mm cannot focus at {self.focus_distance_m} m: "
                f"expected more than {self.focal_length_mm / MM_PER_M} m (is the distance in metres?)"
            )

    @property
    def aperture_diameter_mm(self) -> float:
        return self.focal_length_mm / self.f_number

    @property
    def image_distance_mm(self) -> float:
        """Lens to sensor, from the thin-lens equation: f d_f / (d_f - f)."""
        return self.focal_length_mm / (1.0 - self.focal_length_mm / (self.focus_distance_m * MM_PER_M))

    def focused_at(self, focus_distance_m: float) -> "Lens":
        return replace(self, focus_distance_m=float(focus_distance_m))

    def focal_px(self, image_width_px: int) -> float:
        """Pinhole focal length in pixels: the image distance, so that it breathes with the focus."""
        return self.image_distance_mm * image_width_px / self.sensor_width_mm

    def coc_px_per_dioptre(self, image_width_px: int) -> float:
        """How many pixels the circle of confusion grows for each dioptre away from the focus plane."""
        px_per_mm = image_width_px / self.sensor_width_mm
        return px_per_mm * self.aperture_diameter_mm * self.image_distance_mm / MM_PER_M

    def coc_px(self, depth_m: Float[np.ndarray, "*batch"] | float, image_width_px: int) -> Float[np.ndarray, "*batch"]:
        """Signed DIAMETER of the circle of confusion: positive behind the focus plane, negative in front.

        Neural Bokeh's Eq. 1 (Mandl et al. 2024) with its sign kept and its units made equal; written in dioptres,
        so that it is linear and finite at infinity. depth_m must be positive.
        """
        dioptres = 1.0 / np.asarray(depth_m)
        return np.asarray(self.coc_px_per_dioptre(image_width_px) * (1.0 / self.focus_distance_m - dioptres))

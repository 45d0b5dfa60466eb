"""TrackedFrame: camera, lens state and distortion at one moment."""

from collections.abc import Mapping
from dataclasses import dataclass

from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError

Distortion = Mapping[str, float]
"""Coefficients by their names in OpenCV and COLMAP: k1, k2, k3 (of r^2, r^4, r^6), k4, k5, k6 (the same below the bar), p1, p2."""

DISTORTION_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""In OpenCV's order."""


@dataclass(frozen=True)
class TrackedFrame:
    """focus_distance_m: from the entrance pupil, inf is allowed. time_s: from the start of the shot. None is not known.

    distortion: from the pinhole's picture to the real one; None or empty is a pinhole.
    """

    camera: Camera
    focus_distance_m: float | None = None
    f_number: float | None = None
    time_s: float | None = None
    distortion: Distortion | None = None

    def __post_init__(self) -> None:
        for name, value in (("focus distance", self.focus_distance_m), ("f-number", self.f_number)):
            if value is not None and not value > 0.0:
                raise InputError(f"the {name} of a frame must be positive, got {value}")
        if unknown := set(self.distortion or {}) - set(DISTORTION_NAMES):
            raise InputError(f"lens distortion is given by {', '.join(DISTORTION_NAMES)}, got {', '.join(sorted(unknown))}")

    @property
    def coefficients(self) -> dict[str, float]:
        """Those that are not 0."""
        return {name: float(value) for name, value in (self.distortion or {}).items() if value}

"""Outlines of `mrbokeh.optics.aperture.Aperture.blades` as radius over angle: turned, squeezed and cut by the rim of the lens."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.aperture import Aperture

LEAST_CURVATURE, LARGEST_CURVATURE = -0.5, 1.0
LARGEST_CAT_EYE = 0.97
LARGEST_SQUEEZE = 3.0
_STRAIGHT = 1e-4  # curvatures below are taken as straight

Angles = Float64[np.ndarray, "discs points"]


@dataclass(frozen=True)
class Opening:
    """blades: 0 is round, which has neither rotation nor curvature. The others as in `mrbokeh.optics.aperture.Aperture`."""

    blades: int
    rotation_rad: float = 0.0
    curvature: float = 1.0
    squeeze: float = 1.0
    cat_eye: float = 0.0

    def aperture(self, spherical_aberration: float = 0.0) -> Aperture:
        plain = Aperture.blades(self.blades, self.rotation_rad, self.curvature) if self.blades else Aperture.disc()
        plain = plain.squeezed(self.squeeze)
        return Aperture(plain.outlines, plain.weights, self.cat_eye, spherical_aberration)


def outline_radius(opening: Opening, angles_rad: Angles, field_xy: Float64[np.ndarray, "discs 2"], side: int) -> Angles:
    """Distance of the outline from the origin of the pupil in directions of the picture, from x towards y.

    side: +1 shows the opening as it is, -1 (in front of the focus) mirrored through the origin, with what cuts it.
    """
    cosine, sine = side * np.cos(angles_rad), side * np.sin(angles_rad)
    stretched = np.hypot(opening.squeeze * cosine, sine)
    radius = _blades_radius(opening, np.arctan2(sine, opening.squeeze * cosine)) / stretched
    if opening.cat_eye == 0.0:
        return radius
    middle = -opening.cat_eye * field_xy[:, None, :]
    along = middle[..., 0] * cosine + middle[..., 1] * sine
    apart = (middle**2).sum(axis=2)
    return np.minimum(radius, along + np.sqrt(np.maximum(1.0 - apart + along**2, 1e-9)))


def _blades_radius(opening: Opening, angles_rad: Angles) -> Angles:
    """Arcs of radius 1 / |curvature| between corners on the unit circle, by the law of cosines about the arc's centre."""
    if opening.blades == 0:
        return np.ones_like(angles_rad)
    half = np.pi / opening.blades
    turned = np.mod(angles_rad - opening.rotation_rad, 2.0 * half) - half
    if abs(opening.curvature) < _STRAIGHT:
        return np.asarray(np.cos(half) / np.cos(turned))
    sign, bow = np.sign(opening.curvature), 1.0 / abs(opening.curvature)
    middle = np.cos(half) - sign * np.sqrt(bow**2 - np.sin(half) ** 2)
    return np.asarray(middle * np.cos(turned) + sign * np.sqrt(np.maximum(bow**2 - (middle * np.sin(turned)) ** 2, 0.0)))

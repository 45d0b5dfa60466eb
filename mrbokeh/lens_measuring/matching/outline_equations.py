"""Distances of contours from an opening's outline, and the equations of what would lessen them.

The opening's values are shared by all discs; each disc has a centre and a radius of its own, which are solved for within the equations of
the shared ones (Schur complement).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from mrbokeh.lens_measuring.matching.discs import Disc
from mrbokeh.lens_measuring.matching.outline_model import LARGEST_CURVATURE, Opening, outline_radius

NOISE_FLOOR_PX = 0.03
_HUBER_TIMES = 2.0
_STEP, _RIM_STEP, _OWN_STEP_PX = 1e-4, 0.01, 1e-3

Own = Float64[np.ndarray, "discs 3"]
Residuals = Float64[np.ndarray, "discs points"]


def names_of(opening: Opening) -> tuple[str, ...]:
    """What of an opening is fitted."""
    return ("rotation_rad", "curvature", "squeeze", "cat_eye") if opening.blades else ("squeeze", "cat_eye")


def scale_of(residuals_px: Residuals) -> float:
    """Their typical size: the median absolute one as that of a normal distribution, and a floor."""
    return 1.4826 * float(np.median(np.abs(residuals_px))) + NOISE_FLOOR_PX


def huber(residuals_px: Residuals, scale_px: float) -> float:
    size, bend = np.abs(residuals_px), _HUBER_TIMES * scale_px
    return float(np.where(size < bend, 0.5 * size**2, bend * (size - 0.5 * bend)).sum())


@dataclass(frozen=True)
class OutlineEquations:
    """Per disc: `matrices` times a step of the shared values = -`pulls`; the disc's own values then move by `own_step`."""

    matrices: Float64[np.ndarray, "discs shared shared"]
    pulls: Float64[np.ndarray, "discs shared"]
    own_by_errors: Float64[np.ndarray, "discs 3"]
    own_by_shared: Float64[np.ndarray, "discs 3 shared"]

    def own_step(self, shared: Float64[np.ndarray, " shared"]) -> Own:
        return -(self.own_by_errors + self.own_by_shared @ shared)


@dataclass(frozen=True)
class Contours:
    """Contours of all discs, px, and where they lie in the frame. side: +1 behind the focus, -1 in front."""

    points_px: Float64[np.ndarray, "discs points 2"]
    field_xy: Float64[np.ndarray, "discs 2"]
    side: int

    @classmethod
    def of(cls, discs: Sequence[Disc], side: int) -> "Contours":
        return cls(np.stack([disc.contour_px for disc in discs]), np.array([disc.field_xy for disc in discs]), side)

    def residuals(self, opening: Opening, own: Own) -> Residuals:
        """Along the radius, px; positive outside. own: centre x, y and radius of the unit pupil of each disc."""
        away = self.points_px - own[:, None, :2]
        radius = outline_radius(opening, np.arctan2(away[..., 1], away[..., 0]), self.field_xy, self.side)
        return np.asarray(np.hypot(away[..., 0], away[..., 1]) - own[:, 2:] * radius)

    def equations(self, opening: Opening, own: Own, scale_px: float) -> OutlineEquations:
        """Of weighted least squares, with Huber's weights at this scale."""
        errors = self.residuals(opening, own)
        root = np.sqrt(np.minimum(1.0, _HUBER_TIMES * scale_px / np.maximum(np.abs(errors), 1e-12)))[..., None]
        shared = root * np.stack([self._slope(opening, own, name, errors) for name in names_of(opening)], axis=2)
        mine = root * np.stack([self._own_slope(opening, own, index, errors) for index in range(3)], axis=2)
        weighted = root * errors[..., None]
        mine_t, shared_t = mine.transpose(0, 2, 1), shared.transpose(0, 2, 1)
        inverse = np.linalg.inv(mine_t @ mine + 1e-9 * np.eye(3))
        by_shared, by_errors = inverse @ mine_t @ shared, inverse @ mine_t @ weighted
        cross = shared_t @ mine
        return OutlineEquations(
            shared_t @ shared - cross @ by_shared, (shared_t @ weighted - cross @ by_errors)[..., 0], by_errors[..., 0], by_shared
        )

    def _slope(self, opening: Opening, own: Own, name: str, errors: Residuals) -> Residuals:
        """Across zero the ends that two rims cut are opposite, and their difference a mere shift: steps of cat_eye lead away from zero."""
        value, step = float(getattr(opening, name)), _STEP
        if name == "cat_eye":
            step = _RIM_STEP if value >= 0.0 else -_RIM_STEP
        elif name == "curvature" and value + step > LARGEST_CURVATURE:
            step = -_STEP
        moved = replace(opening, **{name: value + step})  # type: ignore[arg-type]
        return np.asarray((self.residuals(moved, own) - errors) / step)

    def _own_slope(self, opening: Opening, own: Own, index: int, errors: Residuals) -> Residuals:
        step = _OWN_STEP_PX * np.eye(3)[index]
        return np.asarray((self.residuals(opening, own + step) - errors) / _OWN_STEP_PX)

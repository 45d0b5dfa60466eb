"""One opening fitted to the contours of all discs by Levenberg and Marquardt's method, with standard errors.

Outlines are those of `mrbokeh.optics.aperture.Aperture.blades` as radius over angle: turned, squeezed and cut by the rim of the lens.
The opening's values are shared by all discs; each disc has a centre and a radius of its own, which are solved for within the equations of
the shared ones (Schur complement).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float64

from mrbokeh.lens_measuring.matching.discs import Disc
from mrbokeh.optics.aperture import Aperture

LEAST_CURVATURE, LARGEST_CURVATURE = -0.5, 1.0
LARGEST_CAT_EYE = 0.97
LARGEST_SQUEEZE = 3.0
_STRAIGHT = 1e-4  # curvatures below are taken as straight

Angles = Float64[np.ndarray, "discs points"]


@dataclass(frozen=True)
class BladedOpening:
    """Parameters of an opening with blades.

    blades: 0 is round, which has neither rotation nor curvature. The others as in `mrbokeh.optics.aperture.Aperture`.
    """

    blades: int
    rotation_rad: float = 0.0
    curvature: float = 1.0
    squeeze: float = 1.0
    cat_eye: float = 0.0

    def aperture(self, spherical_aberration: float = 0.0) -> Aperture:
        plain = Aperture.blades(self.blades, self.rotation_rad, self.curvature) if self.blades else Aperture.disc()
        plain = plain.squeezed(self.squeeze)
        return Aperture(plain.outlines, plain.weights, self.cat_eye, spherical_aberration)


def outline_radius(opening: BladedOpening, angles_rad: Angles, field_xy: Float64[np.ndarray, "discs 2"], side: int) -> Angles:
    """Return the distance of the outline from the origin of the pupil in directions of the picture, from x towards y.

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


def _blades_radius(opening: BladedOpening, angles_rad: Angles) -> Angles:
    """Return the radius of arcs (1 / |curvature|) between corners on the unit circle, by the law of cosines about the arc's centre."""
    if opening.blades == 0:
        return np.ones_like(angles_rad)
    half = np.pi / opening.blades
    turned = np.mod(angles_rad - opening.rotation_rad, 2.0 * half) - half
    if abs(opening.curvature) < _STRAIGHT:
        return np.asarray(np.cos(half) / np.cos(turned))
    sign, bow = np.sign(opening.curvature), 1.0 / abs(opening.curvature)
    middle = np.cos(half) - sign * np.sqrt(bow**2 - np.sin(half) ** 2)
    return np.asarray(middle * np.cos(turned) + sign * np.sqrt(np.maximum(bow**2 - (middle * np.sin(turned)) ** 2, 0.0)))


NOISE_FLOOR_PX = 0.03
_HUBER_TIMES = 2.0
_STEP, _RIM_STEP, _OWN_STEP_PX = 1e-4, 0.01, 1e-3

Own = Float64[np.ndarray, "discs 3"]
Residuals = Float64[np.ndarray, "discs points"]


def names_of(opening: BladedOpening) -> tuple[str, ...]:
    """Return the parameters of an opening that are fitted."""
    return ("rotation_rad", "curvature", "squeeze", "cat_eye") if opening.blades else ("squeeze", "cat_eye")


def scale_of(residuals_px: Residuals) -> float:
    """Return the typical size of residuals: the median absolute one as that of a normal distribution, and a floor."""
    return 1.4826 * float(np.median(np.abs(residuals_px))) + NOISE_FLOOR_PX


def huber(residuals_px: Residuals, scale_px: float) -> float:
    size, bend = np.abs(residuals_px), _HUBER_TIMES * scale_px
    return float(np.where(size < bend, 0.5 * size**2, bend * (size - 0.5 * bend)).sum())


@dataclass(frozen=True)
class OutlineEquations:
    """Equations per disc: `matrices` times a step of the shared values = -`pulls`; the disc's own values then move by `own_step`."""

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

    def residuals(self, opening: BladedOpening, own: Own) -> Residuals:
        """Return residuals along the radius, px; positive outside. own: centre x, y and radius of the unit pupil of each disc."""
        away = self.points_px - own[:, None, :2]
        radius = outline_radius(opening, np.arctan2(away[..., 1], away[..., 0]), self.field_xy, self.side)
        return np.asarray(np.hypot(away[..., 0], away[..., 1]) - own[:, 2:] * radius)

    def equations(self, opening: BladedOpening, own: Own, scale_px: float) -> OutlineEquations:
        """Return the equations of weighted least squares, with Huber's weights at this scale."""
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

    def _slope(self, opening: BladedOpening, own: Own, name: str, errors: Residuals) -> Residuals:
        """Return the derivative by a parameter. Steps of cat_eye lead away from zero, across which two rims cut opposite ends: a mere
        shift.
        """
        value, step = float(getattr(opening, name)), _STEP
        if name == "cat_eye":
            step = _RIM_STEP if value >= 0.0 else -_RIM_STEP
        elif name == "curvature" and value + step > LARGEST_CURVATURE:
            step = -_STEP
        moved = replace(opening, **{name: value + step})  # type: ignore[arg-type]
        return np.asarray((self.residuals(moved, own) - errors) / step)

    def _own_slope(self, opening: BladedOpening, own: Own, index: int, errors: Residuals) -> Residuals:
        step = _OWN_STEP_PX * np.eye(3)[index]
        return np.asarray((self.residuals(opening, own + step) - errors) / _OWN_STEP_PX)


_STEPS = 30
_ENOUGH = 1e-4  # gain of a step, as a share of what is left
_PRIOR_SPREAD = {"rotation_rad": 2.0, "curvature": 1.0, "squeeze": 0.15, "cat_eye": 1.0}
_PRIOR_PX = 0.05
_RESAMPLES = 400
_BIAS_PX, _RUN = 0.06, 3.0  # of all contours alike by the grid of pixels, over runs of so many points
_OUTLIER_TIMES = 4.0
_PX_PER_SAMPLE = 3.0


@dataclass(frozen=True)
class OutlineFit:
    """Fitted opening.

    own: centre x, y and radius of the unit pupil of every disc, px. residuals_px: along the radius.
    """

    contours: Contours
    opening: BladedOpening
    own: Own
    residuals_px: Residuals

    @cached_property
    def errors(self) -> dict[str, float]:
        """Return the standard error by name."""
        return _standard_errors(self.contours, self.opening, self.own)

    @property
    def relative_rms(self) -> Float64[np.ndarray, " discs"]:
        """Return the RMS residual of each disc, as a share of its radius."""
        return np.asarray(np.sqrt((self.residuals_px**2).mean(axis=1)) / self.own[:, 2])

    @property
    def samples(self) -> float:
        """Return how many independent measurements the contours are taken for: one every 3 px."""
        return float(np.minimum(self.residuals_px.shape[1], 2.0 * np.pi * self.own[:, 2] / _PX_PER_SAMPLE).sum())

    @property
    def log_likelihood(self) -> float:
        """Return the log likelihood of normal errors of one unknown size, none of them larger than 4 times it."""
        size = np.minimum(np.abs(self.residuals_px), _OUTLIER_TIMES * scale_of(self.residuals_px))
        return -0.5 * self.samples * float(np.log((size**2).mean() + NOISE_FLOOR_PX**2))


def fit_outlines(discs: Sequence[Disc], start: BladedOpening, side: int, own: Own | None = None) -> OutlineFit:
    """Fit the opening with as many blades as `start` that is nearest to the contours, from these values on."""
    contours, opening, damping = Contours.of(discs, side), start, 1e-3
    if own is None:
        own = np.array([[*disc.centroid_px, disc.radius_px] for disc in discs])
    errors = contours.residuals(opening, own)
    for _ in range(_STEPS):
        scale = scale_of(errors)
        equations = contours.equations(opening, own, scale)
        whole = equations.matrices.sum(axis=0)
        step = -np.linalg.solve(whole + np.diag(_prior(opening, scale) + damping * np.diag(whole)), equations.pulls.sum(axis=0))
        tried, tried_own = _moved(opening, step), own + equations.own_step(step)
        tried_own[:, 2] = np.maximum(tried_own[:, 2], 1.0)
        tried_errors = contours.residuals(tried, tried_own)
        gain, left = huber(errors, scale) - huber(tried_errors, scale), huber(errors, scale)
        if gain > 0.0:
            opening, own, errors, damping = tried, tried_own, tried_errors, max(damping / 5.0, 1e-7)
        else:
            damping *= 8.0
        if damping > 1e4 or 0.0 < gain < _ENOUGH * left:
            break
    return OutlineFit(contours, opening, own, errors)


def _prior(opening: BladedOpening, scale_px: float) -> Float64[np.ndarray, " shared"]:
    """Return the prior that keeps what no disc tells where it started."""
    return np.array([(max(scale_px, _PRIOR_PX) / _PRIOR_SPREAD[name]) ** 2 for name in names_of(opening)])


def _moved(opening: BladedOpening, step: Float64[np.ndarray, " shared"]) -> BladedOpening:
    values = {name: getattr(opening, name) + float(change) for name, change in zip(names_of(opening), step, strict=True)}
    values["cat_eye"] = float(np.clip(values["cat_eye"], -LARGEST_CAT_EYE, LARGEST_CAT_EYE))
    values["squeeze"] = float(np.clip(values["squeeze"], 1.0 / LARGEST_SQUEEZE, LARGEST_SQUEEZE))
    if "curvature" in values:
        values["curvature"] = float(np.clip(values["curvature"], LEAST_CURVATURE, LARGEST_CURVATURE))
    return replace(opening, **values)


def _standard_errors(contours: Contours, opening: BladedOpening, own: Own) -> dict[str, float]:
    """Return errors by name: the bootstrap's over discs (one step from the fit per draw) and a shared bias, added as squares."""
    scale = scale_of(contours.residuals(opening, own))
    equations = contours.equations(opening, own, scale)
    prior, count = np.diag(_prior(opening, scale)), len(own)
    pulls = equations.pulls - equations.pulls.mean(axis=0)
    draws = np.random.default_rng(0).multinomial(count, np.full(count, 1.0 / count), size=_RESAMPLES).astype(float)
    steps = np.linalg.solve(np.tensordot(draws, equations.matrices, axes=1) + prior, (draws @ pulls)[..., None])[..., 0]
    shared = _BIAS_PX * np.sqrt(_RUN * np.diag(np.linalg.inv(equations.matrices.mean(axis=0) + prior)))
    return {name: float(np.hypot(a, b)) for name, a, b in zip(names_of(opening), steps.std(axis=0), shared, strict=True)}

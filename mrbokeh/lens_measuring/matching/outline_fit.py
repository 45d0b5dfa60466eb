"""One opening fitted to the contours of all discs by Levenberg and Marquardt's method, with standard errors."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float64

from mrbokeh.lens_measuring.matching.discs import Disc
from mrbokeh.lens_measuring.matching.outline_equations import NOISE_FLOOR_PX, Contours, Own, Residuals, huber, names_of, scale_of
from mrbokeh.lens_measuring.matching.outline_model import LARGEST_CAT_EYE, LARGEST_CURVATURE, LARGEST_SQUEEZE, LEAST_CURVATURE, Opening

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
    """own: centre x, y and radius of the unit pupil of every disc, px. residuals_px: along the radius."""

    contours: Contours
    opening: Opening
    own: Own
    residuals_px: Residuals

    @cached_property
    def errors(self) -> dict[str, float]:
        """Standard error by name."""
        return _standard_errors(self.contours, self.opening, self.own)

    @property
    def relative_rms(self) -> Float64[np.ndarray, " discs"]:
        """Of each disc, as a share of its radius."""
        return np.asarray(np.sqrt((self.residuals_px**2).mean(axis=1)) / self.own[:, 2])

    @property
    def samples(self) -> float:
        """How many independent measurements the contours are taken for: one every 3 px."""
        return float(np.minimum(self.residuals_px.shape[1], 2.0 * np.pi * self.own[:, 2] / _PX_PER_SAMPLE).sum())

    @property
    def log_likelihood(self) -> float:
        """Of normal errors of one unknown size, none of them larger than 4 times it."""
        size = np.minimum(np.abs(self.residuals_px), _OUTLIER_TIMES * scale_of(self.residuals_px))
        return -0.5 * self.samples * float(np.log((size**2).mean() + NOISE_FLOOR_PX**2))


def fit_outlines(discs: Sequence[Disc], start: Opening, side: int, own: Own | None = None) -> OutlineFit:
    """The opening with as many blades as `start` that is nearest to the contours, from these values on."""
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


def _prior(opening: Opening, scale_px: float) -> Float64[np.ndarray, " shared"]:
    """Keeps what no disc tells where it started."""
    return np.array([(max(scale_px, _PRIOR_PX) / _PRIOR_SPREAD[name]) ** 2 for name in names_of(opening)])


def _moved(opening: Opening, step: Float64[np.ndarray, " shared"]) -> Opening:
    values = {name: getattr(opening, name) + float(change) for name, change in zip(names_of(opening), step, strict=True)}
    values["cat_eye"] = float(np.clip(values["cat_eye"], -LARGEST_CAT_EYE, LARGEST_CAT_EYE))
    values["squeeze"] = float(np.clip(values["squeeze"], 1.0 / LARGEST_SQUEEZE, LARGEST_SQUEEZE))
    if "curvature" in values:
        values["curvature"] = float(np.clip(values["curvature"], LEAST_CURVATURE, LARGEST_CURVATURE))
    return replace(opening, **values)


def _standard_errors(contours: Contours, opening: Opening, own: Own) -> dict[str, float]:
    """By name: the bootstrap's over discs (one step from the fit for each draw) and that of a bias that all share, added as squares."""
    scale = scale_of(contours.residuals(opening, own))
    equations = contours.equations(opening, own, scale)
    prior, count = np.diag(_prior(opening, scale)), len(own)
    pulls = equations.pulls - equations.pulls.mean(axis=0)
    draws = np.random.default_rng(0).multinomial(count, np.full(count, 1.0 / count), size=_RESAMPLES).astype(float)
    steps = np.linalg.solve(np.tensordot(draws, equations.matrices, axes=1) + prior, (draws @ pulls)[..., None])[..., 0]
    shared = _BIAS_PX * np.sqrt(_RUN * np.diag(np.linalg.inv(equations.matrices.mean(axis=0) + prior)))
    return {name: float(np.hypot(a, b)) for name, a, b in zip(names_of(opening), steps.std(axis=0), shared, strict=True)}

"""The true focus of each slice of a stack and the growth of its blur, found against depth from several views.

Blur around points of known depth is c = k_i |F_i - 1 / z| in slice i: a V over the dioptres, whose tip is the focus F_i (from the
entrance pupil) and whose slope is k_i. A thin lens has k_i = Lens.coc_px_per_dioptre, but lenses with internal focusing change focal
length and pupil, and f-numbers are nominal; EXIF's focus is coarse and has another origin.

The diameter c of a point is measured by comparing its surroundings in the slice with the all-in-focus picture blurred by openings
of growing diameter. The stacks of a scene are calibrated one by one; calibrations of their lenses follow from them.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.optimize import least_squares

from capture.poses.cauchy_loss import CAUCHY_95, squared_under_cauchy, squared_under_cauchy_slope
from capture.poses.lens_calibration import (
    CalibratedFocus,
    LensCalibration,
    focused_stack,
    lens_model_of,
    with_calibrated_focus,
)
from capture.poses.sparse_model import SparseModel, SparseView
from capture.scale.focus import FocusSample
from capture.stacks.slice_files import stated_by_sentinel
from mrbokeh.images.color import luminance
from mrbokeh.optics.aperture import Aperture
from mrbokeh.stacks.focal_stack import METRES, FocalStack
from mrbokeh.stacks.guessed_metres import stated_distances_m
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError

MOST_BLUR_PX = 14.0

_DIAMETERS_PX = np.arange(1.5, MOST_BLUR_PX + 1.01, 0.5)
WINDOW_PX = 19
_WELL_MATCHED = 0.2
_PIXEL_IN_DISC_PX2 = 4.0 / 3.0

Plane = Float32[np.ndarray, "height width"]
FEWEST_SAMPLES = 60
LEAST_BLUR_PX = 2.0
FOCUS_SIGMA_DIOPTRE = 0.05
"""How far a first idea of the focus may well be off: half a step of Nikon's 8-bit code is 0.03 to 0.06 dioptres at 0.5 to 1 m."""
GROWTH_SIGMA = 0.01
"""How far the growth in one slice, over that of a thin lens, may well differ from the growth in the others."""
_DIAMETER_SIGMA_PX = 0.1
_COMMON_ERROR_PX = 0.06  # of all diameters of a slice alike: what the foci of a traced lab of 12 slices were off, times their growth
_PASSES = 4
_TRIED = 101
_ROUGH_PX = 0.5


@dataclass(frozen=True)
class BlurSamples:
    """Measured circles of confusion. slices, points: indices of each; diameter_px: in the registered slice."""

    slices: Int[np.ndarray, " samples"]
    points: Int[np.ndarray, " samples"]
    diameter_px: Float[np.ndarray, " samples"]


def measure_blur(all_in_focus: Plane, slices: Iterable[Plane], xy_px: Float[np.ndarray, "points 2"], aperture: Aperture) -> BlurSamples:
    """Measure the blur around points; only well-fitting diameters between 2 and 14 px are returned.

    all_in_focus, slices: luminance in one geometry.
    """
    blurred = [_blurred(all_in_focus, diameter, aperture) for diameter in _DIAMETERS_PX]
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for index, plane in enumerate(slices):
        diameters = best_diameters(plane, all_in_focus, blurred, xy_px)
        told = np.flatnonzero(np.isfinite(diameters))
        found.append((np.full(len(told), index), told, diameters[told]))
    return BlurSamples(*(np.concatenate(columns) for columns in zip(*found, strict=True)))


def best_diameters(
    plane: Plane, sharp: Plane, blurred: Sequence[Plane], xy_px: Float[np.ndarray, "points 2"]
) -> Float[np.ndarray, " points"]:
    """Return the diameter of the blur nearest to the slice around each point; NaN if none is much nearer than no blur.

    A rasterized opening includes the pixel's own square, which the sharp picture has once already. A disc of diameter c has
    the variance c^2 / 16 along an axis, a pixel 1/12, so what fits as c is sqrt(c^2 + 4/3).
    """
    places = (xy_px - 0.5).astype(np.float32)
    unlike = np.array([_unlike(each, plane, places) for each in blurred])
    lowest = np.argmin(unlike, axis=0)
    inside = np.clip(lowest, 1, len(blurred) - 2)
    columns = np.arange(len(places))
    before, at, after = (unlike[inside + step, columns] for step in (-1, 0, 1))
    bend = before - 2.0 * at + after
    shift = np.divide(0.5 * (before - after), bend, out=np.zeros_like(bend), where=bend > 0)
    fitted_px = _DIAMETERS_PX[inside] + (_DIAMETERS_PX[1] - _DIAMETERS_PX[0]) * shift
    good = (lowest == inside) & (np.abs(shift) <= 1.0) & (at < _WELL_MATCHED * _unlike(sharp, plane, places))
    return np.where(good, np.sqrt(fitted_px**2 + _PIXEL_IN_DISC_PX2), np.nan)


def _blurred(picture: Plane, diameter_px: float, aperture: Aperture) -> Plane:
    kernel = aperture.rasterize(float(diameter_px)).kernel.astype(np.float32)
    return cv2.filter2D(picture, -1, kernel, borderType=cv2.BORDER_REFLECT_101)


def _unlike(a: Plane, b: Plane, places: Float32[np.ndarray, "points 2"]) -> Float[np.ndarray, " points"]:
    """Return the variance of the difference within a window, which ignores a constant that leaks in from beyond it."""
    difference = a - b
    size = (WINDOW_PX, WINDOW_PX)
    variance = cv2.blur(difference**2, size) - cv2.blur(difference, size) ** 2
    sampled = cv2.remap(np.maximum(variance, 0.0), places[:, 0], places[:, 1], cv2.INTER_LINEAR)
    return sampled.ravel().astype(np.float64)


@dataclass(frozen=True)
class FocusStart:
    """First estimates: focus dioptres of the slices, and the relative growth of their blur (a thin lens's px per dioptre, or all 1).

    sigma_dioptre: the error to expect in the dioptres, of all slices or of each. beyond: slices known only to be focused beyond all others,
    so that their focus is searched there: too far a start would lead the fit to a wrong one.
    """

    dioptres: Float[np.ndarray, " slices"]
    growth: Float[np.ndarray, " slices"]
    sigma_dioptre: float | Float[np.ndarray, " slices"] = FOCUS_SIGMA_DIOPTRE
    beyond: tuple[int, ...] = ()


@dataclass(frozen=True)
class FocusFit:
    """The calibrated focus of each slice.

    dioptres: 1 / metres from the entrance pupil. px_per_dioptre: of the registered slices measured.
    sigma_dioptre: one standard deviation of each focus. samples: measured diameters in each slice.
    """

    dioptres: Float[np.ndarray, " slices"]
    px_per_dioptre: Float[np.ndarray, " slices"]
    sigma_dioptre: Float[np.ndarray, " slices"]
    samples: Int[np.ndarray, " slices"]


def calibrate_focus(blur: BlurSamples, point_dioptres: Float[np.ndarray, " points"], start: FocusStart) -> FocusFit:
    """Fit all V's of a stack robustly (Cauchy's loss); without samples a slice keeps its start.

    point_dioptres: 1 / metres of the points by the scaled model.
    """
    fit = _Fit(blur.slices, point_dioptres[blur.points], blur.diameter_px, start)
    if len(blur.slices) < FEWEST_SAMPLES:
        raise InputError(
            f"looked for blur between {LEAST_BLUR_PX:g} and {MOST_BLUR_PX:g} px around points of known depth and found it "
            f"{len(blur.slices)} times, but {FEWEST_SAMPLES} are needed to calibrate the focus: more texture or more slices"
        )
    values = fit.first_values()
    for _ in range(_PASSES):
        within = fit.measurable(values)
        result = least_squares(fit.residuals, values, fit.jacobian, args=(within,), loss="cauchy")
        values = result.x
    covariance = np.linalg.pinv(result.jac.T @ result.jac) / CAUCHY_95**2
    count = len(start.dioptres)
    dioptres, growth = fit.meaning(values)
    told = np.bincount(blur.slices[within], minlength=count)
    variances = np.diag(covariance)[-count:]
    if (variances < 0.0).any() or (growth <= 0.0).any():
        raise InputError("no focus distances explain how the blur of the slices grows with depth: is the scale of the poses right?")
    sigma = np.hypot(np.sqrt(variances), _COMMON_ERROR_PX / growth)
    return FocusFit(dioptres, growth, sigma, told)


@dataclass(frozen=True)
class _Fit:
    """The least-squares problem. Parameters: log of the common growth, the deviations of the slices from it, their focus dioptres."""

    slices: np.ndarray
    point_dioptre: np.ndarray
    diameter_px: np.ndarray
    start: FocusStart

    def first_values(self) -> np.ndarray:
        off = np.abs(self.start.dioptres[self.slices] - self.point_dioptre) * self.start.growth[self.slices]
        told = ~np.isin(self.slices, self.start.beyond)
        common = float(np.median((self.diameter_px / np.maximum(off, 1e-6))[told if told.any() else slice(None)]))
        dioptres = self.start.dioptres.copy()
        for index in self.start.beyond:
            dioptres[index] = self._looked_for(index, common)
        return np.concatenate([[np.log(common)], np.zeros(len(dioptres)), dioptres])

    def _looked_for(self, index: int, common: float) -> float:
        """Return the focus between infinity and the other slices that explains most samples of a slice; the start without samples."""
        mine, others = self.slices == index, np.delete(self.start.dioptres, self.start.beyond)
        if not mine.any() or not others.size:
            return float(self.start.dioptres[index])
        tried = np.linspace(0.0, others.min(), _TRIED)
        predicted = common * self.start.growth[index] * np.abs(tried[:, None] - self.point_dioptre[mine])
        return float(tried[np.log1p(((predicted - self.diameter_px[mine]) / _ROUGH_PX) ** 2).sum(axis=1).argmin()])

    def meaning(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        count = len(self.start.dioptres)
        return values[1 + count :], np.exp(values[0]) * (1.0 + values[1 : 1 + count]) * self.start.growth

    def predicted_px(self, values: np.ndarray) -> np.ndarray:
        dioptres, growth = self.meaning(values)
        return np.asarray(growth[self.slices] * np.abs(dioptres[self.slices] - self.point_dioptre))

    def measurable(self, values: np.ndarray) -> np.ndarray:
        """Select by the predicted diameter; selecting by the measured one would prefer those that noise has pushed inside."""
        predicted = self.predicted_px(values)
        return (predicted > LEAST_BLUR_PX) & (predicted < MOST_BLUR_PX)

    def residuals(self, values: np.ndarray, within: np.ndarray) -> np.ndarray:
        off_px = (self.predicted_px(values) - self.diameter_px)[within] / _DIAMETER_SIGMA_PX
        return np.concatenate([off_px / CAUCHY_95, squared_under_cauchy(self._off_priors(values))])

    def _off_priors(self, values: np.ndarray) -> np.ndarray:
        count = len(self.start.dioptres)
        uneven = values[1 : 1 + count] / GROWTH_SIGMA
        moved = (values[1 + count :] - self.start.dioptres) / self.start.sigma_dioptre
        return np.concatenate([uneven, moved]) / CAUCHY_95

    def jacobian(self, values: np.ndarray, within: np.ndarray) -> np.ndarray:
        """Return the derivatives of the residuals: (samples within + two priors for each slice, parameters)."""
        count, slices = len(self.start.dioptres), self.slices[within]
        dioptres, growth = self.meaning(values)
        off = dioptres[slices] - self.point_dioptre[within]
        rows, predicted = np.arange(len(slices)), growth[slices] * np.abs(off)
        matrix = np.zeros((len(slices) + 2 * count, 1 + 2 * count))
        matrix[rows, 0] = predicted
        matrix[rows, 1 + slices] = predicted / (1.0 + values[1 + slices])
        matrix[rows, 1 + count + slices] = growth[slices] * np.sign(off)
        matrix[rows] /= _DIAMETER_SIGMA_PX * CAUCHY_95
        widths = np.concatenate([np.full(count, GROWTH_SIGMA), np.broadcast_to(self.start.sigma_dioptre, count)]) * CAUCHY_95
        matrix[len(slices) :, 1:] = np.diag(squared_under_cauchy_slope(self._off_priors(values)) / widths)
        return matrix


_WIDEST_PX = 1600
_UNKNOWN_SIGMA_DIOPTRE = 0.5


@dataclass(frozen=True)
class StackFocus:
    """The calibrated focus of one stack. fit: px_per_dioptre at the width of the stack's registered pictures."""

    stack: FocalStack
    fit: FocusFit
    width_px: int


def stack_focus(metric: SparseModel, view: str, stack: FocalStack, start: FocusStart) -> StackFocus:
    """Measure the blur of a merged stack around the points of a model in metres, and fit. Wide pictures are reduced to 1600 px."""
    sharp = luminance(stack.all_in_focus())
    factor = -(-sharp.shape[1] // _WIDEST_PX)
    xy_px, depth_m = metric.depths_in(view)
    chosen = spread_points(xy_px / factor)
    xy_px, depth_m = xy_px[chosen], depth_m[chosen]
    slices = (reduced(luminance(rgb), factor) for rgb in track(stack.iter_rgb(), f"{view}: blur", len(stack)))
    aperture = Aperture.disc() if stack.lens is None else stack.lens.aperture
    blur = measure_blur(reduced(sharp, factor), slices, xy_px / factor, aperture)
    fit = calibrate_focus(blur, 1.0 / depth_m, start)
    return StackFocus(stack, replace(fit, px_per_dioptre=fit.px_per_dioptre * factor), sharp.shape[1])


def spread_points(xy_px: Float[np.ndarray, "points 2"]) -> Int[np.ndarray, " chosen"]:
    """Choose one point per window-sized square: neighbours share pixels and are not independent."""
    cells = np.floor(xy_px / WINDOW_PX).astype(np.int64)
    return np.sort(np.unique(cells, axis=0, return_index=True)[1])


def reduced(plane: Plane, factor: int) -> Float32[np.ndarray, "reduced_height reduced_width"]:
    """Average blocks of factor x factor pixels; incomplete blocks at the right and bottom are dropped."""
    if factor == 1:
        return plane
    height, width = plane.shape[0] // factor, plane.shape[1] // factor
    return cv2.resize(plane[: height * factor, : width * factor], (width, height), interpolation=cv2.INTER_AREA)


def focus_start(stack: FocalStack, sample: FocusSample, metres_per_unit: float, offset_m: float, width_px: int) -> FocusStart:
    """Start from the stated distances less the offset of the lens, hardly trusting a sentinel; without distances, from the depths of the
    points that are sharpest in each slice.
    """
    count = len(stack)
    growth = np.ones(count)
    if stack.lens is not None:
        stated = [stack.lens.focused_at(distance) if distance else stack.lens for distance in stated_distances_m(stack)]
        growth = np.array([lens.coc_px_per_dioptre(width_px) * each.scale for lens, each in zip(stated, stack.slices, strict=True)])
    if np.isfinite(sample.focus_dioptres).all():
        told = np.isfinite(sample.stated_sigma)
        # In registered pictures a thin lens's blur grows alike in all slices.
        growth = np.where(told, growth, np.median(growth[told] if told.any() else growth))
        sigma = np.where(told, FOCUS_SIGMA_DIOPTRE, _UNKNOWN_SIGMA_DIOPTRE)
        beyond = tuple(np.flatnonzero(~told).tolist())
        return FocusStart(1.0 / (1.0 / np.maximum(sample.focus_dioptres, 1e-3) - offset_m), growth, sigma, beyond)
    target, highest = 1.0 / (sample.depth * metres_per_unit), sample.peaks.highest
    known = np.unique(highest)
    if len(known) < 2:
        raise InputError(f"{sample.view}: focus distances are unknown and no two slices have sharp points: photograph more depth")
    medians = np.array([np.median(target[highest == index]) for index in known])
    dioptres = np.polyval(np.polyfit(known, medians, 1), np.arange(count))
    dioptres[known] = medians
    return FocusStart(dioptres, growth, _UNKNOWN_SIGMA_DIOPTRE)


def calibrated_stack(found: StackFocus, view: SparseView) -> FocalStack:
    """Return the stack with its calibrated focus, its camera (in metres) and the distortion of its view."""
    stack, slices = found.stack, []
    rows = zip(stack.slices, stated_distances_m(stack), found.fit.dioptres, found.fit.px_per_dioptre, strict=True)
    for each, stated_m, dioptre, growth in rows:
        slices.append(with_calibrated_focus(each, stated_m, float(dioptre), float(growth) / each.scale, found.width_px))
    return with_view(_with_known_metres(focused_stack(stack, slices)), view)


def _with_known_metres(stack: FocalStack) -> FocalStack:
    """Record that metres that were guessed before now rest on the camera poses."""
    if METRES not in stack.metadata:
        return stack
    return replace(stack, metadata=stack.metadata | {METRES: {"known": True, "why": "metres rest on the camera poses"}})


def with_view(stack: FocalStack, view: SparseView) -> FocalStack:
    return replace(stack, camera=view.camera, metadata=stack.metadata | {"distortion": list(view.distortion)})


def lens_calibrations(found: Mapping[str, StackFocus], offset_m: float) -> list[LensCalibration]:
    """Return one calibration for each lens (model, focal length, f-number) among the stacks, the one with the most stacks first."""
    groups: dict[tuple[str | None, float, float], list[StackFocus]] = {}
    for each in found.values():
        if each.stack.lens is not None:
            lens = each.stack.lens
            key = (lens_model_of(each.stack), round(lens.focal_length_mm, 2), round(lens.f_number, 2))
            groups.setdefault(key, []).append(each)
    ordered = sorted(groups.items(), key=lambda item: -len(item[1]))
    return [LensCalibration(*key, width_px=members[0].width_px, offset_m=offset_m, rows=_rows(members)) for key, members in ordered]


def _rows(members: Sequence[StackFocus]) -> tuple[CalibratedFocus, ...]:
    """Return one row for each stated focus, weighted by each stack's certainty; unknown ones and sentinels stay separate."""
    width_px = members[0].width_px
    alike: dict[object, list[CalibratedFocus]] = {}
    for number, each in enumerate(members):
        told = zip(stated_distances_m(each.stack), stated_by_sentinel(each.stack), strict=True)
        stated_m_of = [None if by_sentinel else stated_m for stated_m, by_sentinel in told]
        columns = (each.stack.slices, stated_m_of, each.fit.dioptres, each.fit.px_per_dioptre, each.fit.sigma_dioptre)
        for index, (photo, stated_m, dioptre, growth, sigma) in enumerate(zip(*columns, strict=True)):
            stated = None if stated_m is None else 1.0 / stated_m
            per_dioptre = float(growth) / photo.scale * width_px / each.width_px
            row = CalibratedFocus(
                stated_dioptre=stated,
                dioptre=float(dioptre),
                px_per_dioptre=per_dioptre,
                breathing_scale=photo.scale,
                sigma_dioptre=float(sigma),
            )
            alike.setdefault((number, index) if stated is None else round(stated, 5), []).append(row)
    return tuple(sorted((_mean(rows) for rows in alike.values()), key=lambda row: row.dioptre))


def _mean(rows: Sequence[CalibratedFocus]) -> CalibratedFocus:
    weight = np.array([1.0 / max(row.sigma_dioptre, 1e-5) ** 2 for row in rows])

    def mean(name: str) -> float:
        return float(np.average([getattr(row, name) for row in rows], weights=weight))

    sigma = float(weight.sum() ** -0.5)
    return CalibratedFocus(
        stated_dioptre=rows[0].stated_dioptre,
        dioptre=mean("dioptre"),
        px_per_dioptre=mean("px_per_dioptre"),
        breathing_scale=mean("breathing_scale"),
        sigma_dioptre=sigma,
        stacks=len(rows),
    )

"""The scale from the stacks' own focus distances: where points are sharpest against where the model puts them.

A point at depth z (model units, from the entrance pupil) is sharp in the slice whose stated focus distance D, less one offset e
for the lens, is its depth in metres: 1 / (D - e) = 1 / (s z). EXIF counts from the film plane, the thin lens from its principal
plane, COLMAP from the entrance pupil; e is the remaining difference, a few centimetres at most.

The sharpness of a point is the local energy of a band-passed picture. Its logarithm is a parabola near the focus, in dioptres,
because blur is proportional to them (Nayar and Nakagawa 1994, Shape from Focus, use a normal curve for the same reason).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from capture.poses.cauchy_loss import CAUCHY_95, deviation
from capture.poses.sparse_model import SparseModel
from capture.scale.answer import ScaleAnswer
from capture.stacks.slice_files import stated_by_sentinel
from mrbokeh.images.color import luminance
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.stacks.guessed_metres import stated_distances_m
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError

_SMOOTHING_PX = 0.7
_WINDOW_PX = 4.0
_REACH = 3
_LEAST_RISE = float(np.log(3.0))

Curves = Float[np.ndarray, "slices points"]
FEWEST_POINTS = 50
OFFSET_SIGMA_M = 0.03
"""How far the entrance pupil of a photographic lens may well lie from where its focus distances count."""
SIGNIFICANT = 3.0
"""Standard deviations from 0 at which an offset counts."""
_NO_OFFSET_M = 1e-6
_STEPS = 25
_LEAST_STATED_SIGMA = 0.001


@dataclass(frozen=True)
class SharpnessPeaks:
    """Log energies of the points that have a peak inside the stack, and the slice in which they are highest."""

    points: Int[np.ndarray, " peaks"]
    log_energy: Float[np.ndarray, "slices peaks"]
    highest: Int[np.ndarray, " peaks"]

    def dioptres(self, focus_dioptres: Float[np.ndarray, " slices"]) -> Float[np.ndarray, " peaks"]:
        """Return the vertices of parabolas through up to three slices on either side of the highest; NaN if one opens upwards.

        Both sides have the same number of slices: the curve is wider than a parabola, and an uneven choice would shift the vertex. Slices
        with
        NaN focus are not used, and points that are sharpest there have no vertex.
        """
        vertices = np.full(len(self.points), np.nan)
        for slice_index in np.unique(self.highest):
            mine = self.highest == slice_index
            reach = _reach(np.isfinite(focus_dioptres), int(slice_index))
            if reach == 0:
                continue
            near = np.arange(slice_index - reach, slice_index + reach + 1)
            weight = np.sqrt(1.0 + reach - np.abs(near - slice_index))
            x = focus_dioptres[near] - focus_dioptres[slice_index]
            design = np.stack([np.ones_like(x), x, x**2], axis=1) * weight[:, None]
            _, slope, bend = np.linalg.lstsq(design, weight[:, None] * self.log_energy[np.ix_(near, mine)], rcond=None)[0]
            with np.errstate(divide="ignore", invalid="ignore"):
                vertex = np.where(bend < 0, -0.5 * slope / bend, np.nan)
            inside = (vertex >= x.min()) & (vertex <= x.max())
            vertices[mine] = focus_dioptres[slice_index] + np.where(inside, vertex, np.nan)
        return vertices


def _reach(known: Bool[np.ndarray, " slices"], middle: int) -> int:
    """Return how many neighbours on either side are known without a gap, up to _REACH; 0 if the middle is unknown."""
    reaches = (n for n in range(_REACH, 0, -1) if middle >= n and middle + n < len(known) and known[middle - n : middle + n + 1].all())
    return next(reaches, 0)


def sharpness_curves(slices: Iterable[Float32[np.ndarray, "height width 3"]], xy_px: Float[np.ndarray, "points 2"]) -> Curves:
    """Return the energy of each point in each registered slice (linear RGB); one slice is held at a time."""
    places = (xy_px - 0.5).astype(np.float32)
    rows = []
    for rgb in slices:
        detail = cv2.Laplacian(cv2.GaussianBlur(luminance(rgb), (0, 0), _SMOOTHING_PX), cv2.CV_32F)
        energy = cv2.GaussianBlur(detail**2, (0, 0), _WINDOW_PX)
        rows.append(cv2.remap(energy, places[:, 0], places[:, 1], cv2.INTER_LINEAR).ravel())
    return np.array(rows, np.float64)


def sharpness_peaks(curves: Curves) -> SharpnessPeaks:
    """Keep points whose sharpest slice is neither the first nor the last, and at least three times as sharp as the least sharp."""
    log_energy = np.log(np.maximum(curves, 1e-20))
    highest = np.argmax(log_energy, axis=0)
    inside = (highest > 0) & (highest < len(curves) - 1)
    rise = log_energy.max(axis=0) - log_energy.min(axis=0)
    points = np.flatnonzero(inside & (rise > _LEAST_RISE))
    return SharpnessPeaks(points, log_energy[:, points], highest[points])


@dataclass(frozen=True)
class FocusSample:
    """Peaks of one stack.

    depth: of its peaks, in model units. focus_dioptres: as stated, NaN where unknown.
    stated_sigma: standard deviation of these, from the intervals of the cameras' codes; 0 where unknown, inf where a sentinel stands for
    the distance: such a slice has no weight.
    """

    view: str
    peaks: SharpnessPeaks
    xy_px: Float[np.ndarray, "peaks 2"]
    depth: Float[np.ndarray, " peaks"]
    focus_dioptres: Float[np.ndarray, " slices"]
    stated_sigma: Float[np.ndarray, " slices"]


def focus_sample(model: SparseModel, view: str, stack: FocalStack) -> FocusSample:
    """Measure the sharpness of the stack's registered slices at the points that the view observes."""
    if not stack.registered:
        raise InputError(f"{stack.folder} is not registered: run `mrbokeh capture merge` on it")
    xy_px, depth = model.depths_in(view)
    curves = sharpness_curves(track(stack.iter_rgb(), f"{view}: sharpness", len(stack)), xy_px)
    peaks = sharpness_peaks(curves)
    stated = np.array([np.nan if distance is None else 1.0 / distance for distance in stated_distances_m(stack)])
    return FocusSample(
        view=view,
        peaks=peaks,
        xy_px=xy_px[peaks.points],
        depth=depth[peaks.points],
        focus_dioptres=stated,
        stated_sigma=stated_sigma_dioptre(stack),
    )


def stated_sigma_dioptre(stack: FocalStack) -> Float[np.ndarray, " slices"]:
    """Return the standard deviation of a distance anywhere in its interval: the width over the square root of 12; inf for a sentinel.

    A sentinel's interval has a width too, but is one-sided about its infinity and would bias the result, however little it weighs.
    """
    intervals = [(each.metadata.get("focus") or {}).get("lens_interval_dioptre") or (0.0, 0.0) for each in stack.slices]
    widths = np.array([abs(float(upper) - float(lower)) for lower, upper in intervals])
    return np.where(stated_by_sentinel(stack), np.inf, widths / np.sqrt(12.0))


@dataclass(frozen=True)
class _Peaks:
    """Peaks of all stacks: dioptre by the stated distances, depth in units, group: the stated distance at which each is sharpest."""

    dioptre: Float[np.ndarray, " peaks"]
    depth: Float[np.ndarray, " peaks"]
    group: Int[np.ndarray, " peaks"]
    stated_sigma: Float[np.ndarray, " peaks"]


def focus_scale(samples: Sequence[FocusSample]) -> ScaleAnswer:
    """Fit the scale and one offset robustly; each stated distance may have an error that its points share.

    Scale and offset are correlated, so an offset that is not significant is set to 0; the resulting change of the scale counts as
    uncertainty.
    """
    peaks = _joined(samples, 0.0)
    if len(peaks.depth) < FEWEST_POINTS:
        raise InputError(
            f"looked for points whose sharpness peaks between slices of known focus distance and found {len(peaks.depth)} in "
            f"{len(samples)} stacks, but {FEWEST_POINTS} are needed: give focus distances (lens.toml), more slices or more texture"
        )
    peaks = _joined(samples, _fit(peaks, OFFSET_SIGMA_M).offset_m)
    with_offset, without = _fit(peaks, OFFSET_SIGMA_M), _fit(peaks, _NO_OFFSET_M)
    told_apart = abs(with_offset.offset_m) > SIGNIFICANT * with_offset.offset_sigma_m
    used = with_offset if told_apart else without
    between = abs(with_offset.scale / without.scale - 1.0)
    facts = {
        "points": len(peaks.depth),
        "stacks": len(samples),
        "offset_m": with_offset.offset_m if told_apart else 0.0,
        "fitted_offset_m": with_offset.offset_m,
        "offset_uncertainty_m": with_offset.offset_sigma_m,
        "residual_dioptre": used.residual_dioptre,
        "stated_error_dioptre": used.stated_sigma_dioptre,
        "metres_per_unit_with_offset": with_offset.scale,
        "metres_per_unit_without_offset": without.scale,
    }
    return ScaleAnswer("focus", used.scale, used.scale_sigma if told_apart else float(np.hypot(used.scale_sigma, between)), facts)


@dataclass(frozen=True)
class _Fit:
    """A fitted scale and offset.

    scale_sigma is relative. residual_dioptre: of one peak. stated_sigma_dioptre: of the stated distances, beyond their peaks' noise.
    """

    scale: float
    scale_sigma: float
    offset_m: float
    offset_sigma_m: float
    residual_dioptre: float
    stated_sigma_dioptre: float


def _fit(peaks: _Peaks, offset_sigma_m: float) -> _Fit:
    """Run Gauss-Newton on the means of the groups, Cauchy-weighted within each.

    Groups count by their points, since noise is uniform over the picture; but the uncertainty of the result depends on the errors of
    whole groups, as observed and as the stated intervals allow: a sandwich covariance (Huber 1967).
    """
    scale, offset_m = float(np.median(1.0 / (peaks.dioptre * peaks.depth))), 0.0
    members = [np.flatnonzero(peaks.group == group) for group in np.unique(peaks.group)]
    prior = np.diag([0.0, offset_sigma_m**-2.0])
    for _ in range(_STEPS):
        from_pupil = 1.0 / np.maximum(1.0 / peaks.dioptre - offset_m, 1e-3)
        by_model = 1.0 / (scale * peaks.depth)
        off = from_pupil - by_model
        means, noise, directions = _group_means(off, np.stack([by_model, from_pupil**2], axis=1), members)
        weighted = directions / noise[:, None]
        normal = weighted.T @ directions + prior
        step = np.linalg.solve(normal, weighted.T @ means + prior @ [0.0, offset_m])
        scale, offset_m = scale * float(np.exp(-step[0])), offset_m - float(step[1])
    shown = float(np.sum(np.maximum(means**2 - noise, 0.0))) / max(len(members) - 2, 1)
    stated = np.array([np.mean(peaks.stated_sigma[mine] ** 2) for mine in members])
    between = np.maximum(np.maximum(shown, stated), _LEAST_STATED_SIGMA**2)
    inverse = np.linalg.inv(normal)
    meat = (weighted * (noise + between)[:, None]).T @ weighted + prior
    sigma = np.sqrt(np.diag(inverse @ meat @ inverse))
    return _Fit(
        scale=scale,
        scale_sigma=float(sigma[0]),
        offset_m=offset_m,
        offset_sigma_m=float(sigma[1]),
        residual_dioptre=deviation(off),
        stated_sigma_dioptre=float(np.sqrt(np.mean(between))),
    )


def _group_means(off: np.ndarray, slopes: np.ndarray, members: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (robust mean of each group, its variance from noise, its derivatives by log scale and offset)."""
    means, noise, directions = [], [], []
    for mine in members:
        middle = np.median(off[mine])
        spread = deviation(off[mine] - middle)
        weight = 1.0 / (1.0 + ((off[mine] - middle) / (CAUCHY_95 * spread)) ** 2)
        means.append(np.average(off[mine], weights=weight))
        noise.append(spread**2 / weight.sum())
        directions.append(np.average(slopes[mine], axis=0, weights=weight))
    return np.array(means), np.array(noise), np.array(directions)


def _joined(samples: Sequence[FocusSample], offset_m: float) -> _Peaks:
    """Join the peaks of all stacks by their stated distances; parabolas are fitted in dioptres from the pupil, by this offset."""
    dioptres, depths, groups, sigmas = [np.zeros(0)], [np.zeros(0)], [np.zeros(0, np.int64)], [np.zeros(0)]
    stated: dict[float, int] = {}
    for sample in samples:
        known = np.isfinite(sample.focus_dioptres)
        if not known.all():
            continue
        names = [stated.setdefault(round(float(each), 6), len(stated)) for each in sample.focus_dioptres]
        told = np.where(np.isfinite(sample.stated_sigma), sample.focus_dioptres, np.nan)
        with np.errstate(divide="ignore"):
            from_pupil = sample.peaks.dioptres(1.0 / (1.0 / told - offset_m))
            dioptre = 1.0 / (1.0 / from_pupil + offset_m)
        good = np.isfinite(dioptre) & (dioptre > 0) & (sample.depth > 0)
        dioptres.append(dioptre[good])
        depths.append(sample.depth[good])
        groups.append(np.array(names, np.int64)[sample.peaks.highest[good]])
        sigmas.append(sample.stated_sigma[sample.peaks.highest[good]])
    return _Peaks(np.concatenate(dioptres), np.concatenate(depths), np.concatenate(groups), np.concatenate(sigmas))

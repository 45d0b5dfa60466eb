"""Focus of each slice and place of each surface, in pixels of blur, solved from the pictures alone.

The circle of confusion of a surface at position u in a slice focused at u_i is |u_i - u| pixels in the registered slices: positions are
affine in dioptres (a dioptre is as many pixels as the blur grows by), and no lens needs to be known for them. That blur grows alike in
all registered slices follows from the entrance pupil: seen from the scene, a disc of confusion is the pupil, whatever the focus.

What is sharp in slice j is blurred in slice i by the disc that explains i best; such diameters for all pairs give the positions by least
squares, and with them every place its own.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from capture.merging.metres.blur_evidence import BlurEvidence, blur_evidence

_BLOCKS = 5
_TOLD_SHARE = 0.9
"""Blur above this share of the widest rung is too wide to be told."""
_NEAR_A_SLICE = 0.3
_LEAST_FILLED = 0.003
_FEWEST_BLOCKS = 3
_LEAST_WEIGHT = 0.03
_OWN_SHARE = 0.05
_NOISE_PERCENTILE = 10.0
_TEXTURED_FLOORS = 5.0
_SURFACE_STEP = 0.7
_MODEL_SHARE = 0.01
"""Share of a cell's texture that a disc of any size does not reproduce of real blur."""
_ROUNDS = 3
_ENOUGH_CELLS = 5000
_SPENT = 4.0
"""Highest cost of the misfit of an outlier, in variances."""
_REACH = 5
_WIDEST_OFFSET_STEPS = 0.8
_WINDOW_SAMPLES = 12.0
"""Independent pixels in a window, for the uncertainty of a place."""
_PRIOR_STEPS = 0.5
_SPREAD_STEPS = 1.0
_LEAST_ERROR_PX2, _LEAST_ERROR_SHARE = 0.4, 0.02
"""Blur below a pixel shows by its square alone."""

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]
Cells = Int[np.ndarray, " some"]
Positions = Float[np.ndarray, " slices"]


@dataclass(frozen=True)
class RelativeFocus:
    """Positions in pixels of blur.

    positions_px, errors_px: (slices,) where each slice is focused, increasing with its index, and the standard error to its neighbours.
    focus_px, error_px: (H, W) the position of the surface at each pixel. The circle of confusion there is positions_px[i] - focus_px.
    """

    positions_px: Positions
    errors_px: Positions
    focus_px: Plane
    error_px: Plane

    def with_index(self, before: Plane, now: Plane) -> "RelativeFocus":
        """Return the same with surfaces moved from one fractional index of slices to another."""
        now_px, before_px = (np.interp(index, np.arange(len(self.positions_px)), self.positions_px) for index in (now, before))
        return replace(self, focus_px=(self.focus_px + (now_px - before_px)).astype(np.float32))


@dataclass(frozen=True)
class _Places:
    """Cells of the evidence, whose errors and gaps are in units of their variance.

    index: fractional. own: shares of the slices that their sharp picture is of, which it fits for no reason.
    """

    errors: Float32[np.ndarray, "cells slices rungs"]
    gaps: Float32[np.ndarray, "cells steps"]
    squares_px2: Float[np.ndarray, " rungs"]
    shrink: float
    shape: tuple[int, int]
    index: Float32[np.ndarray, " cells"]
    own: Float32[np.ndarray, "cells slices"]
    weight: Float32[np.ndarray, " cells"]

    @classmethod
    def of(cls, evidence: BlurEvidence, focus_index: Plane, confidence: Plane) -> "_Places":
        errors, count = evidence.errors, evidence.errors.shape[1]
        index = evidence.at_cells(focus_index).astype(np.float32)
        own = np.clip(2.0 * (0.75 - np.abs(index[:, None] - np.arange(count, dtype=np.float32))), 0.0, 1.0)
        own /= own.sum(axis=1, keepdims=True)
        silent = (errors[:, :, 0] < 0) | (own > _OWN_SHARE)
        lowest = errors.min(axis=2)[~silent]
        floor = float(np.percentile(lowest, _NOISE_PERCENTILE)) + 1e-9 if len(lowest) else 1e-9
        variance = np.float32(floor) + np.float32(_MODEL_SHARE) * evidence.texture
        np.divide(errors, variance[:, None, None], out=errors)
        errors[silent] = -1.0
        grid, box = index.reshape(evidence.shape), np.ones((5, 5), np.uint8)
        jump = (cv2.dilate(grid, box) - cv2.erode(grid, box)).ravel()
        weight = evidence.at_cells(confidence) / (1.0 + (jump / _SURFACE_STEP) ** 2) * (evidence.texture > _TEXTURED_FLOORS * floor)
        gaps = evidence.gaps / variance[:, None]
        return cls(
            errors=errors,
            gaps=gaps,
            squares_px2=evidence.diameters_px**2,
            shrink=evidence.shrink,
            shape=evidence.shape,
            index=index,
            own=own,
            weight=weight.astype(np.float32),
        )

    def thinned(self) -> "_Places":
        """Keep every second or third cell and row: windows overlap, and slices need fewer places than surfaces do."""
        step = int(np.ceil(np.sqrt(len(self.index) / _ENOUGH_CELLS)))
        chosen = np.arange(len(self.index)).reshape(self.shape)[::step, ::step]
        picked = {name: getattr(self, name)[chosen.ravel()] for name in ("errors", "gaps", "index", "own", "weight")}
        return replace(self, shape=(chosen.shape[0], chosen.shape[1]), **picked)

    @property
    def count(self) -> int:
        return self.errors.shape[1]

    @property
    def widest_px(self) -> float:
        return float(np.sqrt(self.squares_px2[-1]))

    def can_tell(self, cells: Cells | slice, one: int, diameter_px: Float[np.ndarray, " some"]) -> Bool[np.ndarray, " some"]:
        """Return which cells have data in a slice, and no wider disc there than the rungs reach."""
        return (self.errors[cells, one, 0] >= 0.0) & (diameter_px <= self.widest_px)

    def misfits(self, cells: Cells, one: int, squares_px2: Float[np.ndarray, "tries some"]) -> Float32[np.ndarray, "tries some"]:
        """Return the squared difference of a slice to the picture blurred by discs of squared diameters.

        Pictures go over linearly between the rungs, for which this is exact.
        """
        wanted = squares_px2.astype(np.float32)
        rungs = self.squares_px2.astype(np.float32)
        rung = np.zeros(wanted.shape, np.uint8)
        for edge in rungs[1:-1]:
            rung += wanted > edge
        share = np.clip((wanted - rungs[rung]) * (1.0 / np.diff(rungs))[rung], 0.0, 1.0)
        at = (cells * self.count + one) * len(rungs) + rung
        below, above = self.errors.take(at), self.errors.take(at + 1)
        gap = self.gaps.take(cells * (len(rungs) - 1) + rung)
        return np.maximum(below + share * (above - below - (1.0 - share) * gap), 0.0)

    @property
    def nearest(self) -> Int[np.ndarray, " cells"]:
        return np.rint(self.index).astype(np.int64)

    @property
    def block(self) -> Int[np.ndarray, " cells"]:
        rows, columns = np.indices(self.shape)
        return ((rows * _BLOCKS // self.shape[0]) * _BLOCKS + columns * _BLOCKS // self.shape[1]).ravel().astype(np.int64)


@dataclass(frozen=True)
class _Diameters:
    """Diameters of pairs: a slice, the slice in which its cells are sharp, what to add to the diameter so far, and its standard error.

    least_px2: error of a squared diameter, below which a small blur cannot be told.
    """

    one: Int[np.ndarray, " pairs"]
    other: Int[np.ndarray, " pairs"]
    value_px: Float[np.ndarray, " pairs"]
    error_px: Float[np.ndarray, " pairs"]
    least_px2: Float[np.ndarray, " pairs"]

    @classmethod
    def joined(cls, parts: Sequence["_Diameters"]) -> "_Diameters":
        return cls(*(np.concatenate([getattr(each, one.name) for each in parts]) for one in fields(cls)))


def solve_relative_focus(
    slices: Callable[[], Iterable[Rgb]],
    all_in_focus: Rgb,
    focus_index: Plane,
    confidence: Plane,
    count: int,
    valid: Callable[[int], Mask] | None = None,
    excluded: Mask | None = None,
) -> RelativeFocus:
    """Solve registered slices, which are read once, and their all-in-focus picture.

    focus_index, confidence: of the merge. valid: where slice i has data. excluded: pixels that were full in some slice.
    """
    fine, wide = blur_evidence(slices, all_in_focus, count, valid, excluded)
    places = _Places.of(fine, focus_index, confidence)
    positions, errors = _positions((places.thinned(), _Places.of(wide, focus_index, confidence).thinned()))
    offset, cell_error = _offsets(places, positions)
    return RelativeFocus(positions, errors, *_dense(places, positions, offset, cell_error, focus_index))


def _positions(levels: Sequence[_Places]) -> tuple[Positions, Positions]:
    """Solve positions by least squares of the diameters of all pairs, first as they are and then of what is left of them.

    Moving one slice or one surface at a time would never undo a common stretch; pairs do.
    """
    count = levels[0].count
    positions, errors = _solved([_measured_whole(each) for each in levels], np.zeros(count))
    for _ in range(_ROUNDS):
        positions, errors = _solved([_measured_rest(each, positions) for each in levels], positions)
    return positions, errors


def _measured_whole(places: _Places) -> "_Diameters":
    """Measure the diameters in all slices of what is sharp near the middle of one."""
    sharp = np.abs(places.index - places.nearest) <= _NEAR_A_SLICE
    nothing = np.zeros((len(places.index), places.count))
    return _measured(places, places.weight * sharp, nothing, nothing[:, 0], np.linspace(0.0, places.widest_px, 61))


def _measured_rest(places: _Places, positions: Positions) -> "_Diameters":
    """Measure the corrections to the diameters that follow from positions."""
    offset, _ = _offsets(places, positions)
    place = np.interp(places.index, np.arange(places.count), positions) + offset
    base = np.abs(positions[None, :] - place[:, None])
    own_blur = (places.own * base**2).sum(axis=1)
    base[base > _TOLD_SHARE * places.widest_px] = np.inf
    return _measured(places, places.weight, base, own_blur, np.linspace(-0.15, 0.15, 31) * places.widest_px)


def _measured(
    places: _Places,
    weight: Float32[np.ndarray, " cells"],
    base: Float[np.ndarray, "cells slices"],
    own_blur: Float[np.ndarray, " cells"],
    candidates: Float[np.ndarray, " candidates"],
) -> _Diameters:
    weight = np.where(weight > _LEAST_WEIGHT * weight.max(), weight, 0.0).astype(np.float32)
    curves = _summed_curves(places, weight, base, own_blur, candidates)
    total = curves.sum(axis=2)
    best = np.clip(total.argmin(axis=2), 1, len(candidates) - 2)
    inside = (total.argmin(axis=2) < len(candidates) - 1) & (total.max(axis=2) > 0)
    step = candidates[1] - candidates[0]
    before, at, after = (np.take_along_axis(curves, (best + k)[:, :, None, None], axis=3)[..., 0] for k in (-1, 0, 1))
    bend = (before - 2.0 * at + after).sum(axis=2) / step**2
    slope = (after - before) / (2.0 * step)
    shift = np.where(bend > 0, -slope.sum(axis=2) / np.maximum(bend, 1e-12), 0.0)
    shift = np.clip(shift, -step, step)
    # How much the blocks of the picture disagree says how far chance goes, not the number of pixels.
    scatter = ((slope - slope.mean(axis=2, keepdims=True)) ** 2).sum(axis=2)
    error = np.sqrt(scatter) / np.maximum(bend, 1e-12)
    # A slice in which next to nothing is sharp tells by chance only.
    filled = np.bincount(places.nearest, weight, places.count) > _LEAST_FILLED * weight.sum()
    spread = (curves.max(axis=3) > 0).sum(axis=2) >= _FEWEST_BLOCKS
    one, other = np.nonzero(inside & spread & filled[None, :] & (bend > 0) & ~np.eye(places.count, dtype=bool))
    value = candidates[best] + shift
    least_px2 = np.full(len(one), _LEAST_ERROR_PX2 * places.shrink**2)
    return _Diameters(one=one, other=other, value_px=value[one, other], error_px=error[one, other], least_px2=least_px2)


def _summed_curves(
    places: _Places,
    weight: Float32[np.ndarray, " cells"],
    base: Float[np.ndarray, "cells slices"],
    own_blur: Float[np.ndarray, " cells"],
    candidates: Float[np.ndarray, " candidates"],
) -> Float[np.ndarray, "slices slices blocks candidates"]:
    """Return, for every slice and the cells of every block that are sharp in another, the misfits at base + candidate.

    They are lessened as by Cauchy's cost: what fits badly everywhere still tells the better from the worse.
    """
    curves = np.zeros((places.count, places.count * _BLOCKS**2, len(candidates)))
    group = places.nearest * _BLOCKS**2 + places.block
    cells = np.argsort(group, kind="stable")
    cells = cells[weight[cells] > 0.0]
    for one in range(places.count):
        told = cells[places.can_tell(cells, one, base[cells, one])]
        if not len(told):
            continue
        diameters = np.maximum(base[told, one] + candidates[:, None], 0.0)
        misfits = np.log1p(places.misfits(told, one, diameters**2 - own_blur[told])) * weight[told]
        first = np.flatnonzero(np.diff(group[told], prepend=-1))
        curves[one, group[told[first]]] = np.add.reduceat(misfits, first, axis=1, dtype=np.float64).T
    return curves.reshape(places.count, places.count, _BLOCKS**2, len(candidates))


def _offset_costs(
    places: _Places, positions: Positions, start: Float[np.ndarray, " cells"], away: Float[np.ndarray, "offsets cells"]
) -> Float[np.ndarray, "offsets cells"]:
    """Return how badly the cells fit all slices if they lie at `start + away`; an outlier costs no more than _SPENT."""
    place, costs = start + away, np.zeros(away.shape)
    # The shares of the slices that a cell's sharp picture is of sum to 1.
    own_blur = places.own @ positions**2 - place * (2.0 * (places.own @ positions) - place)
    for one, position in enumerate(positions):
        told = np.flatnonzero(places.can_tell(slice(None), one, np.abs(position - start)))
        misfits = places.misfits(told, one, (position - place[:, told]) ** 2 - own_blur[:, told])
        costs[:, told] += misfits / (1.0 + misfits / np.float32(_SPENT))
    return costs


def _solved(parts: Sequence[_Diameters], before: Positions) -> tuple[Positions, Positions]:
    """Solve by robust weighted least squares; bends of the positions over the index cost a little, so that nothing stays open."""
    measured, count = _Diameters.joined(parts), len(before)
    sign = np.where(measured.one > measured.other, 1.0, -1.0)
    wanted = (before[measured.one] - before[measured.other]) + sign * measured.value_px
    rows = np.zeros((len(wanted), count))
    rows[np.arange(len(wanted)), measured.one] += 1.0
    rows[np.arange(len(wanted)), measured.other] -= 1.0
    least = measured.least_px2 / np.maximum(np.abs(wanted), 0.5)
    sigma = np.sqrt(measured.error_px**2 + least**2 + (_LEAST_ERROR_SHARE * wanted) ** 2)
    typical = float(np.median(np.abs(wanted) / np.abs(measured.one - measured.other))) if len(wanted) else 1.0
    bends = np.diff(np.eye(count), 2, axis=0) / (2.0 * max(typical, 0.1))
    robust = np.ones(len(wanted))
    positions = before
    for _ in range(8):
        scaled = np.sqrt(robust) / sigma
        system = np.vstack([rows * scaled[:, None], bends, np.ones((1, count))])
        side = np.concatenate([wanted * scaled, np.zeros(len(bends) + 1)])
        positions = np.linalg.lstsq(system, side, rcond=None)[0]
        off = np.abs(rows @ positions - wanted) / sigma
        robust = np.minimum(1.0, 1.5 / np.maximum(off, 1e-9))
    positions = np.maximum.accumulate(positions)
    covariance = np.linalg.pinv(system.T @ system)
    excess = max(1.0, float((robust * off**2).sum()) / max(len(wanted) - count + 1, 1))
    steps = np.diff(np.eye(count), axis=0)
    step_error = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", steps, covariance, steps) * excess, 0.0))
    step_error = np.hypot(step_error, 0.5 * _LEAST_ERROR_PX2 / np.maximum(steps @ positions, 0.5))
    return positions, np.array([max(step_error[max(i - 1, 0)], step_error[min(i, count - 2)]) for i in range(count)])


def _offsets(places: _Places, positions: Positions) -> tuple[Float[np.ndarray, " cells"], Float[np.ndarray, " cells"]]:
    """Return (what to add to the position that the focus index gives, standard error) of each cell."""
    steps = np.maximum(np.gradient(positions), 0.3)
    local = np.interp(places.index, np.arange(places.count), steps)
    start = np.interp(places.index, np.arange(places.count), positions)
    step = _WIDEST_OFFSET_STEPS * local / _REACH
    away = np.arange(-_REACH, _REACH + 1)[:, None] * step
    costs = _offset_costs(places, positions, start, away) + away**2 / (_WINDOW_SAMPLES * (_PRIOR_STEPS * local) ** 2)
    inside = np.clip(costs.argmin(axis=0), 1, 2 * _REACH - 1)
    before, at, after = (np.take_along_axis(costs, (inside + k)[None], axis=0)[0] for k in (-1, 0, 1))
    bend = np.maximum(before - 2.0 * at + after, 0.0)
    shift = np.where(bend > 1e-9, np.clip(0.5 * (before - after) / np.maximum(bend, 1e-9), -1.0, 1.0), 0.0)
    offsets, bends = (inside - _REACH + shift) * step, bend / step**2
    information = 0.5 * bends * _WINDOW_SAMPLES + 1e-9
    shape = places.shape
    trust = information.reshape(shape).astype(np.float32)
    summed = cv2.GaussianBlur((offsets.reshape(shape) * trust).astype(np.float32), (0, 0), _SPREAD_STEPS)
    smooth = summed / cv2.GaussianBlur(trust, (0, 0), _SPREAD_STEPS)
    return smooth.ravel().astype(np.float64), 1.0 / np.sqrt(information)


def _dense(
    places: _Places, positions: Positions, offset: Float[np.ndarray, " cells"], error: Float[np.ndarray, " cells"], focus_index: Plane
) -> tuple[Plane, Plane]:
    height, width = focus_index.shape
    shape = places.shape
    along = np.arange(places.count)
    fine = np.interp(focus_index, along, positions)
    moved = cv2.resize(offset.reshape(shape).astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    error_px = cv2.resize(error.reshape(shape).astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    return (fine + moved).astype(np.float32), error_px

"""Focus calibration of the stacks of a scaled scene, and the lens calibrations that follow from them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int

from capture.poses.lens_calibration import (
    CalibratedFocus,
    LensCalibration,
    focused_stack,
    lens_model_of,
    stated_distances_m,
    with_calibrated_focus,
)
from capture.poses.sparse_model import SparseModel, SparseView
from capture.scale.focus import FocusSample
from capture.scale.focus_calibration import FOCUS_SIGMA_DIOPTRE, WINDOW_PX, FocusFit, FocusStart, Plane, calibrate_focus, measure_blur
from capture.stacks.slice_files import stated_by_sentinel
from mrbokeh.images.color import luminance
from mrbokeh.optics.aperture import Aperture
from mrbokeh.stacks.focal_stack import METRES, FocalStack
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError

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

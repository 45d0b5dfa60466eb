"""Examination of a merged stack in one pass: looks at every slice, predicts it, compares, and keeps what gates, pictures and masks need."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from capture.report.exclusion import LEAST_CONFIDENCE, Disagreement, moving
from capture.report.findings import SliceFindings, StackFindings, focus_curve
from capture.report.gates import DEPTH_OFF_PX
from capture.report.picture_sharpness import PictureEvidence, PictureLook
from capture.report.registration_check import DisplacementEvidence
from capture.report.slice_fit import DepthCheck, DepthEvidence, Prediction, fit_slice, low_frequency_gain
from capture.report.stack_view import Reblur, StackView
from mrbokeh.images.color import luminance
from mrbokeh.images.image_metrics import psnr
from mrbokeh.system.console import track

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]

STEP_PX = 1.0
_WIDEST_BORDER = 0.1
_LEAST_JUDGED = 0.1
_DISC_RADII_PX = (0.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, np.inf)


@dataclass(frozen=True)
class Examination:
    """Findings, and the maps behind their shares: None where nothing can be predicted.

    moving: (H, W) at the width of the report. look: the all-in-focus picture beside its slices, at full size.
    """

    findings: StackFindings
    depth: DepthCheck | None
    moving: Mask | None
    look: PictureLook


Watch = Callable[[int, Rgb, Rgb], None]
"""Callback with the number of a slice, the slice and its prediction, while they are at hand."""


def examine(view: StackView, reblur: Reblur, watch: Watch | None = None) -> Examination:
    """Examine a stack. watch: is told each slice and its prediction. Raises InputError if the stack is not merged."""
    height, width = view.all_in_focus.shape[:2]
    found, disagreements, saturated, evidence = [], [], [], DepthEvidence()
    picture, places = PictureEvidence(view.stack.all_in_focus()), DisplacementEvidence()
    for index in track(range(len(view)), f"{view.stack.folder.name}: examine"):
        stored = view.stored(index)
        picture.add(stored.rgb, stored.camera_rgb, stored.masks.valid)
        places.add(view.slice_rgb(index), view.usable(index))
        saturated.append(view.saturated(index))
        of_slice, kept = _examine_slice(view, index, float(saturated[-1].mean()), reblur, evidence, watch)
        found.append(of_slice)
        if kept is not None:
            disagreements.append(kept)
    clipped = np.logical_or.reduce(saturated)
    disagreements = [
        replace(each, counted=each.counted & ~_lit_by(clipped, view.coc_px(index))) for index, each in enumerate(disagreements)
    ]
    depth = evidence.check() if view.is_explained else None
    judged = float(np.mean([each.counted.mean() for each in disagreements])) if disagreements else 0.0
    moved = None if depth is None or judged < _LEAST_JUDGED else moving(disagreements, depth.off_px)
    camera_rgb = view.stack.all_in_focus_camera_rgb()
    look = picture.look(view.stack.to_rec709(camera_rgb), camera_rgb)
    curve = focus_curve(view.focus_index, view.confidence, len(view))
    findings = StackFindings(
        stack=view.stack,
        size_px=(width, height),
        full_size_px=view.full_size_px,
        slices=tuple(found),
        curve=curve,
        depth_off_share=None if depth is None else depth.share_beyond(DEPTH_OFF_PX),
        moving_share=None if moved is None else float(moved.mean()),
        picture=look.findings,
        pairs=places.places(view.full_size_px[0] / width),
    )
    return Examination(findings, depth, moved, look)


def _examine_slice(
    view: StackView, index: int, saturated: float, reblur: Reblur, evidence: DepthEvidence, watch: Watch | None
) -> tuple[SliceFindings, Disagreement | None]:
    rgb, usable = view.slice_rgb(index), view.usable(index)
    gain = low_frequency_gain(rgb, view.all_in_focus, usable)
    if not view.is_explained:
        return SliceFindings(index, gain, saturated, float(usable.mean())), None
    prediction = predict(view, index, reblur)
    if watch is not None:
        watch(index, rgb, prediction.rgb)
    counted = usable & (view.confidence >= LEAST_CONFIDENCE) & _inside(prediction.coc_px)
    fit, remaining = fit_slice(rgb, prediction, counted)
    evidence.add(remaining, prediction, counted)
    residual, level, per_px = (luminance(each).astype(np.float16) for each in (remaining, prediction.rgb, prediction.per_px))
    findings = SliceFindings(
        index=index,
        gain=gain,
        saturated=saturated,
        counted=float(counted.mean()),
        largest_coc_px=float(np.abs(prediction.coc_px)[counted].max(initial=0.0)),
        psnr_db=psnr(prediction.rgb, rgb, mask=counted) if counted.any() else None,
        unblurred_db=psnr(view.all_in_focus, rgb, mask=counted) if counted.any() else None,
        fit=fit,
    )
    return findings, Disagreement(residual, level, per_px, usable & _inside(prediction.coc_px))


def predict(view: StackView, index: int, reblur: Reblur) -> Prediction:
    """Predict a slice by three renderings.

    Cheaper derivatives mislead the fit near the focus, on stacks of 960x640 whose gate is 0.6 px: those at half the
    resolution by up to 0.4 px of focus, differences to one side by 0.3 px.
    """
    coc_px = view.coc_px(index)
    rgb, less, more = (reblur(view.all_in_focus, coc_px + np.float32(step_px), view.aperture) for step_px in (0.0, -STEP_PX, STEP_PX))
    return Prediction(rgb=rgb, less=less, more=more, coc_px=coc_px, step_px=STEP_PX)


def _lit_by(clipped: Mask, coc_px: Plane) -> Mask:
    """Return pixels that get light of clipped ones: their predicted discs are too dark, and change between slices as if they moved."""
    lit, radii = np.zeros(clipped.shape, bool), 0.5 * np.abs(coc_px)
    for least, largest in pairwise(_DISC_RADII_PX):
        of_these = clipped & (radii >= least) & (radii < largest)
        if of_these.any():
            reach_px = float(radii[of_these].max()) + 1.0
            lit |= cv2.distanceTransform((~of_these).astype(np.uint8), cv2.DIST_L2, 5) <= reach_px
    return lit


def _inside(coc_px: Plane) -> Mask:
    """Return pixels that no light from beyond the picture reaches."""
    reach = int(min(0.5 * float(np.abs(coc_px).max()) + 2, _WIDEST_BORDER * min(coc_px.shape)))
    inside = np.zeros(coc_px.shape, bool)
    inside[reach : coc_px.shape[0] - reach, reach : coc_px.shape[1] - reach] = True
    return inside

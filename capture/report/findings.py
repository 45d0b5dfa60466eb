"""Findings of a stack, in numbers: all that gates, charts and report.json need, and their JSON.

The JSON has numbers that are read back exactly, or as `report.json` shows them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32

from capture.report.gates import exact
from capture.report.picture_sharpness import PictureFindings
from capture.report.registration_check import NeighbourDisplacement, RegistrationDrift, registration_drift
from capture.report.slice_fit import NAMES, Change, SliceFit
from capture.stacks.slice_files import stated_by_sentinel
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.stacks.guessed_metres import STATED_DISTANCE

_TRUSTED = 0.3
_AT_THE_END = 0.1
GAP = 1.6
"""A step larger than this many usual ones means that a slice is missing; a rail or a lens motor steps evenly to a few percent."""
_SAME = 0.2

Plane = Float32[np.ndarray, "height width"]
Number = Callable[[float | None], float | str | None]


@dataclass(frozen=True)
class FocusCurve:
    """Sharp pixels over the slices: whether the stack reaches from the nearest to the farthest thing.

    shares: of the pixels whose focus can be trusted, how many are sharpest in each slice. trusted: share of pixels that can be.
    beyond_near, beyond_far: shares of them whose focus lies at the very first and last slice, so that the true one may lie beyond.
    """

    shares: Float[np.ndarray, " slices"]
    trusted: float
    beyond_near: float
    beyond_far: float


@dataclass(frozen=True)
class FocusSpacing:
    """Spacing of the slices. focus_dioptres: in the order of the slices. usual_step: in dioptres. largest_step: in steps of its neighbours.

    gaps: indices of the slices after which one or more are missing. out_of_order: slices that go back. doubled: slices at the focus of
    the one before.
    """

    focus_dioptres: tuple[float, ...]
    usual_step: float
    largest_step: float
    gaps: tuple[int, ...]
    out_of_order: tuple[int, ...]
    doubled: tuple[int, ...]

    @property
    def is_even(self) -> bool:
        return not (self.gaps or self.out_of_order or self.doubled)


@dataclass(frozen=True)
class SliceFindings:
    """Findings of a slice. What has None as its default is so where nothing can be predicted.

    psnr_db: prediction against slice; unblurred_db: all-in-focus picture against slice (linear, clipped to 1, counted pixels).
    gain: brightness against the all-in-focus picture.
    """

    index: int
    gain: float
    saturated: float
    counted: float
    largest_coc_px: float | None = None
    psnr_db: float | None = None
    unblurred_db: float | None = None
    fit: SliceFit | None = None


@dataclass(frozen=True)
class StackFindings:
    """Findings of a merged stack at the width of the report.

    size_px, full_size_px: width and height of the pictures as examined and as stored. depth_off_share: of the pixels that tell, how many
    contradict depth by more than `gates.DEPTH_OFF_PX`. moving_share: of the picture. Both are None where nothing can be predicted.
    picture: the all-in-focus picture beside its slices, at full size. pairs: how neighbouring slices lie.
    """

    stack: FocalStack
    size_px: tuple[int, int]
    full_size_px: tuple[int, int]
    slices: tuple[SliceFindings, ...]
    curve: FocusCurve
    depth_off_share: float | None
    moving_share: float | None
    picture: PictureFindings
    pairs: tuple[NeighbourDisplacement, ...]

    @property
    def name(self) -> str:
        return self.stack.folder.name

    @cached_property
    def spacing(self) -> FocusSpacing | None:
        """Return the spacing; None where focus distances are not known."""
        if not self.stack.is_metric:
            return None
        calibrated = np.array([STATED_DISTANCE in each.metadata for each in self.stack.slices], bool)
        known = calibrated | ~stated_by_sentinel(self.stack)
        return focus_spacing([each for each in self.stack.focus_distances_m if each is not None], known)

    @cached_property
    def drift(self) -> RegistrationDrift | None:
        """Return the movements that registration found; None where the stack does not say how it was registered."""
        return registration_drift(self.stack, *self.full_size_px)


def focus_curve(focus_index: Plane, confidence: Plane, slices: int) -> FocusCurve:
    trusted = confidence >= _TRUSTED
    index = focus_index[trusted]
    if index.size == 0:
        return FocusCurve(np.zeros(slices), 0.0, 0.0, 0.0)
    counts = np.bincount(np.clip(np.round(index), 0, slices - 1).astype(int), minlength=slices)
    return FocusCurve(
        counts / index.size,
        float(trusted.mean()),
        float((index <= _AT_THE_END).mean()),
        float((index >= slices - 1 - _AT_THE_END).mean()),
    )


def focus_spacing(focus_distances_m: Sequence[float], known: Bool[np.ndarray, " slices"] | None = None) -> FocusSpacing:
    """Judge whether slices follow one another in order, none missing, none twice, close enough in dioptres (inf is allowed).

    A stack whose steps grow or shrink steadily is even too: each step is compared with its neighbours. known: where distances are; steps
    from and to the others are not judged. None: all of them.
    """
    dioptres = 1.0 / np.asarray(focus_distances_m, np.float64)
    told = np.ones(len(dioptres), bool) if known is None else known
    steps = np.where(told[1:] & told[:-1], np.diff(dioptres), np.nan)
    direction = np.sign(_median(steps)) or 1.0
    sizes = np.abs(steps)
    usual = _median(sizes)
    local = np.array([_around(sizes, i, usual) for i in range(len(sizes))])
    return FocusSpacing(
        focus_dioptres=tuple(float(each) for each in dioptres),
        usual_step=usual,
        largest_step=float(np.nanmax(sizes / np.maximum(local, 1e-12), initial=1.0)),
        gaps=tuple(int(i) for i in np.flatnonzero(sizes > GAP * local)),
        out_of_order=tuple(int(i) + 1 for i in np.flatnonzero((steps * direction < 0) & (sizes >= _SAME * local))),
        doubled=tuple(int(i) + 1 for i in np.flatnonzero(sizes < _SAME * local)),
    )


def _around(sizes: np.ndarray, index: int, usual: float) -> float:
    """Return the median step of up to two neighbours on either side, without the step itself."""
    near = [sizes[i] for i in range(max(0, index - 2), min(len(sizes), index + 3)) if i != index]
    return _median(near) if np.isfinite(near).any() else usual


def _median(values: Sequence[float] | np.ndarray) -> float:
    """Return the median of those that are known; 0 where none is."""
    known = np.asarray(values, np.float64)[np.isfinite(values)]
    return float(np.median(known)) if len(known) else 0.0


def slice_document(found: SliceFindings, number: Number) -> dict[str, Any]:
    changes = None
    if found.fit is not None:
        changes = {name: {"value": number(change.value), "error": number(change.error)} for name, change in found.fit.changes.items()}
    return {
        "index": found.index,
        "gain": number(found.gain),
        "saturated_share": found.saturated,
        "counted_share": found.counted,
        "largest_coc_px": found.largest_coc_px,
        "psnr_db": number(found.psnr_db),
        "unblurred_psnr_db": number(found.unblurred_db),
        "changes": changes,
    }


def findings_document(findings: StackFindings) -> dict[str, Any]:
    """Return all findings but the stack itself."""
    curve = findings.curve
    return {
        "size_px": list(findings.size_px),
        "full_size_px": list(findings.full_size_px),
        "slices": [slice_document(each, exact) for each in findings.slices],
        "curve": vars(curve) | {"shares": curve.shares.tolist()},
        "depth_off_share": findings.depth_off_share,
        "moving_share": findings.moving_share,
        "picture": picture_document(findings.picture, exact),
        "pairs": [pair_document(each, exact) for each in findings.pairs],
    }


def findings_from(document: dict[str, Any], stack: FocalStack) -> StackFindings:
    """Read what `findings_document` wrote; KeyError, TypeError or ValueError where it did not."""
    curve, size_px, full_size_px = document["curve"], document["size_px"], document["full_size_px"]
    return StackFindings(
        stack=stack,
        size_px=(int(size_px[0]), int(size_px[1])),
        full_size_px=(int(full_size_px[0]), int(full_size_px[1])),
        slices=tuple(_slice_from(each) for each in document["slices"]),
        curve=FocusCurve(**curve | {"shares": np.asarray(curve["shares"], np.float64)}),
        depth_off_share=document["depth_off_share"],
        moving_share=document["moving_share"],
        picture=_picture_from(document["picture"]),
        pairs=tuple(_pair_from(each) for each in document["pairs"]),
    )


def picture_document(found: PictureFindings, number: Number) -> dict[str, Any]:
    return {
        "unlike_share": number(found.unlike),
        "lost_share": number(found.lost),
        "flat_detail": number(found.flat),
        "largest": number(found.top),
        "largest_of_slices": number(found.slices_top),
        "seen_px": list(found.seen_px),
    }


def _picture_from(document: dict[str, Any]) -> PictureFindings:
    width, height = document["seen_px"]
    lost, flat = _number(document["lost_share"]), _number(document["flat_detail"])
    return PictureFindings(
        unlike=float(document["unlike_share"]),
        lost=lost,
        flat=flat,
        top=float(document["largest"]),
        slices_top=float(document["largest_of_slices"]),
        seen_px=(int(width), int(height)),
    )


def pair_document(found: NeighbourDisplacement, number: Number) -> dict[str, Any]:
    return {
        "first": found.first,
        "off_px": number(found.off_px),
        "error_px": number(found.error_px),
        "place_px": list(found.place_px),
        "parallax_px": number(found.parallax_px),
        "parallax_place_px": list(found.parallax_place_px),
    }


def _pair_from(document: dict[str, Any]) -> NeighbourDisplacement:
    (x, y), (far_x, far_y) = document["place_px"], document["parallax_place_px"]
    return NeighbourDisplacement(
        first=int(document["first"]),
        off_px=_number(document["off_px"]),
        error_px=float(document["error_px"]),
        place_px=(int(x), int(y)),
        parallax_px=float(document["parallax_px"]),
        parallax_place_px=(int(far_x), int(far_y)),
    )


def _slice_from(document: dict[str, Any]) -> SliceFindings:
    changes = document["changes"]
    return SliceFindings(
        index=document["index"],
        gain=float(document["gain"]),
        saturated=document["saturated_share"],
        counted=document["counted_share"],
        largest_coc_px=document["largest_coc_px"],
        psnr_db=_number(document["psnr_db"]),
        unblurred_db=_number(document["unblurred_psnr_db"]),
        fit=None
        if changes is None
        else SliceFit(**{name: Change(float(changes[name]["value"]), float(changes[name]["error"])) for name in NAMES}),
    )


def _number(value: float | str | None) -> float | None:
    return None if value is None else float(value)

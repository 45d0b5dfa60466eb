"""Choice of a side where two things at different depths are seen in one place: a web or the leaves behind it.

There the focus energy has two clear peaks along the slices. The focus map takes what fits its surroundings; who merges may prefer the near
or the far one. The window of the energy sees a thread from several pixels away, where there is nothing but what lies behind it: a pixel
takes the preferred slice only if that shows detail in the pixel itself, else the other one on the same condition, else nothing changes.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int

from capture.merging.all_in_focus import painted
from capture.merging.depth_from_focus import SURFACE_STEP
from capture.merging.focus_volume import FocusVolume, focus_energy
from capture.merging.merged_pictures import replaced_depth
from mrbokeh.images.camera_rgb import write_camera_rgb
from mrbokeh.images.exr_io import read_exr, write_exr
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.stacks.guessed_metres import is_near_first, metres_facts

_DROP = 0.7
"""E-folds by which the energy falls behind one peak and rises to the next: the slices between show half of what either shows."""
_LEAST_NOISE_FLOORS = 30.0
_WITHIN = 3.0
"""E-folds by which the two peaks may differ: less than a quarter of the contrast is what blurred rims reach."""
_SMOOTH_PX = 2.0
_FEWEST_PIXELS = 30
"""Noise of single pixels of the volume has peaks of its own; what crosses has neighbours."""
_OWN_WINDOW_PX, _WINDOW_PX = 1.0, 5.0
_OWN_SHARE = 0.5
"""The wide window is that in which peaks are looked for; texture has about as much in the narrow one, and a thread more."""
_GAP_PX = 5
PREFERRED = "preferred"
"""Key in a stack's metadata: the side that was asked for, the share of the picture that changed, and whether near is known."""

Side = Literal["near", "far"]
Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Labels = Int[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]


@dataclass(frozen=True)
class Preferred:
    """Pixels that show another slice now.

    where: (H, W) these pixels. index: (H, W) the slices of all pixels; a whole number where it changed.
    """

    where: Mask
    index: Plane


def with_preferred(
    merged: FocalStack,
    picture: Rgb,
    slices: Callable[[], Iterable[Rgb]],
    volume: FocusVolume,
    focus_index: Plane,
    rims: Mask,
    side: Side,
) -> tuple[FocalStack, Rgb]:
    """Return the stack and its picture with the preferred side where two things are sharp; writes all_in_focus.exr and depth.exr.

    merged: with a focus distance for every slice, by which the near side is told. slices: gives a fresh pass over the registered ones.
    focus_index: (H, W) what merging took. rims: (H, W) where energy is that of rims of lights.
    """
    first_is_near, sure = nearest_end(merged)
    preferred = preferred_places(slices(), volume, focus_index, first_is_near == (side == "near"), rims)
    record = {"side": side, "share": float(preferred.where.mean()), "first_is_near": first_is_near, "sure": sure}
    merged = replace(merged, metadata=merged.metadata | {PREFERRED: record})
    if not preferred.where.any():
        return merged, picture
    picture, part = blended(picture, slices(), preferred), read_exr(merged.depth_path)[0]
    confidence = part.channels["confidence"].astype(np.float32)
    channels = replaced_depth(merged, part.channels, preferred.index, confidence, preferred.where)
    write_camera_rgb(merged.all_in_focus_path, picture, merged.rec709_from_camera, half=False)
    write_exr(merged.depth_path, replace(part, channels=channels), compress=False)
    return merged, picture


def preferred_side(stack: FocalStack) -> Side | None:
    """Return the side that a merge was asked to prefer; None where it was not asked."""
    record: dict[str, Any] = stack.metadata.get(PREFERRED) or {}
    return record.get("side")


def preferred_lines(stack: FocalStack) -> list[str]:
    """Return the lines to print about the side that a merge preferred; none where none was asked for."""
    record: dict[str, Any] | None = stack.metadata.get(PREFERRED)
    if record is None:
        return []
    taken = f"{record['share']:.2%} of the picture changed, around things that cross" if record["share"] else ""
    lines = [f"--prefer {record['side']}: {taken or 'nothing changed, no place shows the other of two things in focus'}"]
    if record["share"] and not record["sure"]:
        end, other = "first" if record["first_is_near"] else "last", "far" if record["side"] == "near" else "near"
        lines.append(
            f"--prefer {record['side']}: that the {end} slice is the nearest is a guess; if it is the farthest, use --prefer {other}"
        )
    return lines


def preferred_places(registered: Iterable[Rgb], volume: FocusVolume, focus_index: Plane, from_first: bool, excluded: Mask) -> Preferred:
    """Return where one of two clear peaks takes the place of what was taken. Registered slices are read once.

    from_first: the peak that is nearer to the first slice is preferred, else the one nearer to the last. excluded: (H, W) where peaks are
    rims of lights.
    """
    ends = (from_first, not from_first)
    wanted, other = (volume.enlarged(first_of_two_peaks(volume.energies, end).astype(np.float32), 0.0) for end in ends)
    has_wanted, has_other = np.zeros(volume.shape, bool), np.zeros(volume.shape, bool)
    for index, rgb in enumerate(registered):
        is_wanted, is_other = wanted == index, other == index
        if is_wanted.any() or is_other.any():
            detail = _has_the_detail(rgb)
            has_wanted |= detail & is_wanted
            has_other |= detail & is_other
    label = np.where(has_wanted, wanted, np.where(has_other, other, np.float32(-1.0)))
    where = (label >= 0) & (np.abs(label - focus_index) > SURFACE_STEP) & ~excluded
    return Preferred(where, np.where(where, label, focus_index).astype(np.float32))


def blended(picture: Rgb, registered: Iterable[Rgb], preferred: Preferred) -> Rgb:
    """Blend the preferred slices into a picture; where nothing is preferred nearby it stays bit for bit."""
    where = preferred.where
    shared = ((rgb, (where & (preferred.index == index)).astype(np.float32)) for index, rgb in enumerate(registered))
    return painted(picture, shared, where.astype(np.float32))


def first_of_two_peaks(energies: Float32[np.ndarray, "slices height width"], from_first: bool) -> Labels:
    """Return the slice of the first clear peak that a second one follows, -1 where there is one peak or none."""
    order = range(len(energies)) if from_first else range(len(energies) - 1, -1, -1)
    shape, clear = energies.shape[1:], np.log1p(_LEAST_NOISE_FLOORS)
    peak, second, valley = (np.full(shape, start, np.float32) for start in (-1.0, -1.0, np.inf))
    label, left = np.full(shape, -1), np.zeros(shape, bool)
    # At every pixel: up to a peak (label), down until it is left, through the valley and up again.
    for index in order:
        height = np.log1p(cv2.GaussianBlur(energies[index], (0, 0), _SMOOTH_PX))
        rises = ~left & (height > peak)
        label[rises], peak[rises] = index, height[rises]
        left |= (peak > clear) & (height < peak - _DROP)
        valley[left] = np.minimum(valley, height)[left]
        climbs = left & (height > np.maximum(valley + _DROP, clear))
        second[climbs] = np.maximum(second, height)[climbs]
    double = (second > 0) & (np.abs(second - peak) < _WITHIN)
    return np.where(_without_specks(double), label, -1)


def nearest_end(merged: FocalStack) -> tuple[bool, bool]:
    """Return whether the first slice is focused nearer than the last, and whether that is known and not guessed."""
    return is_near_first(merged), bool((metres_facts(merged).get("gauge") or {}).get("near_first_sure", True))


def _without_specks(found: Mask) -> Mask:
    opened = cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, parts, facts, _ = cv2.connectedComponentsWithStats(opened)
    return (opened > 0) & (facts[:, cv2.CC_STAT_AREA] >= _FEWEST_PIXELS)[parts]


def _has_the_detail(rgb: Rgb) -> Mask:
    """Return where detail lies in the pixel itself and not only beside it; small gaps within are filled."""
    own = focus_energy(rgb, _OWN_WINDOW_PX) >= _OWN_SHARE * focus_energy(rgb, _WINDOW_PX)
    return cv2.morphologyEx(own.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((_GAP_PX, _GAP_PX), np.uint8)) > 0

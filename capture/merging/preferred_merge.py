"""The side that was preferred, put into a merged stack: picture, depth.exr and what is remembered of it."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32

from capture.merging.focus_volume import FocusVolume
from capture.merging.preferred_side import Side, blended, preferred_places
from capture.merging.replaced_places import replaced_depth
from mrbokeh.images.camera_rgb import write_camera_rgb
from mrbokeh.images.exr_io import read_exr, write_exr
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.stacks.guessed_metres import is_near_first, metres_facts

PREFERRED = "preferred"
"""Key in a stack's metadata: the side that was asked for, the share of the picture that changed, and whether near is known."""

Rgb = Float32[np.ndarray, "height width 3"]


@dataclass(frozen=True)
class Seen:
    """What merging has seen: the energies, the focus index that it took (H, W), and where energy is that of rims of lights."""

    volume: FocusVolume
    focus_index: Float32[np.ndarray, "height width"]
    rims: Bool[np.ndarray, "height width"]


def with_preferred(merged: FocalStack, picture: Rgb, slices: Callable[[], Iterable[Rgb]], seen: Seen, side: Side) -> tuple[FocalStack, Rgb]:
    """Return the stack and its picture with the preferred side in places where two things are sharp; all_in_focus.exr and depth.exr too.

    merged: with a focus distance for every slice, by which the near side is told. slices: gives a fresh pass over the registered ones.
    """
    first_is_near, sure = nearest_end(merged)
    preferred = preferred_places(slices(), seen.volume, seen.focus_index, first_is_near == (side == "near"), seen.rims)
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


def nearest_end(merged: FocalStack) -> tuple[bool, bool]:
    """Whether the first slice is focused nearer than the last, and whether that is known and not guessed."""
    return is_near_first(merged), bool((metres_facts(merged).get("gauge") or {}).get("near_first_sure", True))


def preferred_side(stack: FocalStack) -> Side | None:
    """Which side a merge was asked to prefer; None where it was not asked."""
    record: dict[str, Any] = stack.metadata.get(PREFERRED) or {}
    return record.get("side")


def preferred_lines(stack: FocalStack) -> list[str]:
    """What to tell people of the side that a merge preferred; nothing where none was asked for."""
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

"""A merged stack retouched by hand: where a mask is white, picture and depth are those of one slice, without merging anew."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32

from capture.merging.all_in_focus import BANDS, painted
from capture.merging.merged_pictures import readable_names, write_readable_pictures
from capture.merging.replaced_places import replaced_depth
from capture.merging.retouch_mask import read_mask
from mrbokeh.figures.stack_pictures import SHEET_NAME, orientation_of, write_merge_sheet
from mrbokeh.images.camera_rgb import write_camera_rgb
from mrbokeh.images.exr_io import read_exr, write_exr
from mrbokeh.stacks.focal_stack import FocalStack, find_focal_stacks, write_focal_stack
from mrbokeh.system.atomic_files import require_safe_outputs
from mrbokeh.system.errors import InputError

RETOUCHES = "retouches"
"""Key in a stack's metadata: which slice was put where a mask is white, in the order of the calls (slice, source, mask, share)."""
PAINTED_CONFIDENCE = 0.5
"""Confidence of a depth that a mask states: it is that of the slice, while the surface under a coarse mask may lean."""
_HALF = 0.5

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]


@dataclass(frozen=True)
class Retouch:
    """A slice and where it is painted in.

    mask: the file as the user named it. share: (H, W) how much of the slice each pixel takes, in 0 to 1."""

    index: int
    mask: Path
    share: Plane


def retouch_scene(scene: Path, slices: Sequence[int], masks: Sequence[Path]) -> FocalStack:
    """Put slices where their masks are white into the one stack of a scene, and write its pictures anew; stack.json is written last.

    All is read and checked before anything is written.
    """
    stack = _only_merged(scene)
    if len(slices) != len(masks):
        raise InputError(f"expected a --mask for each --from-slice, got {len(slices)} of --from-slice and {len(masks)} of --mask")
    require_safe_outputs(_outputs(stack), masks, overwrite=True)
    wanted = [_retouch(stack, index, mask) for index, mask in zip(slices, masks, strict=True)]
    picture, part = stack.all_in_focus_camera_rgb(), read_exr(stack.depth_path)[0]
    channels = dict(part.channels)
    for each in wanted:
        picture = painted(picture, [(stack.slice_camera_rgb(each.index), each.share)], each.share, bands_of(each.share))
        white = each.share >= _HALF
        index, confidence = (np.full(white.shape, value, np.float32) for value in (each.index, PAINTED_CONFIDENCE))
        channels = replaced_depth(stack, channels, index, confidence, white)
    changed = replace(stack, metadata=stack.metadata | {RETOUCHES: [*retouches_of(stack), *(_record(stack, each) for each in wanted)]})
    write_camera_rgb(stack.all_in_focus_path, picture, stack.rec709_from_camera, half=False)
    write_exr(stack.depth_path, replace(part, channels=channels), compress=False)
    write_readable_pictures(changed, picture)
    write_focal_stack(changed)
    write_merge_sheet(changed)
    return changed


def _outputs(stack: FocalStack) -> list[Path]:
    return [stack.all_in_focus_path, stack.depth_path, *(stack.folder / name for name in (*readable_names(stack), SHEET_NAME))]


def retouches_of(stack: FocalStack) -> list[dict[str, object]]:
    return list(stack.metadata.get(RETOUCHES) or [])


def retouches_text(stack: FocalStack) -> str:
    """Say which slices were painted in by which masks; empty where none was."""
    return ", ".join(f"slice {each['slice']} by {each['mask']}" for each in retouches_of(stack))


def stacks_before(scene: Path) -> list[FocalStack]:
    """Return the stacks of a scene as they are before a command works on them; nothing where it has none, which the command says itself."""
    try:
        return find_focal_stacks(scene)
    except InputError:
        return []


def retouched_stacks(stacks: Sequence[FocalStack]) -> dict[Path, str]:
    """Return what was painted into stacks, by their folders."""
    return {stack.folder: text for stack in stacks if (text := retouches_text(stack))}


def bands_of(share: Plane) -> int:
    """Return how many bands fit into what is white: through a stroke that is narrower than a band, what it covers would shine."""
    inside = np.pad((share >= _HALF).astype(np.uint8), 1)
    radius_px = float(cv2.distanceTransform(inside, cv2.DIST_L2, 3).max())
    return int(np.clip(np.log2(max(radius_px, 1.0)), 0, BANDS))


def _only_merged(scene: Path) -> FocalStack:
    stacks = find_focal_stacks(scene)
    if len(stacks) > 1:
        raise InputError(
            f"{scene} has {len(stacks)} stacks: --from-slice needs the folder of the one to retouch, such as {stacks[0].folder}"
        )
    if not stacks[0].merged:
        raise InputError(f"{stacks[0].folder} is not merged yet: run `mrbokeh capture merge` on it before --from-slice")
    return stacks[0]


def _retouch(stack: FocalStack, index: int, path: Path) -> Retouch:
    if not 0 <= index < len(stack):
        raise InputError(f"--from-slice: {stack.folder} has slices 0 to {len(stack) - 1} (as stack.json lists them), got {index}")
    valid = stack.slice_masks(index).valid
    share = read_mask(path, (valid.shape[0], valid.shape[1]), orientation_of(stack))
    if not (share > 0).any():
        raise InputError(f"{path} is black everywhere: paint white what slice {index} is to give")
    share = np.where(valid, share, np.float32(0.0))
    if not (share > 0).any():
        raise InputError(f"{path} is white only where slice {index}, laid on the others, has no data: choose another slice there")
    return Retouch(index, path, share)


def _record(stack: FocalStack, each: Retouch) -> dict[str, object]:
    source = stack.slices[each.index].metadata.get("source", stack.slices[each.index].path)
    return {"slice": each.index, "source": source, "mask": each.mask.name, "share": float(each.share.mean())}

"""Merged stacks retouched by hand: where a mask is white, picture and depth are those of one slice, without merging anew."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32

from capture.merging.all_in_focus import BANDS, painted
from capture.merging.merged_pictures import readable_names, replaced_depth, write_readable_pictures
from mrbokeh.figures.stack_pictures import SHEET_NAME, orientation_of, write_merge_sheet
from mrbokeh.images.camera_rgb import write_camera_rgb
from mrbokeh.images.exif import as_stored, stored_orientation, upright
from mrbokeh.images.exr_io import read_exr, write_exr
from mrbokeh.images.image_io import require_suffix
from mrbokeh.images.picture_codec import stored_pixels
from mrbokeh.stacks.focal_stack import FocalStack, find_focal_stacks, write_focal_stack
from mrbokeh.system.atomic_files import require_safe_outputs
from mrbokeh.system.errors import InputError, require_file

MASK_SUFFIXES = (".png", ".tif", ".tiff", ".exr")
_ALPHA, _COLOURS = 3, 3
_PAINTED = (0.1, 0.9)
_LARGEST_UNPAINTED = 0.6
"""Share of pixels that are neither black nor white: soft brushes leave rims, a photograph is nearly all between."""
RETOUCHES = "retouches"
"""Key in a stack's metadata: which slice was put where a mask is white, in the order of the calls (slice, source, mask, share)."""
PAINTED_CONFIDENCE = 0.5
"""Confidence of a depth that a mask states: it is that of the slice, while the surface under a coarse mask may lean."""
_HALF = 0.5

Plane = Float32[np.ndarray, "height width"]
Rgb = Float32[np.ndarray, "height width 3"]


@dataclass(frozen=True)
class Retouch:
    """A slice and where it is painted in.

    mask: the file as the user named it. share: (H, W) of the slice in each pixel, 0 to 1.
    """

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
    pictures = [stack.folder / name for name in (*readable_names(stack), SHEET_NAME)]
    require_safe_outputs([stack.all_in_focus_path, stack.depth_path, *pictures], masks, overwrite=True)
    wanted = [_retouch(stack, index, mask) for index, mask in zip(slices, masks, strict=True)]
    picture, part = stack.all_in_focus_camera_rgb(), read_exr(stack.depth_path)[0]
    channels = dict(part.channels)
    for each in wanted:
        picture = painted(picture, [(stack.slice_camera_rgb(each.index), each.share)], each.share, bands_of(each.share))
        white = each.share >= _HALF
        index, confidence = (np.full(white.shape, value, np.float32) for value in (each.index, PAINTED_CONFIDENCE))
        channels = replaced_depth(stack, channels, index, confidence, white)
    listed = retouches_of(stack)
    for record in (_record(stack, each) for each in wanted):
        listed = [*(each for each in listed if each != record), record]
    changed = replace(stack, metadata=stack.metadata | {RETOUCHES: listed})
    write_camera_rgb(stack.all_in_focus_path, picture, stack.rec709_from_camera, half=False)
    write_exr(stack.depth_path, replace(part, channels=channels), compress=False)
    write_readable_pictures(changed, picture)
    write_focal_stack(changed)
    write_merge_sheet(changed)
    return changed


def retouches_of(stack: FocalStack) -> list[dict[str, object]]:
    return list(stack.metadata.get(RETOUCHES) or [])


def retouches_text(stack: FocalStack) -> str:
    """Say which slices were painted in by which masks; empty where none was."""
    return ", ".join(f"slice {each['slice']} by {each['mask']}" for each in retouches_of(stack))


def retouched_stacks(stacks: Sequence[FocalStack]) -> dict[Path, str]:
    """Return what was painted into stacks, by their folders."""
    return {stack.folder: text for stack in stacks if (text := retouches_text(stack))}


def stacks_before(scene: Path) -> list[FocalStack]:
    """Return the stacks of a scene before a command works on them; none where it has none, which the command says itself."""
    try:
        return find_focal_stacks(scene)
    except InputError:
        return []


def bands_of(share: Plane) -> int:
    """Return how many bands fit into what is white: in a stroke that is narrower than a band, what it covers would shine through."""
    inside = np.pad((share >= _HALF).astype(np.uint8), 1)
    radius_px = float(cv2.distanceTransform(inside, cv2.DIST_L2, 3).max())
    return int(np.clip(np.log2(max(radius_px, 1.0)), 0, BANDS))


def read_mask(path: Path, shape: tuple[int, int], orientation: int) -> Plane:
    """Return how white each pixel is, 0 to 1, as the sensor saw it. shape: (H, W) there; orientation: what brings that upright, by EXIF.

    A mask is of the size of the upright picture or of that of the sensor. Where these are the same, PNG and TIFF stand upright and EXR
    does not, as the pictures of a stack do. What is transparent is black.
    """
    require_suffix(path, MASK_SUFFIXES, "--mask")
    require_file(path, "a picture for --mask")
    is_exr = path.suffix.lower() == ".exr"
    white = _of_exr(path) if is_exr else upright(_of_codes(path), stored_orientation(path))
    if not np.isfinite(white).all():
        raise InputError(f"{path}: {int((~np.isfinite(white)).sum())} pixels are NaN or infinite: paint the mask from 0 (black) to 1")
    white = np.clip(white, 0.0, 1.0).astype(np.float32)
    between = float(((white > _PAINTED[0]) & (white < _PAINTED[1])).mean())
    if between > _LARGEST_UNPAINTED:
        raise InputError(
            f"{path}: {between:.0%} of it is neither black nor white: expected white strokes on black, not the photograph itself"
        )
    upright_shape = upright(np.empty(shape, np.bool_), orientation).shape
    if white.shape == upright_shape and not (is_exr and white.shape == shape):
        return as_stored(white, orientation)
    if white.shape != shape:
        size, expected = (f"{each[1]} x {each[0]}" for each in (white.shape, upright_shape))
        raise InputError(f"{path} has {size} px, but the stack's pictures have {expected} px: paint the mask over all_in_focus.png")
    return white


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


def _of_codes(path: Path) -> Plane:
    pixels = stored_pixels(path)
    if pixels.dtype.kind != "f" and pixels.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path} stores {pixels.dtype}: expected a mask of 8 or 16 bits, or of float")
    top = np.float32(1.0 if pixels.dtype.kind == "f" else np.iinfo(pixels.dtype).max)
    shares = pixels.astype(np.float32) / top
    if shares.ndim == 2:
        return shares
    white = shares[..., :_COLOURS].mean(axis=2)
    return np.asarray(white * shares[..., _ALPHA] if shares.shape[2] > _ALPHA else white, np.float32)


def _of_exr(path: Path) -> Plane:
    """Return the colour, which EXR has multiplied by alpha already, else the only channel."""
    part = read_exr(path)[0]
    if set("RGB") <= part.channels.keys():
        return np.asarray(part.stacked("RGB").mean(axis=2), np.float32)
    if len(part.channels) > 1 and "Y" not in part.channels:
        raise InputError(f"{path}: expected a mask in R, G, B, in Y or in one channel, but it has {', '.join(sorted(part.channels))}")
    return np.asarray(part.channels.get("Y", next(iter(part.channels.values()))), np.float32)

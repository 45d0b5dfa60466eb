"""Pictures of a merged focal stack for people to look at."""

from collections import Counter
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Shaped, UInt8

from mrbokeh.images.color import srgb_to_linear
from mrbokeh.images.exif import known_orientation, upright
from mrbokeh.images.image_io import WIDEST_PX, SheetRow, write_contact_sheet, write_preview
from mrbokeh.images.picture_codec import codes_of, write_stored
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.stacks.guessed_metres import unit_of

SHEET_NAME = "merge.png"
TRUSTED = 0.3
_LEAST_TRUSTED = 0.05
_LEAST_COLOUR = np.float32(0.25)
_GREY = np.float32(127.5)
_COLOURS = (18, 240)
"""First and last of the 256 colours of the map that are taken, as its ends are nearly black."""

Plane = Float32[np.ndarray, "height width"]
Rgb = Float32[np.ndarray, "height width 3"]
Rgb8 = UInt8[np.ndarray, "height width 3"]


def write_merge_sheet(stack: FocalStack, camera_rgb: Rgb | None = None, depth_rgb8: Rgb8 | None = None) -> Path:
    """Write merge.png into the folder of the stack: some slices, the all-in-focus picture and the depth side by side.

    camera_rgb: the all-in-focus picture as it is stored. depth_rgb8: `depth_codes`. What is None is read.
    """
    slices = {_slice_text(stack, index): _small(stack.slice_camera_rgb(index)) for index in shown_slices(stack)}
    slices["all in focus"] = _small(stack.all_in_focus_camera_rgb() if camera_rgb is None else camera_rgb)
    depth = _small(depth_codes(stack) if depth_rgb8 is None else depth_rgb8)
    pictures = {caption: stack.to_rec709(rgb) for caption, rgb in slices.items()} | {"depth": _shown_alike(depth)}
    path = stack.folder / SHEET_NAME
    write_contact_sheet(path, [SheetRow(stack.folder.name, pictures)])
    return path


def _small(picture: Shaped[np.ndarray, "height width 3"]) -> Shaped[np.ndarray, "small_height small_width 3"]:
    """Return a picture no wider than a sheet shows it."""
    import cv2

    height, width = picture.shape[:2]
    if width <= WIDEST_PX:
        return picture
    return cv2.resize(picture, (WIDEST_PX, round(height * WIDEST_PX / width)), interpolation=cv2.INTER_AREA)


def write_stack_pictures(stack: FocalStack, out: Path) -> list[tuple[Path, str]]:
    """Write some slices, the all-in-focus picture and the depth at full size. Returns (file, caption) of each."""
    pictures = [(stack.slice_rgb(index), f"slice {index}{_focus_text(stack, index)}", f"slice_{index}") for index in shown_slices(stack)]
    pictures.append((stack.all_in_focus(), "all in focus", "all_in_focus"))
    pictures.append((depth_picture(stack), "depth: near is red, far is blue; grey where it is a guess", "depth"))
    written = []
    for rgb, caption, name in pictures:
        path = out / f"{stack.folder.name}_{name}.png"
        write_preview(path, rgb)
        written.append((path, caption))
    return written


def write_upright_png(path: Path, rgb: Rgb, stack: FocalStack) -> None:
    """Write a picture of the stack in 8 bits of sRGB, nothing tone-mapped, as its cameras' orientation says."""
    write_stored(path, upright(codes_of(rgb, np.uint8, "srgb"), orientation_of(stack)))


def orientation_of(stack: FocalStack) -> int:
    """Return EXIF's number that most slices state (a camera that looks straight down changes its mind)."""
    stated = Counter(known_orientation(each.metadata.get("orientation")) for each in stack.slices)
    return stated.most_common(1)[0][0]


def shown_slices(stack: FocalStack) -> list[int]:
    """Return the nearest, a middle and the farthest slice."""
    return sorted({0, len(stack) // 2, len(stack) - 1})


def depth_picture(stack: FocalStack) -> Rgb:
    """Return `depth_codes` as scene-linear light, dimmed a little so that tone mapping for people leaves it unchanged."""
    return _shown_alike(depth_codes(stack))


def _shown_alike(codes: Rgb8) -> Rgb:
    return 0.8 * srgb_to_linear(codes.astype(np.float32) / 255.0)


def depth_codes(stack: FocalStack) -> UInt8[np.ndarray, "height width 3"]:
    """Return depth (dioptres, or the focus index) as `nearness_codes`."""
    depth, confidence = stack.depth_planes("Z" if stack.is_metric else "focus_index", "confidence")
    return nearness_codes((1.0 / depth if stack.is_metric else -depth).astype(np.float32), confidence)


def nearness_codes(nearness: Plane, confidence: Plane) -> UInt8[np.ndarray, "height width 3"]:
    """Return nearness in sRGB colours from near (red) to far (blue), grey where it is a guess.

    The scale runs from the 1st to the 99th percentile of what is trusted, or of all where that is little.
    """
    import cv2

    trusted = nearness[confidence >= TRUSTED]
    low, high = np.percentile(trusted if trusted.size > _LEAST_TRUSTED * nearness.size else nearness, [1, 99])
    dark, bright = _COLOURS
    level = cv2.convertScaleAbs(np.clip(nearness - low, 0.0, high - low), alpha=(bright - dark) / max(float(high - low), 1e-9), beta=dark)
    colours = cv2.cvtColor(cv2.applyColorMap(level, cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    trust = np.clip(confidence[..., None] / np.float32(TRUSTED), _LEAST_COLOUR, 1.0).astype(np.float32)
    return np.rint(_GREY + trust * (colours.astype(np.float32) - _GREY)).astype(np.uint8)


def _slice_text(stack: FocalStack, index: int) -> str:
    """Return the number of a slice, by which retouching and compositing know it, its focus, and the photograph that it was."""
    source = stack.slices[index].metadata.get("source")
    return f"slice {index}{_focus_text(stack, index)}" + (f", {Path(source).name}" if source else "")


def _focus_text(stack: FocalStack, index: int) -> str:
    distance_m = stack.slices[index].focus_distance_m
    return "" if distance_m is None else f", focused at {distance_m:.3g} {unit_of(stack)}"

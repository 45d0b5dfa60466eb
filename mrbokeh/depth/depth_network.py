"""Depth from one picture by a network that the user brings (.onnx), such as MiDaS (Ranftl et al. 2020) or Depth Anything.

The network's input tells its layout and size; what the file cannot say stands in a JSON of its name beside it (model.onnx: model.json).
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from mrbokeh.depth.depth_map import DepthMap, DepthSettings
from mrbokeh.images.color import linear_to_srgb
from mrbokeh.system.atomic_files import read_json
from mrbokeh.system.errors import InputError

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Shown = Float32[np.ndarray, "rows columns 3"]
Given = Float32[np.ndarray, "rows columns"]

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class NetworkInput:
    """Input that a depth network expects: sRGB codes in [0, 1], less mean, over std, in its size.

    short_side_px, multiple_px: of networks that take any size. fit: "stretch" to a fixed size, or "pad" (whole picture, mirrored beyond
    its edges). channels: "RGB" or "BGR".
    """

    mean: tuple[float, ...] = IMAGENET_MEAN
    std: tuple[float, ...] = IMAGENET_STD
    short_side_px: int = 518
    multiple_px: int = 14
    fit: str = "stretch"
    channels: str = "RGB"
    output: str | None = field(default=None)

    def __post_init__(self) -> None:
        if len(self.mean) != 3 or len(self.std) != 3 or min(self.std) <= 0 or self.fit not in ("stretch", "pad"):
            raise InputError(f"expected mean and std of three colours and fit 'stretch' or 'pad', got {self}")
        if sorted(self.channels) != ["B", "G", "R"] or min(self.short_side_px, self.multiple_px) < 1:
            raise InputError(f"expected channels 'RGB' or 'BGR' and sizes above 0, got {self}")


def read_network_input(model: Path) -> NetworkInput:
    """Read the JSON beside the network, if there is one."""
    sidecar = model.with_suffix(".json")
    if not sidecar.is_file():
        return NetworkInput()
    values: dict[str, Any] = read_json(sidecar, "what a depth network wants")
    try:
        stated: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
        return NetworkInput(**stated)
    except TypeError:
        known = ", ".join(NetworkInput.__dataclass_fields__)
        raise InputError(f"{sidecar}: expected entries out of {known}, got {', '.join(values)}") from None


def network_depth(model: Path, photo_rgb: Rgb, settings: DepthSettings) -> DepthMap:
    """Return the network's depth at its own size, without padding."""
    given = predicted(model, photo_rgb, read_network_input(model))
    everywhere = np.ones(given.shape, bool)
    if settings.model_gives == "metric":
        return DepthMap(np.where(given > 0, given, np.float32(np.inf)), everywhere, f"{model.name}, metres")
    if settings.known:
        return DepthMap.of_dioptres(_fitted(given, photo_rgb, settings), everywhere, f"{model.name}, fitted to known distances")
    if settings.near_far_m is None:
        raise InputError(
            f"{model} gives depth without a scale: state the nearest and farthest distance with --disparity NEAR:FAR, or two known ones "
            f"with --known X,Y,METRES, or --depth-model-gives metric if it gives metres"
        )
    low, high = float(given.min()), float(given.max())
    levels = ((given - low) / max(high - low, 1e-12)).astype(np.float32)
    return DepthMap.of_levels(levels, settings.near_far_m, everywhere, model.name)


def _fitted(given: Given, photo_rgb: Rgb, settings: DepthSettings) -> Given:
    """Fit 1 / depth = a given + b through the known distances (least squares if there are more than two)."""
    height, width = photo_rgb.shape[:2]
    for each in settings.known:
        if not (0 <= each.x_px < width and 0 <= each.y_px < height):
            raise InputError(f"the known distance at pixel {each.x_px:g},{each.y_px:g} lies outside the photograph of {width}x{height} px")
    rows, columns = given.shape
    seen = np.array([given[int(each.y_px * rows / height), int(each.x_px * columns / width)] for each in settings.known], np.float64)
    if len(seen) < 2 or np.ptp(seen) <= 1e-6 * max(float(np.ptp(given)), 1e-12):
        raise InputError("expected two known distances at places that the network sees at different depths: give --known twice")
    slope, offset = np.polyfit(seen, [1.0 / each.depth_m for each in settings.known], 1)
    if slope <= 0:
        raise InputError(
            "the known distances say that what the network takes for near is far: does it give metric depth, or are they swapped?"
        )
    return (slope * given + offset).astype(np.float32)


def predicted(model: Path, photo_rgb: Rgb, wants: NetworkInput) -> Given:
    """Return what the network gives for a photograph (linear), at the size in which it saw the picture."""
    from mrbokeh.renderers.onnx_sessions import open_session

    session = open_session(model)
    socket = session.get_inputs()[0]
    layout = _layout(socket.shape, model)
    size = _size(socket.shape, layout, photo_rgb, wants)
    seen, cut = _fitted_in(np.clip(linear_to_srgb(photo_rgb), 0.0, 1.0), size, wants)
    normalised = ((seen[..., ["RGB".index(c) for c in wants.channels]] - np.array(wants.mean)) / np.array(wants.std)).astype(np.float32)
    batch = normalised.transpose(2, 0, 1)[None] if layout == "NCHW" else normalised[None]
    dtype = np.float16 if socket.type == "tensor(float16)" else np.float32
    given = session.run(None if wants.output is None else [wants.output], {socket.name: batch.astype(dtype)})[0]
    plane = np.squeeze(np.asarray(given, np.float32))
    if plane.ndim != 2:
        raise InputError(
            f"{model}: expected one plane of depth, got an output of shape {np.shape(given)}: name it as 'output' in {model.stem}.json"
        )
    if not np.isfinite(plane).all():
        raise InputError(f"{model} gave NaN or infinity: does it want another mean and std (in {model.stem}.json)?")
    return np.ascontiguousarray(_cut(plane, cut, size))


def _layout(shape: Any, model: Path) -> str:
    if len(shape) == 4 and shape[1] == 3:
        return "NCHW"
    if len(shape) == 4 and shape[3] == 3:
        return "NHWC"
    raise InputError(f"{model}: expected a network that takes one picture (1, 3, H, W) or (1, H, W, 3), got an input of shape {shape}")


def _size(shape: Any, layout: str, photo_rgb: Rgb, wants: NetworkInput) -> tuple[int, int]:
    """Return (width, height) in which the network sees the picture: a fixed one, or the short side as wanted, in whole multiples."""
    fixed = shape[2:4] if layout == "NCHW" else shape[1:3]
    height, width = photo_rgb.shape[:2]
    shrink = wants.short_side_px / min(height, width)
    rows, columns = (max(1, round(side * shrink / wants.multiple_px)) * wants.multiple_px for side in (height, width))
    return (fixed[1] if isinstance(fixed[1], int) else columns), (fixed[0] if isinstance(fixed[0], int) else rows)


def _fitted_in(codes: Rgb, size: tuple[int, int], wants: NetworkInput) -> tuple[Shown, tuple[int, int, int, int]]:
    """Return the picture at the network's size, and the rows and columns (top, bottom, left, right) that are picture and not padding."""
    import cv2

    (height, width), (columns, rows) = codes.shape[:2], size
    if wants.fit == "stretch":
        return _resized(codes, size), (0, rows, 0, columns)
    scale = min(columns / width, rows / height)
    inner = (min(columns, max(1, round(width * scale))), min(rows, max(1, round(height * scale))))
    left, top = (columns - inner[0]) // 2, (rows - inner[1]) // 2
    beyond = (top, rows - inner[1] - top, left, columns - inner[0] - left)
    return cv2.copyMakeBorder(_resized(codes, inner), *beyond, cv2.BORDER_REFLECT), (top, top + inner[1], left, left + inner[0])


def _resized(codes: Rgb, size: tuple[int, int]) -> Shown:
    import cv2

    if codes.shape[1::-1] == size:
        return codes
    shrinks = size[0] < codes.shape[1]
    return np.clip(cv2.resize(codes, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC), 0.0, 1.0)


def _cut(plane: Plane, cut: tuple[int, int, int, int], size: tuple[int, int]) -> Given:
    """Cut padding off; networks that give a coarser map than they see are cut in proportion."""
    down, across = plane.shape[0] / size[1], plane.shape[1] / size[0]
    top, bottom, left, right = round(cut[0] * down), round(cut[1] * down), round(cut[2] * across), round(cut[3] * across)
    return plane[top:bottom, left:right]

"""Plate: the photograph that virtual objects go into, with what is known of its depth, lens and camera."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.camera import Camera
from mrbokeh.capture_bundle import CaptureBundle
from mrbokeh.errors import InputError
from mrbokeh.exr_io import read_exr
from mrbokeh.focal_stack import FILE_NAME, read_focal_stack
from mrbokeh.image_io import read_image
from mrbokeh.lens import Lens

_DEPTH_NAMES = ("Z", "depth.Z", "Depth.Z", "Y")


@dataclass(frozen=True)
class Plate:
    """rgb: (H, W, 3) linear, blurred by the real lens; depth_m: (H, W) or None; lens: as focused for this photograph."""

    rgb: Float32[np.ndarray, "height width 3"]
    depth_m: Float32[np.ndarray, "height width"] | None
    lens: Lens
    camera: Camera

    def point_under_pixel_m(self, x_px: float, y_px: float) -> tuple[float, float, float]:
        """Where in the scene (camera axes, metres) the photograph shows at a pixel."""
        if self.depth_m is None:
            raise InputError(
                "to stand an object on a pixel the photograph needs depth: give --depth, a focal stack, or --at X,Y,Z in metres"
            )
        height, width = self.depth_m.shape
        if not (0 <= x_px < width and 0 <= y_px < height):
            raise InputError(f"pixel {x_px:g},{y_px:g} lies outside the photograph of {width}x{height} px")
        depth_m = float(self.depth_m[int(y_px), int(x_px)])
        x_m, y_m, z_m = self.camera.unproject(np.array([x_px, y_px]), np.array(depth_m))
        return float(x_m), float(y_m), float(z_m)


def open_plate(photo: Path, slice_index: int | None, depth: Path | None, lens: Lens | None, focus_m: float | None) -> Plate:
    """A photograph with a lens, or a merged focal stack with the number of a slice, which brings its own lens and depth.

    lens: overrides the stack's optics but keeps the focus of its slice; needed for a lone photograph. focus_m overrides all.
    """
    if photo.is_dir():
        return _stack_plate(photo, slice_index, lens, focus_m)
    if slice_index is not None:
        raise InputError(f"--slice chooses a slice of a focal stack, but {photo} is not a folder with {FILE_NAME}")
    if lens is None:
        raise InputError(f"{photo} does not tell its lens: give --lens LENS.json (see `mrbokeh lens new`)")
    rgb = read_image(photo)
    focused = lens if focus_m is None else lens.focused_at(focus_m)
    return Plate(rgb, None if depth is None else read_depth_m(depth), focused, _pinhole(focused, rgb))


def bundle_plate(bundle: CaptureBundle, depth: Path | None, lens: Lens | None, focus_m: float | None) -> Plate:
    """What the viewfinder captured; lens: overrides the optics but keeps the focus. Objects are placed in camera axes."""
    focused = bundle.lens if lens is None else lens.focused_at(bundle.lens.focus_distance_m)
    focused = focused if focus_m is None else focused.focused_at(focus_m)
    camera = replace(bundle.camera, camera_from_world=np.eye(4))
    return Plate(bundle.plate_rgb, None if depth is None else read_depth_m(depth), focused, camera)


def read_depth_m(path: Path) -> Float32[np.ndarray, "height width"]:
    """A depth map in metres from the Z channel of an EXR; 0 and negative values count as background."""
    channels = {name: pixels for part in read_exr(path) for name, pixels in part.channels.items()}
    name = next((each for each in _DEPTH_NAMES if each in channels), None)
    if name is None:
        raise InputError(f"{path}: expected depth in metres in a channel {' or '.join(_DEPTH_NAMES)}, found {sorted(channels)}")
    depth = channels[name].astype(np.float32)
    return np.where(depth > 0, depth, np.inf).astype(np.float32)


def _stack_plate(folder: Path, slice_index: int | None, lens: Lens | None, focus_m: float | None) -> Plate:
    stack = read_focal_stack(folder)
    if slice_index is None or not 0 <= slice_index < len(stack):
        raise InputError(
            f"{folder} is a focal stack of {len(stack)} slices: choose one with --slice 0 to {len(stack) - 1}, got {slice_index}"
        )
    focused = stack.lens_of(slice_index) if lens is None else lens.focused_at(stack.lens_of(slice_index).focus_distance_m)
    focused = focused if focus_m is None else focused.focused_at(focus_m)
    rgb = stack.slice_rgb(slice_index)
    camera = stack.camera or _pinhole(stack.lens_of(stack.reference), rgb)
    # A stack of a scene knows where its camera stood; objects are placed in camera axes.
    return Plate(rgb, stack.depth_m(), focused, replace(camera, camera_from_world=np.eye(4)))


def _pinhole(lens: Lens, rgb: Float32[np.ndarray, "height width 3"]) -> Camera:
    height, width = rgb.shape[:2]
    focal_px = lens.focal_px(width)
    return Camera(width, height, (focal_px, focal_px), (width / 2, height / 2))

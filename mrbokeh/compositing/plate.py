"""Plate: the photograph that virtual objects go into, with its depth, lens and camera; Insertion: the protocol of every way to insert
them.

Every insertion owes these (tests/compositing/test_compositing.py asks all of them):
- identity: where no light of a layer arrives and none of the photograph is hidden, the picture is the plate bit for bit;
- no layers give the plate;
- an opaque layer in focus before everything replaces the plate where it covers the pixel;
- a layer behind everything changes nothing where depth is known;
- linearity: twice the light in plate and layers gives twice the picture.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.images.alpha_io import is_straight, read_alpha
from mrbokeh.images.exif import TIFF_SUFFIXES, header_of
from mrbokeh.images.image_io import read_image
from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import Camera, camera_of_lens
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.solving.sun_of_photograph import SunOfPhotograph
from mrbokeh.system.errors import InputError

_NEAR_PX, LEAST_CONFIDENCE = 15, 0.05
"""Depth is taken from around where nothing so near has so much confidence: 4 to 10 % of three real stacks, all plain."""


@dataclass(frozen=True)
class Plate:
    """Photograph with its depth, lens and camera.

    rgb: (H, W, 3) linear, blurred by the real lens. depth_m: (H, W) of the sharp scene or None. lens: as focused for this photograph.
    sharp_rgb: (H, W, 3) the same view all in focus (of a focal stack), in the colours of rgb, or None.
    depth_confidence: (H, W) in [0, 1], of a focal stack: 0 where nothing there told the depth, which is then that of its surroundings.
    depth_error_dioptres: how far depth from focus may be off; 0 of other depth.
    near_alpha: (H, W) in [0, 1], a user's own matte of what stands in front of the virtual objects: sharp where its distance is known
    (by depth or told), else as the photograph shows it; NaN where depth is to tell; or None.
    alpha: (H, W) in [0, 1], the plate's own, by which rgb is multiplied; None is opaque.
    depth_note: what is known and what is guessed of a phone's own depth and focus, in words.
    metres_guessed: of a stack that knows no focus distance, and of a phone's depth without a unit; blur is right in pixels all the same.
    slopes_known: False where near and far are guessed apart, so that a level surface may seem steep.
    blur_from: where the lens has its blur from, in words, if its focal length and f-number are made up.
    focus_known, view_known: False where nothing tells the focus, and where the field of view is guessed.
    rough_focus_m: nearest and farthest distance that the focus in the photograph's file may mean, where that is a wide range.
    world_from_camera: (3, 3) turns camera axes into upright ones, where that is known; phone_level: by the level of the phone itself.
    white_lux: illuminance under which a white surface shows 1.0, by the exposure of the photograph (`Photograph.white_lux`).
    sun: where the sun stood, by the file, whether it shone or not; None also where the exposure is unknown.
    shadow_contrast: power of the light that remains in a shadow by which the photograph shows it: above 1 of what a camera developed.
    """

    rgb: Float32[np.ndarray, "height width 3"]
    depth_m: Float32[np.ndarray, "height width"] | None
    lens: Lens
    camera: Camera
    sharp_rgb: Float32[np.ndarray, "height width 3"] | None = None
    depth_confidence: Float32[np.ndarray, "height width"] | None = None
    depth_error_dioptres: float = 0.0
    near_alpha: Float32[np.ndarray, "height width"] | None = None
    alpha: Float32[np.ndarray, "height width"] | None = None
    metres_guessed: bool = False
    slopes_known: bool = True
    blur_from: str = ""
    focus_known: bool = True
    view_known: bool = True
    world_from_camera: Float[np.ndarray, "3 3"] | None = None
    phone_level: bool = False
    depth_note: str = ""
    rough_focus_m: tuple[float, float] | None = None
    white_lux: float | None = None
    sun: SunOfPhotograph | None = None
    shadow_contrast: float = 1.0

    def __post_init__(self) -> None:
        size = self.rgb.shape[:2]
        planes = (self.depth_m, self.depth_confidence, self.sharp_rgb, self.near_alpha)
        for what, plane in zip(("depth map", "confidence", "all-in-focus picture", "matte"), planes, strict=True):
            if plane is not None and plane.shape[:2] != size:
                raise InputError(
                    f"the {what} of the photograph is {plane.shape[1]}x{plane.shape[0]} px but the photograph is {size[1]}x{size[0]} px: "
                    f"resize it to that size"
                )

    def point_under_pixel_m(self, x_px: float, y_px: float) -> tuple[float, float, float]:
        """Return the place in the scene (camera axes, metres) that the photograph shows at a pixel."""
        if self.depth_m is None:
            raise InputError(
                "to stand an object on a pixel the photograph needs depth: give --depth, a focal stack, or --at X,Y,Z in metres"
            )
        depth_m = self.depth_at_m(x_px, y_px)
        if not 0.0 < depth_m < np.inf:
            raise InputError(f"pixel {x_px:g},{y_px:g} shows what is infinitely far, by its depth: choose one on the ground")
        x_m, y_m, z_m = self.camera.unproject(np.array([x_px, y_px], np.float64), np.array(depth_m))
        return float(x_m), float(y_m), float(z_m)

    def require_pixel(self, x_px: float, y_px: float) -> None:
        """Raise InputError for a pixel outside the photograph."""
        height, width = self.rgb.shape[:2]
        if not (0 <= x_px < width and 0 <= y_px < height):
            raise InputError(f"pixel {x_px:g},{y_px:g} lies outside the photograph of {width}x{height} px: choose one within")

    def depth_at_m(self, x_px: float, y_px: float) -> float:
        """Return the depth at a pixel of a photograph with depth. Raises InputError if it lies outside."""
        assert self.depth_m is not None
        self.require_pixel(x_px, y_px)
        return float(self.depth_m[int(y_px), int(x_px)])

    def is_depth_from_around(self, x_px: float, y_px: float) -> bool:
        """Return whether nothing within _NEAR_PX of a pixel told its depth from focus."""
        if self.depth_confidence is None:
            return False
        top, left = max(int(y_px) - _NEAR_PX, 0), max(int(x_px) - _NEAR_PX, 0)
        near = self.depth_confidence[top : int(y_px) + _NEAR_PX + 1, left : int(x_px) + _NEAR_PX + 1]
        return bool(near.max() < LEAST_CONFIDENCE)

    def length_m(self, pixels: float, depth_m: float) -> float:
        """Return the length of what covers so many pixels upright at a depth, facing the camera."""
        return pixels / self.camera.focal_px[1] * depth_m


def plate_of(rgb: Float32[np.ndarray, "height width 3"], lens: Lens, depth_m: Float32[np.ndarray, "height width"] | None = None) -> Plate:
    """A picture through the pinhole of its lens, which looks at its middle."""
    return Plate(rgb, depth_m, lens, camera_of_lens(lens, rgb.shape[1], rgb.shape[0]))


def shrunk(plate: Plate, width_px: int, height_px: int) -> Plate:
    """Return the plate with fewer pixels; depth is picked, as a mean of two surfaces is none."""
    import cv2

    size_px = (width_px, height_px)

    def by(method: int) -> Callable[[np.ndarray | None], np.ndarray | None]:
        return lambda plane: None if plane is None else np.ascontiguousarray(cv2.resize(plane, size_px, interpolation=method))

    mean, picked = by(cv2.INTER_AREA), by(cv2.INTER_NEAREST)
    rgb = mean(plate.rgb)
    assert rgb is not None
    return replace(
        plate,
        rgb=rgb,
        depth_m=picked(plate.depth_m),
        camera=plate.camera.resized(*size_px),
        sharp_rgb=mean(plate.sharp_rgb),
        depth_confidence=mean(plate.depth_confidence),
        near_alpha=None if plate.near_alpha is None else shrunk_matte(plate.near_alpha, size_px),
        alpha=mean(plate.alpha),
    )


def with_own_alpha(plate: Plate, path: Path, alpha: Float32[np.ndarray, "height width"] | None) -> Plate:
    """The plate as its file stores it, with that file's alpha; colour is multiplied by it where it is stored straight."""
    if alpha is None:
        return replace(plate, alpha=None)
    return replace(plate, rgb=plate.rgb * alpha[..., None] if is_straight(path) else plate.rgb, alpha=alpha)


def read_matte(path: Path) -> Float32[np.ndarray, "height width"]:
    """Read a user's matte of what stands in front: its numbers are coverage; of a cut-out, its alpha.

    A grey picture with alpha (PNG, TIFF) has gaps, where it is transparent: NaN.
    """
    alpha = read_alpha(path)
    if alpha is None:
        return np.ascontiguousarray(read_image(path, "linear")[..., 1])
    if path.suffix.lower() not in _GREY_WITH_ALPHA:
        return alpha
    with header_of(path) as picture:
        has_gaps = picture.mode == "LA"
    return np.where(alpha < 0.5, np.float32(np.nan), read_image(path, "linear")[..., 1]) if has_gaps else alpha


_GREY_WITH_ALPHA = (".png", *TIFF_SUFFIXES)


def shrunk_matte(matte: Float32[np.ndarray, "height width"], size_px: tuple[int, int]) -> Float32[np.ndarray, "new_height new_width"]:
    """Return a matte with fewer pixels, width and height: the mean of what it tells; a gap where it tells less than half."""
    import cv2

    told = 1.0 - np.isnan(matte).astype(np.float32)
    held, share = (cv2.resize(each, size_px, interpolation=cv2.INTER_AREA) for each in (np.nan_to_num(matte, nan=0.0), told))
    return np.where(share < 0.5, np.float32(np.nan), held / np.maximum(share, 0.5)).astype(np.float32)


@dataclass(frozen=True)
class Inserted:
    """A photograph with virtual layers in it, in two parts, so that grain and the like can be put on the virtual part alone.

    photo_rgb: (H, W, 3) what is left of the photograph: its own numbers where nothing was put in.
    virtual: light of the layers as it arrives, blurred and partly hidden, premultiplied; alpha is the share of the pupil
      that sees them; depth_m is theirs, sharp, front first.
    """

    photo_rgb: Float32[np.ndarray, "height width 3"]
    virtual: Layer

    @property
    def rgb(self) -> Float32[np.ndarray, "height width 3"]:
        return self.photo_rgb + self.virtual.rgb


@runtime_checkable
class Insertion(Protocol):
    """A way of putting layers in; its settings are its constructor's."""

    def insert(self, plate: Plate, layers: Sequence[Layer], renderer: Renderer) -> Inserted:
        """Virtual layers, sharp, front first, of the plate's size, blurred by the plate's lens; the plate is not blurred again."""
        ...


def same_size(plate: Plate, layers: Sequence[Layer]) -> Sequence[Layer]:
    """Return the layers, once each is as large as the plate and lies before the camera. Raises InputError where one does not."""
    height, width = plate.rgb.shape[:2]
    for layer in layers:
        if layer.alpha.shape != (height, width):
            raise InputError(
                f"the virtual layer is {layer.width_px}x{layer.height_px} px but the photograph is {width}x{height} px: "
                f"render or resize it to that size"
            )
        if not layer.depth_m.min(initial=np.inf) > 0.0 and not (layer.depth_m[layer.alpha > 0] > 0.0).all():
            raise InputError("the depth of the virtual layer must be above 0 m where it covers the picture: give metres along the axis")
    return layers

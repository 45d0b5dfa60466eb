"""Real things that hide virtual ones: by the depth that some camera saw, or by a mask for a camera that stands still."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float32

from mrbokeh.compositing.over import occlusion_matte
from mrbokeh.images.image_io import read_depth
from mrbokeh.layering.hidden_background import layer_from_view
from mrbokeh.optics.camera import Camera, camera_from_json
from mrbokeh.optics.lens_file import read_transmission
from mrbokeh.scene.staging.scene_description import RealThings
from mrbokeh.system.atomic_files import read_json
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.world_axes import upright_camera

Plane = Float32[np.ndarray, "height width"]
_FINER = 1.25
"""Depth is resampled to so many pixels per pixel drawn: fewer leave holes where it is seen from nearby, more only take time."""
_SAME_SIZE = 0.02


@runtime_checkable
class Occlusion(Protocol):
    def matte(self, depth_m: Plane, camera: Camera, frame: Camera) -> Plane:
        """Return how much of virtual things at these depths stays visible, 1 is all. camera: cut out of `frame`, both upright."""
        ...

    def depth_m(self, camera: Camera) -> Plane | None:
        """Return the depth of the real things as a camera sees them, inf where unknown; None where depth is never known."""
        ...


@dataclass(frozen=True, eq=False)
class RealDepth:
    """Depth (metres, inf is not known) that `view`, an upright camera, saw. Everything stands still."""

    seen_m: Plane
    view: Camera

    def __post_init__(self) -> None:
        size = self.seen_m.shape
        if abs(size[1] * self.view.height_px / (size[0] * self.view.width_px) - 1.0) > _SAME_SIZE:
            raise InputError(
                f"the depth map has {size[1]}x{size[0]} px, but its camera {self.view.width_px}x{self.view.height_px}: "
                f"expected the same picture, give the camera that saw it"
            )

    def matte(self, depth_m: Plane, camera: Camera, frame: Camera) -> Plane:  # noqa: ARG002
        return occlusion_matte(depth_m, self.depth_m(camera))

    def depth_m(self, camera: Camera) -> Plane:
        share = _FINER * camera.focal_px[0] / self.view.focal_px[0]
        width, height = (max(round(size * share), 1) for size in (self.view.width_px, self.view.height_px))
        depth_m = cv2.resize(self.seen_m, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
        colourless = np.zeros((*depth_m.shape, 3), np.float32)
        return layer_from_view(colourless, depth_m, self.view.resized(width, height), camera).depth_m


@dataclass(frozen=True, eq=False)
class Mask:
    """Mask of a camera that stands still. hides: (H, W) over the whole frame, 1 where something real is always in front."""

    hides: Plane

    def matte(self, depth_m: Plane, camera: Camera, frame: Camera) -> Plane:
        height, width = self.hides.shape
        scale_x, scale_y = (f / c for f, c in zip(frame.focal_px, camera.focal_px, strict=True))
        left, top = frame.principal_px[0] - camera.principal_px[0] * scale_x, frame.principal_px[1] - camera.principal_px[1] * scale_y
        to_x, to_y = width / frame.width_px, height / frame.height_px
        # Pixel centres lie at +0.5 here and at 0 in OpenCV.
        mask_from_pixel = np.array(
            [[scale_x * to_x, 0, (0.5 * scale_x + left) * to_x - 0.5], [0, scale_y * to_y, (0.5 * scale_y + top) * to_y - 0.5]]
        )
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        hidden = cv2.warpAffine(self.hides, mask_from_pixel, depth_m.shape[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return np.float32(1.0) - hidden

    def depth_m(self, camera: Camera) -> Plane | None:  # noqa: ARG002
        return None


def read_occlusion(real: RealThings | None, up: str) -> Occlusion | None:
    """Read what the scene file's [occlusion] names; InputError where a file is not what it should be."""
    if real is None:
        return None
    if real.mask is not None:
        return Mask(np.clip(read_transmission(real.mask), 0.0, 1.0).astype(np.float32))
    depth, camera = Path(str(real.depth)), Path(str(real.camera))
    view = camera_from_json(read_json(camera, "the camera of a depth map"), str(camera))
    return RealDepth(read_depth(depth), upright_camera(view, up))

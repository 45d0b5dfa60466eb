"""Intrinsics for the pictures of a clip: of its size, and turned as its metadata turn the pictures."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mrbokeh.optics.camera import Camera, have_same_shape
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.tracked_frame import Distortion


@dataclass(frozen=True)
class Intrinsics:
    """camera: its pose says nothing. distortion: None is a pinhole."""

    camera: Camera
    distortion: Distortion | None = None

    def turned(self, quarter_turns: int) -> "Intrinsics":
        """For pictures turned counter-clockwise, so often by 90 degrees."""
        turned = self
        for _ in range(quarter_turns % 4):
            turned = turned._turned_once()
        return turned

    def _turned_once(self) -> "Intrinsics":
        """A point (x, y) comes to (y, width - x)."""
        (fx, fy), (cx, cy), width_px = self.camera.focal_px, self.camera.principal_px, self.camera.width_px
        camera = Camera(self.camera.height_px, width_px, (fy, fx), (cy, width_px - cx), np.eye(4))
        if self.distortion is None:
            return Intrinsics(camera)
        p1, p2 = (self.distortion.get(name, 0.0) for name in ("p1", "p2"))
        tangential = {"p1": -p2, "p2": p1} if p1 or p2 else {}
        return Intrinsics(camera, {**{name: value for name, value in self.distortion.items() if name not in ("p1", "p2")}, **tangential})


def intrinsics_of_clip(stated: Intrinsics, size_px: tuple[int, int], quarter_turns: int, clip: Path) -> Intrinsics:
    """size_px: (width, height) of the clip's pictures as they are shown; quarter_turns: counter-clockwise, by which they were turned.

    What was stated for the camera held level holds for upright pictures too, if the clip's metadata turn them. InputError where the
    pictures have another shape.
    """
    for turns in dict.fromkeys((0, quarter_turns)):
        found = stated.turned(turns)
        if have_same_shape(size_px, (found.camera.width_px, found.camera.height_px)):
            return replace(found, camera=replace(found.camera.resized(*size_px), camera_from_world=np.eye(4)))
    raise InputError(
        f"expected intrinsics for pictures of the shape of {clip} ({size_px[0]}x{size_px[1]}), got those of "
        f"{stated.camera.width_px}x{stated.camera.height_px}: state them for all of the picture, or give --calibrate"
    )

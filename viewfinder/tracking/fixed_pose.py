"""A camera on a tripod: its pose, measured once, holds for every frame."""

from pathlib import Path

from mrbokeh.optics.camera import Camera, camera_from_json
from mrbokeh.system.atomic_files import read_json
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.track import is_rigid
from viewfinder.flow.frames import CameraFrame
from viewfinder.tracking.base import TrackedPose


class FixedPose:
    """camera: pose and intrinsics; who composites takes `camera.resized` to the size of its frames for intrinsics."""

    name = "fixed pose"

    def __init__(self, camera: Camera) -> None:
        self.camera = camera

    def track(self, frame: CameraFrame, intrinsics: Camera) -> TrackedPose:  # noqa: ARG002
        return TrackedPose(self.camera.camera_from_world, 1.0, frame.captured_s)

    def close(self) -> None:
        """Nothing runs."""


def read_fixed_pose(path: Path | str) -> FixedPose:
    """From the JSON of `mrbokeh.optics.camera`."""
    document = read_json(path, "a camera with its pose")
    camera = camera_from_json(document if isinstance(document, dict) else {}, str(path))
    if not is_rigid(camera.camera_from_world):
        raise InputError(f"{path}: camera_from_world must be a rigid transform (4x4: a rotation and a shift in metres), but it is not one")
    return FixedPose(camera)

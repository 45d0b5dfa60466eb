"""Tracker: the protocol of everything that knows where the camera is, its poses, and the camera on a tripod."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from mrbokeh.optics.camera import Camera, camera_from_json
from mrbokeh.system.atomic_files import read_json
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.track import is_rigid
from viewfinder.frames import CameraFrame, Pose


@dataclass(frozen=True)
class TrackedPose:
    """Pose of a frame.

    camera_from_world: (4, 4), metres. quality: 0 (a guess) to 1. residual_px: RMS of the reprojected points; points: how many.

    captured_s: of the frame that it belongs to, so that a late pose is not taken for a new one. is_certain: False where another pose fits
      as well, as for a board that is small in the picture; nothing should be shown or measured by it then.
    """

    camera_from_world: Pose
    quality: float
    captured_s: float
    residual_px: float = 0.0
    points: int = 0
    is_certain: bool = True


@runtime_checkable
class Tracker(Protocol):
    """Tracker, called with every frame that is composited, in order; frames between may be missing.

    intrinsics: of the size of the frame; its pose is not looked at. None where the track is lost. Must be fast (a few ms): what is
    slow (detection, localisation) runs in a thread of its own, on the newest frame.
    """

    name: str

    def track(self, frame: CameraFrame, intrinsics: Camera) -> TrackedPose | None: ...

    def close(self) -> None: ...


class FixedPose:
    """Tracker on a tripod. camera: pose and intrinsics, measured once."""

    name = "fixed pose"

    def __init__(self, camera: Camera) -> None:
        self.camera = camera

    def track(self, frame: CameraFrame, intrinsics: Camera) -> TrackedPose:  # noqa: ARG002
        return TrackedPose(self.camera.camera_from_world, 1.0, frame.captured_s)

    def close(self) -> None:
        """Close nothing: nothing runs."""


def read_fixed_pose(path: Path | str) -> FixedPose:
    """Read the JSON of `mrbokeh.optics.camera`."""
    document = read_json(path, "a camera with its pose")
    camera = camera_from_json(document if isinstance(document, dict) else {}, str(path))
    if not is_rigid(camera.camera_from_world):
        raise InputError(f"{path}: camera_from_world must be a rigid transform (4x4: a rotation and a shift in metres), but it is not one")
    return FixedPose(camera)

"""The protocol of everything that knows where the camera is."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from mrbokeh.optics.camera import Camera
from viewfinder.flow.frames import CameraFrame, Pose


@dataclass(frozen=True)
class TrackedPose:
    """camera_from_world: (4, 4), metres. quality: 0 (a guess) to 1. residual_px: RMS of the reprojected points; points: how many.

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
    """Called with every frame that is composited, in order; frames between may be missing.

    intrinsics: of the size of the frame; its pose is not looked at. None where the track is lost. Must be fast (a few ms): what is
    slow (detection, localisation) runs in a thread of its own, on the newest frame.
    """

    name: str

    def track(self, frame: CameraFrame, intrinsics: Camera) -> TrackedPose | None: ...

    def close(self) -> None: ...

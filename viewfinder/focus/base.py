"""The protocol of everything that knows where the lens is focused."""

from typing import Protocol, runtime_checkable

from viewfinder.flow.frames import CameraFrame, LensState
from viewfinder.tracking.base import TrackedPose


@runtime_checkable
class FocusSource(Protocol):
    """Called with every frame that is composited; says what it knows of the lens, None for the rest. Must be fast."""

    name: str

    def state(self, frame: CameraFrame, pose: TrackedPose | None) -> LensState: ...

    def close(self) -> None: ...

"""The protocol of everything that camera frames come from."""

from collections.abc import Iterator
from threading import Event
from typing import Protocol, runtime_checkable

from viewfinder.flow.frames import CameraFrame


@runtime_checkable
class FrameSource(Protocol):
    """A camera. `name` is for people to read.

    transfer: the curve of its codes (see mrbokeh.video.color); a stream that comes over a network tells it with its first frame.
    status: one sentence while the camera is away or has trouble, None while all is well. Any thread may read both.
    """

    name: str

    @property
    def transfer(self) -> str: ...

    @property
    def status(self) -> str | None: ...

    def frames(self, stopping: Event) -> Iterator[CameraFrame]:
        """Frames in the rhythm and the size in which the camera gives them, until `stopping` is set.

        A camera that went away is waited for. Raises InputError where waiting would not help.
        """
        ...

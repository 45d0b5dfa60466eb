"""FrameSource: the protocol of cameras, and what they share: size limits, pictures the right way up, opening again what went away."""

from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from threading import Event
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from mrbokeh.system.errors import InputError
from mrbokeh.video.color import VideoColor
from mrbokeh.video.frames import display_bgr
from viewfinder.frames import Bgr, CameraFrame


@runtime_checkable
class FrameSource(Protocol):
    """Camera. `name` is for people to read.

    transfer: the curve of its codes (see mrbokeh.video.color); a stream that comes over a network tells it with its first frame.
    status: one sentence while the camera is away or has trouble, None while all is well. Any thread may read both.
    """

    name: str

    @property
    def transfer(self) -> str: ...

    @property
    def status(self) -> str | None: ...

    def frames(self, stopping: Event) -> Iterator[CameraFrame]:
        """Yield frames in the rhythm and the size in which the camera gives them, until `stopping` is set.

        A camera that went away is waited for. Raises InputError where waiting would not help.
        """
        ...


@dataclass(frozen=True)
class SizeLimit:
    """Largest size of frames, with their aspect; None is no limit."""

    width_px: int | None = None
    height_px: int | None = None

    def fit(self, width_px: int, height_px: int) -> tuple[int, int]:
        """Return (width, height) with the same aspect, within the limits, never enlarged."""
        pairs = ((self.width_px, width_px), (self.height_px, height_px))
        scale = min([1.0, *(most / size for most, size in pairs if most is not None)])
        return max(1, round(width_px * scale)), max(1, round(height_px * scale))

    def applied(self, bgr: Bgr) -> UInt8[np.ndarray, "fitted_height fitted_width 3"]:
        """Return the picture itself where it is small enough, else scaled down by areas."""
        import cv2

        size_px = self.fit(bgr.shape[1], bgr.shape[0])
        return bgr if size_px == (bgr.shape[1], bgr.shape[0]) else cv2.resize(bgr, size_px, interpolation=cv2.INTER_AREA)


# A camera may differ this much from the aspect ratio before the picture would look stretched.
_ASPECT_TOLERANCE = 0.01


UNLIMITED = SizeLimit()


class ExactSize:
    """FrameSource over another. Its frames raise InputError where the camera's aspect ratio is another one."""

    def __init__(self, source: FrameSource, width_px: int, height_px: int) -> None:
        self._source, self._size_px = source, (width_px, height_px)
        self.name = source.name

    @property
    def transfer(self) -> str:
        return self._source.transfer

    @property
    def status(self) -> str | None:
        return self._source.status

    def frames(self, stopping: Event) -> Iterator[CameraFrame]:
        for frame in self._source.frames(stopping):
            yield replace(frame, bgr=self._scaled(frame.bgr), full_picture=None)

    def _scaled(self, bgr: Bgr) -> UInt8[np.ndarray, "scaled_height scaled_width 3"]:
        import cv2

        (width, height), (given_height, given_width) = self._size_px, bgr.shape[:2]
        if (given_width, given_height) == self._size_px:
            return bgr
        if abs(given_width * height / (given_height * width) - 1.0) > _ASPECT_TOLERANCE:
            raise InputError(
                f"{self.name} gives {given_width}x{given_height} px, but the layer is {width}x{height} px: "
                f"render the layer with the aspect ratio of the camera (frames are scaled to the size of the layer)"
            )
        return cv2.resize(bgr, self._size_px, interpolation=cv2.INTER_AREA)


def upright_bgr(frame: Any, color: VideoColor, limit: SizeLimit) -> Bgr:
    """Return (H, W, 3) display codes, blue first, turned as the stream says (to the nearest quarter turn), within the limit."""
    turns = round(frame.rotation / 90) % 4
    if turns % 2:
        height_px, width_px = limit.fit(frame.height, frame.width)
    else:
        width_px, height_px = limit.fit(frame.width, frame.height)
    return np.ascontiguousarray(np.rot90(display_bgr(frame, color, (width_px, height_px)), turns))


FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.25, 4.0

Item = TypeVar("Item")


class CameraAwayError(Exception):
    """Absence of a camera that may come back; the message is the sentence that people read meanwhile."""


def reconnecting(
    session: Callable[[], Generator[Item, Any, Any]],
    stopping: Event,
    tell: Callable[[str | None], None],
    first_pause_s: float = FIRST_PAUSE_S,
) -> Iterator[Item]:
    """Yield what a session gives, session after session, until `stopping` is set.

    session: opens the camera, yields, closes the camera at its end; raises CameraAwayError where the camera is away. Other errors
    are not caught. tell: gets that sentence, and None as soon as something comes again. Pauses double up to LONGEST_PAUSE_S.
    """
    pause_s = first_pause_s
    while not stopping.is_set():
        try:
            with closing(session()) as items:
                for item in items:
                    tell(None)
                    pause_s = first_pause_s
                    yield item
        except CameraAwayError as error:
            tell(str(error))
        stopping.wait(pause_s)
        pause_s = min(2 * pause_s, LONGEST_PAUSE_S)

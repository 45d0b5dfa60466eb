"""Frames of the viewfinder: from the camera, finished, and as viewers are told of them; and the slot that keeps the newest."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from threading import Condition
from typing import Any, Generic, NamedTuple, TypedDict, TypeVar

import numpy as np
from jaxtyping import Float64, UInt8

Bgr = UInt8[np.ndarray, "height width 3"]
Pose = Float64[np.ndarray, "4 4"]


@dataclass(frozen=True)
class LensState:
    """Knowledge of the lens at one moment; None is not known. focus_distance_m: from the entrance pupil, inf is allowed."""

    focus_distance_m: float | None = None
    f_number: float | None = None
    focal_length_mm: float | None = None

    def completed_by(self, other: "LensState") -> "LensState":
        """Return this state, completed by the other where something is not known."""
        return LensState(*(theirs if mine is None else mine for mine, theirs in zip(self._values(), other._values(), strict=True)))

    def _values(self) -> tuple[float | None, ...]:
        return self.focus_distance_m, self.f_number, self.focal_length_mm


UNKNOWN_LENS = LensState()


@dataclass(frozen=True)
class CameraFrame:
    """Frame of a camera with what is known of it.

    bgr: (H, W, 3) 8-bit display codes, blue first. captured_s: `time.monotonic` when the camera gave it. sequence: counts captures.

    lens, camera_from_world: what the source itself knows (a tracked camera, the Exif of a tethered one); most know nothing.
    full_picture: gives the picture as large as the camera gave it, where bgr was made smaller; for captures, it may take its time.
    """

    bgr: Bgr
    captured_s: float
    sequence: int
    lens: LensState = UNKNOWN_LENS
    camera_from_world: Pose | None = None
    full_picture: Callable[[], Bgr] | None = None


class Remark(NamedTuple):
    """Remark on a picture that is not what the user waits for. arrow: right and down, of length 1, to where the object is; or None."""

    sentence: str
    arrow: tuple[float, float] | None = None


@dataclass(frozen=True)
class FrameStatus:
    """Status that the page shows with a picture.

    focus_distance_m, f_number: of the lens that blurred the virtual layer; focus_pending: another one was asked for and is not shown yet.
    tracking: quality of the pose from 0 (lost) to 1, None without a tracker. tracking_unsure: another pose would fit as well, so that
      nothing is shown by this one. layer_age_ms: since the virtual layer was drawn.
    stages_ms: how long each stage took, by name, in the order in which they ran. dropped: captures so far that were never composited.
    remark: why nothing virtual is seen, or that the picture is old; None where all is well.
    """

    focus_distance_m: float
    f_number: float
    focus_pending: bool = False
    tracking: float | None = None
    tracking_unsure: bool = False
    layer_age_ms: float = 0.0
    stages_ms: Mapping[str, float] = field(default_factory=dict)
    dropped: int = 0
    remark: Remark | None = None


@dataclass(frozen=True)
class OutputFrame:
    """Finished picture (H, W, 3), 8-bit display codes, blue first; captured_s, sequence: of the capture it shows."""

    bgr: Bgr
    captured_s: float
    sequence: int
    status: FrameStatus


Item = TypeVar("Item")


class Newest(Generic[Item]):
    """Slot between two threads that keeps one thing: `put` replaces what was not taken in time, `take` waits for something new."""

    def __init__(self) -> None:
        self._changed = Condition()
        self._item: Item | None = None

    def put(self, item: Item) -> None:
        with self._changed:
            self._item = item
            self._changed.notify()

    def take(self, timeout_s: float) -> Item | None:
        """Return the newest item, which leaves the slot; None if nothing came in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._item is not None, timeout_s)
            item, self._item = self._item, None
            return item

    @property
    def waiting(self) -> bool:
        """Whether something lies in the slot."""
        with self._changed:
            return self._item is not None


def finite(metres: float) -> float | None:
    """Return None for infinity, for which JSON has no word."""
    return metres if abs(metres) != float("inf") else None


_FOLDERS = re.compile(r"""(?<![\w/:.])(?:[A-Za-z]:)?[\\/](?:[^\s\\/:,;'"()]+[\\/])+(?=[^\s\\/])""")


def without_folders(sentence: str) -> str:
    """Return a sentence for viewers, whom the folders of this machine do not concern: of each path the last name."""
    return _FOLDERS.sub("", sentence)


class RemarkJson(TypedDict):
    """Remark as the page gets it."""

    sentence: str
    arrow: list[float] | None


def remark_json(remark: Remark | None) -> RemarkJson | None:
    if remark is None:
        return None
    return RemarkJson(sentence=without_folders(remark.sentence), arrow=None if remark.arrow is None else list(remark.arrow))


def frame_header(frame: OutputFrame) -> dict[str, Any]:
    """Return what the page is told of a picture, ready for JSON; captured_ms is `time.monotonic`, as the clock's answers are."""
    status = frame.status
    return {
        "sequence": frame.sequence,
        "captured_ms": 1000 * frame.captured_s,
        "focus_distance_m": finite(status.focus_distance_m),
        "f_number": status.f_number,
        "focus_pending": status.focus_pending,
        "tracking": status.tracking,
        "tracking_unsure": status.tracking_unsure,
        "layer_age_ms": round(status.layer_age_ms, 1),
        "stages_ms": {name: round(took_ms, 2) for name, took_ms in status.stages_ms.items()},
        "dropped": status.dropped,
        "remark": remark_json(status.remark),
    }

"""Keyframes of a clip, evenly spread over the motion of the picture: none while the camera rests, many in a fast pan."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64

from mrbokeh.system.console import track
from mrbokeh.tracking.charuco.detector import Grey, flow
from mrbokeh.video.clip import VideoInfo, read_display_frames

_SEARCH_WIDTH_PX = 480
_FEATURES = 200
_APART_SHARE = 0.035
"""Of the picture's width, by which neighbouring keyframes differ where there may be keyframes enough."""

_FEWEST = 8
_LOST_SHARE = 0.1
"""Motion counted for a step in which no feature could be followed: a fast blur."""


def motion_of_clip(clip: Path, info: VideoInfo) -> Float64[np.ndarray, " frames"]:
    """Return how far the picture has moved by each frame: the sum of median displacements since the first, in picture widths."""
    width_px = min(_SEARCH_WIDTH_PX, info.width_px)
    height_px = max(16, round(info.height_px * width_px / info.width_px))
    moved: list[float] = []
    before: Grey | None = None
    for frame in track(read_display_frames(clip, width_px, height_px), "motion", info.frame_count or 0):
        grey = cv2.cvtColor(frame.bgr, cv2.COLOR_BGR2GRAY)
        moved.append(0.0 if before is None else _step(before, grey) / width_px)
        before = grey
    return np.cumsum(np.array(moved, np.float64))


def chosen_keyframes(motion: Float64[np.ndarray, " frames"], most: int, apart_share: float = _APART_SHARE) -> list[int]:
    """Choose frame numbers; the first and the last are always among them."""
    count = int(np.clip(motion[-1] / apart_share + 1, _FEWEST, most))
    if count >= len(motion):
        return list(range(len(motion)))
    # A little of plain time keeps places apart where nothing moves.
    along = motion + 1e-3 * np.arange(len(motion)) / len(motion)
    wanted = np.linspace(along[0], along[-1], count)
    return sorted({int(each) for each in np.abs(along[:, None] - wanted).argmin(axis=0)} | {0, len(motion) - 1})


def write_keyframes(clip: Path, info: VideoInfo, numbers: Sequence[int], folder: Path, *, fresh: bool = False) -> None:
    """Write frame_000012.png, with the video's code values at its full size; existing ones are kept, unless fresh ones are wanted."""
    folder.mkdir(parents=True, exist_ok=True)
    wanted = {number: folder / f"{view_name(number)}.png" for number in numbers}
    for stale in set(folder.glob("frame_*.png")) - set(wanted.values()):
        stale.unlink()
    if not fresh and all(path.exists() for path in wanted.values()):
        return
    for number, frame in enumerate(track(read_display_frames(clip, info.width_px, info.height_px), "keyframes", info.frame_count or 0)):
        if number in wanted:
            cv2.imwrite(str(wanted[number]), frame.bgr)


def view_name(number: int) -> str:
    return f"frame_{number:06d}"


def frame_of(name: str) -> int:
    """Return the frame of a view."""
    return int(name.rpartition("_")[2])


def _step(before: Grey, grey: Grey) -> float:
    """Return the median displacement in pixels."""
    places = cv2.goodFeaturesToTrack(before, _FEATURES, 0.01, 8.0)
    if places is None:
        return 0.0
    start = places.reshape(-1, 2).astype(np.float64) + 0.5
    there, good = flow(before, grey, start)
    if np.count_nonzero(good) < 0.1 * len(start):
        return _LOST_SHARE * grey.shape[1]
    return float(np.median(np.linalg.norm(there[good] - start[good], axis=1)))

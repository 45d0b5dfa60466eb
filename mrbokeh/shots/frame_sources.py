"""Camera, focus and depth of each frame, from files."""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.depth.depth_filters import TemporalDepthFilter
from mrbokeh.images.image_io import read_depth, read_image
from mrbokeh.optics.camera import Camera
from mrbokeh.shots.hooks import CameraSource, DepthSource, FocusSource, MatteSource, Moment
from mrbokeh.shots.kept import Kept
from mrbokeh.shots.scene_camera import scene_track
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.focus_pull import parse_focus_keys, read_focus_pull
from mrbokeh.tracking.camera_track.track import CameraTrack, TrackedFrame
from mrbokeh.video.clip import VideoInfo
from mrbokeh.video.picture_sources.numbered_files import is_pattern, numbered

Plane = Float32[np.ndarray, "height width"]


@dataclass(frozen=True)
class CameraFile:
    """Description of a fixed camera (JSON) or a track, in any form that mrbokeh.tracking.camera_track reads.

    size_px, frame_rate: of the clip. up: what points up in the world of the scene that it looks at (mrbokeh.shots.scene_camera).
    """

    path: Path
    size_px: tuple[int, int]
    frame_rate: Fraction = Fraction(25)
    up: str = "-z"

    @classmethod
    def of_clip(cls, path: Path, clip: VideoInfo, up: str) -> "CameraFile":
        return cls(path, (clip.width_px, clip.height_px), clip.frame_rate, up)

    @property
    def files(self) -> tuple[Path, ...]:
        return (self.path,)

    def opened(self, threads: int) -> CameraSource:  # noqa: ARG002
        return _OpenedTrack(scene_track(self.path, self.size_px, self.up), float(self.frame_rate))


class _OpenedTrack:
    def __init__(self, track: CameraTrack, frame_rate: float) -> None:
        self._track, self._timed, self._frame_rate = track, track.timed(frame_rate), frame_rate

    def camera_at(self, moment: Moment, after_s: float = 0.0) -> Camera:
        """Beyond the ends of the track the camera stays where it was."""
        camera = (self._track.at(moment.number) if after_s == 0.0 else self._around(moment, after_s)).camera
        return camera if (camera.width_px, camera.height_px) == moment.size_px else camera.resized(*moment.size_px)

    def _around(self, moment: Moment, after_s: float) -> TrackedFrame:
        first, last = self._track.numbers[0], self._track.numbers[-1]
        return self._timed.at_time(min(max(moment.number + after_s * self._frame_rate, first), last) / self._frame_rate)


@dataclass(frozen=True)
class FocusPulled:
    """Description of a focus pull: keys FRAME:METRES,... or the metadata of a cine camera (CSV), whose steps are smoothed."""

    keys: str = ""
    path: Path | None = None

    @classmethod
    def of(cls, text: str) -> "FocusPulled":
        """What the command line says: a file by its suffix .csv, else keys."""
        return cls(path=Path(text).resolve()) if text.lower().endswith(".csv") else cls(text)

    @property
    def files(self) -> tuple[Path, ...]:
        return () if self.path is None else (self.path,)

    def opened(self, threads: int) -> FocusSource:  # noqa: ARG002
        return parse_focus_keys(self.keys, "smooth") if self.path is None else read_focus_pull(self.path).smoothed()


@dataclass(frozen=True)
class DepthFiles:
    """Description of the depth of the photographed scene: one file for all frames, or numbered ones (depth.%04d.exr).

    steady: numbered depth goes through a temporal filter. It looks at `warm_up` frames before the first one asked for, so that
    a segment begins as if the one before had gone through it too; the clip itself begins with a filter that has settled.
    """

    path: Path
    steady: bool = False
    warm_up: int = 48

    @property
    def files(self) -> tuple[Path, ...]:
        return (self.path,)

    def opened(self, threads: int) -> DepthSource:  # noqa: ARG002
        return _SteadyDepth(self) if self.steady and is_pattern(self.path) else _Depth(self)


class _Depth:
    def __init__(self, described: DepthFiles) -> None:
        self._path, self._read = described.path, Kept(lambda name: read_depth(Path(name)))

    def depth_m_at(self, moment: Moment) -> Plane:
        return _of_size(self._read(str(numbered(self._path, moment.number))), moment, self._path)


@dataclass(frozen=True)
class MatteFiles:
    """Description of mattes of what is near, whose numbers are coverage: one picture for all frames, or numbered ones (matte.%04d.png)."""

    path: Path

    @property
    def files(self) -> tuple[Path, ...]:
        return (self.path,)

    def opened(self, threads: int) -> MatteSource:  # noqa: ARG002
        return _Mattes(self.path)


class _Mattes:
    def __init__(self, path: Path) -> None:
        self._path, self._read = path, Kept(lambda name: np.ascontiguousarray(read_image(Path(name), "linear")[..., 1]))

    def near_alpha_at(self, moment: Moment) -> Plane:
        return _of_size(self._read(str(numbered(self._path, moment.number))), moment, self._path)


class _SteadyDepth:
    def __init__(self, described: DepthFiles) -> None:
        self._described, self._filter = described, TemporalDepthFilter()
        self._next: int | None = None
        self._plane: Plane | None = None

    def depth_m_at(self, moment: Moment) -> Plane:
        if self._plane is None or self._next != moment.number + 1:
            for number in self._still_to_go(moment.number):
                self._plane = self._filter.filtered(read_depth(numbered(self._described.path, number)))
            self._next = moment.number + 1
        assert self._plane is not None
        return _of_size(self._plane, moment, self._described.path)

    def _still_to_go(self, number: int) -> Sequence[int]:
        """The next one; where the filter starts anew those before, and at the clip's beginning first those behind it, backwards."""
        if self._next == number:
            return [number]
        self._filter = TemporalDepthFilter()
        warm_up = self._described.warm_up
        first = next(each for each in range(max(number - warm_up, 0), number + 1) if each == number or self._is_there(each))
        if first > 0 and self._is_there(first - 1):
            return range(first, number + 1)
        ahead = [each for each in range(first + 1, first + warm_up + 1) if self._is_there(each)]
        return [*reversed(ahead), *range(first, number + 1)]

    def _is_there(self, number: int) -> bool:
        return numbered(self._described.path, number).exists()


def _of_size(plane: Plane, moment: Moment, path: Path) -> Plane:
    width, height = moment.size_px
    if plane.shape != (height, width):
        raise InputError(f"{path} is {plane.shape[1]}x{plane.shape[0]} px but the clip is {width}x{height} px: resize it to that size")
    return plane

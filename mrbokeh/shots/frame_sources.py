"""Camera, focus and depth of each frame, from files."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.camera import Camera
from mrbokeh.camera_track.focus_metadata import read_focus_pull
from mrbokeh.camera_track.focus_pull import parse_focus_keys
from mrbokeh.camera_track.formats import read_track
from mrbokeh.camera_track.options import TrackOptions
from mrbokeh.camera_track.track import CameraTrack
from mrbokeh.depth_sources.temporal_filter import TemporalDepthFilter
from mrbokeh.errors import InputError
from mrbokeh.image_io import read_depth
from mrbokeh.picture_sources.numbered_files import is_pattern, numbered
from mrbokeh.shots.hooks import CameraSource, DepthSource, FocusSource, Moment
from mrbokeh.shots.kept import Kept

Plane = Float32[np.ndarray, "height width"]


@dataclass(frozen=True)
class CameraFile:
    """Description of a fixed camera (JSON) or a track, in any form that mrbokeh.camera_track reads; size_px: of the clip."""

    path: Path
    size_px: tuple[int, int]

    @property
    def files(self) -> tuple[Path, ...]:
        return (self.path,)

    def opened(self, threads: int) -> CameraSource:  # noqa: ARG002
        return _OpenedTrack(read_track(self.path, TrackOptions(size_px=self.size_px)))


class _OpenedTrack:
    def __init__(self, track: CameraTrack) -> None:
        self._track = track

    def camera_at(self, moment: Moment) -> Camera:
        camera = self._track.at(moment.number).camera
        return camera if (camera.width_px, camera.height_px) == moment.size_px else camera.resized(*moment.size_px)


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

    steady: numbered depth goes through a temporal filter. It looks back `warm_up` frames before the first one asked for, so that
    a segment begins as if the one before had gone through it too.
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

    def _still_to_go(self, number: int) -> range:
        """From the next one, or from those before where the filter starts anew."""
        if self._next == number:
            return range(number, number + 1)
        self._filter = TemporalDepthFilter()
        begin = max(number - self._described.warm_up, 0)
        while not numbered(self._described.path, begin).exists() and begin < number:
            begin += 1
        return range(begin, number + 1)


def _of_size(depth_m: Plane, moment: Moment, path: Path) -> Plane:
    width, height = moment.size_px
    if depth_m.shape != (height, width):
        raise InputError(
            f"{path} is {depth_m.shape[1]}x{depth_m.shape[0]} px but the clip is {width}x{height} px: resize the depth to that size"
        )
    return depth_m

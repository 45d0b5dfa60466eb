"""Camera, focus, depth, matte and look of each frame, from files and from the clip itself.

Depth that is found from the clip and the track of its moving camera is kept in a folder beside the track.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from time import monotonic

import numpy as np
from jaxtyping import Float32

from mrbokeh.compositing.plate import Inserted, Plate, read_matte
from mrbokeh.compositing.plate_look.colour_match import ColourMatch, triple_of
from mrbokeh.compositing.plate_look.exposure_match import stated_exposure
from mrbokeh.compositing.plate_look.finishing import Finishing, LookOptions, finished, finishing_of
from mrbokeh.depth.depth_filters import TemporalDepthFilter
from mrbokeh.depth.open_depth import depth_of_file
from mrbokeh.depth.views import DEPTH_NAME
from mrbokeh.images.color_management import NamedSpace
from mrbokeh.optics.camera import Camera, have_same_shape
from mrbokeh.shots.inputs import CameraSource, DepthSource, Finisher, FocusSource, Kept, MatteSource, Moment
from mrbokeh.system.atomic_files import read_json, writing_alone
from mrbokeh.system.console import kept_when_interrupted
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import say
from mrbokeh.tracking.camera_track.focus_pull import FocusPull, parse_focus_keys, read_focus_pull
from mrbokeh.tracking.camera_track.formats import format_of_file, read_track
from mrbokeh.tracking.camera_track.track import CameraTrack, TrackedFrame, TrackOptions
from mrbokeh.video.clip import VideoInfo
from mrbokeh.video.image_sequence import STOP, held_number, is_pattern, numbered, numbers_of
from mrbokeh.video.picture_source import PictureSource, open_source
from mrbokeh.video.proxy_source import ProxySource

Plane = Float32[np.ndarray, "height width"]
_WARM_UP = 48


@dataclass(frozen=True)
class CameraFile:
    """Description of a fixed camera (JSON) or a track, in any form that mrbokeh.tracking.camera_track reads.

    size_px, frame_rate: of the clip. up: what points up in the world of the scene that it looks at (mrbokeh.shots.frame_sources).
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
        """Return the camera of a frame; beyond the ends of the track it stays where it was."""
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
        """Parse the command line's text: a file by its suffix .csv, else keys."""
        return cls(path=Path(text).resolve()) if text.lower().endswith(".csv") else cls(text)

    @property
    def files(self) -> tuple[Path, ...]:
        return () if self.path is None else (self.path,)

    def opened(self, threads: int) -> FocusSource:  # noqa: ARG002
        return self._pull

    @property
    def _pull(self) -> FocusPull:
        return parse_focus_keys(self.keys, "smooth") if self.path is None else read_focus_pull(self.path).smoothed()

    def require_reached(self, numbers: Sequence[int]) -> None:
        """Raise InputError if all keys of a pull lie before the frames, or all behind: the focus would stand still."""
        first, last = self._pull.frames[0], self._pull.frames[-1]
        if first < last and (last < numbers[0] or first > numbers[-1]):
            raise InputError(
                f"--focus-pull has its keys from frame {first:g} to {last:g}, but the frames taken are {numbers[0]}-{numbers[-1]}: "
                f"count its keys as the files do, or say by --first-number what the clip's first frame is called"
            )


@dataclass(frozen=True)
class DepthFiles:
    """Description of the depth of the photographed scene: one file for all frames, or numbered ones (depth.%04d.exr).

    steady: numbered depth goes through a temporal filter. It looks at 48 frames before the first one asked for, so that
    a segment begins as if the one before had gone through it too; the clip itself begins with a filter that has settled.
    near_far_m: metres of the largest and the smallest number of pictures that are even in 1/distance. with_holes: NaN is unknown depth.
    """

    path: Path
    steady: bool = False
    near_far_m: tuple[float, float] | None = None
    with_holes: bool = False

    def read(self, name: str | Path) -> Plane:
        """Read one file of depth."""
        return depth_of_file(Path(name), self.near_far_m, with_holes=self.with_holes)

    @property
    def files(self) -> tuple[Path, ...]:
        return (self.path,)

    def opened(self, threads: int) -> DepthSource:  # noqa: ARG002
        return _SteadyDepth(self) if self.steady and is_pattern(self.path) else _Depth(self)


class _Depth:
    def __init__(self, described: DepthFiles) -> None:
        self._path, self._read = described.path, Kept(described.read)

    def depth_m_at(self, moment: Moment) -> Plane:
        return _of_size(self._read(str(_file_at(self._path, moment.number))), moment, self._path)


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
        self._path, self._read = path, Kept(lambda name: read_matte(Path(name)))

    def near_alpha_at(self, moment: Moment) -> Plane:
        return _of_size(self._read(str(_file_at(self._path, moment.number))), moment, self._path)


def _file_at(path: Path, number: int) -> Path:
    """Return a frame's file; where it is missing, which was allowed before the work then, the one before."""
    there = numbered(path, number)
    return there if there.exists() or not is_pattern(path) else numbered(path, held_number(numbers_of(path), number))


class _SteadyDepth:
    def __init__(self, described: DepthFiles) -> None:
        self._described, self._filter = described, TemporalDepthFilter()
        self._next: int | None = None
        self._plane: Plane | None = None

    def depth_m_at(self, moment: Moment) -> Plane:
        if self._plane is None or self._next != moment.number + 1:
            for number in self._still_to_go(moment.number):
                self._plane = self._filter.filtered(self._described.read(_file_at(self._described.path, number)))
            self._next = moment.number + 1
        assert self._plane is not None
        return _of_size(self._plane, moment, self._described.path)

    def _still_to_go(self, number: int) -> Sequence[int]:
        """Return the numbers to filter: the next one; a new filter first sees the frames before, at the clip's beginning those behind,
        backwards.
        """
        if self._next == number:
            return [number]
        self._filter = TemporalDepthFilter()
        first = next(each for each in range(max(number - _WARM_UP, 0), number + 1) if each == number or self._is_there(each))
        if first > 0 and self._is_there(first - 1):
            return range(first, number + 1)
        ahead = [each for each in range(first + 1, first + _WARM_UP + 1) if self._is_there(each)]
        return [*reversed(ahead), *range(first, number + 1)]

    def _is_there(self, number: int) -> bool:
        return numbered(self._described.path, number).exists()


def _of_size(plane: Plane, moment: Moment, path: Path) -> Plane:
    width, height = moment.size_px
    if plane.shape != (height, width):
        raise InputError(f"{path} is {plane.shape[1]}x{plane.shape[0]} px but the clip is {width}x{height} px: resize it to that size")
    return plane


@dataclass(frozen=True)
class ClipLook:
    """Description of a Finisher: options as typed, and the clip whose frames `start` and the next are measured, by every worker alike.

    Exposures are those that numbered pictures state, each its own: a camera that steps its exposure from frame to frame takes the
    virtual light with it. An exposure that the user states is that of all frames. first_number: of the clip's frame 0. space: of its
    numbers.
    """

    options: LookOptions
    clip: Path
    rate: str | None
    start: int
    first_number: int = 0
    space: NamedSpace | None = None
    missing: str = STOP
    proxy: Fraction = Fraction(1)

    @property
    def files(self) -> tuple[Path, ...]:
        texts = (self.options.grain, self.options.vignetting, self.options.match_exposure)
        return tuple(path for path in (Path(text) for text in texts if text) if path.is_file())

    def opened(self, threads: int) -> Finisher:
        source = ProxySource.of(open_source(self.clip, self.rate, self.space, self.missing), self.proxy)
        stop = min(self.start + 2, len(source.times_s))
        first, *rest = (frame.rgb for frame in source.frames(self.start, stop, threads))
        finishing = finishing_of(self.options, first, source.file_of(self.start), rest[0] if rest else None)
        if self.options.match_exposure is None or self.options.plate_exposure is not None:
            return _Look(finishing)
        return _ExposedLook(finishing, self._exposures(source))

    def _exposures(self, source: PictureSource) -> Callable[[int], float]:
        """Return, by a frame's number, how much brighter it shows the same light than the frame `start`."""

        def brightness(index: int) -> float:
            path = source.file_of(index)
            assert path is not None  # or the Finishing would have been refused
            return stated_exposure(path).brightness

        measured = brightness(self.start)
        return lambda number: brightness(number - self.first_number) / measured


class _Look:
    def __init__(self, finishing: Finishing) -> None:
        self._finishing = finishing

    def finished(self, inserted: Inserted, plate: Plate, number: int) -> Inserted:
        return finished(inserted, plate, self._finishing, number)


class _ExposedLook:
    """Look with a gain for every frame."""

    def __init__(self, finishing: Finishing, change: Callable[[int], float]) -> None:
        self._finishing, self._change = finishing, change

    def finished(self, inserted: Inserted, plate: Plate, number: int) -> Inserted:
        colour = self._finishing.colour or ColourMatch()
        gained = replace(colour, gain=triple_of(np.array(colour.gain) * self._change(number)))
        return finished(inserted, plate, replace(self._finishing, colour=gained), number)


def scene_track(path: Path, size_px: tuple[int, int], scene_up: str) -> CameraTrack:
    """Read a camera track whose world points up as the scene's does.

    size_px: (width, height) of the plate. scene_up: what points up in the world of the scene, in which its objects are placed.

    A file of one camera does not say what is up, so it is the scene's. Any other track has an axis of its own; if that is another one,
    places of objects and poses of the camera are not of one world, and no turn can tell which of them is meant: InputError. Pictures of
    the track with another shape than the plate raise InputError too.
    """
    is_single = _is_single_camera(path)
    track = read_track(path, TrackOptions(up=scene_up, size_px=size_px) if is_single else TrackOptions(size_px=size_px))
    if not have_same_shape(track.size_px, size_px):
        raise InputError(
            f"{path}: expected a camera for pictures of the plate's shape ({size_px[0]}x{size_px[1]}), got one for "
            f"{track.size_px[0]}x{track.size_px[1]}: was it made for another clip, or for one that is turned or cropped?"
        )
    if not is_single and track.up != scene_up:
        raise InputError(
            f"{path}: {track.up} points up in this track{_remark(path)}, but {scene_up} in the scene: where the scene's places are the "
            f"track's, write up = {track.up!r} into the scene file, else turn the track: "
            f"mrbokeh track convert {path.name} turned.json --out-up={scene_up}"
        )
    return track


def _is_single_camera(path: Path) -> bool:
    if not path.exists() or format_of_file(path) != "json":
        return False
    document = read_json(path, "a camera track")
    return isinstance(document, dict) and "camera_from_world" in document


def _remark(path: Path) -> str:
    """Return a hint that COLMAP's usual axis may be stated otherwise."""
    return " (as in most of COLMAP's maps; state another by --up in that conversion)" if format_of_file(path) == "colmap" else ""


def found_depth_files(camera: Path, clip: Path) -> Path:
    """Return the pattern of the files that hold the depth of a tracked clip. camera: its track."""
    return _folder(camera, clip) / DEPTH_NAME


def _folder(camera: Path, clip: Path) -> Path:
    """Return where the depth of a tracked clip is kept: beside the track."""
    name = re.sub(r"\W+", "_", re.sub(r"%0?\d*d|#+", "", clip.stem)).strip("_")
    return camera.resolve().with_name(f"{camera.stem}_{name}_depth")


def find_depth(source: PictureSource, camera: Path, taken: Sequence[int], first_number: int) -> None:
    """Find the depth of the frames that are taken, as far as it is not kept from an earlier run."""
    from mrbokeh.depth.views.clip_depth import ClipDepth
    from mrbokeh.tracking.camera_track.formats import read_track
    from mrbokeh.tracking.camera_track.track import TrackOptions

    size_px, folder = (source.info.width_px, source.info.height_px), _folder(camera, source.path)
    track = read_track(camera, TrackOptions(size_px=size_px))
    if not track.metric:
        say(f"the lengths of {camera.name} may not be metres: depth is in its unit, as places in a scene and Z of layers have to be")
    found = ClipDepth(source, track, folder, first_number)
    began_s = monotonic()
    with writing_alone(folder), kept_when_interrupted(f"finished depth is kept in {folder}"):
        made = found.write(taken)
    if made:
        took_s = (monotonic() - began_s) / made
        say(f"depth of {made} frames lies in {folder} ({took_s:.1f} s a frame); what moves by itself has that of what is behind it")

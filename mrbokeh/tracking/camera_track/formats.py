"""Camera tracks in files of many kinds, chosen by name or by content.

json            our own, or a single camera            opentrackio     JSON samples of SMPTE's OpenTrackIO 1.0.1
chan            Nuke                                   colmap          a folder with cameras.txt and images.txt
nerfstudio      transforms.json                        colmap-binary   the same as .bin

Our own JSON holds everything of a CameraTrack:

    {"format": "mrbokeh-camera-track", "version": 1, "up": "-z", "metric": true, "fixed": false,
     "frames": [{"frame": 0, "time_s": 0.0, "camera": {...}, "focus_distance_m": 1.2, "f_number": 2.8, "distortion": {"k1": -0.1}}]}

camera is that of `mrbokeh.optics.camera`. Unknown values are left out; focus_distance_m null is infinity. A file with one camera and
nothing else is a camera on a tripod.
"""

import math
from collections.abc import Callable
from pathlib import Path
from types import MappingProxyType
from typing import Any

from mrbokeh.optics.camera import camera_from_json, camera_to_json
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track import colmap_file, opentrackio_file
from mrbokeh.tracking.camera_track.program_files import read_chan, read_nerfstudio, write_chan, write_nerfstudio
from mrbokeh.tracking.camera_track.track import CameraTrack, TrackedFrame, TrackOptions, fixed_track

FORMAT = "mrbokeh-camera-track"
VERSION = 1


def read_own(path: Path, options: TrackOptions) -> CameraTrack:
    """Read our own JSON. Raises InputError if it is of another version or incomplete."""
    document = read_json(path, "a camera track")
    if isinstance(document, dict) and "camera_from_world" in document:
        return fixed_track(camera_from_json(document, str(path)), options.up or "-z")
    if not isinstance(document, dict) or document.get("format") != FORMAT or document.get("version") != VERSION:
        raise InputError(f"{path}: expected a camera track (format {FORMAT!r}, version {VERSION}) or a single camera; see `mrbokeh track`")
    try:
        frames = {int(each["frame"]): _frame(each, f"{path}, frame {each['frame']}") for each in document["frames"]}
        if len(frames) < len(document["frames"]):
            raise InputError(f"{path}: two of its frames have the same number")
        metric = options.is_metric(bool(document.get("metric", True)))
        return CameraTrack(frames, options.up or document["up"], metric, bool(document.get("fixed", False)))
    except (KeyError, TypeError, ValueError) as error:
        raise error if isinstance(error, InputError) else InputError(f"{path}: not a whole camera track ({error!r})") from None


def write_own(path: Path, track: CameraTrack, options: TrackOptions) -> tuple[str, ...]:
    write_json(path, track_to_json(track.with_up(options.up or track.up)))
    return ()


def track_to_json(track: CameraTrack) -> dict[str, Any]:
    frames = [{"frame": number, **_frame_to_json(track.frames[number])} for number in track.numbers]
    return {"format": FORMAT, "version": VERSION, "up": track.up, "metric": track.metric, "fixed": track.fixed, "frames": frames}


def _frame_to_json(frame: TrackedFrame) -> dict[str, Any]:
    document: dict[str, Any] = {"camera": camera_to_json(frame.camera)}
    if frame.time_s is not None:
        document["time_s"] = frame.time_s
    if frame.focus_distance_m is not None:
        document["focus_distance_m"] = frame.focus_distance_m if math.isfinite(frame.focus_distance_m) else None
    if frame.f_number is not None:
        document["f_number"] = frame.f_number
    if frame.distortion is not None:
        document["distortion"] = dict(frame.distortion)
    return document


def _frame(document: dict[str, Any], where: str) -> TrackedFrame:
    focus_m = document.get("focus_distance_m", math.inf) if "focus_distance_m" in document else None
    if "focus_distance_m" in document and document["focus_distance_m"] is None:
        focus_m = math.inf
    numbers = {name: float(document[name]) for name in ("f_number", "time_s") if name in document}
    distortion = {str(name): float(value) for name, value in document["distortion"].items()} if "distortion" in document else None
    camera = camera_from_json(document["camera"], where)
    return TrackedFrame(camera, None if focus_m is None else float(focus_m), distortion=distortion, **numbers)


Read = Callable[[Path, TrackOptions], CameraTrack]
Write = Callable[[Path, CameraTrack, TrackOptions], tuple[str, ...]]

FORMATS: MappingProxyType[str, tuple[Read, Write]] = MappingProxyType(
    {
        "json": (read_own, write_own),
        "chan": (read_chan, write_chan),
        "nerfstudio": (read_nerfstudio, write_nerfstudio),
        "opentrackio": (opentrackio_file.read, opentrackio_file.write),
        "colmap": (colmap_file.read, colmap_file.write_text),
        "colmap-binary": (colmap_file.read, colmap_file.write_binary),
    }
)


def read_track(path: Path | str, options: TrackOptions | None = None, format_: str | None = None) -> CameraTrack:
    """Read a camera track. Raises InputError if the file is none of FORMATS, incomplete, or needs an option to be understood."""
    path = Path(path)
    if not path.exists():
        raise InputError(f"expected a camera track at {path}, but there is none")
    return FORMATS[_checked(format_ or format_of_file(path))][0](path, options or TrackOptions())


def write_track(path: Path | str, track: CameraTrack, options: TrackOptions | None = None, format_: str | None = None) -> tuple[str, ...]:
    """Write a camera track. Returns what the format cannot hold and the file therefore lacks, in words."""
    return FORMATS[_checked(format_ or format_of_name(Path(path)))][1](Path(path), track, options or TrackOptions())


def format_of_name(path: Path) -> str:
    """Return the format by name: transforms.json is nerfstudio's, any other .json ours, .jsonl OpenTrackIO, no suffix a COLMAP folder."""
    if path.name == "transforms.json":
        return "nerfstudio"
    names = {".json": "json", ".chan": "chan", ".jsonl": "opentrackio", "": "colmap"}
    if path.suffix.lower() not in names:
        raise InputError(f"cannot tell by {path.name} what kind of camera track to write: name it by --format, one of {', '.join(FORMATS)}")
    return names[path.suffix.lower()]


def format_of_file(path: Path) -> str:
    """Return the format by suffix, or by content if the suffix leaves it open."""
    if path.is_dir():
        return "colmap"
    if path.suffix.lower() != ".json":
        return format_of_name(path)
    document = read_json(path, "a camera track")
    first = document[0] if isinstance(document, list) and document else document
    if isinstance(first, dict) and isinstance(first.get("protocol"), dict):
        return "opentrackio"
    frames = first.get("frames") if isinstance(first, dict) else None
    if isinstance(frames, list) and frames and isinstance(frames[0], dict) and "transform_matrix" in frames[0]:
        return "nerfstudio"
    return "json"


def _checked(name: str) -> str:
    if name not in FORMATS:
        raise InputError(f"expected a kind of camera track, one of {', '.join(FORMATS)}, got {name!r}")
    return name

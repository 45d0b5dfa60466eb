"""Camera tracks in files of many kinds, chosen by name or by what the file is.

json            our own, or a single camera            opentrackio     JSON samples of SMPTE's OpenTrackIO 1.0.1
chan            Nuke                                   colmap          a folder with cameras.txt and images.txt
nerfstudio      transforms.json                        colmap-binary   the same as .bin
"""

from collections.abc import Callable
from pathlib import Path
from types import MappingProxyType

from mrbokeh.system.atomic_files import read_json
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track import chan_file, colmap_file, nerfstudio_file, opentrackio_file
from mrbokeh.tracking.camera_track.track import CameraTrack, TrackOptions, read_own, write_own

Read = Callable[[Path, TrackOptions], CameraTrack]
Write = Callable[[Path, CameraTrack, TrackOptions], tuple[str, ...]]

FORMATS: MappingProxyType[str, tuple[Read, Write]] = MappingProxyType(
    {
        "json": (read_own, write_own),
        "chan": (chan_file.read, chan_file.write),
        "nerfstudio": (nerfstudio_file.read, nerfstudio_file.write),
        "opentrackio": (opentrackio_file.read, opentrackio_file.write),
        "colmap": (colmap_file.read, colmap_file.write_text),
        "colmap-binary": (colmap_file.read, colmap_file.write_binary),
    }
)


def read_track(path: Path | str, options: TrackOptions | None = None, format_: str | None = None) -> CameraTrack:
    """Raises InputError where the file is none of FORMATS, incomplete, or needs an option to be understood."""
    path = Path(path)
    if not path.exists():
        raise InputError(f"expected a camera track at {path}, but there is none")
    return FORMATS[_checked(format_ or format_of_file(path))][0](path, options or TrackOptions())


def write_track(path: Path | str, track: CameraTrack, options: TrackOptions | None = None, format_: str | None = None) -> tuple[str, ...]:
    """Returns what the format cannot hold and the file therefore lacks, in words."""
    return FORMATS[_checked(format_ or format_of_name(Path(path)))][1](Path(path), track, options or TrackOptions())


def format_of_name(path: Path) -> str:
    """transforms.json is nerfstudio's, any other .json ours, .jsonl OpenTrackIO; a name without suffix becomes a COLMAP folder."""
    if path.name == "transforms.json":
        return "nerfstudio"
    names = {".json": "json", ".chan": "chan", ".jsonl": "opentrackio", "": "colmap"}
    if path.suffix.lower() not in names:
        raise InputError(f"cannot tell by {path.name} what kind of camera track to write: name it by --format, one of {', '.join(FORMATS)}")
    return names[path.suffix.lower()]


def format_of_file(path: Path) -> str:
    """By what is in it where the suffix leaves it open."""
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

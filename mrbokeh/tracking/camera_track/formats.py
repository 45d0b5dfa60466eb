"""Camera tracks in files of many kinds, chosen by name or by content.

json            our own, or a single camera            opentrackio     JSON samples of SMPTE's OpenTrackIO 1.0.1
chan            Nuke                                   colmap          a folder with cameras.txt and images.txt
nerfstudio      transforms.json                        colmap-binary   the same as .bin

Our own JSON holds everything of a CameraTrack:

    {"format": "mrbokeh-camera-track", "version": 1, "up": "-z", "metric": true, "fixed": false,
     "frames": [{"frame": 0, "time_s": 0.0, "camera": {...}, "focus_distance_m": 1.2, "f_number": 2.8, "distortion": {"k1": -0.1}}]}

camera is that of `mrbokeh.optics.camera`. Unknown values are left out; focus_distance_m null is infinity. A file with one camera and
nothing else is a camera on a tripod.

A .chan has one line a frame with FRAME TX TY TZ RX RY RZ VFOV. Y is up, the camera looks along -z; angles in degrees, the vertical angle
of view last. The rotation order names the rotation that is applied to points first: Nuke's own is ZXY, that is roll, then tilt, then pan.
The file tells neither it nor the size of the pictures; pixels are square and the principal point lies in the middle.

transforms.json (nerfstudio, instant-ngp) has cameras as OpenGL has them, one intrinsic for all frames or one for each. World points come
out with z up, unless the options say otherwise (nerfstudio turns its worlds so; ARKit's have +y up). The unit of lengths is not told.
"""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from mrbokeh.optics.camera import Camera, camera_from_json, camera_to_json
from mrbokeh.system.atomic_files import atomic_path, read_json, write_json
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track import colmap_file, opentrackio_file
from mrbokeh.tracking.camera_track.track import (
    DISTORTION_NAMES,
    CameraTrack,
    TrackedFrame,
    TrackOptions,
    fixed_track,
    frame_numbers,
    is_rigid,
    lost,
    picture_name,
)
from mrbokeh.tracking.world_axes import from_opengl, rigid, to_opengl

_COLUMNS = "FRAME TX TY TZ RX RY RZ VFOV"
_CHAN_UP = "+y"


def read_chan(path: Path, options: TrackOptions) -> CameraTrack:
    """Read a .chan; options.size_px is needed. Raises InputError with the line that is wrong."""
    if options.size_px is None:
        raise InputError(f"{path}: a .chan does not tell the size of the pictures: give --size WIDTHxHEIGHT")
    frames: dict[int, TrackedFrame] = {}
    for line_number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        values = _chan_values(line, f"{path}, line {line_number}")
        frame = round(values[0])
        if frame in frames:
            raise InputError(f"{path}, line {line_number}: frame {frame} comes twice")
        frames[frame] = TrackedFrame(_chan_camera(values[1:], options.size_px, options.rotation_order))
    if not frames:
        raise InputError(f"{path} holds no frame: expected lines of {_COLUMNS}")
    return CameraTrack(frames, options.up or _CHAN_UP, options.is_metric(True))


def write_chan(path: Path, track: CameraTrack, options: TrackOptions) -> tuple[str, ...]:
    """Write a .chan with all digits. Returns what it cannot hold."""
    turned = track.with_up(options.up or _CHAN_UP)
    lines = [_chan_line(number, turned.frames[number].camera, options.rotation_order) for number in turned.numbers]
    with atomic_path(path) as temporary:
        temporary.write_text("".join(lines), encoding="utf-8")
    return lost(track)


def _chan_values(line: str, where: str) -> list[float]:
    try:
        values = [float(each) for each in line.split()]
    except ValueError:
        values = []
    if len(values) != 8 or not np.isfinite(values).all() or not 0.0 < values[7] < 180.0:
        raise InputError(f"{where}: expected 8 numbers, {_COLUMNS} (in degrees, VFOV between 0 and 180), got {line.strip()!r}")
    return values


def _chan_camera(values: Sequence[float], size_px: tuple[int, int], order: str) -> Camera:
    from scipy.spatial.transform import Rotation

    place, angles_deg, view_deg = values[:3], values[3:6], values[6]
    width_px, height_px = size_px
    focal_px = 0.5 * height_px / np.tan(np.deg2rad(view_deg) / 2.0)
    # Lower case stands for fixed axes, in the order of application.
    turn = Rotation.from_euler(order.lower(), _in_order(angles_deg, order), degrees=True)
    pose = from_opengl(rigid(turn.as_matrix(), np.asarray(place, np.float64)))
    return Camera(
        width_px=width_px,
        height_px=height_px,
        focal_px=(float(focal_px), float(focal_px)),
        principal_px=(width_px / 2.0, height_px / 2.0),
        camera_from_world=pose,
    )


def _in_order(xyz_deg: Sequence[float], order: str) -> list[float]:
    return [xyz_deg["XYZ".index(axis)] for axis in order]


def _chan_line(number: int, camera: Camera, order: str) -> str:
    world_from_camera = to_opengl(camera.camera_from_world)
    angles_deg = _euler_deg(world_from_camera[:3, :3], order)
    view_deg = np.rad2deg(2.0 * np.arctan(0.5 * camera.height_px / camera.focal_px[1]))
    return " ".join([str(number), *(repr(float(value)) for value in (*world_from_camera[:3, 3], *angles_deg, view_deg))]) + "\n"


def _euler_deg(rotation: np.ndarray, order: str) -> list[float]:
    """Return angles of x, y, z. If the middle rotation is a right angle, many triples are one rotation: SciPy chooses, and would warn."""
    from scipy.spatial.transform import Rotation

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        angles = Rotation.from_matrix(rotation).as_euler(order.lower(), degrees=True)
    return [float(angles[order.index(axis)]) for axis in "XYZ"]


_NERFSTUDIO_UP = "+z"
_PINHOLES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV", "perspective")
_INTRINSICS = ("w", "h", "fl_x", "fl_y", "cx", "cy")


def read_nerfstudio(path: Path, options: TrackOptions) -> CameraTrack:
    """Read a transforms.json. Raises InputError for fisheye and other cameras that are no pinhole with distortion."""
    document = read_json(path, "a transforms.json")
    try:
        names = [str(each["file_path"]) for each in document["frames"]]
        frames = [_nerfstudio_frame({**document, **each}, options, f"{path}, {each['file_path']}") for each in document["frames"]]
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: not a whole transforms.json with frames, file_path and transform_matrix ({error!r})") from None
    return CameraTrack(dict(zip(frame_numbers(names), frames, strict=True)), options.up or _NERFSTUDIO_UP, options.is_metric(False))


def write_nerfstudio(path: Path, track: CameraTrack, options: TrackOptions) -> tuple[str, ...]:
    """Write a transforms.json; intrinsics are shared if all frames have the same. Returns what it cannot hold."""
    turned = track.with_up(options.up or _NERFSTUDIO_UP)
    intrinsics = {number: _intrinsics_to_json(turned.frames[number]) for number in turned.numbers}
    first = intrinsics[turned.numbers[0]]
    shared = first if all(each == first for each in intrinsics.values()) else {}
    frames = [
        {
            "file_path": picture_name(number),
            "transform_matrix": to_opengl(turned.frames[number].camera.camera_from_world).tolist(),
            **({} if shared else intrinsics[number]),
        }
        for number in turned.numbers
    ]
    write_json(path, {"camera_model": "OPENCV", **shared, "frames": frames})
    return lost(track, ("lens distortion", "principal points off the middle", "pixels that are not square"))


def _nerfstudio_frame(document: Mapping[str, Any], options: TrackOptions, where: str) -> TrackedFrame:
    """Return one frame. document: its own values over the shared ones."""
    if (model := document.get("camera_model", "OPENCV")) not in _PINHOLES or document.get("is_fisheye"):
        raise InputError(f"{where}: expected a pinhole camera with distortion, got {model}: undistort the pictures first")
    pose = np.asarray(document["transform_matrix"], np.float64)
    if not is_rigid(pose):
        raise InputError(f"{where}: transform_matrix must be a rotation and a shift (4x4), but it is not")
    told = {name: float(document[name]) for name in DISTORTION_NAMES if name in document} if options.keep_distortion else {}
    return TrackedFrame(_nerfstudio_camera(document, pose, where), distortion=told if any(told.values()) else None)


def _nerfstudio_camera(document: Mapping[str, Any], pose: np.ndarray, where: str) -> Camera:
    """Return the camera; missing values follow instant-ngp: an angle of view for a focal length, one for both axes, the middle."""
    if "w" not in document or "h" not in document:
        raise InputError(f"{where}: expected the size of the pictures as w and h")
    width_px, height_px = round(float(document["w"])), round(float(document["h"]))
    across = _focal_px(document, "x", width_px)
    down = _focal_px(document, "y", height_px)
    focal_x, focal_y = across or down, down or across
    if focal_x is None or focal_y is None:
        raise InputError(f"{where}: expected a focal length as fl_x or camera_angle_x")
    principal_px = float(document.get("cx", width_px / 2.0)), float(document.get("cy", height_px / 2.0))
    return Camera(
        width_px=width_px, height_px=height_px, focal_px=(focal_x, focal_y), principal_px=principal_px, camera_from_world=from_opengl(pose)
    )


def _focal_px(document: Mapping[str, Any], axis: str, side_px: int) -> float | None:
    if f"fl_{axis}" in document:
        return float(document[f"fl_{axis}"])
    if f"camera_angle_{axis}" in document:
        return 0.5 * side_px / math.tan(0.5 * float(document[f"camera_angle_{axis}"]))
    return None


def _intrinsics_to_json(frame: TrackedFrame) -> dict[str, float | int]:
    camera = frame.camera
    values = camera.width_px, camera.height_px, *camera.focal_px, *camera.principal_px
    return {**dict(zip(_INTRINSICS, values, strict=True)), **frame.coefficients}


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

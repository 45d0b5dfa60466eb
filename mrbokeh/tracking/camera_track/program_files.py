"""Camera tracks of other programs in one file: Nuke's .chan, and transforms.json of nerfstudio and instant-ngp.

A .chan has one line a frame with FRAME TX TY TZ RX RY RZ VFOV. Y is up, the camera looks along -z; angles in degrees, the vertical angle
of view last. The rotation order names the rotation that is applied to points first: Nuke's own is ZXY, that is roll, then tilt, then pan.
The file tells neither it nor the size of the pictures; pixels are square and the principal point lies in the middle.

transforms.json has cameras as OpenGL has them, one intrinsic for all frames or one for each. World points come out with z up, unless the
options say otherwise (nerfstudio turns its worlds so; ARKit's have +y up). The unit of lengths is not told.
"""

import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mrbokeh.optics.camera import Camera
from mrbokeh.system.atomic_files import atomic_path, read_json, write_json
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.track import (
    DISTORTION_NAMES,
    CameraTrack,
    TrackedFrame,
    TrackOptions,
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

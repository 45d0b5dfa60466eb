"""transforms.json of nerfstudio and instant-ngp: cameras as OpenGL has them, one intrinsic for all frames or one for each.

World points come out with z up, unless the options say otherwise (nerfstudio turns its worlds so; ARKit's have +y up). The unit of
lengths is not told; structure from motion leaves it open.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mrbokeh.optics.camera import Camera
from mrbokeh.system.atomic_files import read_json, write_json
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
from mrbokeh.tracking.world_axes import from_opengl, to_opengl

_UP = "+z"
_PINHOLES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV", "perspective")
_INTRINSICS = ("w", "h", "fl_x", "fl_y", "cx", "cy")


def read(path: Path, options: TrackOptions) -> CameraTrack:
    """Read a transforms.json. Raises InputError for fisheye and other cameras that are no pinhole with distortion."""
    document = read_json(path, "a transforms.json")
    try:
        names = [str(each["file_path"]) for each in document["frames"]]
        frames = [_frame({**document, **each}, options, f"{path}, {each['file_path']}") for each in document["frames"]]
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: not a whole transforms.json with frames, file_path and transform_matrix ({error!r})") from None
    return CameraTrack(dict(zip(frame_numbers(names), frames, strict=True)), options.up or _UP, options.is_metric(False))


def write(path: Path, track: CameraTrack, options: TrackOptions) -> tuple[str, ...]:
    """Write a transforms.json; intrinsics are shared if all frames have the same. Returns what it cannot hold."""
    turned = track.with_up(options.up or _UP)
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


def _frame(document: Mapping[str, Any], options: TrackOptions, where: str) -> TrackedFrame:
    """Return one frame. document: its own values over the shared ones."""
    if (model := document.get("camera_model", "OPENCV")) not in _PINHOLES or document.get("is_fisheye"):
        raise InputError(f"{where}: expected a pinhole camera with distortion, got {model}: undistort the pictures first")
    pose = np.asarray(document["transform_matrix"], np.float64)
    if not is_rigid(pose):
        raise InputError(f"{where}: transform_matrix must be a rotation and a shift (4x4), but it is not")
    told = {name: float(document[name]) for name in DISTORTION_NAMES if name in document} if options.keep_distortion else {}
    return TrackedFrame(_camera(document, pose, where), distortion=told if any(told.values()) else None)


def _camera(document: Mapping[str, Any], pose: np.ndarray, where: str) -> Camera:
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

"""OpenTrackIO 1.0.1 samples (SMPTE RIS, opentrackio.org) as JSON: one sample, a list of them, or one on each line (.jsonl).

The stage is Z up and right-handed, a camera without rotation looks along +Y; `transforms` are composed in order, each with the
intrinsic rotations pan (about Z), tilt (X), roll (Y) in degrees. Lens values are turned by "Conversion of OpenCV to OpenTrackIO
lens calibration parameters" (SMPTE RIS, 2025-09-02): lengths on the sensor are millimetres from the middle of the picture, right and
down, so that coefficients of r^2n are those of OpenCV over F^2n; in `radial` those above and below the bar alternate. Tangential
ones, of second order in millimetres, are those of OpenCV over F.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mrbokeh.atomic_files import atomic_path
from mrbokeh.camera_track.opentrackio_lens import camera_on_stage, distortion_of, lens_document, static_document
from mrbokeh.camera_track.options import TrackOptions, lost
from mrbokeh.camera_track.track import CameraTrack
from mrbokeh.camera_track.tracked_frame import TrackedFrame
from mrbokeh.camera_track.world_axes import inverted, rigid, with_up
from mrbokeh.errors import InputError

_UP = "+z"
_STAGE_FROM_OURS = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Camera axes: ours look along +z with y down, the stage's along +y with z up."""

_STEEP = 1e-9


def read(path: Path, options: TrackOptions) -> CameraTrack:
    """Frames are numbered in the order of samples, times count from the first one; other cameras' samples must be taken out before."""
    samples = _samples(path)
    static: dict[str, Any] = {}
    frames = {}
    first_s: float | None = None
    for number, sample in enumerate(samples):
        where = f"{path}, sample {number}"
        try:
            static = sample.get("static", static)
            time_s = _seconds(sample.get("timing", {}).get("sampleTimestamp"))
            first_s = time_s if first_s is None else first_s
            elapsed_s = None if time_s is None or first_s is None else time_s - first_s
            frames[number] = _frame(sample, static, options, where, elapsed_s)
        except (KeyError, TypeError, ValueError) as error:
            raise error if isinstance(error, InputError) else InputError(f"{where}: not a whole OpenTrackIO sample ({error!r})") from None
    if not frames:
        raise InputError(f"{path} holds no OpenTrackIO sample")
    return CameraTrack(frames, options.up or _UP, options.is_metric(True))


def write(path: Path, track: CameraTrack, options: TrackOptions) -> tuple[str, ...]:
    """.jsonl gets a sample on each line, anything else one list."""
    turned = with_up(track, options.up or _UP)
    sensor_mm = options.sensor_width_mm or 36.0
    samples = [_sample(turned.frames[number], sensor_mm) for number in turned.numbers]
    lines = "".join(json.dumps(each) + "\n" for each in samples) if path.suffix == ".jsonl" else json.dumps(samples, indent=1) + "\n"
    with atomic_path(path) as temporary:
        temporary.write_text(lines, encoding="utf-8")
    kept = ("focus distances", "f-numbers", "times", "lens distortion", "principal points off the middle", "pixels that are not square")
    numbers = () if turned.numbers == list(range(len(samples))) else ("frame numbers that do not count from 0",)
    return lost(track, kept) + numbers


def _samples(path: Path) -> list[dict[str, Any]]:
    text = path.read_text(encoding="utf-8")
    try:
        document = [json.loads(line) for line in text.splitlines() if line.strip()] if path.suffix == ".jsonl" else json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(f"expected OpenTrackIO samples in {path}, but it is not JSON: {error}") from None
    samples = document if isinstance(document, list) else [document]
    if not all(isinstance(each, dict) and each.get("protocol", {}).get("name") == "OpenTrackIO" for each in samples):
        raise InputError(f"{path}: expected samples whose protocol is OpenTrackIO")
    return samples


def _frame(sample: Mapping[str, Any], static: Mapping[str, Any], options: TrackOptions, where: str, time_s: float | None) -> TrackedFrame:
    lens = sample.get("lens", {})
    stage_from_camera = np.eye(4)
    for transform in sample["transforms"]:
        stage_from_camera = stage_from_camera @ _motion(transform)
    camera_from_world = inverted(stage_from_camera @ _STAGE_FROM_OURS)
    camera, focal_mm = camera_on_stage(static, lens, camera_from_world, options, where)
    distortion = distortion_of(lens, focal_mm, where) if options.keep_distortion else None
    focus_m, f_number = (None if lens.get(name) is None else float(lens[name]) for name in ("focusDistance", "fStop"))
    return TrackedFrame(camera, focus_m, f_number, time_s, distortion)


def _motion(transform: Mapping[str, Any]) -> np.ndarray:
    place, turn = transform["translation"], transform.get("rotation", {"pan": 0.0, "tilt": 0.0, "roll": 0.0})
    if "scale" in transform:
        raise ValueError("transforms with a scale are not read")
    rotation = Rotation.from_euler("ZXY", [float(turn[name]) for name in ("pan", "tilt", "roll")], degrees=True)
    return rigid(rotation.as_matrix(), np.array([float(place[name]) for name in "xyz"]))


def _sample(frame: TrackedFrame, sensor_mm: float) -> dict[str, Any]:
    stage_from_camera = inverted(frame.camera.camera_from_world) @ inverted(_STAGE_FROM_OURS)
    pan, tilt, roll = pan_tilt_roll_deg(stage_from_camera[:3, :3])
    x, y, z = stage_from_camera[:3, 3].tolist()
    document: dict[str, Any] = {
        "protocol": {"name": "OpenTrackIO", "version": [1, 0, 1]},
        "static": static_document(frame.camera, sensor_mm),
        "transforms": [
            {"translation": {"x": x, "y": y, "z": z}, "rotation": {"pan": pan, "tilt": tilt, "roll": roll}, "id": "Camera"},
        ],
        "lens": lens_document(frame, sensor_mm),
    }
    if frame.time_s is not None:
        nanoseconds = round(frame.time_s * 1e9)
        document["timing"] = {"sampleTimestamp": {"seconds": nanoseconds // 10**9, "nanoseconds": nanoseconds % 10**9}}
    return document


def pan_tilt_roll_deg(rotation: np.ndarray) -> tuple[float, float, float]:
    """A camera that looks straight up or down has no roll, its pan says all."""
    across = float(np.hypot(rotation[0, 1], rotation[1, 1]))
    tilt = math.atan2(rotation[2, 1], across)
    if across < _STEEP:
        pan, roll = math.atan2(rotation[1, 0], rotation[0, 0]), 0.0
    else:
        pan, roll = math.atan2(-rotation[0, 1], rotation[1, 1]), math.atan2(-rotation[2, 0], rotation[2, 2])
    return math.degrees(pan), math.degrees(tilt), math.degrees(roll)


def _seconds(timestamp: Mapping[str, Any] | None) -> float | None:
    return None if timestamp is None else int(timestamp["seconds"]) + 1e-9 * int(timestamp["nanoseconds"])

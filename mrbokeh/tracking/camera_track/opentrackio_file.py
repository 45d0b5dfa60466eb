"""OpenTrackIO 1.0.1 samples (SMPTE RIS, opentrackio.org) as JSON: one sample, a list of them, or one on each line (.jsonl).

`opentrackio_sample` has the axes. Lens values are turned by "Conversion of OpenCV to OpenTrackIO
lens calibration parameters" (SMPTE RIS, 2025-09-02): lengths on the sensor are millimetres from the middle of the picture, right and
down, so that coefficients of r^2n are those of OpenCV over F^2n; in `radial` those above and below the bar alternate. Tangential
ones, of second order in millimetres, are those of OpenCV over F.

Sensor and lens of an OpenTrackIO sample: see `opentrackio_file` for the conventions.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mrbokeh.optics.camera import Camera
from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.opentrackio_sample import (
    camera_from_stage,
    is_sample,
    is_scaled,
    known,
    lens_numbers,
    pose_document,
    sampled_s,
)
from mrbokeh.tracking.camera_track.track import CameraTrack, Distortion, TrackedFrame
from mrbokeh.tracking.camera_track.track_file import TrackOptions, lost

_MODEL = "Brown-Conrady U-D"
_RADIAL = ("k1", "k4", "k2", "k5", "k3", "k6")
"""OpenCV's names in OpenLensIO's order: above and below the bar in turn, of r^2, r^4, r^6."""


def camera_on_stage(
    static: Mapping[str, Any], lens: Mapping[str, Any], camera_from_world: np.ndarray, options: TrackOptions, where: str
) -> tuple[Camera, float]:
    """(the camera, its focal length in millimetres)."""
    told = static.get("camera", {})
    (width_px, height_px), (width_mm, height_mm) = _size_px(told, options, where), _sensor_mm(told, options, where)
    height_mm = height_mm or width_mm * height_px / width_px
    if "pinholeFocalLength" not in lens:
        raise InputError(f"{where}: expected lens.pinholeFocalLength, without which nobody knows the angle of view")
    focal_mm = float(lens["pinholeFocalLength"])
    offset = lens.get("projectionOffset", {"x": 0.0, "y": 0.0})
    focal_px = focal_mm * width_px / width_mm, focal_mm * height_px / height_mm
    principal_px = (0.5 + float(offset["x"]) / width_mm) * width_px, (0.5 + float(offset["y"]) / height_mm) * height_px
    return Camera(width_px, height_px, focal_px, principal_px, camera_from_world), focal_mm


def distortion_of(lens: Mapping[str, Any], focal_mm: float, where: str) -> Distortion | None:
    """None where it tells none; raises InputError for any other model, and for a centre of its own."""
    listed = lens.get("distortion", [])
    if not listed:
        return None
    fitting = [each for each in listed if each.get("model") == _MODEL]
    shift = lens.get("distortionOffset", {})
    if not fitting or any(abs(float(shift.get(axis, 0.0))) > 1e-9 for axis in "xy"):
        models = ", ".join(str(each.get("model", "Brown-Conrady D-U")) for each in listed)
        raise InputError(
            f"{where}: expected a lens distortion of the model {_MODEL} about the principal point, got {models}: "
            f"read the file without its distortion, or have it written so"
        )
    radial = {
        name: float(value) * focal_mm ** (2 * (index // 2 + 1)) for index, (name, value) in enumerate(_of(fitting[0], "radial", _RADIAL))
    }
    tangential = {name: float(value) * focal_mm for name, value in _of(fitting[0], "tangential", ("p1", "p2"))}
    return radial | tangential


def lens_document(frame: TrackedFrame, sensor_mm: float) -> dict[str, Any]:
    camera = frame.camera
    mm_per_px = sensor_mm / camera.width_px
    focal_mm = camera.focal_px[0] * mm_per_px
    height_mm = _height_mm(camera, sensor_mm)
    document: dict[str, Any] = {
        "pinholeFocalLength": focal_mm,
        "projectionOffset": {
            "x": (camera.principal_px[0] / camera.width_px - 0.5) * sensor_mm,
            "y": (camera.principal_px[1] / camera.height_px - 0.5) * height_mm,
        },
    }
    document |= lens_numbers(focusDistance=frame.focus_distance_m, fStop=frame.f_number)
    if told := frame.coefficients:
        radial = [told.get(name, 0.0) / focal_mm ** (2 * (index // 2 + 1)) for index, name in enumerate(_RADIAL)]
        tangential = [told.get(name, 0.0) / focal_mm for name in ("p1", "p2")]
        document["distortion"] = [{"model": _MODEL, "radial": radial, "tangential": tangential}]
    return document


def static_document(camera: Camera, sensor_mm: float) -> dict[str, Any]:
    """A sensor on which pixels that are not square are wider or higher."""
    dimensions = {"width": sensor_mm, "height": _height_mm(camera, sensor_mm)}
    return {
        "camera": {
            "activeSensorPhysicalDimensions": dimensions,
            "activeSensorResolution": {"width": camera.width_px, "height": camera.height_px},
        }
    }


def _height_mm(camera: Camera, sensor_mm: float) -> float:
    return sensor_mm / camera.width_px * camera.height_px * camera.focal_px[0] / camera.focal_px[1]


def _of(document: Mapping[str, Any], key: str, names: tuple[str, ...]) -> list[tuple[str, float]]:
    values = document.get(key, [])
    if len(values) > len(names):
        raise ValueError(f"more {key} coefficients than {len(names)}")
    return list(zip(names, values, strict=False))


def _size_px(told: Mapping[str, Any], options: TrackOptions, where: str) -> tuple[int, int]:
    if options.size_px is not None:
        return options.size_px
    if "activeSensorResolution" not in told:
        raise InputError(f"{where}: the samples do not tell the size of the pictures (activeSensorResolution): give --size WIDTHxHEIGHT")
    return int(told["activeSensorResolution"]["width"]), int(told["activeSensorResolution"]["height"])


def _sensor_mm(told: Mapping[str, Any], options: TrackOptions, where: str) -> tuple[float, float | None]:
    if "activeSensorPhysicalDimensions" in told:
        dimensions = told["activeSensorPhysicalDimensions"]
        return float(dimensions["width"]), float(dimensions["height"])
    if options.sensor_width_mm is None:
        raise InputError(f"{where}: the samples do not tell the sensor's size (activeSensorPhysicalDimensions): give --sensor-width MM")
    return options.sensor_width_mm, None


_UP = "+z"


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
            time_s = sampled_s(sample)
            first_s = time_s if first_s is None else first_s
            elapsed_s = None if time_s is None or first_s is None else time_s - first_s
            frames[number] = _frame(sample, static, options, where, elapsed_s)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise error if isinstance(error, InputError) else InputError(f"{where}: not a whole OpenTrackIO sample ({error!r})") from None
    if not frames:
        raise InputError(f"{path} holds no OpenTrackIO sample")
    return CameraTrack(frames, options.up or _UP, options.is_metric(True))


def write(path: Path, track: CameraTrack, options: TrackOptions) -> tuple[str, ...]:
    """.jsonl gets a sample on each line, anything else one list."""
    turned = track.with_up(options.up or _UP)
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
    if not all(is_sample(each) for each in samples):
        raise InputError(f"{path}: expected samples whose protocol is OpenTrackIO")
    return samples


def _frame(sample: Mapping[str, Any], static: Mapping[str, Any], options: TrackOptions, where: str, time_s: float | None) -> TrackedFrame:
    lens = sample.get("lens", {})
    if is_scaled(sample):
        raise ValueError("transforms with a scale are not read")
    camera, focal_mm = camera_on_stage(static, lens, camera_from_stage(sample), options, where)
    distortion = distortion_of(lens, focal_mm, where) if options.keep_distortion else None
    return TrackedFrame(camera, known(lens, "focusDistance"), known(lens, "fStop"), time_s, distortion)


def _sample(frame: TrackedFrame, sensor_mm: float) -> dict[str, Any]:
    document = pose_document(frame.camera.camera_from_world, frame.time_s)
    return document | {"static": static_document(frame.camera, sensor_mm), "lens": lens_document(frame, sensor_mm)}

"""Sensor and lens of an OpenTrackIO sample: see `opentrackio_file` for the conventions."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.opentrackio_sample import lens_numbers
from mrbokeh.tracking.camera_track.options import TrackOptions
from mrbokeh.tracking.camera_track.tracked_frame import Distortion, TrackedFrame

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

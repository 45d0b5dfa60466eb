"""OpenTrackIO 1.0.1 samples (SMPTE RIS, opentrackio.org) as JSON: one sample, a list of them, or one on each line (.jsonl).

Its stage is Z up, Y forward, X right, metres; a camera without rotation looks along Y. `transforms` are composed in order, each with a
translation and the intrinsic right-handed rotations pan (about Z), tilt (X), roll (Y) in degrees.

Lens values are converted by "Conversion of OpenCV to OpenTrackIO lens calibration parameters" (SMPTE RIS, 2025-09-02): lengths on the
sensor are millimetres from the middle of the picture, right and down, so that coefficients of r^2n are those of OpenCV over F^2n; in
`radial` those above and below the bar alternate. Tangential ones, of second order in millimetres, are those of OpenCV over F.

Samples from a network are what JSON or CBOR gave, and may be anything: a malformed one raises KeyError, TypeError, ValueError or
AttributeError.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.camera import Camera
from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.track import CameraTrack, Distortion, TrackedFrame, TrackOptions, lost
from mrbokeh.tracking.world_axes import CAMERA_FROM_STAGE_CAMERA, inverted, pan_tilt_roll_deg, rigid, stage_rotation

PROTOCOL = "OpenTrackIO"
_UNTURNED = {"pan": 0.0, "tilt": 0.0, "roll": 0.0}
_NANOSECONDS = 10**9

Document = Mapping[str, Any]
Pose = Float64[np.ndarray, "4 4"]


def is_sample(document: Any) -> bool:
    protocol = document.get("protocol") if isinstance(document, dict) else None
    return isinstance(protocol, dict) and protocol.get("name") == PROTOCOL


def camera_from_stage(sample: Document, before_m: float = 0.0) -> Pose:
    """Return our camera axes from the stage. before_m: how far the point that is meant lies before the one whose place is stated."""
    if not len(sample["transforms"]):
        raise ValueError("no transforms")
    stage_from_camera = np.eye(4)
    for transform in sample["transforms"]:
        stage_from_camera = stage_from_camera @ _motion(transform)
    return CAMERA_FROM_STAGE_CAMERA @ inverted(stage_from_camera @ rigid(np.eye(3), np.array([0.0, before_m, 0.0])))


def is_scaled(sample: Document) -> bool:
    """Return whether a transform has a scale, which `camera_from_stage` leaves out."""
    return any("scale" in transform for transform in sample["transforms"])


def known(lens: Document, name: str) -> float | None:
    """Return a number of the lens that must be above 0; senders write 0 and below if they do not know it."""
    value = lens.get(name)
    return None if value is None or number(value) <= 0.0 else number(value)


def number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"expected a finite number, got {value!r}")
    return float(value)


def sampled_s(sample: Document) -> float | None:
    """Return the time by the sender's clock; None if it is not stated."""
    told = sample.get("timing", {}).get("sampleTimestamp")
    return None if told is None else number(told["seconds"]) + number(told["nanoseconds"]) / _NANOSECONDS


def pose_document(camera_from_stage: Pose, time_s: float | None) -> dict[str, Any]:
    """Return a sample without static data and lens."""
    stage_from_camera = inverted(camera_from_stage) @ CAMERA_FROM_STAGE_CAMERA
    pan, tilt, roll = pan_tilt_roll_deg(stage_from_camera[:3, :3])
    x, y, z = stage_from_camera[:3, 3].tolist()
    motion = {"translation": {"x": x, "y": y, "z": z}, "rotation": {"pan": pan, "tilt": tilt, "roll": roll}, "id": "Camera"}
    document: dict[str, Any] = {"protocol": {"name": PROTOCOL, "version": [1, 0, 1]}, "transforms": [motion]}
    if time_s is not None:
        seconds, nanoseconds = divmod(round(time_s * _NANOSECONDS), _NANOSECONDS)
        document["timing"] = {"sampleTimestamp": {"seconds": seconds, "nanoseconds": nanoseconds}}
    return document


def lens_numbers(**values: float | None) -> dict[str, float]:
    """Return the known values; a focus at infinity, for which JSON has no number, is left out."""
    return {name: value for name, value in values.items() if value is not None and math.isfinite(value)}


def _motion(transform: Document) -> Pose:
    place, turn = transform["translation"], transform.get("rotation", _UNTURNED)
    angles = [number(turn[name]) for name in ("pan", "tilt", "roll")]
    return rigid(stage_rotation(*angles), np.array([number(place[name]) for name in "xyz"]))


_MODEL = "Brown-Conrady U-D"
_RADIAL = ("k1", "k4", "k2", "k5", "k3", "k6")
"""OpenCV's names in OpenLensIO's order: above and below the bar in turn, of r^2, r^4, r^6."""


def camera_on_stage(
    static: Mapping[str, Any], lens: Mapping[str, Any], camera_from_world: np.ndarray, options: TrackOptions, where: str
) -> tuple[Camera, float]:
    """Return (the camera, its focal length in millimetres)."""
    told = static.get("camera", {})
    (width_px, height_px), (width_mm, height_mm) = _size_px(told, options, where), _sensor_mm(told, options, where)
    height_mm = height_mm or width_mm * height_px / width_px
    if "pinholeFocalLength" not in lens:
        raise InputError(f"{where}: expected lens.pinholeFocalLength, without which nobody knows the angle of view")
    focal_mm = float(lens["pinholeFocalLength"])
    offset = lens.get("projectionOffset", {"x": 0.0, "y": 0.0})
    focal_px = focal_mm * width_px / width_mm, focal_mm * height_px / height_mm
    principal_px = (0.5 + float(offset["x"]) / width_mm) * width_px, (0.5 + float(offset["y"]) / height_mm) * height_px
    return Camera(
        width_px=width_px, height_px=height_px, focal_px=focal_px, principal_px=principal_px, camera_from_world=camera_from_world
    ), focal_mm


def distortion_of(lens: Mapping[str, Any], focal_mm: float, where: str) -> Distortion | None:
    """Return the distortion, None if there is none. Raises InputError for any other model, and for a centre of its own."""
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
    """Return the sensor's document; pixels that are not square make it wider or higher."""
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
    """Read samples; frames are numbered in their order, times count from the first. Other cameras' samples must be removed before."""
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
    """Write samples, one on each line of a .jsonl, else one list. Returns what the format cannot hold."""
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
    return TrackedFrame(
        camera=camera, focus_distance_m=known(lens, "focusDistance"), f_number=known(lens, "fStop"), time_s=time_s, distortion=distortion
    )


def _sample(frame: TrackedFrame, sensor_mm: float) -> dict[str, Any]:
    document = pose_document(frame.camera.camera_from_world, frame.time_s)
    return document | {"static": static_document(frame.camera, sensor_mm), "lens": lens_document(frame, sensor_mm)}

"""OpenTrackIO 1.0.1 samples (SMPTE RIS, opentrackio.org) as JSON: one sample, a list of them, or one on each line (.jsonl).

`opentrackio_sample` has the axes. Lens values are turned by "Conversion of OpenCV to OpenTrackIO
lens calibration parameters" (SMPTE RIS, 2025-09-02): lengths on the sensor are millimetres from the middle of the picture, right and
down, so that coefficients of r^2n are those of OpenCV over F^2n; in `radial` those above and below the bar alternate. Tangential
ones, of second order in millimetres, are those of OpenCV over F.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.opentrackio_lens import camera_on_stage, distortion_of, lens_document, static_document
from mrbokeh.tracking.camera_track.opentrackio_sample import camera_from_stage, is_sample, is_scaled, known, pose_document, sampled_s
from mrbokeh.tracking.camera_track.options import TrackOptions, lost
from mrbokeh.tracking.camera_track.track import CameraTrack
from mrbokeh.tracking.camera_track.tracked_frame import TrackedFrame
from mrbokeh.tracking.camera_track.world_axes import with_up

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

"""What a sample of OpenTrackIO 1.0.1 (SMPTE RIS, opentrackio.org) says of the pose and the lens, from a file or a network.

Its stage is Z up, Y forward, X right, metres; a camera without rotation looks along Y. `transforms` are composed in order, each with a
translation and the intrinsic right-handed rotations pan (about Z), tilt (X), roll (Y) in degrees.

Samples are what JSON or CBOR gave, and may be anything: what is not as it should be raises KeyError, TypeError, ValueError or
AttributeError.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float64

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
    """Our camera axes from the stage. before_m: how far the point that is meant lies before the one whose place is told."""
    if not len(sample["transforms"]):
        raise ValueError("no transforms")
    stage_from_camera = np.eye(4)
    for transform in sample["transforms"]:
        stage_from_camera = stage_from_camera @ _motion(transform)
    return CAMERA_FROM_STAGE_CAMERA @ inverted(stage_from_camera @ rigid(np.eye(3), np.array([0.0, before_m, 0.0])))


def is_scaled(sample: Document) -> bool:
    """Whether a transform has a scale, which `camera_from_stage` leaves out."""
    return any("scale" in transform for transform in sample["transforms"])


def known(lens: Document, name: str) -> float | None:
    """A number of the lens that must be above 0; 0 and below are what senders write that do not know."""
    value = lens.get(name)
    return None if value is None or number(value) <= 0.0 else number(value)


def number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"expected a finite number, got {value!r}")
    return float(value)


def sampled_s(sample: Document) -> float | None:
    """By the sender's clock; None where it is not told."""
    told = sample.get("timing", {}).get("sampleTimestamp")
    return None if told is None else number(told["seconds"]) + number(told["nanoseconds"]) / _NANOSECONDS


def pose_document(camera_from_stage: Pose, time_s: float | None) -> dict[str, Any]:
    """A sample without static data and lens."""
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
    """What is not known, and a focus at infinity, for which JSON has no number, are left out."""
    return {name: value for name, value in values.items() if value is not None and math.isfinite(value)}


def _motion(transform: Document) -> Pose:
    place, turn = transform["translation"], transform.get("rotation", _UNTURNED)
    angles = [number(turn[name]) for name in ("pan", "tilt", "roll")]
    return rigid(stage_rotation(*angles), np.array([number(place[name]) for name in "xyz"]))

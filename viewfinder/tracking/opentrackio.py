"""OpenTrackIO 1.0.1 (SMPTE RIS, opentrackio.org): the payload, JSON or CBOR, to and from a TrackingSample.

Its stage is Z up, Y forward, X right, metres; a camera without rotation looks along Y. `transforms` are composed in order, each with
a translation and the intrinsic right-handed rotations pan (about Z), tilt (X), roll (Y) in degrees. Our world has the stage's
ground for its board: x along X, y along -Y, z along -Z, so that what stands on the board stands on the stage.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mrbokeh.errors import MissingExtraError
from viewfinder.frames import LensState, Pose
from viewfinder.tracking.opentrackio_packets import CBOR, JSON
from viewfinder.tracking.rigid_motion import inverted, rigid
from viewfinder.tracking.stage_axes import CAMERA_FROM_STAGE_CAMERA, STAGE_FROM_BOARD, pan_tilt_roll_deg
from viewfinder.tracking.tracking_sample import MalformedMessageError, TrackingSample

_UNUSED_OF_LENS = ("distortion", "distortionOffset", "projectionOffset", "exposureFalloff", "encoders", "rawEncoders", "tStop")


@dataclass(frozen=True)
class StageReading:
    """How a sender's numbers are meant. stage_from_world: where our world lies on its stage.

    pose_at_sensor: the sender tells where the sensor is, and the entrance pupil lies entrancePupilOffset before it; else its
      transform is that of the entrance pupil.
    """

    stage_from_world: Pose = field(default_factory=STAGE_FROM_BOARD.copy)
    pose_at_sensor: bool = False


def decode_opentrackio(payload: bytes, encoding: int, reading: StageReading | None = None) -> TrackingSample:
    """Raises MalformedMessageError where it is no sample with a pose."""
    try:
        return _sample(_document(payload, encoding), reading or StageReading())
    except Exception as error:
        # What strangers send ends in whatever the decoders and conversions raise; none of it is worth more than being counted.
        raise MalformedMessageError(f"not an OpenTrackIO sample: {error!r}") from None


def encode_opentrackio(document: Mapping[str, Any], encoding: int) -> bytes:
    return require_cbor().dumps(dict(document)) if encoding == CBOR else json.dumps(document).encode()


def opentrackio_document(sample: TrackingSample, reading: StageReading | None = None) -> dict[str, Any]:
    """The sample as OpenTrackIO writes it, with the pose of the entrance pupil; what the lens does not know is left out."""
    world_from_camera = inverted(sample.camera_from_world) @ CAMERA_FROM_STAGE_CAMERA
    stage_from_camera = (reading or StageReading()).stage_from_world @ world_from_camera
    pan, tilt, roll = pan_tilt_roll_deg(stage_from_camera[:3, :3])
    x, y, z = stage_from_camera[:3, 3].tolist()
    lens = {
        "focusDistance": sample.lens.focus_distance_m,
        "fStop": sample.lens.f_number,
        "pinholeFocalLength": sample.lens.focal_length_mm,
    }
    document: dict[str, Any] = {
        "protocol": {"name": "OpenTrackIO", "version": [1, 0, 1]},
        "transforms": [
            {
                "translation": {"x": x, "y": y, "z": z},
                "rotation": {"pan": pan, "tilt": tilt, "roll": roll},
                "id": "Camera",
            }
        ],
        "lens": {name: value for name, value in lens.items() if value is not None and math.isfinite(value)},
    }
    if sample.sender_s is not None:
        seconds = math.floor(sample.sender_s)
        document["timing"] = {"sampleTimestamp": {"seconds": seconds, "nanoseconds": round((sample.sender_s - seconds) * 1e9)}}
    return document


def _document(payload: bytes, encoding: int) -> dict[str, Any]:
    document = json.loads(payload) if encoding == JSON else require_cbor().loads(payload)
    if not isinstance(document, dict) or document["protocol"]["name"] != "OpenTrackIO":
        raise ValueError("its protocol is not OpenTrackIO")
    return document


def require_cbor() -> Any:
    """The package that reads CBOR; raises MissingExtraError where it is not installed."""
    try:
        import cbor2
    except ImportError:
        raise MissingExtraError("cbor2", "viewfinder") from None
    return cbor2


def _sample(document: dict[str, Any], reading: StageReading) -> TrackingSample:
    lens = document.get("lens", {})
    stage_from_camera = np.eye(4)
    for transform in document["transforms"]:
        stage_from_camera = stage_from_camera @ _motion(transform)
    if not len(document["transforms"]):
        raise ValueError("no transforms")
    if reading.pose_at_sensor:
        stage_from_camera = stage_from_camera @ rigid(np.eye(3), np.array([0.0, _number(lens.get("entrancePupilOffset", 0.0)), 0.0]))
    camera_from_world = CAMERA_FROM_STAGE_CAMERA @ inverted(stage_from_camera) @ reading.stage_from_world
    state = LensState(*(_positive(lens.get(name)) for name in ("focusDistance", "fStop", "pinholeFocalLength")))
    scaled = {"transforms.scale" for transform in document["transforms"] if "scale" in transform}
    ignored = {f"lens.{name}" for name in _UNUSED_OF_LENS if name in lens} | scaled
    return TrackingSample(camera_from_world, state, _seconds(document.get("timing", {}).get("sampleTimestamp")), frozenset(ignored))


def _motion(transform: dict[str, Any]) -> Pose:
    place, turn = transform["translation"], transform.get("rotation", {"pan": 0.0, "tilt": 0.0, "roll": 0.0})
    angles = [_number(turn[name]) for name in ("pan", "tilt", "roll")]
    return rigid(Rotation.from_euler("ZXY", angles, degrees=True).as_matrix(), np.array([_number(place[name]) for name in "xyz"]))


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"expected a finite number, got {value!r}")
    return float(value)


def _positive(value: Any) -> float | None:
    """0 and below are what senders write that do not know."""
    if value is None or _number(value) <= 0.0:
        return None
    return _number(value)


def _seconds(timestamp: Any) -> float | None:
    return None if timestamp is None else _number(timestamp["seconds"]) + 1e-9 * _number(timestamp["nanoseconds"])

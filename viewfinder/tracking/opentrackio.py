"""OpenTrackIO 1.0.1 (SMPTE RIS, opentrackio.org): the payload, JSON or CBOR, to and from a TrackingSample.

What a sample says is read by `camera_track.opentrackio_sample`, as it is from files. Our world has the stage's ground for its
board: x along X, y along -Y, z along -Z, so that what stands on the board stands on the stage.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from mrbokeh.system.errors import MissingExtraError
from mrbokeh.tracking.camera_track.opentrackio_sample import (
    camera_from_stage,
    is_sample,
    is_scaled,
    known,
    lens_numbers,
    number,
    pose_document,
    sampled_s,
)
from mrbokeh.tracking.camera_track.world_axes import inverted
from viewfinder.flow.frames import LensState, Pose
from viewfinder.tracking.opentrackio_packets import CBOR, JSON
from viewfinder.tracking.tracking_sample import STAGE_FROM_BOARD, MalformedMessageError, TrackingSample

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
    camera_from_stage = sample.camera_from_world @ inverted((reading or StageReading()).stage_from_world)
    lens = sample.lens
    told = lens_numbers(focusDistance=lens.focus_distance_m, fStop=lens.f_number, pinholeFocalLength=lens.focal_length_mm)
    return pose_document(camera_from_stage, sample.sender_s) | {"lens": told}


def _document(payload: bytes, encoding: int) -> dict[str, Any]:
    document = json.loads(payload) if encoding == JSON else require_cbor().loads(payload)
    if not is_sample(document):
        raise ValueError("its protocol is not OpenTrackIO")
    return dict(document)


def require_cbor() -> Any:
    """The package that reads CBOR; raises MissingExtraError where it is not installed."""
    try:
        import cbor2
    except ImportError:
        raise MissingExtraError("cbor2", "viewfinder") from None
    return cbor2


def _sample(document: dict[str, Any], reading: StageReading) -> TrackingSample:
    lens = document.get("lens", {})
    before_m = number(lens.get("entrancePupilOffset", 0.0)) if reading.pose_at_sensor else 0.0
    camera_from_world = camera_from_stage(document, before_m) @ reading.stage_from_world
    state = LensState(*(known(lens, name) for name in ("focusDistance", "fStop", "pinholeFocalLength")))
    ignored = {f"lens.{name}" for name in _UNUSED_OF_LENS if name in lens} | ({"transforms.scale"} if is_scaled(document) else set())
    return TrackingSample(camera_from_world, state, sampled_s(document), frozenset(ignored))

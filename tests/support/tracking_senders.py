"""What a tracking system sends: FreeD and OpenTrackIO, written as their documents say, for the readers to be tested with."""

import json
import struct
from collections.abc import Iterator, Mapping
from typing import Any

from mrbokeh.tracking.camera_track.opentrackio_file import lens_numbers, pose_document
from mrbokeh.tracking.world_axes import CAMERA_FROM_STAGE_CAMERA, inverted, pan_tilt_roll_deg
from viewfinder.tracking.freed import _FIELD_BYTES, _PER_DEGREE, _PER_M, _TYPE, FreeDMessage, checksum
from viewfinder.tracking.pose_history import STAGE_FROM_BOARD, TrackingSample
from viewfinder.tracking.socket_tracker import _HEADER, _IDENTIFIER, _LAST, CBOR, StageReading, fletcher16, require_cbor


def write_freed(message: FreeDMessage) -> bytes:
    """Encode a message; OverflowError where a number does not fit: angles to 256 degrees, places to 131 m."""
    signed = [round(angle * _PER_DEGREE) for angle in message.pan_tilt_roll_deg] + [round(place * _PER_M) for place in message.xyz_m]
    body = bytes([_TYPE, message.camera]) + b"".join(number.to_bytes(_FIELD_BYTES, "big", signed=True) for number in signed)
    body += b"".join(count.to_bytes(_FIELD_BYTES, "big") for count in (message.zoom, message.focus)) + struct.pack(">H", 0)
    return body + bytes([checksum(body)])


def freed_message(sample: TrackingSample, camera: int = 1, zoom: int = 0, focus: int = 0) -> FreeDMessage:
    """Return what a sender with the usual signs would write, whose stage has our world for its ground."""
    stage_from_camera = STAGE_FROM_BOARD @ inverted(sample.camera_from_world) @ CAMERA_FROM_STAGE_CAMERA
    pan, tilt, roll = pan_tilt_roll_deg(stage_from_camera[:3, :3])
    x, y, z = stage_from_camera[:3, 3].tolist()
    return FreeDMessage(camera, (-pan, tilt, roll), (x, y, z), zoom, focus)


def packets(payload: bytes, encoding: int, sequence_number: int, segment_bytes: int = 1400) -> Iterator[bytes]:
    """Yield the datagrams that carry a payload."""
    for offset in range(0, max(len(payload), 1), segment_bytes):
        segment = payload[offset : offset + segment_bytes]
        last = _LAST if offset + segment_bytes >= len(payload) else 0
        head = _HEADER.pack(_IDENTIFIER, 0, encoding, sequence_number & 0xFFFF, offset, last | len(segment))
        yield head + struct.pack(">H", fletcher16(head + segment)) + segment


def encode_opentrackio(document: Mapping[str, Any], encoding: int) -> bytes:
    """Encode as JSON or CBOR."""
    return require_cbor().dumps(dict(document)) if encoding == CBOR else json.dumps(document).encode()


def opentrackio_document(sample: TrackingSample, reading: StageReading | None = None) -> dict[str, Any]:
    """Return the sample as OpenTrackIO writes it, with the pose of the entrance pupil; what the lens does not know is left out."""
    camera_from_stage = sample.camera_from_world @ inverted((reading or StageReading()).stage_from_world)
    lens = sample.lens
    told = lens_numbers(focusDistance=lens.focus_distance_m, fStop=lens.f_number, pinholeFocalLength=lens.focal_length_mm)
    return pose_document(camera_from_stage, sample.sender_s) | {"lens": told}

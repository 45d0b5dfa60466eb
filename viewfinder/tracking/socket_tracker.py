"""SocketTracker: camera poses that another system sends over UDP, at the time of each frame: FreeD, or OpenTrackIO 1.0.1.

A packet of OpenTrackIO (SMPTE RIS, opentrackio.org) holds a segment of a payload in JSON or CBOR:

 0  "OTrk"      4  reserved      5  encoding (1 JSON, 2 CBOR)      6  sequence number, 16 bits
 8  offset of this segment in the payload, 32 bits                12  last segment (1 bit), length of this segment (15 bits)
14  checksum over the first 14 bytes and the segment, 16 bits      all big-endian

A sample is read by `camera_track.opentrackio_file`, as it is from files. Our world has the stage's ground for its board: x along X,
y along -Y, z along -Z, so that what stands on the board stands on the stage.
"""

import json
import socket
import struct
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from threading import Event, Thread
from typing import Any

import numpy as np

from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError, MissingExtraError
from mrbokeh.tracking.camera_track.opentrackio_file import (
    camera_from_stage,
    is_sample,
    is_scaled,
    known,
    number,
    sampled_s,
)
from viewfinder.frames import UNKNOWN_LENS, CameraFrame, LensState, Pose
from viewfinder.tracking.freed import FreeDReading, freed_sample, read_freed
from viewfinder.tracking.pose_history import STAGE_FROM_BOARD, MalformedMessageError, PoseAtTime, PoseHistory, SenderClock, TrackingSample
from viewfinder.tracking.tracker import TrackedPose

JSON, CBOR = 1, 2

_HEADER = struct.Struct(">4sBBHIH")
_IDENTIFIER = b"OTrk"
_CHECKSUM_BYTES = 2
HEADER_BYTES = _HEADER.size + _CHECKSUM_BYTES
_LAST = 0x8000
_LARGEST_PAYLOAD = 1 << 20
_UNFINISHED_AT_ONCE = 8


def fletcher16(data: bytes) -> int:
    """Return Fletcher's checksum (1982) with sums modulo 256, the second sum in the high byte.

    The second sum adds the first after every byte, so that byte i of n counts n - i times.
    """
    values = np.frombuffer(data, np.uint8).astype(np.uint64)
    first = int(values.sum()) % 256
    second = int((values * np.arange(len(values), 0, -1, dtype=np.uint64)).sum()) % 256
    return second << 8 | first


@dataclass(frozen=True)
class Segment:
    encoding: int
    sequence_number: int
    offset: int
    last: bool
    content: bytes


def read_packet(datagram: bytes) -> Segment:
    """Decode a packet; MalformedMessageError where length, identifier, encoding or checksum are wrong."""
    if len(datagram) < HEADER_BYTES or not datagram.startswith(_IDENTIFIER):
        raise MalformedMessageError("not an OpenTrackIO packet")
    _, _, encoding, sequence_number, offset, length = _HEADER.unpack_from(datagram)
    content = datagram[HEADER_BYTES:]
    if len(content) != length & ~_LAST or encoding not in (JSON, CBOR) or offset + len(content) > _LARGEST_PAYLOAD:
        raise MalformedMessageError("the header of an OpenTrackIO packet does not fit what follows it")
    (stated,) = struct.unpack_from(">H", datagram, _HEADER.size)
    if stated != fletcher16(datagram[: _HEADER.size] + content):
        raise MalformedMessageError("the checksum of an OpenTrackIO packet is wrong")
    return Segment(encoding=encoding, sequence_number=sequence_number, offset=offset, last=bool(length & _LAST), content=content)


@dataclass
class _Unfinished:
    parts: dict[int, bytes] = field(default_factory=dict)
    size: int | None = None

    def whole(self) -> bytes | None:
        """Return the payload, once no byte of it is missing."""
        if self.size is None or sum(map(len, self.parts.values())) < self.size:
            return None
        joined = b"".join(self.parts[offset] for offset in sorted(self.parts))
        contiguous = all(joined[offset : offset + len(part)] == part for offset, part in self.parts.items())
        if len(joined) != self.size or not contiguous:
            raise MalformedMessageError("the segments of an OpenTrackIO payload overlap")
        return joined


class Reassembly:
    """Reassembly of segments, in whatever order they come; payloads that stay incomplete are forgotten, the oldest first."""

    def __init__(self) -> None:
        self._unfinished: OrderedDict[tuple[object, int, int], _Unfinished] = OrderedDict()

    def add(self, sender: object, segment: Segment) -> bytes | None:
        """Return the payload that this segment completes."""
        if segment.offset == 0 and segment.last:
            return segment.content
        key = sender, segment.sequence_number, segment.encoding
        message = self._unfinished.setdefault(key, _Unfinished())
        message.parts[segment.offset] = segment.content
        if segment.last:
            message.size = segment.offset + len(segment.content)
        if len(self._unfinished) > _UNFINISHED_AT_ONCE:
            self._unfinished.popitem(last=False)
        try:
            whole = message.whole()
        except MalformedMessageError:
            del self._unfinished[key]
            raise
        if whole is not None:
            del self._unfinished[key]
        return whole


_UNUSED_OF_LENS = ("distortion", "distortionOffset", "projectionOffset", "exposureFalloff", "encoders", "rawEncoders", "tStop")


@dataclass(frozen=True)
class StageReading:
    """Meaning of a sender's numbers. stage_from_world: where our world lies on its stage.

    pose_at_sensor: the sender tells where the sensor is, and the entrance pupil lies entrancePupilOffset before it; else its
      transform is that of the entrance pupil.
    """

    stage_from_world: Pose = field(default_factory=STAGE_FROM_BOARD.copy)
    pose_at_sensor: bool = False


def decode_opentrackio(payload: bytes, encoding: int, reading: StageReading | None = None) -> TrackingSample:
    """Decode a sample; MalformedMessageError where it is no sample with a pose."""
    try:
        return _sample(_document(payload, encoding), reading or StageReading())
    except Exception as error:
        # What strangers send ends in whatever the decoders and conversions raise; none of it is worth more than being counted.
        raise MalformedMessageError(f"not an OpenTrackIO sample: {error!r}") from None


def _document(payload: bytes, encoding: int) -> dict[str, Any]:
    document = json.loads(payload) if encoding == JSON else require_cbor().loads(payload)
    if not is_sample(document):
        raise ValueError("its protocol is not OpenTrackIO")
    return dict(document)


def require_cbor() -> Any:
    """Return the package that reads CBOR; MissingExtraError where it is not installed."""
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


# A datagram can be no longer.
_LARGEST_DATAGRAM = 65535
_POLL_S = 0.1

Decoder = Callable[[bytes, object], TrackingSample | None]
"""(datagram, who sent it) to a sample; None where more datagrams are needed; raises MalformedMessageError."""


@dataclass(frozen=True)
class TrackingAddress:
    """Address to listen on. port 0 takes a free one. group: of a multicast, to be joined on the interface with the address `host`."""

    port: int
    host: str = "127.0.0.1"
    group: str | None = None


def opentrackio_decoder(reading: StageReading | None = None) -> Decoder:
    """Return a decoder of both encodings; MissingExtraError where the package for CBOR is not installed."""
    require_cbor()
    reassembly = Reassembly()

    def decode(datagram: bytes, sender: object) -> TrackingSample | None:
        segment = read_packet(datagram)
        payload = reassembly.add(sender, segment)
        return None if payload is None else decode_opentrackio(payload, segment.encoding, reading)

    return decode


def freed_decoder(reading: FreeDReading | None = None, camera: int | None = None) -> Decoder:
    """Return a decoder. camera: the number of the one to follow; None follows all, for a port with one camera."""

    def decode(datagram: bytes, _sender: object) -> TrackingSample | None:
        message = read_freed(datagram)
        return freed_sample(message, reading or FreeDReading()) if camera in (None, message.camera) else None

    return decode


class SocketTracker:
    """Tracker. video_delay_s may be set at any time: how much later the picture of a moment comes than the pose of that moment.

    malformed: datagrams that were thrown away. ignored: what the sender tells and nothing here makes use of.
    """

    def __init__(self, address: TrackingAddress, decode: Decoder, video_delay_s: float = 0.0, hold_s: float = 0.1) -> None:
        self.name = f"tracking from UDP port {address.port}"
        self.video_delay_s, self._hold_s, self._decode = video_delay_s, hold_s, decode
        self.malformed, self.ignored = 0, frozenset[str]()
        self._history, self._clock = PoseHistory(), SenderClock()
        self._arrived_s: float | None = None
        self._stopping = Event()
        self._socket = _bound(address)
        self.port = int(self._socket.getsockname()[1])
        self._thread = Thread(target=self._receive, name="tracking", daemon=True)
        self._thread.start()

    def track(self, frame: CameraFrame, intrinsics: Camera) -> TrackedPose | None:  # noqa: ARG002
        """Interpolate between the two samples around the frame; a little beyond the newest one it stands still and loses quality."""
        found = self._at(frame)
        if found is None or found.beyond_s >= self._hold_s:
            return None
        return TrackedPose(found.camera_from_world, 1.0 - found.beyond_s / self._hold_s, frame.captured_s)

    def lens(self, frame: CameraFrame) -> LensState:
        """Return what the sender says of the lens at the time of the frame; nothing where it has fallen silent."""
        found = self._at(frame)
        return UNKNOWN_LENS if found is None or found.beyond_s >= self._hold_s else found.lens

    @property
    def remark(self) -> str | None:
        """Sentence where something is wrong: nothing comes, or what comes is not understood."""
        silent_s = None if self._arrived_s is None else time.monotonic() - self._arrived_s
        if silent_s is None:
            other = f", only {self.malformed} that were not understood" if self.malformed else ""
            return f"no packets of the tracking system have come to port {self.port} yet{other}"
        return f"the tracking system has been silent for {silent_s:.1f} s" if silent_s >= self._hold_s else None

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()
        self._socket.close()

    def _at(self, frame: CameraFrame) -> PoseAtTime | None:
        return self._history.at(frame.captured_s - self.video_delay_s)

    def _receive(self) -> None:
        while not self._stopping.is_set():
            try:
                datagram, sender = self._socket.recvfrom(_LARGEST_DATAGRAM)
            except OSError:
                # Nothing came in time, or (Windows) an earlier answer found nobody.
                continue
            self._take(datagram, sender, time.monotonic())

    def _take(self, datagram: bytes, sender: object, arrived_s: float) -> None:
        try:
            sample = self._decode(datagram, sender)
        except MalformedMessageError:
            self.malformed += 1
            return
        if sample is not None:
            self.ignored |= sample.ignored
            self._history.add(self._clock.ours_s(sample.sender_s, arrived_s), sample)
            self._arrived_s = arrived_s


def _bound(address: TrackingAddress) -> socket.socket:
    listening = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    listening.settimeout(_POLL_S)
    try:
        if address.group is None:
            listening.bind((address.host, address.port))
        else:
            # Several programs may follow one camera; and a group is received at any address of the machine.
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listening.bind(("", address.port))
            membership = struct.pack("4s4s", socket.inet_aton(address.group), socket.inet_aton(address.host))
            listening.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
    except (OSError, OverflowError) as error:
        listening.close()
        where = f"{address.host} port {address.port}" + (f", group {address.group}" if address.group else "")
        raise InputError(f"cannot listen for tracking on {where} ({error}): choose another port or interface") from None
    return listening

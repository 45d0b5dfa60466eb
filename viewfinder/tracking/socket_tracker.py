"""SocketTracker: camera poses that another system sends over UDP (OpenTrackIO, FreeD), at the time of each frame."""

import socket
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from threading import Event, Thread

from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError
from viewfinder.frames import UNKNOWN_LENS, CameraFrame, LensState
from viewfinder.tracking.freed import FreeDReading, freed_sample, read_freed
from viewfinder.tracking.opentrackio import Reassembly, StageReading, decode_opentrackio, read_packet, require_cbor
from viewfinder.tracking.pose_history import MalformedMessageError, PoseAtTime, PoseHistory, SenderClock, TrackingSample
from viewfinder.tracking.tracker import TrackedPose

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

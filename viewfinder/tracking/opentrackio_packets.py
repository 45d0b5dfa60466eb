"""OpenTrackIO over UDP: the 16-byte header, Fletcher's checksum, and payloads in segments (SMPTE RIS OpenTrackIO 1.0.1, network part).

 0  "OTrk"      4  reserved      5  encoding (1 JSON, 2 CBOR)      6  sequence number, 16 bits
 8  offset of this segment in the payload, 32 bits                12  last segment (1 bit), length of this segment (15 bits)
14  checksum over the first 14 bytes and the segment, 16 bits      all big-endian
"""

import struct
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from viewfinder.tracking.tracking_sample import MalformedMessageError

JSON, CBOR = 1, 2
PORT = 55555

_HEADER = struct.Struct(">4sBBHIH")
_IDENTIFIER = b"OTrk"
_CHECKSUM_BYTES = 2
HEADER_BYTES = _HEADER.size + _CHECKSUM_BYTES
_LAST = 0x8000
_LARGEST_SEGMENT = 1400
_LARGEST_PAYLOAD = 1 << 20
_UNFINISHED_AT_ONCE = 8


def fletcher16(data: bytes) -> int:
    """Fletcher's checksum (1982) with sums modulo 256, the second sum in the high byte.

    The second sum adds the first after every byte, so that byte i of n counts n - i times.
    """
    values = np.frombuffer(data, np.uint8).astype(np.uint64)
    first = int(values.sum()) % 256
    second = int((values * np.arange(len(values), 0, -1, dtype=np.uint64)).sum()) % 256
    return second << 8 | first


def packets(payload: bytes, encoding: int, sequence_number: int, segment_bytes: int = _LARGEST_SEGMENT) -> Iterator[bytes]:
    """The datagrams that carry a payload."""
    for offset in range(0, max(len(payload), 1), segment_bytes):
        segment = payload[offset : offset + segment_bytes]
        last = _LAST if offset + segment_bytes >= len(payload) else 0
        head = _HEADER.pack(_IDENTIFIER, 0, encoding, sequence_number & 0xFFFF, offset, last | len(segment))
        yield head + struct.pack(">H", fletcher16(head + segment)) + segment


@dataclass(frozen=True)
class Segment:
    encoding: int
    sequence_number: int
    offset: int
    last: bool
    content: bytes


def read_packet(datagram: bytes) -> Segment:
    """Raises MalformedMessageError where length, identifier, encoding or checksum are wrong."""
    if len(datagram) < HEADER_BYTES or not datagram.startswith(_IDENTIFIER):
        raise MalformedMessageError("not an OpenTrackIO packet")
    _, _, encoding, sequence_number, offset, length = _HEADER.unpack_from(datagram)
    content = datagram[HEADER_BYTES:]
    if len(content) != length & ~_LAST or encoding not in (JSON, CBOR) or offset + len(content) > _LARGEST_PAYLOAD:
        raise MalformedMessageError("the header of an OpenTrackIO packet does not fit what follows it")
    (stated,) = struct.unpack_from(">H", datagram, _HEADER.size)
    if stated != fletcher16(datagram[: _HEADER.size] + content):
        raise MalformedMessageError("the checksum of an OpenTrackIO packet is wrong")
    return Segment(encoding, sequence_number, offset, bool(length & _LAST), content)


@dataclass
class _Unfinished:
    parts: dict[int, bytes] = field(default_factory=dict)
    size: int | None = None

    def whole(self) -> bytes | None:
        """The payload, once no byte of it is missing."""
        if self.size is None or sum(map(len, self.parts.values())) < self.size:
            return None
        joined = b"".join(self.parts[offset] for offset in sorted(self.parts))
        contiguous = all(joined[offset : offset + len(part)] == part for offset, part in self.parts.items())
        if len(joined) != self.size or not contiguous:
            raise MalformedMessageError("the segments of an OpenTrackIO payload overlap")
        return joined


class Reassembly:
    """Puts segments together, in whatever order they come; payloads that stay incomplete are forgotten, the oldest first."""

    def __init__(self) -> None:
        self._unfinished: OrderedDict[tuple[object, int, int], _Unfinished] = OrderedDict()

    def add(self, sender: object, segment: Segment) -> bytes | None:
        """The payload that this segment completes."""
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

"""XMP packets of photographs, and the further pictures that phones put behind a JPEG.

XMP lies in a JPEG's first kilobytes, and an extended packet in chunks (XMP Specification Part 3, 1.1.3). Further pictures are listed in a
segment of CIPA DC-007, Multi-Picture Format.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

from mrbokeh.system.errors import InputError

_PACKET = b"http://ns.adobe.com/xap/1.0/\0"
_EXTENSION = b"http://ns.adobe.com/xmp/extension/\0"
_HAS_EXTENDED = "{http://ns.adobe.com/xmp/note/}HasExtendedXMP"
_GUID = 32
_APP1, _APP2, _START_OF_SCAN = 0xE1, 0xE2, 0xDA


def jpeg_xmp(data: bytes, path: Path) -> dict[str, str]:
    """Return simple properties of a JPEG by their full name ({namespace}Name); {} if it is none or has none.

    path: the file, for the error. Raises InputError where a chunk of the extended packet is missing.
    """
    segments = [content for marker, _, content in _segments(data) if marker == _APP1]
    packet = next((each.removeprefix(_PACKET) for each in segments if each.startswith(_PACKET)), None)
    if packet is None:
        return {}
    properties = xmp_properties(packet, path)
    if _HAS_EXTENDED in properties:
        chunks = [each.removeprefix(_EXTENSION) for each in segments if each.startswith(_EXTENSION)]
        properties |= xmp_properties(_reassembled(chunks, properties[_HAS_EXTENDED], path), path)
    return properties


def _segments(data: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Yield marker, place and content of the segments before the picture starts."""
    place = 2
    while data[:2] == b"\xff\xd8" and data[place : place + 1] == b"\xff" and place + 4 <= len(data):
        marker, length = data[place + 1], int.from_bytes(data[place + 2 : place + 4], "big")
        if marker == _START_OF_SCAN or length < 2:
            return
        yield marker, place + 4, data[place + 4 : place + 2 + length]
        place += 2 + length


def _reassembled(chunks: list[bytes], guid: str, path: Path) -> bytes:
    """Join the chunks of an extended packet.

    Each has the digest that names the packet, its full length, its own offset (big-endian) and its part of the packet.
    """
    own = [each for each in chunks if each[:_GUID].decode("ascii", "replace") == guid]
    parts = {int.from_bytes(each[_GUID + 4 : _GUID + 8], "big"): each[_GUID + 8 :] for each in own}
    length = int.from_bytes(own[0][_GUID : _GUID + 4], "big") if own else -1
    packet = bytearray()
    for offset in sorted(parts):
        if offset == len(packet):
            packet += parts[offset]
    if len(packet) != length:
        raise InputError(
            f"{path}: its extended XMP, in which the depth lies, is incomplete ({len(packet)} of {length} bytes): copy it again"
        )
    return bytes(packet)


def xmp_properties(packet: bytes, path: Path) -> dict[str, str]:
    """Return simple properties of an XMP packet by their full name. Raises InputError where it is damaged."""
    try:
        root = ElementTree.fromstring(packet.strip(b"\0 \r\n\t"))
    except ElementTree.ParseError as error:
        raise InputError(f"{path}: its XMP cannot be read ({error}): copy the file again from the phone") from None
    found = {name: value for element in root.iter() for name, value in element.attrib.items()}
    return found | {
        element.tag: element.text.strip() for element in root.iter() if len(element) == 0 and element.text and element.text.strip()
    }


_MPF, _MP_ENTRIES, _MP_ENTRY_BYTES = b"MPF\0", 0xB002, 16


def further_jpegs(data: bytes) -> list[bytes]:
    """Return the JPEGs behind the first one of a file, as its Multi-Picture segment lists them; none where it is damaged."""
    index = next(((place + 4, each[4:]) for marker, place, each in _segments(data) if marker == _APP2 and each.startswith(_MPF)), None)
    if index is None:
        return []
    try:
        listed = _listed(index[1])
    except struct.error:
        return []
    pieces = [data[index[0] + offset : index[0] + offset + size] for size, offset in listed if offset]
    return [each for each in pieces if each[:2] == b"\xff\xd8"]


def _listed(tiff: bytes) -> list[tuple[int, int]]:
    """Return size and offset of each picture; offsets count from the TIFF header of the index."""
    order = "<" if tiff[:2] == b"II" else ">"
    (first,) = struct.unpack_from(order + "I", tiff, 4)
    (count,) = struct.unpack_from(order + "H", tiff, first)
    for entry in range(first + 2, first + 2 + 12 * count, 12):
        tag, _, length, place = struct.unpack_from(order + "HHII", tiff, entry)
        if tag == _MP_ENTRIES:
            return [struct.unpack_from(order + "II", tiff, at + 4) for at in range(place, place + length, _MP_ENTRY_BYTES)]
    return []

"""XMP of a JPEG: the packet of the first kilobytes and the extended one, which is cut into chunks (XMP Specification Part 3, 1.1.3)."""

from pathlib import Path
from xml.etree import ElementTree

from mrbokeh.system.errors import InputError

_PACKET = b"http://ns.adobe.com/xap/1.0/\0"
_EXTENSION = b"http://ns.adobe.com/xmp/extension/\0"
_HAS_EXTENDED = "{http://ns.adobe.com/xmp/note/}HasExtendedXMP"
_GUID = 32


def read_xmp(path: Path) -> dict[str, str]:
    """Simple properties by their full name ({namespace}Name); {} where the file is no JPEG or has none.

    Raises InputError where a chunk of the extended packet is missing.
    """
    segments = _app1_segments(path.read_bytes())
    packet = next((each.removeprefix(_PACKET) for each in segments if each.startswith(_PACKET)), None)
    if packet is None:
        return {}
    properties = _properties(packet, path)
    if _HAS_EXTENDED in properties:
        chunks = [each.removeprefix(_EXTENSION) for each in segments if each.startswith(_EXTENSION)]
        properties |= _properties(_reassembled(chunks, properties[_HAS_EXTENDED], path), path)
    return properties


def _app1_segments(data: bytes) -> list[bytes]:
    """Contents of the APP1 segments before the picture starts."""
    segments, place = [], 2
    while data[:2] == b"\xff\xd8" and data[place : place + 1] == b"\xff" and place + 4 <= len(data):
        marker, length = data[place + 1], int.from_bytes(data[place + 2 : place + 4], "big")
        if marker == 0xDA or length < 2:
            break
        if marker == 0xE1:
            segments.append(data[place + 4 : place + 2 + length])
        place += 2 + length
    return segments


def _reassembled(chunks: list[bytes], guid: str, path: Path) -> bytes:
    """Each chunk: the digest that names the packet, its full length, its own offset (big-endian), its part of the packet."""
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


def _properties(packet: bytes, path: Path) -> dict[str, str]:
    try:
        root = ElementTree.fromstring(packet.strip(b"\0 \r\n\t"))
    except ElementTree.ParseError as error:
        raise InputError(f"{path}: its XMP cannot be read ({error}): copy the file again from the phone") from None
    found = {name: value for element in root.iter() for name, value in element.attrib.items()}
    return found | {
        element.tag: element.text.strip() for element in root.iter() if len(element) == 0 and element.text and element.text.strip()
    }

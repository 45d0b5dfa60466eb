"""A maker note as Apple's phones write it."""

import struct
from collections.abc import Mapping, Sequence


def apple_note(rationals: Mapping[int, Sequence[tuple[int, int]]]) -> bytes:
    """Return a note with signed rationals by their tags; offsets count from its beginning."""
    ends = 14 + 2 + 12 * len(rationals) + 4
    entries, values = b"", b""
    for tag, pairs in rationals.items():
        entries += struct.pack(">HHII", tag, 10, len(pairs), ends + len(values))
        values += b"".join(struct.pack(">ii", *each) for each in pairs)
    return b"Apple iOS\0\0\1MM" + struct.pack(">H", len(rationals)) + entries + bytes(4) + values

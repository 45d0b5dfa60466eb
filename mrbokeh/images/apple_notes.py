"""Maker notes of Apple's phones: which way is down, by their accelerometer, and between which distances they were focused.

The tags and their meaning are those that ExifTool's table of Apple's maker notes lists (8 and 12). A note is an IFD after the name
"Apple iOS", whose offsets count from the note's beginning.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mrbokeh.images.exif import exif_and_size

_NAME, _IFD_AT = b"Apple iOS\0", 14
_GRAVITY, _FOCUS, _RATIONALS = 8, 12, (5, 10)
_EXIF_IFD, _MAKER_NOTE, _LENS_MODEL = 0x8769, 0x927C, 0xA434
_STILL, _IN_PLANE = 0.1, 0.2
"""How far from 1 g the reading of a phone may be that is held still, and the least of it along the picture that tells its roll."""
_FARTHEST_M = 1e4


@dataclass(frozen=True)
class AppleNotes:
    """gravity: (3,) in g along the phone's right, top, and out of its screen. focus_m: nearest and farthest distance. None if unknown."""

    gravity: tuple[float, float, float] | None = None
    focus_m: tuple[float, float] | None = None

    @property
    def focus_distance_m(self) -> float | None:
        """Return the middle of the range of the focus, in dioptres."""
        return None if self.focus_m is None else 2.0 / (1.0 / self.focus_m[0] + 1.0 / self.focus_m[1])


def apple_notes(note: bytes) -> AppleNotes:
    """Read a maker note; what is not Apple's, or is damaged, tells nothing."""
    if not note.startswith(_NAME):
        return AppleNotes()
    values = dict(_rationals(note))
    gravity, focus = values.get(_GRAVITY, ()), values.get(_FOCUS, ())
    is_still = len(gravity) == 3 and abs(float(np.linalg.norm(gravity)) - 1.0) < _STILL
    is_distance = len(focus) == 2 and min(focus) > 0.0 and max(focus) < _FARTHEST_M
    return AppleNotes(
        gravity=(gravity[0], gravity[1], gravity[2]) if is_still else None, focus_m=(min(focus), max(focus)) if is_distance else None
    )


def _rationals(note: bytes) -> Iterator[tuple[int, tuple[float, ...]]]:
    """Yield the number and the values of each tag that holds rationals."""
    order = "<" if note[12:14] == b"II" else ">"
    try:
        (count,) = struct.unpack_from(f"{order}H", note, _IFD_AT)
        for entry in range(count):
            tag, kind, many, at = struct.unpack_from(f"{order}HHII", note, _IFD_AT + 2 + 12 * entry)
            if kind in _RATIONALS and many <= 3:
                parts = struct.unpack_from(f"{order}{2 * many}{'i' if kind == max(_RATIONALS) else 'I'}", note, at)
                yield tag, tuple(above / below if below else 0.0 for above, below in zip(parts[::2], parts[1::2], strict=True))
    except struct.error:
        return


def held_by_phone(path: Path) -> Float[np.ndarray, "3 3"] | None:
    """Return the turn from camera axes (x right, y down, z forward) to upright ones by the accelerometer of Apple's phones, or None.

    The picture is taken to be shown nearly upright, whichever way the sensor was held. None for cameras that look at who holds the phone,
    and where the reading is not that of a phone held still.
    """
    found = exif_and_size(path)
    tags = found[0].get_ifd(_EXIF_IFD) if found else {}
    note = tags.get(_MAKER_NOTE)
    gravity = apple_notes(note).gravity if isinstance(note, bytes) else None
    if gravity is None or "front" in str(tags.get(_LENS_MODEL, "")).lower():
        return None
    right, top, out = np.array(gravity) / np.linalg.norm(gravity)
    # The back camera looks against the axis out of the screen; quarter turns bring down nearest to the picture's.
    across, along = (right, -top) if abs(top) >= abs(right) else (top, right)
    if np.hypot(across, along) < _IN_PLANE:
        across, along = 0.0, np.hypot(across, along)
    down = np.array([across * np.sign(along), abs(along), -out])
    return _turned_to(down / np.linalg.norm(down))


def _turned_to(down: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return the turn whose second row is down, and which looks no way aside."""
    right = np.cross(down, [0.0, 0.0, 1.0])
    right = np.array([1.0, 0.0, 0.0]) if np.linalg.norm(right) < 1e-6 else right / np.linalg.norm(right)
    return np.stack([right, down, np.cross(right, down)])

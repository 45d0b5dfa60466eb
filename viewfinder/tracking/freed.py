"""FreeD D1 (Vinten free-d): camera place and angles in 29 bytes, zoom and focus as raw counts of their encoders.

    0  0xD1      1  camera      2  pan, tilt, roll: 3 bytes each, signed, degrees * 32768     11  x, y, z: 3 bytes each, signed, mm * 64
   20  zoom, focus: 3 bytes each, unsigned counts     26  spare     28  checksum: 0x40 less the sum of the others, modulo 256

z is up; with all angles 0 the camera looks along y with x to its right. Pan counts to the right, tilt up, roll clockwise as seen
from behind. Senders differ in this more than in anything else: `FreeDReading.signs` turns it round.

EncoderTable tells what the counts mean, from a CSV that somebody measured on that lens:

    axis,count,value
    focus_m,0,inf
    focus_m,21000,2.0
    focus_m,65535,0.45
    zoom_mm,0,24
    zoom_mm,65535,70
    f_number,0,2.8
    f_number,65535,22

focus_m counts from the entrance pupil. Between two rows focus goes with dioptres, the f-number with stops, zoom with millimetres;
beyond the ends it stays. An axis may be missing, or have one row: then it does not move.
"""

import csv
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from mrbokeh.system.errors import InputError
from mrbokeh.tracking.world_axes import CAMERA_FROM_STAGE_CAMERA, inverted, rigid, stage_rotation
from viewfinder.frames import UNKNOWN_LENS, LensState, Pose
from viewfinder.tracking.pose_history import STAGE_FROM_BOARD, MalformedMessageError, TrackingSample

AXES = ("focus_m", "zoom_mm", "f_number")
_COLUMNS = ("axis", "count", "value")

Axis = tuple[Float64[np.ndarray, " rows"], Float64[np.ndarray, " rows"]]
Count = int | float | None


@dataclass(frozen=True)
class EncoderTable:
    """Meaning of the counts of a lens's encoders.

    axes: for each name of AXES (counts ascending, the values in which it is interpolated: dioptres, millimetres, logarithms).
    """

    axes: Mapping[str, Axis]

    def lens(self, focus: Count = None, zoom: Count = None, iris: Count = None) -> LensState:
        """Return what the counts say; None where there is no count or no axis for it."""
        dioptres, millimetres, stops = (self._at(name, count) for name, count in zip(AXES, (focus, zoom, iris), strict=True))
        return LensState(
            None if dioptres is None else (1.0 / dioptres if dioptres > 0.0 else np.inf),
            None if stops is None else float(np.exp(stops)),
            millimetres,
        )

    def _at(self, name: str, count: Count) -> float | None:
        if count is None or name not in self.axes:
            return None
        return float(np.interp(count, *self.axes[name]))


def read_encoder_table(path: Path | str) -> EncoderTable:
    """Read a table; InputError names the line that is wrong."""
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"expected a lens table ({','.join(_COLUMNS)}) at {path}, but cannot read it: {error}") from None
    rows = csv.DictReader(lines, skipinitialspace=True)
    if tuple(name.strip() for name in rows.fieldnames or ()) != _COLUMNS:
        raise InputError(f"{path}: expected a first line {','.join(_COLUMNS)}, got {','.join(rows.fieldnames or ())!r}")
    found: dict[str, dict[float, float]] = {}
    for row in rows:
        axis, count, value = _row(row, f"{path}, line {rows.line_num}")
        counts = found.setdefault(axis, {})
        if count in counts:
            raise InputError(f"{path}, line {rows.line_num}: the count {count:g} of {axis} was there before: keep one of the two")
        counts[count] = value
    if not found:
        raise InputError(f"{path}: expected rows such as focus_m,21000,2.0 below the first line, found none")
    return EncoderTable({axis: _monotone(axis, counts, path) for axis, counts in found.items()})


def _row(row: Mapping[str, str | None], where: str) -> tuple[str, float, float]:
    axis = (row["axis"] or "").strip()
    try:
        count, value = float(row["count"] or ""), float(row["value"] or "")
    except ValueError:
        count = value = np.nan
    endless = axis == "focus_m" and value == np.inf
    if axis not in AXES or not np.isfinite(count) or not (endless or (np.isfinite(value) and value > 0.0)):
        raise InputError(
            f"{where}: expected one of {', '.join(AXES)}, a count and a positive value, got {', '.join(map(str, row.values()))}"
        )
    return axis, count, value


def _monotone(axis: str, values: Mapping[float, float], path: Path) -> Axis:
    counts = np.array(sorted(values))
    stated = np.array([values[count] for count in counts])
    interpolated = {"focus_m": 1.0 / stated, "zoom_mm": stated, "f_number": np.log(stated)}[axis]
    steps = np.diff(interpolated)
    if len(steps) and not ((steps > 0).all() or (steps < 0).all()):
        wrong = int(np.argmax(steps * np.sign(interpolated[-1] - interpolated[0]) <= 0))
        raise InputError(
            f"{path}: {axis} must go one way as the count grows, but turns between {counts[wrong]:g} and {counts[wrong + 1]:g}: "
            f"measure these rows again"
        )
    return counts, interpolated


MESSAGE_BYTES = 29

_TYPE = 0xD1
_CHECKSUM_START = 0x40
_PER_DEGREE = 32768.0
_PER_M = 64.0 * 1000.0
_FIELD_BYTES = 3


@dataclass(frozen=True)
class FreeDMessage:
    """Message. pan_tilt_roll_deg, xyz_m: as sent. zoom, focus: counts of the encoders, 0 to 2**24 - 1."""

    camera: int
    pan_tilt_roll_deg: tuple[float, float, float]
    xyz_m: tuple[float, float, float]
    zoom: int
    focus: int


@dataclass(frozen=True)
class FreeDReading:
    """Meaning of a sender's numbers: signs of (pan, tilt, roll, x, y, z); where our world lies on its stage; its lens.

    pupil_before_m: how far the entrance pupil lies before the point whose place is sent (often the head of the tripod).
    """

    signs: tuple[int, int, int, int, int, int] = (1, 1, 1, 1, 1, 1)
    stage_from_world: Pose = field(default_factory=STAGE_FROM_BOARD.copy)
    pupil_before_m: float = 0.0
    table: EncoderTable | None = None


def read_freed(datagram: bytes) -> FreeDMessage:
    """Decode a message; MalformedMessageError where length, type or checksum are wrong."""
    if len(datagram) != MESSAGE_BYTES or datagram[0] != _TYPE:
        raise MalformedMessageError("not a D1 message of FreeD")
    if datagram[-1] != checksum(datagram[:-1]):
        raise MalformedMessageError("the checksum of a FreeD message is wrong")
    numbers = [datagram[first : first + _FIELD_BYTES] for first in range(2, 26, _FIELD_BYTES)]
    pan, tilt, roll = (int.from_bytes(each, "big", signed=True) / _PER_DEGREE for each in numbers[:3])
    x, y, z = (int.from_bytes(each, "big", signed=True) / _PER_M for each in numbers[3:6])
    zoom, focus = (int.from_bytes(each, "big") for each in numbers[6:])
    return FreeDMessage(camera=datagram[1], pan_tilt_roll_deg=(pan, tilt, roll), xyz_m=(x, y, z), zoom=zoom, focus=focus)


def freed_sample(message: FreeDMessage, reading: FreeDReading) -> TrackingSample:
    """Convert a message to our conventions; without a table the counts of the lens say nothing and are told as ignored."""
    numbers = np.array([*message.pan_tilt_roll_deg, *message.xyz_m]) * reading.signs
    pan, tilt, roll = numbers[:3]
    stage_from_camera = rigid(stage_rotation(-pan, tilt, roll), numbers[3:])
    stage_from_pupil = stage_from_camera @ rigid(np.eye(3), np.array([0.0, reading.pupil_before_m, 0.0]))
    camera_from_world = CAMERA_FROM_STAGE_CAMERA @ inverted(stage_from_pupil) @ reading.stage_from_world
    if reading.table is None:
        return TrackingSample(camera_from_world, UNKNOWN_LENS, ignored=frozenset({"zoom and focus counts (no lens table)"}))
    return TrackingSample(camera_from_world, reading.table.lens(focus=message.focus, zoom=message.zoom))


def checksum(body: bytes) -> int:
    """Return the last byte of a message."""
    return (_CHECKSUM_START - sum(body)) % 256

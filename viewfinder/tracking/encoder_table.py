"""EncoderTable: what the raw counts of a lens's encoders mean, from a CSV that somebody measured on that lens.

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
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from mrbokeh.system.errors import InputError
from viewfinder.flow.frames import LensState

AXES = ("focus_m", "zoom_mm", "f_number")
_COLUMNS = ("axis", "count", "value")

Axis = tuple[Float64[np.ndarray, " rows"], Float64[np.ndarray, " rows"]]
Count = int | float | None


@dataclass(frozen=True)
class EncoderTable:
    """axes: for each name of AXES (counts ascending, the values in which it is interpolated: dioptres, millimetres, logarithms)."""

    axes: Mapping[str, Axis]

    def lens(self, focus: Count = None, zoom: Count = None, iris: Count = None) -> LensState:
        """What the counts say; None where there is no count or no axis for it."""
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
    """Raises InputError naming the line that is wrong."""
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

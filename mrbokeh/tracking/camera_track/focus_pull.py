"""FocusPull: the focus distance by frame, from keyframes or from tables that cine cameras wrote (CSV).

Between keys it goes in dioptres, in which rings of lenses and the size of the blur are about linear.

    Sony Venice    "Focus Distance (ft)"
    RED            REDline --printMeta 5: "Focus Distance" in mm
    Canon          "FocusPosition": the bits of a float in metres
    any            a column named focus or focus distance with its unit: focus_distance_m, Focus (mm), focus_ft, ...

Rows count as frames from 0 unless there is a column FrameNo or frame. Rows without a distance are bridged.

Cameras round what they write. A smooth sequence is sought among those that round to what was written: averaging with neighbours on both
sides, which has no lag, alternates with clipping to half a step (projections onto convex sets, Bregman 1965). The average is a Gaussian
and what that takes away averaged once more ("twicing", Tukey 1977), for a plain one pulls a curve into chords: on rounded sines it left
more error than the rounding. Lens encoders and the tables behind them step neither in metres nor evenly in dioptres, so the step is
measured around each value.
"""

import csv
import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from mrbokeh.system.errors import InputError, require_file

Samples = Float64[np.ndarray, " samples"]

_NEIGHBOURS = 4
_SIGMA_FRAMES = 3.0
_ROUNDS = 60


def quantisation_steps(values: Samples) -> Samples:
    """Return at each sample the least distance between two of the values that occur around its own; 0 if only one occurs."""
    levels, of_sample = np.unique(values, return_inverse=True)
    if len(levels) == 1:
        return np.zeros_like(values)
    gaps = np.diff(levels)
    steps = [gaps[max(index - _NEIGHBOURS, 0) : index + _NEIGHBOURS].min() for index in range(len(levels))]
    return np.array(steps)[of_sample]


def smoothed_within_steps(values: Samples) -> Samples:
    """Return samples within half a step of those given, about as smooth as that allows."""
    reach = 0.5 * quantisation_steps(values)
    low, high = values - reach, values + reach
    smooth = values
    for _ in range(_ROUNDS):
        smooth = np.clip(_averaged(smooth), low, high)
    return smooth


def _averaged(values: Samples) -> Samples:
    """Average samples, mirrored through the first and last one so that a steady pull stays as it is at its ends."""
    from scipy.ndimage import gaussian_filter1d

    pad = min(len(values) - 1, int(6 * _SIGMA_FRAMES))
    before, after = 2.0 * values[0] - values[pad:0:-1], 2.0 * values[-1] - values[-2 : -pad - 2 : -1]
    longer = np.concatenate([before, values, after])
    once = gaussian_filter1d(longer, _SIGMA_FRAMES, mode="nearest")
    twice = once + gaussian_filter1d(longer - once, _SIGMA_FRAMES, mode="nearest")
    return twice[pad : pad + len(values)]


EASINGS = ("linear", "smooth")

Keys = Float64[np.ndarray, " keys"]


@dataclass(frozen=True)
class FocusPull:
    """Focus distance by frame, from keys.

    frames: growing. dioptres: 1/m at those frames, 0 is infinity.

    easing: linear, or smooth: no kinks, at rest in the first and last key, never beyond the keys (Fritsch and Carlson 1980).
    held: before the first and after the last key the focus stays; else asking for such frames is an InputError.
    """

    frames: Keys
    dioptres: Keys
    easing: str = "linear"
    held: bool = True

    def __post_init__(self) -> None:
        if self.easing not in EASINGS:
            raise InputError(f"easing must be one of {', '.join(EASINGS)}, got {self.easing!r}")
        if not len(self.frames) or (np.diff(self.frames) <= 0).any():
            raise InputError(f"the frames of a focus pull must grow from key to key, got {self.frames.tolist()[:8]}")
        if not (np.isfinite(self.dioptres) & (self.dioptres >= 0)).all():
            raise InputError("the distances of a focus pull must be positive metres, or inf")

    def at(self, frame: float | int) -> float:
        """Return metres from the entrance pupil; inf is infinity."""
        place = self._place(frame)
        dioptres = float(np.interp(place, self.frames, self.dioptres) if self.easing == "linear" else self._smooth(place))
        return 1.0 / dioptres if dioptres > 0.0 else float("inf")

    def shifted(self, offset: float | int) -> "FocusPull":
        """Return the pull in which key n is n + offset."""
        return replace(self, frames=self.frames + offset)

    def smoothed(self) -> "FocusPull":
        """Return the pull without the steps in which cameras write their metadata. The keys must be about one a frame."""
        return replace(self, dioptres=smoothed_within_steps(self.dioptres))

    def _place(self, frame: float | int) -> float:
        first, last = float(self.frames[0]), float(self.frames[-1])
        if not self.held and not first <= frame <= last:
            raise InputError(
                f"the focus is known from frame {first:g} to {last:g}, but was asked for at frame {frame:g}: shift or extend it"
            )
        return float(np.clip(frame, first, last))

    def _smooth(self, place: float) -> float:
        if len(self.frames) == 1:
            return float(self.dioptres[0])
        from scipy.interpolate import CubicHermiteSpline, PchipInterpolator  # 0.3 s for each worker of a video, which seldom has a pull

        slopes = PchipInterpolator(self.frames, self.dioptres).derivative()(self.frames)
        slopes[[0, -1]] = 0.0
        return max(float(CubicHermiteSpline(self.frames, self.dioptres, slopes)(place)), 0.0)


def parse_focus_keys(text: str, easing: str = "linear") -> FocusPull:
    """Parse "FRAME:METRES,FRAME:METRES,..." such as 0:1.2,48:3.5; inf is infinity."""
    try:
        pairs = [each.split(":") for each in text.split(",")]
        frames, metres = np.array([float(frame) for frame, _ in pairs]), np.array([float(distance) for _, distance in pairs])
    except ValueError:
        frames, metres = np.zeros(0), np.zeros(0)
    if not len(frames) or not (metres > 0).all() or not np.isfinite(frames).all():
        raise InputError(f"expected focus keys as FRAME:METRES,FRAME:METRES with positive metres, such as 0:1.2,48:3.5, got {text!r}")
    return FocusPull(frames, 1.0 / metres, easing)


Row = Mapping[str, str]

_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048, "in": 0.0254}
_HEADER = re.compile(r"focus[ _]?(?:distance|position)?[ _]?\(?(m|cm|mm|ft|in)\)?", re.IGNORECASE)
_FRAME_COLUMNS = ("frame", "frameno", "frame_number")


def read_focus_pull(path: Path | str) -> FocusPull:
    """Read a table of focus distances. Raises InputError if no column or no row tells one."""
    path = Path(path)
    rows = _rows(path)
    distance_m = _distance_column(rows[0], path)
    distances = [_tried(distance_m, row, f"{path}, row {number}") for number, row in enumerate(rows, 1)]
    known = [index for index, each in enumerate(distances) if each is not None and each > 0.0]
    if not known:
        raise InputError(f"{path} has a column of focus distances, but none of its {len(rows)} rows tells one: the lens was not read")
    frames = np.array([_frame_number(rows[index], index, path) for index in known])
    dioptres = np.array([1.0 / (distances[index] or np.inf) for index in known])
    return FocusPull(frames, dioptres, held=False)


def _rows(path: Path) -> list[Row]:
    require_file(path, "a table of focus distances")
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows: list[Row] = list(csv.DictReader(file))
    except (csv.Error, UnicodeDecodeError) as error:
        raise InputError(f"expected a table (CSV) in {path}, but it is not one: {error}") from None
    if not rows:
        raise InputError(f"{path} holds no row: expected a header and a row for each frame")
    return rows


def _distance_column(row: Row, path: Path) -> Callable[[Row], float]:
    """Return a function that takes the metres out of a row."""
    for name in row:
        if name and (match := _HEADER.fullmatch(name.strip())):
            unit = _METRES[match[1].lower()]
            return lambda row: float(row[name]) * unit
    if "FocusPosition" in row:
        return lambda row: float(struct.unpack(">f", bytes.fromhex(row["FocusPosition"]))[0])
    if "Focus Distance" in row and "FrameNo" in row:
        return lambda row: float(row["Focus Distance"]) * _METRES["mm"]
    raise InputError(
        f"{path}: expected a column of focus distances with its unit, such as focus_distance_m or 'Focus Distance (ft)', "
        f"or a table of a Venice, RED or Canon; its columns are {', '.join(list(row)[:12])}"
    )


def _tried(distance_m: Callable[[Row], float], row: Row, where: str) -> float | None:
    """Return the distance of a row, None if it is empty. Raises InputError if it is no number."""
    try:
        return distance_m(row)
    except (ValueError, TypeError, struct.error) as error:
        if "empty" in str(error) or "convert string to float: ''" in str(error) or "NoneType" in str(error):
            return None
        raise InputError(f"{where}: its focus distance is not a number ({error})") from None


def _frame_number(row: Row, index: int, path: Path) -> float:
    for name in row:
        if name and name.strip().lower() in _FRAME_COLUMNS:
            try:
                return float(row[name])
            except ValueError:
                raise InputError(f"{path}, row {index + 1}: expected a frame number, got {row[name]!r}") from None
    return float(index)

"""FocusPull: the focus distance by frame, from keyframes, metadata or a track.

Between keys it goes in dioptres, which rings of lenses and the size of the blur are about linear in.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.focus_steps import smoothed_within_steps
from mrbokeh.tracking.camera_track.track import CameraTrack

EASINGS = ("linear", "smooth")

Keys = Float64[np.ndarray, " keys"]


@dataclass(frozen=True)
class FocusPull:
    """frames: growing. dioptres: 1/m at those frames, 0 is infinity. f_numbers, t_numbers: at the same frames, where known.

    easing: linear, or smooth: no kinks, at rest in the first and last key, never beyond the keys (Fritsch and Carlson 1980).
    held: before the first and after the last key the focus stays; else asking for such frames is an InputError.
    """

    frames: Keys
    dioptres: Keys
    easing: str = "linear"
    f_numbers: Keys | None = None
    t_numbers: Keys | None = None
    held: bool = True

    def __post_init__(self) -> None:
        if self.easing not in EASINGS:
            raise InputError(f"easing must be one of {', '.join(EASINGS)}, got {self.easing!r}")
        if not len(self.frames) or (np.diff(self.frames) <= 0).any():
            raise InputError(f"the frames of a focus pull must grow from key to key, got {self.frames.tolist()[:8]}")
        if not (np.isfinite(self.dioptres) & (self.dioptres >= 0)).all():
            raise InputError("the distances of a focus pull must be positive metres, or inf")

    def at(self, frame: float | int) -> float:
        """Metres from the entrance pupil; inf is infinity."""
        place = self._place(frame)
        dioptres = float(np.interp(place, self.frames, self.dioptres) if self.easing == "linear" else self._smooth(place))
        return 1.0 / dioptres if dioptres > 0.0 else float("inf")

    def f_number_at(self, frame: float | int) -> float | None:
        return self._stop_at(self.f_numbers, frame)

    def t_number_at(self, frame: float | int) -> float | None:
        return self._stop_at(self.t_numbers, frame)

    def shifted(self, offset: float | int) -> "FocusPull":
        """Key n becomes n + offset."""
        return replace(self, frames=self.frames + offset)

    def smoothed(self) -> "FocusPull":
        """Without the steps in which cameras write their metadata: see `focus_steps`. The keys must be one a frame, or about."""
        return replace(self, dioptres=smoothed_within_steps(self.dioptres))

    def transmitting(self, transmittance: float) -> "FocusPull":
        """f-numbers from T-numbers: T = N / sqrt(transmittance). A cine prime transmits about 0.8; nothing in the metadata tells."""
        if not 0.0 < transmittance <= 1.0:
            raise InputError(f"the transmittance of a lens lies above 0 and is at most 1, got {transmittance}")
        if self.t_numbers is None:
            raise InputError("this focus pull knows no T-numbers: leave the transmittance out")
        return replace(self, f_numbers=self.t_numbers * np.sqrt(transmittance))

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
        slopes = PchipInterpolator(self.frames, self.dioptres).derivative()(self.frames)
        slopes[[0, -1]] = 0.0
        return max(float(CubicHermiteSpline(self.frames, self.dioptres, slopes)(place)), 0.0)

    def _stop_at(self, numbers: Keys | None, frame: float | int) -> float | None:
        """Between keys in stops."""
        return None if numbers is None else float(np.exp2(np.interp(self._place(frame), self.frames, np.log2(numbers))))


def parse_focus_keys(text: str, easing: str = "linear") -> FocusPull:
    """ "FRAME:METRES,FRAME:METRES,..." such as 0:1.2,48:3.5; inf is infinity."""
    try:
        pairs = [each.split(":") for each in text.split(",")]
        frames, metres = np.array([float(frame) for frame, _ in pairs]), np.array([float(distance) for _, distance in pairs])
    except ValueError:
        frames, metres = np.zeros(0), np.zeros(0)
    if not len(frames) or not (metres > 0).all() or not np.isfinite(frames).all():
        raise InputError(f"expected focus keys as FRAME:METRES,FRAME:METRES with positive metres, such as 0:1.2,48:3.5, got {text!r}")
    return FocusPull(frames, 1.0 / metres, easing)


def focus_of_track(track: CameraTrack) -> FocusPull:
    """What the track itself tells. Raises InputError where it tells no focus."""
    known = [number for number in track.numbers if track.frames[number].focus_distance_m is not None]
    if not known:
        raise InputError("the camera track tells no focus distance: give keyframes or the camera's metadata")
    dioptres = [1.0 / (track.frames[number].focus_distance_m or np.inf) for number in known]
    stops = [track.frames[number].f_number for number in known]
    f_numbers = None if any(each is None for each in stops) else np.array(stops, np.float64)
    return FocusPull(np.array(known, np.float64), np.array(dioptres), f_numbers=f_numbers, held=track.fixed)

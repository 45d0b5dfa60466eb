"""Timecode: hours, minutes, seconds and frames by which editors know a frame, of videos (text) and of EXR (header entry timeCode)."""

import re
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

_TEXT = re.compile(r"(\d\d):(\d\d):(\d\d)([:;.])(\d\d)")
_EXR_MOST = 30


@dataclass(frozen=True)
class Timecode:
    """Timecode of a frame.

    count: frames since midnight. per_second: whole frames that a second of the code has, 30 at 29.97. drops: whether two numbers a minute
    are left out, but each tenth minute, so that the code keeps pace with the clock (SMPTE ST 12-1; four at 59.94).
    """

    count: int
    per_second: int
    drops: bool = False

    @classmethod
    def parsed(cls, text: str, rate: Fraction) -> "Timecode | None":
        """Parse 10:20:30:12, with ; before the frames where numbers are dropped; None if it is none at this rate."""
        found, per_second = _TEXT.fullmatch(text.strip()), round(rate)
        if found is None or int(found[5]) >= per_second:
            return None
        hours, minutes, seconds, frames = (int(found[place]) for place in (1, 2, 3, 5))
        return cls.of(hours, minutes, seconds, frames, per_second, drops=found[4] != ":")

    @classmethod
    def of(cls, hours: int, minutes: int, seconds: int, frames: int, per_second: int, *, drops: bool) -> "Timecode":
        passed = 60 * hours + minutes
        dropped = (passed - passed // 10) * (per_second // 15) if drops else 0
        return cls((60 * passed + seconds) * per_second + frames - dropped, per_second, drops)

    @classmethod
    def of_exr(cls, code: Any, rate: Fraction) -> "Timecode":
        """Return that of a header entry timeCode."""
        return cls.of(code.hours, code.minutes, code.seconds, code.frame, round(rate), drops=bool(code.dropFrame))

    def later(self, frames: int) -> "Timecode":
        """Return the timecode so many frames later."""
        return replace(self, count=self.count + frames)

    @property
    def parts(self) -> tuple[int, int, int, int]:
        """Hours, minutes, seconds and frames."""
        count, per_minute = self.count, 60 * self.per_second
        if self.drops:
            lost = self.per_second // 15
            tens, rest = divmod(count, 10 * per_minute - 9 * lost)
            count += 9 * lost * tens + lost * max(0, (rest - lost) // (per_minute - lost))
        seconds, frames = divmod(count, self.per_second)
        return seconds // 3600 % 24, seconds // 60 % 60, seconds % 60, frames

    def __str__(self) -> str:
        hours, minutes, seconds, frames = self.parts
        return f"{hours:02d}:{minutes:02d}:{seconds:02d}{';' if self.drops else ':'}{frames:02d}"

    def to_exr(self) -> Any:
        """Return the header entry timeCode, which counts to 29 at most; None where a second has more frames."""
        import OpenEXR

        if self.per_second > _EXR_MOST:
            return None
        return OpenEXR.TimeCode(*self.parts, self.drops, *[False] * 5, *[0] * 8)

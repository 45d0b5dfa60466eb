"""FrameIndex: which frame of a video is shown when, and where decoding can begin; read from its packets, without decoding."""

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from mrbokeh.system.errors import InputError
from mrbokeh.video.decoding import frame_rate, opened, told_as_damage


@dataclass(frozen=True, eq=False)
class FrameIndex:
    """shown: times of the frames in units of time_base, growing. is_key: whether decoding can begin at that frame.

    decoded: when the decoder gets the packet of that frame, which is what containers seek by. has_times is False where packets
    carry none: then frames can only be counted from the beginning on, and `shown` is their count.
    """

    shown: Int64[np.ndarray, " frames"]
    decoded: Int64[np.ndarray, " frames"]
    is_key: Bool[np.ndarray, " frames"]
    time_base: Fraction
    has_times: bool = True

    @classmethod
    def of(cls, path: Path) -> "FrameIndex":
        """Packets that are not shown (before the first keyframe, cut off by an edit list) do not count."""
        with opened(path) as (container, stream), told_as_damage(path):
            rate = frame_rate(stream)
            packets = [_Facts.of(packet) for packet in container.demux(stream) if packet.size and not packet.is_discard]
            time_base = Fraction(stream.time_base)
        first_key = next((place for place, packet in enumerate(packets) if packet.is_key), 0)
        shown = [packet for packet in packets[first_key:] if packet.shown is None or packet.shown >= (packets[first_key].shown or 0)]
        if not shown:
            raise InputError(f"{path} holds no picture that can be decoded: it is damaged or cut off")
        times = {packet.shown for packet in shown}
        if None in times or len(times) < len(shown):
            return cls._counted(len(shown), 1 / rate)
        shown.sort(key=lambda packet: packet.shown or 0)
        columns = zip(*((packet.shown, packet.decoded, packet.is_key) for packet in shown), strict=True)
        when, decoded, is_key = (np.array(column) for column in columns)
        return cls(when.astype(np.int64), decoded.astype(np.int64), is_key.astype(bool), time_base)

    @classmethod
    def _counted(cls, count: int, time_base: Fraction) -> "FrameIndex":
        places = np.arange(count, dtype=np.int64)
        return cls(places, places, places == 0, time_base, has_times=False)

    @property
    def times_s(self) -> Float64[np.ndarray, " frames"]:
        return np.array([float(tick * self.time_base) for tick in self.shown.tolist()])

    def number_of(self, tick: int | None) -> int | None:
        """The number of the frame that is shown at a time; None where none is."""
        if tick is None:
            return None
        number = int(np.searchsorted(self.shown, tick))
        return number if number < len(self.shown) and self.shown[number] == tick else None

    def keys_before(self, number: int) -> list[int]:
        """Frames at which decoding may begin to reach this one, the last first."""
        return np.flatnonzero(self.is_key[: number + 1])[::-1].tolist()


@dataclass(frozen=True)
class _Facts:
    shown: int | None
    decoded: int
    is_key: bool

    @classmethod
    def of(cls, packet: Any) -> "_Facts":
        decoded = packet.dts if packet.dts is not None else packet.pts
        return cls(packet.pts, 0 if decoded is None else decoded, packet.is_keyframe)

"""VideoTarget: a video out of parts that are encoded on their own and joined packet by packet.

Parts are in the final encoding already, so that joining takes no time and no light away. That needs groups of pictures that do not
refer to others (each part begins with a keyframe, and H.265 is told to close its groups) and encoders whose output does not depend
on who runs them (one thread). The cut into segments never depends on the number of workers, so neither does the file: for ProRes,
DNxHR and FFV1, where every picture stands alone, it is the one that would be written in one go; H.264 and H.265 get a keyframe
at every segment.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from mrbokeh.images.color_management import NamedSpace
from mrbokeh.images.layer import Layer
from mrbokeh.shots.frame_maker import Picture, Rgba
from mrbokeh.shots.result_space import in_space
from mrbokeh.shots.segment import Segment
from mrbokeh.shots.shot import PartSink, Shot
from mrbokeh.system.atomic_files import refuse_existing
from mrbokeh.system.errors import InputError
from mrbokeh.video.encodings import encoding_for, encoding_name, with_alpha
from mrbokeh.video.packets import PacketWriter, packets_of
from mrbokeh.video.writer import VideoWriter

_THREADS = 1


@dataclass(frozen=True)
class VideoTarget:
    """A Target. encoding: a name in ENCODINGS or None for the usual one of the suffix; audio_from: a video whose sound is copied.

    space: what the codes are, where it is not BT.709 as the tags say then. even_rate: pictures per second of the result; at each of its
    times it shows the nearest picture of the shot, which is held or left out for that.
    """

    path: Path
    encoding: str | None = None
    audio_from: Path | None = None
    space: NamedSpace | None = None
    even_rate: Fraction | None = None

    @property
    def settings(self) -> dict[str, str]:
        return {
            "encoding": repr(encoding_for(self.path, self.encoding)),
            "container": self.path.suffix.lower(),
            "output space": str(self.space or ""),
            "even rate": str(self.even_rate or ""),
        }

    @property
    def lacks_alpha(self) -> str | None:
        if encoding_for(self.path, self.encoding).alpha:
            return None
        keeping = with_alpha(self.path)
        instead = ".mov, .mkv or frames.%04d.exr" if keeping is None else f"--encoding {keeping}"
        return f"{encoding_name(self.path, self.encoding)} cannot hold it (write {instead})"

    def require_new(self, shot: Shot, overwrite: bool) -> None:
        refuse_existing(self.path, overwrite)
        encoding = encoding_for(self.path, self.encoding)
        if self.space is not None and self.space.is_linear:
            told = f"{self.space.name} is linear light, which codes of a video cannot hold"
            raise InputError(f"{self.path}: {told}: write frames.%04d.exr, or name a space with a curve")
        if self.even_rate is not None and not encoding.stands_alone:
            told = f"--constant-rate needs pictures that stand alone, but those of {encoding.codec} refer to others"
            raise InputError(f"{self.path}: {told}: take another --encoding")
        writer = VideoWriter(self.path, *self._format(shot), encoding=self.encoding)
        if self.path.suffix.lower() == ".mxf" and self.even_rate is None:
            for segment in shot.segments:
                for time_s in shot.times_s(segment):
                    writer.next_tick(time_s)

    def part(self, folder: Path, segment: Segment) -> Path:
        suffix = self.path.suffix.lower()
        return folder / f"{segment.number:05d}{encoding_for(self.path, self.encoding).part_suffix(suffix)}"

    @contextmanager
    def writing(self, shot: Shot, segment: Segment, folder: Path) -> Iterator[PartSink]:
        name = encoding_name(self.path, self.encoding)
        settings: dict[str, Any] = {"encoding": name, "threads": _THREADS, "as_codes": self.space is not None}
        with VideoWriter(self.part(folder, segment), *self._format(shot), **settings) as writer:
            yield _Sink(writer, self, shot.times_s(segment)[0], segment.start)

    def join(self, shot: Shot, folder: Path) -> str:
        reordered = max(packets_of(self.part(folder, segment))[1] for segment in shot.segments)
        writer = PacketWriter(
            self.path,
            *self._format(shot),
            encoding=self.encoding,
            audio_from=self.audio_from,
            audio_start_s=shot.begin_s,
            reordered=reordered,
            as_codes=self.space is not None,
        )
        with writer:
            for segment in shot.segments:
                packets, count = packets_of(self.part(folder, segment))[0], segment.frame_count
                if len(packets) != count:
                    raise InputError(f"{self.part(folder, segment)} holds {len(packets)} of {count} pictures: delete it and start again")
                writer.append(*self._placed(packets, shot, segment))
        return writer.audio_note

    def _placed(self, packets: list[Any], shot: Shot, segment: Segment) -> tuple[list[Any], list[float]]:
        """The packets of a part with the times at which they are shown; some more than once and others never for an even rate."""
        if self.even_rate is None:
            return packets, shot.times_s(segment)
        first, last = segment.start - shot.start, segment.stop - shot.start
        shown = enumerate(held_pictures(shot.all_times_s, self.even_rate))
        here = [(packets[picture - first], float(tick / self.even_rate)) for tick, picture in shown if first <= picture < last]
        return [packet for packet, _ in here], [time_s for _, time_s in here]

    def _format(self, shot: Shot) -> tuple[Any, ...]:
        info = shot.source.info
        if self.even_rate is not None:
            return info.width_px, info.height_px, self.even_rate, 1 / (self.even_rate * 1000)
        return info.width_px, info.height_px, info.frame_rate, info.time_base


def held_pictures(times_s: Sequence[float], rate: Fraction) -> list[int]:
    """Which picture is the nearest in time at 0, 1/rate, 2/rate and so on, as long as the last of them is shown (1/rate)."""
    shown_s = np.asarray(times_s, np.float64)
    ticks_s = np.arange(max(1, round(shown_s[-1] * rate) + 1)) / float(rate)
    later = np.searchsorted((shown_s[1:] + shown_s[:-1]) / 2, ticks_s, side="right")
    nearest: list[int] = later.tolist()
    return nearest


@dataclass(frozen=True)
class _Sink:
    writer: VideoWriter
    target: VideoTarget
    begin_s: float
    start: int

    def write(self, picture: Picture, index: int, time_s: float) -> None:
        kept = picture.rgb if isinstance(picture, Rgba) and not self.writer.encoding.alpha else picture
        stored = in_space(kept, self.target.space)
        if isinstance(stored, (Layer, Rgba)):
            stored = np.dstack([stored.rgb, stored.alpha])
        rate = self.target.even_rate
        self.writer.write(stored, time_s - self.begin_s if rate is None else float((index - self.start) / rate))

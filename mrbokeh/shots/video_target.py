"""VideoTarget: a video out of parts that are encoded on their own and joined packet by packet.

Parts are in the final encoding already, so that joining takes no time and no light away. That needs groups of pictures that do not
refer to others (each part begins with a keyframe, and H.265 is told to close its groups) and encoders whose output does not depend
on who runs them (one thread). The cut into segments never depends on the number of workers, so neither does the file: for ProRes,
DNxHR and FFV1, where every picture stands alone, it is the one that would be written in one go; H.264 and H.265 get a keyframe
at every segment.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mrbokeh.atomic_files import refuse_existing
from mrbokeh.errors import InputError
from mrbokeh.layer import Layer
from mrbokeh.shots.frame_maker import Picture
from mrbokeh.shots.segment import Segment
from mrbokeh.shots.shot import PartSink, Shot
from mrbokeh.video_encodings import encoding_for, encoding_name
from mrbokeh.video_packets import PacketWriter, packets_of
from mrbokeh.video_writer import VideoWriter

_THREADS = 1


@dataclass(frozen=True)
class VideoTarget:
    """A Target. encoding: a name in ENCODINGS or None for the usual one of the suffix; audio_from: a video whose sound is copied."""

    path: Path
    encoding: str | None = None
    audio_from: Path | None = None

    @property
    def settings(self) -> dict[str, str]:
        return {"encoding": repr(encoding_for(self.path, self.encoding)), "container": self.path.suffix.lower()}

    def require_new(self, shot: Shot, overwrite: bool) -> None:
        refuse_existing(self.path, overwrite)
        writer = VideoWriter(self.path, *self._format(shot), encoding=self.encoding)
        if self.path.suffix.lower() == ".mxf":
            for segment in shot.segments:
                for time_s in shot.times_s(segment):
                    writer.next_tick(time_s)

    def part(self, folder: Path, segment: Segment) -> Path:
        suffix = self.path.suffix.lower()
        return folder / f"{segment.number:05d}{encoding_for(self.path, self.encoding).part_suffix(suffix)}"

    @contextmanager
    def writing(self, shot: Shot, segment: Segment, folder: Path) -> Iterator[PartSink]:
        begin_s = shot.times_s(segment)[0]
        name = encoding_name(self.path, self.encoding)
        with VideoWriter(self.part(folder, segment), *self._format(shot), encoding=name, threads=_THREADS) as writer:
            yield _Sink(writer, begin_s)

    def join(self, shot: Shot, folder: Path) -> str:
        reordered = max(packets_of(self.part(folder, segment))[1] for segment in shot.segments)
        writer = PacketWriter(
            self.path,
            *self._format(shot),
            encoding=self.encoding,
            audio_from=self.audio_from,
            audio_start_s=shot.begin_s,
            reordered=reordered,
        )
        with writer:
            for segment in shot.segments:
                packets, times_s = packets_of(self.part(folder, segment))[0], shot.times_s(segment)
                if len(packets) != len(times_s):
                    raise InputError(
                        f"{self.part(folder, segment)} holds {len(packets)} of {len(times_s)} pictures: delete it and start again"
                    )
                writer.append(packets, times_s)
        return writer.audio_note

    def _format(self, shot: Shot) -> tuple[Any, ...]:
        info = shot.source.info
        return info.width_px, info.height_px, info.frame_rate, info.time_base


@dataclass(frozen=True)
class _Sink:
    writer: VideoWriter
    begin_s: float

    def write(self, picture: Picture, index: int, time_s: float) -> None:  # noqa: ARG002
        if isinstance(picture, Layer):
            picture = np.dstack([picture.rgb, picture.alpha])
        self.writer.write(picture, time_s - self.begin_s)

"""PacketWriter: a video out of parts that are encoded already, packet by packet, at new times and with sound."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mrbokeh.video.writer import VideoWriter, told_as_mistake


class PacketWriter(VideoWriter):
    """A VideoWriter that takes packets in place of pictures; its file is that of a VideoWriter given all the pictures.

    Its own encoder is opened, for the header of the file comes from it, but never fed. Each part holds whole groups of pictures and
    comes out of a VideoWriter of the same settings. reordered: how many places any packet comes before its turn (`packets_of`),
    the largest of all parts; times of decoding follow from it.
    """

    def __init__(self, *arguments: Any, reordered: int = 0, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        self._reordered = reordered
        self._shown: list[int] = []

    def append(self, packets: Sequence[Any], times_s: Sequence[float]) -> None:
        """The packets of a part, as they are stored; times_s: of its pictures in the order of showing."""
        import av

        first = len(self._shown)
        self._shown += [self.next_tick(time_s) for time_s in times_s]
        for place, (packet, rank) in enumerate(zip(packets, _ranks(packets), strict=True), first):
            copied = av.Packet(bytes(packet))
            copied.is_keyframe, copied.time_base, copied.duration = packet.is_keyframe, self.time_base, self._ticks_per_frame
            copied.pts, copied.dts = self._shown[first + rank], self._decoded_at(place - self._reordered)
            copied.stream = self._stream
            with told_as_mistake(self.path):
                self._container.mux(copied)
        if self._audio is not None:
            self._audio.copy_until(times_s[-1])

    def _decoded_at(self, place: int) -> int:
        """A packet is decoded when the picture so many places before it is shown; before the first of all, time goes on evenly."""
        return self._shown[place] if place >= 0 else self._shown[0] + place * self._ticks_per_frame

    def _flush(self) -> None:
        """Nothing waits in an encoder that got nothing."""


def packets_of(part: Path) -> tuple[list[Any], int]:
    """The packets of a video in their order, and how many places the one that comes earliest before its turn does so."""
    import av

    with av.open(str(part)) as container:
        packets = [packet for packet in container.demux(container.streams.video[0]) if packet.size]
    return packets, max((place - rank for place, rank in enumerate(_ranks(packets))), default=0)


def _ranks(packets: Sequence[Any]) -> list[int]:
    """When each packet's picture is shown, counted in pictures."""
    ranks: list[int] = np.argsort(np.argsort([packet.pts for packet in packets], kind="stable"), kind="stable").tolist()
    return ranks

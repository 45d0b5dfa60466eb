"""VideoWriter: linear pictures into a video file with its times and its sound; PacketWriter: the same from encoded parts."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from jaxtyping import Float32

from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.errors import InputError
from mrbokeh.video.audio import CarriedAudio
from mrbokeh.video.color import BT709, BT709_RGB, UNNAMED, UNNAMED_RGB, VideoColor
from mrbokeh.video.encodings import Encoding, encoding_for
from mrbokeh.video.frames import encoded_frame
from mrbokeh.video.timecode import Timecode

_REORDERED = 16
"""How many places a packet comes before its turn at most, by the standards of H.264 and H.265."""


@dataclass(frozen=True)
class StreamFacts:
    """Facts of a video beside its pictures. timecode: of the first. pixel_aspect: width of a pixel over its height."""

    timecode: Timecode | None = None
    pixel_aspect: Fraction = Fraction(1)


class VideoWriter:
    """Writes linear pictures as a video, for use in a `with` block: the file appears whole when the block ends well, else not at all.

    time_base: the unit in which times are rounded; pass that of the source to keep its times exactly (Matroska rounds to 1 ms,
    MXF has none and needs an even rate).
    encoding: a name in ENCODINGS, or None for the usual one of the suffix. Colour is tagged BT.709 throughout. Values
    beyond what the codes can hold are clipped: the limited range of h264, prores and dnxhr goes from -0.06 to 1.08, ffv1 from 0 to 1.
    audio_from: a video whose first audio stream is carried over, from audio_start_s on; `audio_note` says what became of it.
    threads: of the encoder, 0 for all cores; H.264 comes out a little different with another number.
    as_codes: pictures are code values already (0 black, 1 white), of a colour space for which video has no tags. facts: written along.
    """

    def __init__(
        self,
        path: Path,
        width_px: int,
        height_px: int,
        frame_rate: Fraction = Fraction(25),
        time_base: Fraction | None = None,
        *,
        encoding: str | None = None,
        audio_from: Path | None = None,
        audio_start_s: float = 0.0,
        threads: int = 0,
        as_codes: bool = False,
        facts: StreamFacts | None = None,
    ) -> None:
        self.path, self.encoding, self.suffix = Path(path), encoding_for(path, encoding), Path(path).suffix.lower()
        self.size_px, self.frame_rate = (width_px, height_px), frame_rate
        _require_storable(self.path, self.encoding, self.size_px)
        even = self.suffix == ".mxf"
        self.time_base = 1 / frame_rate if even else time_base or 1 / (frame_rate * 1000)
        self.color = _color(self.encoding, as_codes)
        self.audio_note = "no audio"
        self._facts = facts or StreamFacts()
        self._audio_from, self._audio_start_s, self._threads = audio_from, audio_start_s, threads
        self._last_tick: int | None = None
        self.frame_count = 0
        self._first_shown: int | None = None
        self._muxed = 0

    def __enter__(self) -> "VideoWriter":
        import av

        with ExitStack() as stack:
            temporary = stack.enter_context(atomic_path(self.path))
            self._container = stack.enter_context(av.open(str(temporary), "w", container_options=self._container_options()))
            self._stream = self._add_stream()
            self._audio = None
            if self._audio_from is not None:
                self._audio = stack.enter_context(CarriedAudio(self._audio_from, self._container, self.suffix, self._audio_start_s))
                self.audio_note = self._audio.note
            self._stack = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if kind is not None:
            self._stack.__exit__(kind, error, trace)
            return
        with self._stack:
            self._finish()

    def write(self, picture: Float32[np.ndarray, "height width channels"], time_s: float) -> None:
        """One picture of linear light (H, W, 3), of an encoding with alpha also (H, W, 4), premultiplied; times must grow."""
        height, width, channels = picture.shape
        if (width, height) != self.size_px:
            raise InputError(f"{self.path}: expected pictures of {self.size_px[0]}x{self.size_px[1]} px, got {width}x{height} px")
        if channels not in ((3, 4) if self.encoding.alpha else (3,)):
            raise InputError(
                f"{self.path}: pictures with alpha need an encoding that keeps it (prores4444-alpha, ffv1-alpha), not {self.encoding.codec}"
            )
        frame = encoded_frame(picture, self.encoding, self.color)
        frame.pts, frame.time_base, frame.duration = self.next_tick(time_s), self.time_base, self._ticks_per_frame
        with told_as_mistake(self.path):
            self._mux(self._stream.encode(frame))
        if self._audio is not None:
            self._audio.copy_until(time_s)

    @property
    def _ticks_per_frame(self) -> int:
        return max(1, round(1 / self.frame_rate / self.time_base))

    def next_tick(self, time_s: float) -> int:
        """The time of one more picture in units of time_base. Raises InputError where the container cannot hold it."""
        tick = round(Fraction(time_s) / self.time_base)
        if self.suffix == ".mxf" and (tick != self.frame_count or abs(time_s - tick * self.time_base) > self.time_base / 4):
            raise InputError(
                f"{self.path}: MXF holds even rates only, but picture {self.frame_count} comes at {time_s:.4f} s: write .mov, or "
                f"give --constant-rate {float(self.frame_rate):.5g} to hold and leave out pictures"
            )
        if self._last_tick is not None and tick <= self._last_tick:
            raise InputError(
                f"{self.path}: expected growing times, got {time_s:.6f} s after {float(self._last_tick * self.time_base):.6f} s"
            )
        self._last_tick = tick
        self.frame_count += 1
        return tick

    def _container_options(self) -> dict[str, str]:
        """Return options with which the same pictures make the same file: without random numbers in it, and without the hour.

        QuickTime stores when each stream begins in a unit of its own, 1 ms unless told otherwise: a finer multiple of ours.
        """
        if self.suffix not in (".mov", ".mp4"):
            return {"fflags": "+bitexact"}
        per_s = self.time_base.denominator
        return {"movie_timescale": str(per_s * max(1, round(1_000_000 / per_s)))}

    def _add_stream(self) -> Any:
        stream: Any = self._container.add_stream(self.encoding.codec, rate=self.frame_rate, options=dict(self.encoding.options))
        context = stream.codec_context
        stream.width, stream.height = self.size_px
        stream.pix_fmt = self.encoding.pixel_format
        stream.time_base = context.time_base = self.time_base
        context.thread_type, context.thread_count = "AUTO", self._threads
        context.colorspace, context.color_range = self.color.matrix, self.color.code_range
        context.color_trc, context.color_primaries = self.color.transfer, self.color.primaries
        if self._facts.timecode is not None:
            stream.metadata["timecode"] = str(self._facts.timecode)
        context.sample_aspect_ratio = self._facts.pixel_aspect
        if self.encoding.tag and self.suffix in (".mov", ".mp4"):
            context.codec_tag = self.encoding.tag
        return stream

    def _finish(self) -> None:
        if self._last_tick is None:
            raise InputError(f"{self.path}: expected at least one frame, got none; the video was not written")
        self._flush()
        if self._audio is not None:
            self._audio.finish(float(self._last_tick * self.time_base + 1 / self.frame_rate))

    def _flush(self) -> None:
        self._mux(self._stream.encode(None))

    def _mux(self, packets: list[Any]) -> None:
        """Write packets; x265 leaves the times of decoding to chance if a video has fewer pictures than it looks ahead."""
        for packet in packets:
            self._first_shown = packet.pts if self._first_shown is None else self._first_shown
            earliest = self._first_shown - _REORDERED * self._ticks_per_frame
            if packet.dts is None or not earliest <= packet.dts <= packet.pts:
                packet.dts = earliest + self._muxed * self._ticks_per_frame
            self._muxed += 1
            self._container.mux(packet)


def _color(encoding: Encoding, as_codes: bool) -> VideoColor:
    is_rgb = encoding.pixel_format.startswith("gbr")
    if as_codes:
        return UNNAMED_RGB if is_rgb else UNNAMED
    return BT709_RGB if is_rgb else BT709


def _require_storable(path: Path, encoding: Encoding, size_px: tuple[int, int]) -> None:
    width, height = size_px
    if ("420" in encoding.pixel_format and height % 2) or (
        ("420" in encoding.pixel_format or "422" in encoding.pixel_format) and width % 2
    ):
        raise InputError(f"{path}: {width}x{height} px cannot be stored with halved chroma; crop to even sizes or write .mov or .mkv")
    if width < encoding.least_px[0] or height < encoding.least_px[1]:
        least = "x".join(map(str, encoding.least_px))
        raise InputError(
            f"{path}: {width}x{height} px is too small for {encoding.codec}, which begins at {least} px: take another encoding"
        )


@contextmanager
def told_as_mistake(path: Path) -> Iterator[None]:
    """Turn FFmpeg's writing errors into one sentence."""
    import av

    try:
        yield
    except av.FFmpegError as error:
        raise InputError(
            f"{path} cannot be written in this encoding, size and rate: {error.strerror}; try .mov or another encoding"
        ) from None


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
        """Return the time of decoding: when the picture so many places before is shown; before the first of all, time goes on evenly."""
        return self._shown[place] if place >= 0 else self._shown[0] + place * self._ticks_per_frame

    def _flush(self) -> None:
        """Do nothing: no packet waits in an encoder that got nothing."""


def packets_of(part: Path) -> tuple[list[Any], int]:
    """The packets of a video in their order, and how many places the one that comes earliest before its turn does so."""
    import av

    with av.open(str(part)) as container:
        packets = [packet for packet in container.demux(container.streams.video[0]) if packet.size]
    return packets, max((place - rank for place, rank in enumerate(_ranks(packets))), default=0)


def _ranks(packets: Sequence[Any]) -> list[int]:
    """Return the place of each packet's picture in the order of showing."""
    ranks: list[int] = np.argsort(np.argsort([packet.pts for packet in packets], kind="stable"), kind="stable").tolist()
    return ranks

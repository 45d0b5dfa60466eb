"""PictureSource: the frames of a clip, any stretch of them at once, from a video or from numbered pictures.

The frames of a video are counted once, from its packets and without decoding, and then read from anywhere.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float64, Int64

from mrbokeh.images.color_management import NamedSpace
from mrbokeh.system.errors import InputError
from mrbokeh.video.clip import Frame, VideoInfo, chroma_placement, frame_rate, opened, probe, told_as_damage, upright_alpha, upright_frame
from mrbokeh.video.image_sequence import STOP, ImageSequence, is_pattern, pattern_of_folder
from mrbokeh.video.timecode import Timecode


@dataclass(frozen=True, eq=False)
class FrameIndex:
    """Times of a video's frames, and the frames at which decoding can begin.

    shown: times of the frames in units of time_base, growing. is_key: whether decoding can begin at that frame. decoded: when the
    decoder gets the packet of that frame, by which containers seek. has_times is False if packets carry none: then frames can only be
    counted from the beginning on, and `shown` is their count.
    """

    shown: Int64[np.ndarray, " frames"]
    decoded: Int64[np.ndarray, " frames"]
    is_key: Bool[np.ndarray, " frames"]
    time_base: Fraction
    has_times: bool = True

    @classmethod
    def of(cls, path: Path) -> "FrameIndex":
        """Read the index. Packets that are not shown (before the first keyframe, cut off by an edit list) do not count."""
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


@dataclass(frozen=True, eq=False)
class VideoSource:
    """A PictureSource. Decoding begins at the keyframe before, and goes by the times of the frames, not by counting from there."""

    path: Path
    info: VideoInfo
    index: FrameIndex
    space: NamedSpace | None = None

    @classmethod
    def open(cls, path: Path, space: NamedSpace | None = None) -> "VideoSource":
        info, index = probe(path, as_codes=space is not None), FrameIndex.of(path)
        return cls(path, replace(info, frame_count=len(index.shown)), index, space)

    @property
    def times_s(self) -> Float64[np.ndarray, " frames"]:
        return self.index.times_s

    @property
    def first_number(self) -> int:
        return 0

    def file_of(self, index: int) -> Path | None:  # noqa: ARG002
        return None

    def timecode_of(self, index: int) -> Timecode | None:
        return None if self.info.timecode is None else self.info.timecode.later(index)

    def frames(self, start: int, stop: int, threads: int = 0) -> Iterator[Frame]:
        with opened(self.path, threads) as (container, stream), told_as_damage(self.path):
            placed, expected = chroma_placement(stream), start
            for number, stored in self._numbered_from(start, container, stream):
                if expected >= stop:
                    return
                if number < start:
                    continue
                if number != expected:
                    break
                time_s = float(self.index.shown[number].item() * self.index.time_base)
                yield self._frame(placed(stored), time_s)
                expected += 1
        if expected < stop:
            raise InputError(f"{self.path}: frame {expected} cannot be decoded; the file is damaged or cut off there")

    def _frame(self, stored: Any, time_s: float) -> Frame:
        """Convert a frame. Colour is stored straight, and multiplied by alpha once it is light."""
        frame = upright_frame(stored, time_s, self.path, as_codes=self.space is not None)
        rgb = frame.rgb if self.space is None else self.space.to_rec709(frame.rgb)
        if not self.info.has_alpha:
            return replace(frame, rgb=rgb)
        alpha = upright_alpha(stored, self.path)
        return replace(frame, rgb=rgb * alpha[..., None], alpha=alpha)

    def _numbered_from(self, start: int, container: Any, stream: Any) -> Iterator[tuple[int, Any]]:
        """Yield (number, PyAV frame) from a keyframe on; the first is not after `start`."""
        if not self.index.has_times:
            yield from enumerate(container.decode(stream))
            return
        for key in self.index.keys_before(start) or [0]:
            if key > 0 or start > 0:
                container.seek(int(self.index.decoded[key]), stream=stream, backward=True)
            numbered = ((self.index.number_of(frame.pts), frame) for frame in container.decode(stream))
            counted = ((number, frame) for number, frame in numbered if number is not None)
            first = next(counted, None)
            if first is not None and (first[0] <= start or key == 0):
                yield first
                yield from counted
                return


@runtime_checkable
class PictureSource(Protocol):
    """Source of frames (tests/video/test_picture_sources.py asks all of them).

    It can be pickled and opened again by another process or machine that sees the same files. `frames(i, j)` are the frames that
    reading all of them gives from the i-th on, picture and time, wherever a decoder has to begin for that.
    """

    @property
    def path(self) -> Path:
        """The file, or the pattern of the files."""
        ...

    @property
    def info(self) -> VideoInfo: ...

    @property
    def times_s(self) -> Float64[np.ndarray, " frames"]:
        """Time of each frame, as the file has it."""
        ...

    @property
    def first_number(self) -> int:
        """The number that users know frame 0 by: of the first file of a sequence, 0 of a video."""
        ...

    def file_of(self, index: int) -> Path | None:
        """The picture that frame is stored in, whose metadata may be asked; None of a video."""
        ...

    def timecode_of(self, index: int) -> Timecode | None:
        """The timecode of a frame, if the file has one."""
        ...

    @property
    def space(self) -> NamedSpace | None:
        """The colour space of its numbers, where the user names it; None is what the files say themselves."""
        ...

    def frames(self, start: int, stop: int, threads: int = 0) -> Iterator[Frame]:
        """Frames from `start` to `stop` (excluded) as linear light, with alpha where `info.has_alpha`.

        threads: of the decoder, 0 takes all.
        """
        ...


def open_source(clip: Path, rate: str | None = None, space: NamedSpace | None = None, missing: str = STOP) -> PictureSource:
    """Open a video, or numbered pictures (a pattern or their folder) with a rate in frames per second ("25", "23.976" or "24000/1001").

    Paths become absolute. rate: None is that of an EXR's header. space: meaning of the clip's numbers, in place of what its files say.
    missing: of numbered pictures, stop, hold or black.
    """
    clip = pattern_of_folder(clip) if clip.is_dir() else clip
    if is_pattern(clip):
        return ImageSequence.open(clip.resolve(), None if rate is None else parse_rate(rate), space, missing)
    if rate is not None:
        raise InputError(f"--rate is for numbered pictures (frames.%04d.exr), but {clip} has its own times: leave it out")
    if space is not None and space.is_linear:
        raise InputError(
            f"{clip}: the numbers of a video follow a curve, but {space.name} is linear: name the camera's own space (--input-space)"
        )
    return VideoSource.open(clip.resolve(), space)


_FAR = 48


def frames_taken(source: PictureSource, taken: Sequence[int], threads: int = 0) -> Iterator[Frame]:
    """Yield frames of a source, counted from its first, in their order.

    Videos are decoded through short gaps, for a new beginning costs up to a group of pictures; of numbered pictures no other is read.
    """
    farthest = _FAR if source.file_of(taken[0]) is None else 1
    begins = [0, *(place for place in range(1, len(taken)) if taken[place] - taken[place - 1] > farthest)]
    for begin, end in zip(begins, [*begins[1:], len(taken)], strict=True):
        run = taken[begin:end]
        wanted = set(run)
        for index, frame in enumerate(source.frames(run[0], run[-1] + 1, threads), run[0]):
            if index in wanted:
                yield frame


_FRAMES = re.compile(r"(-?\d+)(?:-(-?\d+)(?:x(\d+))?)?")


def parse_frames(text: str) -> list[range]:
    """Parse frame numbers as studios type them: 1001-1050, the last included, 1001-1050x2 for every second, 1001-1010,1020."""
    found = [_FRAMES.fullmatch(each.strip()) for each in text.split(",")]
    for each in found:
        if each and each[2] and int(each[2]) < int(each[1]):
            told = f"got {each[0]!r}, which runs backwards: give {each[2]}-{each[1]}"
            raise InputError(f"--frames: expected the first number before the last, {told}")
    ranges = [range(int(each[1]), int(each[2] or each[1]) + 1, int(each[3] or 1) or -1) for each in found if each]
    if len(ranges) < len(found) or not all(ranges):
        gone = " (START:STOP, counted from 0, is no longer taken)" if ":" in text else ""
        told = "numbers as the files have them, the last included: 1001-1050, 1001-1050x2 or 1001-1010,1020"
        raise InputError(f"--frames: expected {told}, got {text!r}{gone}")
    return ranges


def numbers_taken(text: str | None, numbers: range, clip: Path) -> Sequence[int]:
    """Return the frame numbers that --frames names, in order, each once; None takes all. numbers: those that the clip has."""
    ranges = [numbers] if text is None else parse_frames(text)
    if any(each[0] < numbers[0] or each[-1] > numbers[-1] for each in ranges):
        raise InputError(f"--frames {text}: {clip} has the frames {numbers[0]}-{numbers[-1]}: take some of those, or say --first-number")
    return ranges[0] if len(ranges) == 1 else sorted({number for each in ranges for number in each})


def parse_rate(text: str) -> Fraction:
    """Frames per second; the usual decimals of NTSC mean the fractions that they stand for."""
    ntsc = {"23.976": 24, "23.98": 24, "29.97": 30, "47.952": 48, "59.94": 60, "119.88": 120}
    if text in ntsc:
        return Fraction(ntsc[text] * 1000, 1001)
    try:
        rate = Fraction(text)
    except (ValueError, ZeroDivisionError):
        rate = Fraction(0)
    if not 0 < rate <= 1000:
        raise InputError(f"expected frames per second such as 25, 23.976 or 24000/1001, got {text!r}")
    return rate

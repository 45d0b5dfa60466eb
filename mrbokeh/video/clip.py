"""Videos decoded to scene-linear Rec.709 pictures with their times, by PyAV; files that would be shown wrongly are refused.

Colour tags are explicit (see `video.color`).
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from mrbokeh.system.errors import InputError, require_file
from mrbokeh.video.color import VideoColor, color_of
from mrbokeh.video.frames import display_bgr, has_alpha, linear_rgb, stored_alpha
from mrbokeh.video.timecode import Timecode

_LONGEST_LAST_FRAME_S = 1.0
"""Recordings of a screen show their last frame for long."""

# Decoders that say where chroma lies, and JPEG, where it lies in the middle, which is what FFmpeg takes when nobody says.
_PLACES_CHROMA = ("h264", "hevc", "av1", "mpeg1video", "mpeg2video", "mjpeg")


@contextmanager
def opened(path: Path, threads: int = 0) -> Iterator[tuple[Any, Any]]:
    """Open a video as (container, first video stream). threads: of the decoder, 0 leaves it to FFmpeg."""
    import av

    require_file(path, "a video", ": check the name")
    try:
        container = av.open(str(path))
    except av.FFmpegError as error:
        raise InputError(f"{path} cannot be read as a video: {error.strerror}") from None
    with container:
        if not container.streams.video:
            raise InputError(f"{path} holds no video stream: expected a video")
        stream = container.streams.video[0]
        if stream.sample_aspect_ratio not in (None, 0, 1):
            raise InputError(f"{path} has pixels that are not square ({stream.sample_aspect_ratio}): scale it to square pixels first")
        stream.thread_type = "AUTO"
        stream.codec_context.thread_count = threads
        yield container, stream


def decoded(path: Path, start: int, stop: int | None) -> Iterator[tuple[Any, float]]:
    """Yield (PyAV frame, its time in seconds) of the frames from `start` to `stop`, decoded from the beginning on.

    Raises InputError where they end before the file says, once all that can be decoded have been given.
    """
    with opened(path) as (container, stream), told_as_damage(path):
        rate, time_s, told_s, cut = frame_rate(stream), 0.0, _told_end_s(container, stream), False

        def frames() -> Iterator[Any]:
            nonlocal cut
            for packet in container.demux(stream):
                cut |= packet.is_corrupt
                yield from packet.decode()

        for index, frame in enumerate(map(chroma_placement(stream), frames())):
            if stop is not None and index >= stop:
                return
            time_s = float(index / rate) if frame.pts is None else float(frame.pts * frame.time_base)
            if index >= start:
                yield frame, time_s
        if cut or (told_s is not None and time_s + 1.0 / rate < told_s - _LONGEST_LAST_FRAME_S):
            of_all = "" if told_s is None else f" of {told_s:.3g}"
            raise InputError(f"{path}: its pictures end at {time_s:.3g}{of_all} s: the file is damaged or cut off")


def _told_end_s(container: Any, stream: Any) -> float | None:
    """Return when the pictures end as the header says, where it does."""
    if stream.duration is not None:
        return float((stream.duration + (stream.start_time or 0)) * stream.time_base)
    alone = container.duration is not None and len(container.streams) == 1
    return (container.duration + (container.start_time or 0)) * 1e-6 if alone else None


@contextmanager
def told_as_damage(path: Path) -> Iterator[None]:
    """Turn FFmpeg's decoding errors into one sentence."""
    import av

    try:
        yield
    except av.FFmpegError as error:
        raise InputError(f"{path}: decoding stopped: {error.strerror}; the file is damaged or cut off") from None


def frame_rate(stream: Any) -> Fraction:
    """The mean rate that the file states, 25 where it states none."""
    return Fraction(stream.average_rate or stream.guessed_rate or 25)


def chroma_placement(stream: Any) -> Callable[[Any], Any]:
    """Return a function that marks the chroma of frames as lying on the left columns, if their decoder leaves that open.

    All but JPEG have it there. Without the mark FFmpeg spreads chroma half a pixel too far to the right (seen on ProRes 4:2:2).
    """
    import av

    if stream.codec_context.name in _PLACES_CHROMA:
        return lambda frame: frame
    graph = av.filter.Graph()
    graph.link_nodes(graph.add_buffer(template=stream), graph.add("setparams", "chroma_location=left"), graph.add("buffersink")).configure()

    def placed(frame: Any) -> Any:
        graph.push(frame)
        return graph.pull()

    return placed


def quarter_turns(frame: Any, path: Path) -> int:
    """Return the quarter turns, counter-clockwise, that bring the decoded picture upright. Raises InputError if the film is not plain."""
    if frame.interlaced_frame:
        raise InputError(f"{path} is interlaced: deinterlace it first, for instance with FFmpeg's bwdif filter")
    if frame.rotation % 90:
        raise InputError(
            f"{path} is to be shown turned by {frame.rotation} degrees: expected quarter turns; turn it with a video editor first"
        )
    return frame.rotation // 90 % 4


@dataclass(frozen=True)
class Frame:
    """Decoded frame. rgb: (H, W, 3) linear Rec.709, upright. time_s: from the start of the video, as it is written in the file.

    alpha: (H, W) in [0, 1], by which rgb is multiplied; None is opaque.
    """

    rgb: Float32[np.ndarray, "height width 3"]
    time_s: float
    alpha: Float32[np.ndarray, "height width"] | None = None


@dataclass(frozen=True)
class DisplayFrame:
    """Frame of a preview. bgr: (H, W, 3) the video's own code values in 8 bit, blue first, upright."""

    bgr: UInt8[np.ndarray, "height width 3"]
    time_s: float


@dataclass(frozen=True)
class VideoInfo:
    """Facts of a video's header and first frame. Sizes are those of the upright picture; frame_count is None if unknown.

    rotation_deg: counter-clockwise, that brings the stored picture upright. has_alpha: whether frames hold coverage, even if all is
    opaque. timecode: of the first frame.
    """

    width_px: int
    height_px: int
    frame_rate: Fraction
    time_base: Fraction
    frame_count: int | None
    color: VideoColor
    rotation_deg: int
    has_alpha: bool = False
    timecode: Timecode | None = None

    @property
    def quarter_turns(self) -> int:
        """Quarter turns, counter-clockwise, that bring the stored picture upright."""
        return self.rotation_deg // 90 % 4


def probe(path: Path, *, as_codes: bool = False) -> VideoInfo:
    """Header and first frame of a video; refuses what `read_frames` would refuse. as_codes: as of `upright_frame`."""
    with opened(path) as (container, stream):
        frame = next(container.decode(stream), None)
        if frame is None:
            raise InputError(f"{path} holds no picture that can be decoded: it is damaged or cut off")
        width_px, height_px = (frame.height, frame.width) if quarter_turns(frame, path) % 2 else (frame.width, frame.height)
        color = color_of(frame, str(path), as_codes=as_codes)
        count, turned = stream.frames or None, frame.rotation
        return VideoInfo(
            width_px=width_px,
            height_px=height_px,
            frame_rate=frame_rate(stream),
            time_base=stream.time_base,
            frame_count=count,
            color=color,
            rotation_deg=turned,
            has_alpha=has_alpha(frame),
            timecode=_timecode(container, frame_rate(stream)),
        )


def _timecode(container: Any, rate: Fraction) -> Timecode | None:
    """Return the timecode that a video states, in whichever of its streams."""
    stated = [container.metadata, *(stream.metadata for stream in container.streams)]
    texts = [text for each in stated for name, text in each.items() if name.lower() == "timecode"]
    return Timecode.parsed(texts[0], rate) if texts else None


def read_frames(path: Path, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
    """Yield frames `start` to `stop` (excluded) of a video as linear light, one at a time, with their times, also variable ones.

    Coverage is left out: colour is as it is stored, straight (`mrbokeh.video.picture_source` has both).
    """
    for stored, time_s in decoded(path, start, stop):
        yield upright_frame(stored, time_s, path)


def upright_frame(stored: Any, time_s: float, path: Path, *, as_codes: bool = False) -> Frame:
    """A decoded PyAV frame as linear light, turned as it is to be shown.

    as_codes: the code values of red, green and blue instead (0 black, 1 white), for a curve and primaries that the file does not say.
    """
    rgb = linear_rgb(stored, color_of(stored, str(path), as_codes=as_codes))
    return Frame(np.ascontiguousarray(np.rot90(rgb, quarter_turns(stored, path))), time_s)


def upright_alpha(stored: Any, path: Path) -> Float32[np.ndarray, "height width"]:
    """The coverage of a decoded PyAV frame that has some, in [0, 1], turned as it is to be shown."""
    return np.ascontiguousarray(np.rot90(stored_alpha(stored), quarter_turns(stored, path)))


def has_alpha_apart(path: Path) -> bool:
    """Return whether a video keeps coverage outside its pictures, as VP8 and VP9 do, where FFmpeg's own decoders do not read it."""
    with opened(path) as (_, stream):
        return bool(stream.metadata.get("alpha_mode") == "1")


def read_display_frames(path: Path, width_px: int, height_px: int) -> Iterator[DisplayFrame]:
    """Yield all frames scaled to a size as 8-bit code values; quicker than `read_frames`, for previews. Primaries stay as they are."""
    for stored, time_s in decoded(path, 0, None):
        turns = quarter_turns(stored, path)
        size = (height_px, width_px) if turns % 2 else (width_px, height_px)
        yield DisplayFrame(np.ascontiguousarray(np.rot90(display_bgr(stored, color_of(stored, str(path)), size), turns)), time_s)

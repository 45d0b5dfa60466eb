"""Videos to and from scene-linear Rec.709 pictures with their times. Colour tags are explicit both ways (see `video_color`)."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from mrbokeh.atomic_files import atomic_path
from mrbokeh.errors import InputError
from mrbokeh.video_audio import AudioCopy
from mrbokeh.video_color import BT709, BT709_RGB, VideoColor, color_of
from mrbokeh.video_frames import display_bgr, encoded_frame, encoding_for, linear_rgb

# Decoders that say where chroma lies, and JPEG, where it lies in the middle, which is what FFmpeg takes when nobody says.
_PLACES_CHROMA = ("h264", "hevc", "av1", "mpeg1video", "mpeg2video", "mjpeg")


@dataclass(frozen=True)
class Frame:
    """rgb: (H, W, 3) linear Rec.709, upright. time_s: from the start of the video, as it is written in the file."""

    rgb: Float32[np.ndarray, "height width 3"]
    time_s: float


@dataclass(frozen=True)
class DisplayFrame:
    """bgr: (H, W, 3) the video's own code values in 8 bit, blue first, upright, for a preview."""

    bgr: UInt8[np.ndarray, "height width 3"]
    time_s: float


@dataclass(frozen=True)
class VideoInfo:
    """What a video's header and first frame say. Sizes are those of the upright picture; frame_count is None where unknown."""

    width_px: int
    height_px: int
    frame_rate: Fraction
    time_base: Fraction
    frame_count: int | None
    color: VideoColor
    rotation_deg: int


def probe(path: Path) -> VideoInfo:
    """Header and first frame of a video; refuses what `read_frames` would refuse."""
    with _opened(path) as (container, stream):
        frame = next(container.decode(stream), None)
        if frame is None:
            raise InputError(f"{path} holds no picture that can be decoded: it is damaged or cut off")
        width_px, height_px = (frame.height, frame.width) if _quarter_turns(frame, path) % 2 else (frame.width, frame.height)
        rate = stream.average_rate or stream.guessed_rate or Fraction(25)
        color = color_of(frame, str(path))
        return VideoInfo(width_px, height_px, Fraction(rate), stream.time_base, stream.frames or None, color, frame.rotation)


def read_frames(path: Path, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
    """Frames `start` to `stop` (excluded) of a video as linear light, one at a time; times are kept, also variable ones."""
    for decoded, time_s in _decoded(path, start, stop):
        color = color_of(decoded, str(path))
        rgb = linear_rgb(decoded, color)
        yield Frame(np.ascontiguousarray(np.rot90(rgb, _quarter_turns(decoded, path))), time_s)


def read_display_frames(path: Path, width_px: int, height_px: int) -> Iterator[DisplayFrame]:
    """All frames scaled to a size as 8-bit code values; quicker than `read_frames`, for previews. Primaries stay as they are."""
    for decoded, time_s in _decoded(path, 0, None):
        turns = _quarter_turns(decoded, path)
        size = (height_px, width_px) if turns % 2 else (width_px, height_px)
        yield DisplayFrame(np.ascontiguousarray(np.rot90(display_bgr(decoded, color_of(decoded, str(path)), size), turns)), time_s)


class VideoWriter:
    """Writes linear pictures as a video, for use in a `with` block: the file appears whole when the block ends well, else not at all.

    time_base: the unit in which times are rounded; pass that of the source to keep its times exactly (Matroska rounds to 1 ms).
    encoding: a name in ENCODINGS, or None for the usual one of the suffix. Colour is tagged BT.709 throughout. Values
    beyond what the codes can hold are clipped: the limited range of h264 and prores goes from -0.06 to 1.08, ffv1 from 0 to 1.
    audio_from: a video whose first audio stream is copied, from audio_start_s on; `audio_note` says what became of it.
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
    ) -> None:
        self.path, self.encoding = Path(path), encoding_for(path, encoding)
        if "420" in self.encoding.pixel_format and (width_px % 2 or height_px % 2):
            raise InputError(
                f"{path}: {width_px}x{height_px} px cannot be stored with halved chroma; crop to even sizes or write .mov or .mkv"
            )
        self.size_px, self.frame_rate = (width_px, height_px), frame_rate
        self.time_base = time_base or 1 / (frame_rate * 1000)
        self.color = BT709_RGB if self.encoding.pixel_format.startswith("gbr") else BT709
        self.audio_note = "no audio"
        self._audio_from, self._audio_start_s = audio_from, audio_start_s
        self._last_tick: int | None = None
        self.frame_count = 0

    def __enter__(self) -> "VideoWriter":
        import av

        with ExitStack() as stack:
            temporary = stack.enter_context(atomic_path(self.path))
            self._container = stack.enter_context(av.open(str(temporary), "w", options=self._container_options()))
            self._stream = self._add_stream()
            self._audio = None
            if self._audio_from is not None:
                self._audio = stack.enter_context(
                    AudioCopy(self._audio_from, self._container, self.path.suffix.lower(), self._audio_start_s)
                )
                self.audio_note = self._audio.note
            self._stack = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if kind is not None:
            self._stack.__exit__(kind, error, trace)
            return
        with self._stack:
            self._finish()

    def write(self, rgb: Float32[np.ndarray, "height width 3"], time_s: float) -> None:
        """One picture of linear light (H, W, 3); times must grow."""
        if rgb.shape != (self.size_px[1], self.size_px[0], 3):
            raise InputError(f"{self.path}: expected pictures of {self.size_px[0]}x{self.size_px[1]} px, got {rgb.shape[1]}x{rgb.shape[0]}")
        tick = round(Fraction(time_s) / self.time_base)
        if self._last_tick is not None and tick <= self._last_tick:
            raise InputError(
                f"{self.path}: expected growing times, got {time_s:.6f} s after {float(self._last_tick * self.time_base):.6f} s"
            )
        frame = encoded_frame(rgb, self.encoding, self.color)
        frame.pts, frame.time_base, self._last_tick = tick, self.time_base, tick
        frame.duration = round(1 / self.frame_rate / self.time_base)
        self._container.mux(self._stream.encode(frame))
        self.frame_count += 1
        if self._audio is not None:
            self._audio.copy_until(time_s)

    def _container_options(self) -> dict[str, str]:
        """QuickTime stores when each stream begins in a unit of its own, 1 ms unless told otherwise: a finer multiple of ours."""
        if self.path.suffix.lower() == ".mkv":
            return {}
        per_s = self.time_base.denominator
        return {"movie_timescale": str(per_s * max(1, round(1_000_000 / per_s)))}

    def _add_stream(self) -> Any:
        stream: Any = self._container.add_stream(self.encoding.codec, rate=self.frame_rate, options=self.encoding.options)
        context = stream.codec_context
        stream.width, stream.height = self.size_px
        stream.pix_fmt = self.encoding.pixel_format
        stream.time_base = context.time_base = self.time_base
        context.thread_type = "AUTO"
        context.colorspace, context.color_range = self.color.matrix, self.color.code_range
        context.color_trc, context.color_primaries = self.color.transfer, self.color.primaries
        return stream

    def _finish(self) -> None:
        if self._last_tick is None:
            raise InputError(f"{self.path}: expected at least one frame, got none; the video was not written")
        self._container.mux(self._stream.encode(None))
        if self._audio is not None:
            self._audio.copy_until(float((self._last_tick + 1) * self.time_base) + float(1 / self.frame_rate))


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    import av

    if not Path(path).is_file():
        raise InputError(f"expected a video at {path}, but there is no such file")
    try:
        container = av.open(str(path))
    except av.FFmpegError as error:
        raise InputError(f"{path} cannot be read as a video: {error.strerror}") from None
    with container:
        if not container.streams.video:
            raise InputError(f"{path} holds no video stream")
        stream = container.streams.video[0]
        if stream.sample_aspect_ratio not in (None, 0, 1):
            raise InputError(f"{path} has pixels that are not square ({stream.sample_aspect_ratio}): scale it to square pixels first")
        stream.thread_type = "AUTO"
        yield container, stream


def _decoded(path: Path, start: int, stop: int | None) -> Iterator[tuple[Any, float]]:
    """(PyAV frame, its time in seconds) of the frames from `start` to `stop`."""
    import av

    with _opened(path) as (container, stream):
        rate = stream.average_rate or stream.guessed_rate or Fraction(25)
        try:
            placed = _chroma_placement(stream)
            for index, frame in enumerate(map(placed, container.decode(stream))):
                if stop is not None and index >= stop:
                    return
                if index >= start:
                    yield frame, float(index / rate) if frame.pts is None else float(frame.pts * frame.time_base)
        except av.FFmpegError as error:
            raise InputError(f"{path}: decoding stopped: {error.strerror}; the file is damaged or cut off") from None


def _chroma_placement(stream: Any) -> Callable[[Any], Any]:
    """Says of frames whose decoder leaves it open that their chroma lies on the left columns, as all but JPEG have it.

    Without that FFmpeg spreads chroma half a pixel too far to the right (seen on ProRes 4:2:2).
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


def _quarter_turns(frame: Any, path: Path) -> int:
    """How often the decoded picture is to be turned by 90 degrees counter-clockwise; refuses what is not a plain upright film."""
    if frame.interlaced_frame:
        raise InputError(f"{path} is interlaced: deinterlace it first, for instance with FFmpeg's bwdif filter")
    if frame.rotation % 90:
        raise InputError(
            f"{path} is to be shown turned by {frame.rotation} degrees: expected quarter turns; turn it with a video editor first"
        )
    return frame.rotation // 90 % 4

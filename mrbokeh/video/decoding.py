"""Opening a video and taking its stored frames out of it, by PyAV; refuses what would be shown wrongly."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

from mrbokeh.system.errors import InputError

# Decoders that say where chroma lies, and JPEG, where it lies in the middle, which is what FFmpeg takes when nobody says.
_PLACES_CHROMA = ("h264", "hevc", "av1", "mpeg1video", "mpeg2video", "mjpeg")


@contextmanager
def opened(path: Path, threads: int = 0) -> Iterator[tuple[Any, Any]]:
    """(container, first video stream); threads: of the decoder, 0 leaves it to FFmpeg."""
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
        stream.codec_context.thread_count = threads
        yield container, stream


def decoded(path: Path, start: int, stop: int | None) -> Iterator[tuple[Any, float]]:
    """(PyAV frame, its time in seconds) of the frames from `start` to `stop`, decoded from the beginning on."""
    with opened(path) as (container, stream), told_as_damage(path):
        rate = frame_rate(stream)
        placed = chroma_placement(stream)
        for index, frame in enumerate(map(placed, container.decode(stream))):
            if stop is not None and index >= stop:
                return
            if index >= start:
                yield frame, float(index / rate) if frame.pts is None else float(frame.pts * frame.time_base)


@contextmanager
def told_as_damage(path: Path) -> Iterator[None]:
    """What FFmpeg cannot decode is told as a sentence."""
    import av

    try:
        yield
    except av.FFmpegError as error:
        raise InputError(f"{path}: decoding stopped: {error.strerror}; the file is damaged or cut off") from None


def frame_rate(stream: Any) -> Fraction:
    """The mean rate that the file states, 25 where it states none."""
    return Fraction(stream.average_rate or stream.guessed_rate or 25)


def chroma_placement(stream: Any) -> Callable[[Any], Any]:
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


def quarter_turns(frame: Any, path: Path) -> int:
    """How often the decoded picture is to be turned by 90 degrees counter-clockwise; refuses what is not a plain upright film."""
    if frame.interlaced_frame:
        raise InputError(f"{path} is interlaced: deinterlace it first, for instance with FFmpeg's bwdif filter")
    if frame.rotation % 90:
        raise InputError(
            f"{path} is to be shown turned by {frame.rotation} degrees: expected quarter turns; turn it with a video editor first"
        )
    return frame.rotation // 90 % 4

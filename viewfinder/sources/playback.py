"""Sources that FFmpeg decodes: a video file in its own rhythm, and a stream over the network (RTSP, HTTP, MPEG-TS over UDP), always its
newest frame; and a moving test pattern, to look at a stream without a camera.
"""

import itertools
import time
from collections.abc import Callable, Generator, Iterator
from functools import partial
from pathlib import Path
from threading import Event, Thread
from typing import Any, TypeVar
from urllib.parse import urlsplit

import numpy as np

from mrbokeh.video.clip import probe, read_display_frames
from mrbokeh.video.color import color_of
from viewfinder.frames import Bgr, CameraFrame, Newest
from viewfinder.sources.frame_source import UNLIMITED, CameraAwayError, SizeLimit, reconnecting, upright_bgr


class Rhythm:
    """Rhythm of a recording as its times pass in reality; what is late is not hurried after."""

    def __init__(self, stopping: Event, now_s: Callable[[], float] = time.monotonic) -> None:
        self._stopping, self._now_s = stopping, now_s
        self._start_s: float | None = None
        self._due_s = now_s()

    def restart(self, pause_s: float) -> None:
        """Begin the recording again, `pause_s` after the last time waited for."""
        self._start_s = None
        self._due_s += pause_s

    def wait_for(self, time_s: float) -> bool:
        """Wait for a time; False if the stop came first."""
        if self._start_s is None:
            self._start_s = self._due_s - time_s
        self._due_s = self._start_s + time_s
        ahead_s = self._due_s - self._now_s()
        if ahead_s < 0:
            self._start_s -= ahead_s
            self._due_s -= ahead_s
        return not self._stopping.wait(max(ahead_s, 0.0))


DEFAULT_FPS = 30.0


class PatternSource:
    """FrameSource of colour bars that move to the left, with the number of the frame."""

    name, transfer = "test pattern", "srgb"
    status: str | None = None

    def __init__(self, width_px: int, height_px: int, fps: float = DEFAULT_FPS) -> None:
        bars = np.array([[(i >> 2 & 1) * 200 + 20, (i >> 1 & 1) * 200 + 20, (i & 1) * 200 + 20] for i in range(8)], np.float64)
        columns = bars[np.arange(width_px) * 8 // width_px]
        fade = np.linspace(1.0, 0.3, height_px)[:, None, None]
        self._background = np.rint(columns[None] * fade).astype(np.uint8)
        self._fps = fps

    def frames(self, stopping: Event) -> Iterator[CameraFrame]:
        rhythm = Rhythm(stopping)
        for sequence in itertools.count():
            bgr = self.picture(sequence)
            if not rhythm.wait_for(sequence / self._fps):
                return
            yield CameraFrame(bgr, time.monotonic(), sequence)

    def picture(self, sequence: int) -> Bgr:
        """Return the frame of that number (H, W, 3), blue first."""
        import cv2

        bgr = np.roll(self._background, -4 * sequence, axis=1)
        cv2.putText(bgr, str(sequence), (12, bgr.shape[0] - 14), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (255, 255, 255), 2, cv2.LINE_AA)
        return bgr


class VideoFileSource:
    """FrameSource of a video file, played in its own rhythm, from the start again when it ends.

    limit: larger pictures are scaled down with their aspect. fps: at most so many frames per second.
    """

    status: str | None = None

    def __init__(self, path: Path, limit: SizeLimit = UNLIMITED, fps: float | None = None) -> None:
        info = probe(path)
        self.name, self.transfer = path.name, info.color.transfer_name
        self._path, self._fps, self._last_s = path, fps, float(1 / info.frame_rate)
        self._size_px = limit.fit(info.width_px, info.height_px)

    def frames(self, stopping: Event) -> Iterator[CameraFrame]:
        rhythm, sequence = Rhythm(stopping), itertools.count()
        while not stopping.is_set():
            next_s = -1.0
            for frame in read_display_frames(self._path, *self._size_px):
                if frame.time_s < next_s:
                    continue
                if not rhythm.wait_for(frame.time_s):
                    return
                next_s = frame.time_s + (1 / self._fps - 1e-6 if self._fps else 0.0)
                yield CameraFrame(frame.bgr, time.monotonic(), next(sequence))
            rhythm.restart(self._last_s)


_POLL_S = 0.05

Item = TypeVar("Item")


def newest_of(produce: Callable[[Event], Iterator[Item]], stopping: Event, *, name: str, leave_s: float = 5.0) -> Iterator[Item]:
    """Yield the newest item each time one is asked for; what came in between is dropped, so that no queue grows anywhere.

    produce: runs in the thread until the event that it gets is set, which is when `stopping` is, or when nobody asks any more. Its
    exception is raised here. leave_s: how long the end waits for the thread.
    """
    slot: Newest[Item] = Newest()
    leaving, ended, failures = Event(), Event(), list[BaseException]()

    def drain() -> None:
        try:
            for item in produce(leaving):
                slot.put(item)
        except Exception as error:
            failures.append(error)
        finally:
            ended.set()

    thread = Thread(target=drain, name=name, daemon=True)
    thread.start()
    try:
        while not stopping.is_set():
            finished = ended.is_set()
            item = slot.take(_POLL_S)
            if item is not None:
                yield item
            elif finished:
                break
    finally:
        leaving.set()
        thread.join(leave_s)
    if failures:
        raise failures[0]


SCHEMES = ("rtsp", "rtsps", "http", "https", "udp")
OPEN_TIMEOUT_S, READ_TIMEOUT_S = 4.0, 2.0
# A short look at the stream before it starts. What came meanwhile is decoded at once and passed over (FFmpeg's nobuffer would
# throw the first key frame away instead).
_LOW_DELAY = {"flags": "low_delay", "probesize": "500000", "analyzeduration": "500000", "max_delay": "100000"}
_OF_SCHEME = {
    "rtsp": {"rtsp_transport": "tcp"},
    "rtsps": {"rtsp_transport": "tcp"},
    "udp": {"overrun_nonfatal": "1", "fifo_size": "50000"},
}


class NetworkStreamSource:
    """FrameSource. A thread decodes all that comes, the newest frame is taken; a stream that dies is opened again.

    url: of one of SCHEMES; `udp://@:5000` listens. A recording behind a URL is played in its own rhythm, again and again.
    limit: larger pictures are scaled down with their aspect.
    """

    def __init__(self, url: str, limit: SizeLimit = UNLIMITED) -> None:
        self.name, self.transfer = _without_password(url), "bt709"
        self.status: str | None = f"{self.name}: connecting"
        self._url, self._limit = url, limit

    def frames(self, stopping: Event) -> Iterator[CameraFrame]:
        decoded = newest_of(self._decoded, stopping, name=f"decode {self.name}", leave_s=OPEN_TIMEOUT_S + READ_TIMEOUT_S)
        for sequence, frame, captured_s in decoded:
            color = color_of(frame, self.name)
            self.transfer = color.transfer_name
            full = partial(upright_bgr, frame, color, UNLIMITED)
            yield CameraFrame(upright_bgr(frame, color, self._limit), captured_s, sequence, full_picture=full)

    def _tell(self, sentence: str | None) -> None:
        self.status = sentence

    def _decoded(self, stopping: Event) -> Iterator[tuple[int, Any, float]]:
        """Yield (number, PyAV frame, when it came), connection after connection."""
        return reconnecting(partial(self._connection, stopping, itertools.count()), stopping, self._tell)

    def _connection(self, stopping: Event, sequence: Iterator[int]) -> Generator[tuple[int, Any, float], None, None]:
        import av

        try:
            with self._opened() as container:
                rhythm = Rhythm(stopping) if container.duration else None
                for frame in _frames_of(container):
                    if stopping.is_set() or (rhythm and not rhythm.wait_for(frame.time or 0.0)):
                        return
                    yield next(sequence), frame, time.monotonic()
        except av.FFmpegError as error:
            raise CameraAwayError(f"{self.name} does not answer ({error.strerror}): trying again") from None
        if rhythm is None:
            raise CameraAwayError(f"{self.name} has ended: waiting for it to begin again")

    def _opened(self) -> Any:
        import av

        options = {**_LOW_DELAY, **_OF_SCHEME.get(urlsplit(self._url).scheme.lower(), {})}
        container = av.open(self._url, options=options, timeout=(OPEN_TIMEOUT_S, READ_TIMEOUT_S))
        if not container.streams.video:
            container.close()
            raise CameraAwayError(f"{self.name} has no picture: waiting for one")
        return container


def _frames_of(container: Any) -> Iterator[Any]:
    """Yield whole pictures as they come; what cannot be decoded, as before the first key frame, is left out."""
    import av

    stream = container.streams.video[0]
    # Threads that work on several frames at once would hold each of these frames back.
    stream.thread_type = "SLICE"
    for packet in container.demux(stream):
        try:
            frames = packet.decode()
        except av.InvalidDataError:
            continue
        yield from (frame for frame in frames if not frame.is_corrupt)


def _without_password(url: str) -> str:
    parts = urlsplit(url)
    return parts._replace(netloc=parts.netloc.rsplit("@", 1)[-1], query="").geturl() if "@" in parts.netloc else url

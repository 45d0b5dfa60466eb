"""Sources that are files or that FFmpeg decodes: a video file in its own rhythm, a stream over the network (RTSP, HTTP, MPEG-TS over UDP),
always its newest frame, and a folder into which a tethering tool writes photographs, of which the newest whole one is shown, with its
Exif; and a moving test pattern, to look at a stream without a camera.
"""

import itertools
import time
import warnings
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Event, Thread
from typing import Any, TypeVar
from urllib.parse import urlsplit

import numpy as np

from mrbokeh.lens_measuring.matching.photo_facts import read_facts
from mrbokeh.system.errors import InputError
from mrbokeh.video.clip import probe, read_display_frames
from mrbokeh.video.color import color_of
from viewfinder.frames import Bgr, CameraFrame, LensState, Newest
from viewfinder.sources.frame_source import UNLIMITED, CameraAwayError, SizeLimit, reconnecting, upright_bgr

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")


class NotWholeError(Exception):
    """File that is still being written, damaged, or no picture."""


@dataclass(frozen=True)
class TetheredPicture:
    """Photograph with what its Exif tells of the lens.

    bgr: upright 8-bit codes (H, W, 3), blue first. full: reads the file once more, at its own size.
    """

    bgr: Bgr
    lens: LensState
    full: Callable[[], Bgr]


def read_tethered(path: Path, limit: SizeLimit) -> TetheredPicture:
    """Decode a file to the last byte, so that one cut short raises NotWholeError."""
    from PIL import Image

    try:
        # A TIFF that is still being written makes Pillow warn before it fails.
        with warnings.catch_warnings(action="ignore"), Image.open(path) as picture:
            size_px = picture.size
            # JPEG can be decoded at an 8th of its size and more; at least twice what is wanted keeps the scaling by areas.
            wanted = limit.fit(*size_px)
            picture.draft("RGB", (2 * wanted[0], 2 * wanted[1]))
            picture.load()
            bgr = limit.applied(_upright_bgr(picture))
    except (OSError, SyntaxError, ValueError) as error:
        raise NotWholeError(f"{path.name} cannot be read: {error}") from None
    facts = read_facts(path, size_px)
    lens = LensState(facts.focus_distance_m, facts.f_number, facts.focal_length_mm)
    return TetheredPicture(bgr, lens, lambda: read_tethered(path, UNLIMITED).bgr)


def _upright_bgr(picture: Any) -> Bgr:
    from PIL import ImageOps

    upright = ImageOps.exif_transpose(picture)
    if upright.mode.startswith("I;16"):
        grey = (np.asarray(upright) >> 8).astype(np.uint8)
        return np.repeat(grey[..., None], 3, axis=2)
    return np.ascontiguousarray(np.asarray(upright.convert("RGB"))[..., ::-1])


REPEATED_FPS = 10.0

# (time of the last change in ns, bytes): while a file is written they change.
Stamp = tuple[int, int]


class WatchedFolderSource:
    """FrameSource of the newest whole JPEG, PNG or TIFF, `fps` times a second, so that the stream goes on between two photographs.

    captured_s of its frames is when they are shown again. Frames carry the Exif's focus distance, f-number and focal length. A file
    counts once it has kept its size and date for one look and can be decoded to its end. limit: larger
    pictures are scaled down with their aspect. Raises InputError where there is no such folder at the start.
    """

    transfer = "srgb"

    def __init__(self, folder: Path, limit: SizeLimit = UNLIMITED, fps: float = REPEATED_FPS) -> None:
        if not folder.is_dir():
            raise InputError(f"--source folder: expected the folder into which photographs come, but there is none at {folder}")
        self.name = f"folder {folder.name}"
        self._waiting = f"waiting for the first photograph in {folder}"
        self.status: str | None = self._waiting
        self._folder, self._limit, self._pause_s = folder, limit, 1 / fps
        self._arrivals = itertools.count()
        self._seen: dict[Path, tuple[Stamp, int]] = {}
        self._unreadable: dict[Path, int] = {}
        self._shown = -1

    def frames(self, stopping: Event) -> Iterator[CameraFrame]:
        picture: TetheredPicture | None = None
        sequence = itertools.count()
        while not stopping.is_set():
            picture = self._newer() or picture
            if picture is not None:
                yield CameraFrame(picture.bgr, time.monotonic(), next(sequence), picture.lens, full_picture=picture.full)
            stopping.wait(self._pause_s)

    def _newer(self) -> TetheredPicture | None:
        """Return the newest whole photograph if it is not the one that is shown already."""
        try:
            before, self._seen = self._seen, self._look()
        except OSError:
            self.status = f"the folder {self._folder} is gone: waiting for it"
            return None
        for path, (stamp, arrival) in sorted(self._seen.items(), key=lambda each: each[1][1], reverse=True):
            if arrival <= self._shown:
                break
            if before.get(path) == (stamp, arrival) and self._unreadable.get(path) != arrival and (picture := self._read(path, arrival)):
                return picture
        if not self._unreadable:
            self.status = self._waiting if self._shown < 0 else None
        return None

    def _read(self, path: Path, arrival: int) -> TetheredPicture | None:
        try:
            picture = read_tethered(path, self._limit)
        except NotWholeError as error:
            self._unreadable[path] = arrival
            self.status = f"{error}: waiting until it is whole"
            return None
        self._unreadable.clear()
        self._shown, self.status = arrival, None
        return picture

    def _look(self) -> dict[Path, tuple[Stamp, int]]:
        """Return every photograph with its stamp and the number of its arrival, a new one where the stamp is another than before.

        Not its date alone: tools that copy from a card keep the date of the shot.
        """
        found = {}
        for path, stamp in sorted(self._stamps().items(), key=lambda each: each[1]):
            known = self._seen.get(path)
            found[path] = known if known is not None and known[0] == stamp else (stamp, next(self._arrivals))
        return found

    def _stamps(self) -> dict[Path, Stamp]:
        found: dict[Path, Stamp] = {}
        for path in self._folder.iterdir():
            if path.suffix.lower() in SUFFIXES and not path.name.startswith("."):
                try:
                    state = path.stat()
                except FileNotFoundError:
                    # Renamed or removed since the folder was listed.
                    continue
                found[path] = (state.st_mtime_ns, state.st_size)
        return found


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

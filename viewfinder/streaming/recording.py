"""Recorder: a FrameSink that writes what the viewer shows to a file, each picture at the time at which it was captured."""

import logging
import queue
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from fractions import Fraction
from pathlib import Path
from threading import Event, Thread

import numpy as np
from jaxtyping import UInt8

from mrbokeh.compositing.overlay import CodeTables, code_tables
from mrbokeh.system.atomic_files import refuse_existing
from mrbokeh.system.errors import InputError
from mrbokeh.video.encodings import encoding_for
from mrbokeh.video.writer import VideoWriter
from viewfinder.frames import Bgr, OutputFrame
from viewfinder.streaming.encoders import TIME_BASE, even_size

# The compositor must not starve: the quality of files that are made at leisure in half of the time, at 2.5 times the size.
_LIVE_H264 = {"crf": "14", "preset": "superfast"}


@dataclass(frozen=True)
class FileForm:
    """Form of a file. tables: of the codes of the pictures. encoding: of mrbokeh.video, None goes by the suffix."""

    tables: CodeTables
    frame_rate: Fraction
    encoding: str | None = None


@dataclass(frozen=True)
class Written:
    """Result of a file. note: why it ended before the pictures did, None where it did not."""

    frame_count: int
    duration_s: float
    note: str | None = None


def write_recording(path: Path, frames: Iterator[OutputFrame], form: FileForm) -> Written:
    """Write a file, which appears whole at the end. InputError where there is no picture."""
    first = next(frames, None)
    if first is None:
        raise InputError(f"{path}: expected at least one picture, got none; the video was not written")
    height, width = _stored(path, first.bgr, form).shape[:2]
    last_s = first.captured_s
    with _writer(path, width, height, form) as writer:
        _write(writer, _stored(path, first.bgr, form), 0.0, form)
        for frame in frames:
            stored = _stored(path, frame.bgr, form)
            if stored.shape[:2] != (height, width):
                note = f"the size of the picture changed from {width}x{height} px: the recording ended there"
                return Written(writer.frame_count, last_s - first.captured_s, note)
            # A picture that is shown twice, or that a camera's clock set back, has no time of its own.
            if frame.captured_s - last_s >= float(TIME_BASE):
                _write(writer, stored, frame.captured_s - first.captured_s, form)
                last_s = frame.captured_s
    return Written(writer.frame_count, last_s - first.captured_s)


def _writer(path: Path, width_px: int, height_px: int, form: FileForm) -> VideoWriter:
    writer = VideoWriter(
        path=path, width_px=width_px, height_px=height_px, frame_rate=form.frame_rate, time_base=TIME_BASE, encoding=form.encoding
    )
    if writer.encoding.codec == "libx264":
        writer.encoding = writer.encoding._replace(options=_LIVE_H264)
    return writer


def _write(writer: VideoWriter, bgr: UInt8[np.ndarray, "rows columns 3"], time_s: float, form: FileForm) -> None:
    writer.write(form.tables.linear_from_code[bgr[..., ::-1]], time_s)


def _stored(path: Path, bgr: Bgr, form: FileForm) -> UInt8[np.ndarray, "rows columns 3"]:
    """Cut off a last odd row and column where chroma is halved."""
    if "420" not in encoding_for(path, form.encoding).pixel_format:
        return bgr
    width, height = even_size(bgr)
    return bgr[:height, :width]


_POLL_S = 0.1
_FIRST_PICTURE_S = 2.0

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Recording:
    """Finished file. dropped: pictures that came while the encoder was busy; their time is shown by the picture before.

    note: why it ended before it was stopped, None where it did not.
    """

    path: Path
    frame_count: int
    dropped: int
    duration_s: float
    note: str | None = None


class Recorder:
    """FrameSink that writes MP4 (H.264) or QuickTime (.mov, ProRes 4444 unless `encoding` says otherwise), one at a time.

    transfer: of the codes of the pictures (see FrameSource); files are BT.709. waiting: how many pictures the encoder may lag behind.
    Files appear whole when they are stopped, and none is overwritten.
    """

    def __init__(self, transfer: str, *, frame_rate: float = 30.0, encoding: str | None = None, waiting: int = 8) -> None:
        self._form = FileForm(code_tables(transfer), Fraction(frame_rate).limit_denominator(1001), encoding)
        self._waiting = waiting
        self._frames: queue.Queue[OutputFrame] = queue.Queue(waiting)
        self._stopping, self._shown_one = Event(), Event()
        self._thread: Thread | None = None
        self._path = Path()
        self._failure: InputError | None = None
        self._written = Written(0, 0.0)
        self._dropped = 0

    @property
    def wants_frame(self) -> bool:
        return self._thread is not None and self._thread.is_alive() and not self._stopping.is_set()

    @property
    def dropped(self) -> int:
        return self._dropped

    def start(self, path: Path) -> None:
        """Begin a file; InputError where one is under way, the name is taken or its suffix unknown."""
        if self._thread is not None:
            raise InputError(f"expected one recording at a time, but {self._path.name} is not stopped yet: stop it first")
        encoding_for(path, self._form.encoding)
        refuse_existing(path, overwrite=False)
        self._path, self._failure, self._dropped = path, None, 0
        self._frames = queue.Queue(self._waiting)
        self._stopping.clear()
        self._shown_one.clear()
        self._thread = Thread(target=self._work, name="recorder", daemon=True)
        self._thread.start()

    def show(self, frame: OutputFrame) -> None:
        if not self.wants_frame:
            return
        try:
            self._frames.put_nowait(frame)
        except queue.Full:
            self._dropped += 1
        self._shown_one.set()

    def fail(self, _sentence: str) -> None:
        """Keep the last picture: the camera may come back."""

    def stop(self) -> Recording:
        """End the file with what was shown until now; InputError where nothing was or it could not be written.

        Stopped before the first picture came it waits for one, for a while.
        """
        if self._thread is None:
            raise InputError("expected a recording under way, but none was started")
        if self._thread.is_alive():
            self._shown_one.wait(_FIRST_PICTURE_S)
        self._stopping.set()
        self._thread.join()
        self._thread = None
        if self._failure is not None:
            raise self._failure
        written = self._written
        return Recording(
            path=self._path, frame_count=written.frame_count, dropped=self._dropped, duration_s=written.duration_s, note=written.note
        )

    def close(self) -> None:
        """Stop if a recording is under way; what went wrong with it goes to the log."""
        self._shown_one.set()  # nothing more is waited for
        try:
            if self._thread is not None:
                self.stop()
        except InputError as error:
            log.warning("%s", error)

    def _work(self) -> None:
        try:
            self._written = write_recording(self._path, self._shown(), self._form)
        except InputError as error:
            self._failure = error
        except Exception as error:
            log.debug("the recording failed", exc_info=True)
            self._failure = InputError(f"{self._path} could not be written ({error}): check the folder and the space on the disk")

    def _shown(self) -> Iterator[OutputFrame]:
        """Yield pictures as they come; after the stop those that wait already."""
        while True:
            try:
                yield self._frames.get(timeout=_POLL_S)
            except queue.Empty:
                if self._stopping.is_set():
                    return


def recording_path(folder: Path, suffix: str = ".mp4") -> Path:
    """Return a name in the folder that is not taken: the date and time, and a number where one second sees two recordings."""
    stem = f"viewfinder-{datetime.now():%Y%m%d-%H%M%S}"
    path, number = folder / f"{stem}{suffix}", 1
    while path.exists():
        number += 1
        path = folder / f"{stem}-{number}{suffix}"
    return path

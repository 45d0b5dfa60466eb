"""Recorder: a FrameSink that writes what the viewer shows to files, each picture at the time at which it was captured."""

import logging
import queue
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime
from fractions import Fraction
from pathlib import Path
from threading import Event, Thread

import numpy as np
from jaxtyping import UInt8

from mrbokeh.compositing.overlay import code_tables
from mrbokeh.system.atomic_files import refuse_existing
from mrbokeh.system.errors import InputError
from mrbokeh.video.encodings import encoding_for
from viewfinder.frames import Bgr, OutputFrame
from viewfinder.streaming.encoders import TIME_BASE, even_size
from viewfinder.streaming.take_file import SUFFIXES, TakeWriter, free_bytes, free_name, length_s

RESERVE_BYTES = 64 << 20
"""A take ends before the disk has less than this: a file that ends well needs a little, and the system does."""
_WARN_S, _LOOK_S = 300.0, 1.0


@dataclass(frozen=True)
class Form:
    """Form of the files. transfer: gives the curve of the pictures' codes, which a browser camera tells with its first picture.

    encoding: of mrbokeh.video, None goes by the suffix.
    """

    transfer: Callable[[], str]
    frame_rate: Fraction
    encoding: str | None = None


class Take:
    """Take that goes on in a new part, NAME-2, where the size of the pictures changes. Their rate may change: each has its own time.

    parts: the files that were ended. trouble: why one of them did not take everything. room_s: how long the disk will do, None while
    that is not known.
    """

    def __init__(self, path: Path, form: Form) -> None:
        self._path, self._form = path, form
        self.parts: list[Path] = []
        self.frame_count, self.duration_s = 0, 0.0
        self.room_s: float | None = None
        self.trouble: str | None = None
        self._writer: TakeWriter | None = None
        self._first_s = self._last_s = self._looked_s = 0.0

    def write(self, frame: OutputFrame) -> None:
        """Write a picture; one that is shown twice, or that a camera's clock set back, has no time of its own. OSError: a full disk."""
        stored = self._stored(frame.bgr)
        if self._writer is None or self._writer.size_px != stored.shape[1::-1]:
            self.close()
            self._begin(stored.shape[1], stored.shape[0], frame.captured_s)
        elif frame.captured_s - self._last_s < float(TIME_BASE):
            return
        assert self._writer is not None, "begun"
        self.duration_s += frame.captured_s - self._last_s
        self._last_s = frame.captured_s
        light = code_tables(self._form.transfer()).linear_from_code[stored[..., ::-1]]
        self._writer.write(light, frame.captured_s - self._first_s)
        self.frame_count += 1
        self._look_at_the_disk(self._writer)

    def close(self) -> None:
        """End the part that is under way."""
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.__exit__(None, None, None)
            self.parts += [writer.path] if writer.kept else []
            self.trouble = self.trouble or writer.trouble

    def _begin(self, width_px: int, height_px: int, at_s: float) -> None:
        path = free_name(self._path)
        form = self._form
        writer = TakeWriter(
            path=path, width_px=width_px, height_px=height_px, frame_rate=form.frame_rate, time_base=TIME_BASE, encoding=form.encoding
        )
        self._writer, self._first_s, self._last_s = writer.__enter__(), at_s, at_s

    def _look_at_the_disk(self, writer: TakeWriter) -> None:
        passed_s = self._last_s - self._first_s
        if passed_s < _LOOK_S or time.monotonic() - self._looked_s < _LOOK_S:
            return
        self._looked_s = time.monotonic()
        left_bytes = free_bytes(self._path.parent) - RESERVE_BYTES
        self.room_s = max(0.0, left_bytes * passed_s / max(1, writer.size_bytes))
        if left_bytes <= 0:
            raise OSError(None, "the disk is full")

    def _stored(self, bgr: Bgr) -> UInt8[np.ndarray, "rows columns 3"]:
        """Cut off a last odd row and column where chroma is halved."""
        if "420" not in encoding_for(self._path, self._form.encoding).pixel_format:
            return bgr
        width, height = even_size(bgr)
        return bgr[:height, :width]


_POLL_S = 0.1
_FIRST_PICTURE_S = 2.0

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Recording:
    """Finished take. dropped: pictures that came while the encoder was busy; their time is shown by the picture before.

    note: why it ended before it was stopped, None where it did not.
    """

    parts: tuple[Path, ...]
    frame_count: int
    dropped: int
    duration_s: float
    note: str | None = None

    @property
    def sentence(self) -> str:
        """Sentence for the page and the log about what became of it."""
        names = " and ".join(each.name for each in self.parts)
        return f"saved {names} ({self.duration_s:.0f} s)" + (f"; it ended there by itself: {self.note}" if self.note else "")


class Recorder:
    """FrameSink that writes MP4 (H.264) or QuickTime (.mov, ProRes 4444 unless `encoding` says otherwise), one take at a time.

    transfer: gives the curve of the pictures' codes (see FrameSource); files are BT.709. say: is told what became of each take, and
    that the disk will soon be full. waiting: how many pictures the encoder may lag behind. No file is overwritten.
    """

    def __init__(
        self,
        transfer: Callable[[], str],
        say: Callable[[str], None] = log.warning,
        *,
        frame_rate: float = 30.0,
        encoding: str | None = None,
        waiting: int = 8,
    ) -> None:
        self._form = Form(transfer, Fraction(frame_rate).limit_denominator(1001), encoding)
        self._say, self._waiting = say, waiting
        self._frames: queue.Queue[OutputFrame] = queue.Queue(waiting)
        self._stopping, self._shown_one = Event(), Event()
        self._thread: Thread | None = None
        self._path = Path()
        self._take: Take | None = None
        self._ended: Recording | InputError | None = None
        self._dropped = 0

    @property
    def wants_frame(self) -> bool:
        return self._thread is not None and self._thread.is_alive() and not self._stopping.is_set()

    @property
    def dropped(self) -> int:
        return self._dropped

    @property
    def take(self) -> Take | None:
        """The take that is under way."""
        return self._take if self.wants_frame else None

    def start(self, path: Path) -> None:
        """Begin a take; InputError where one is under way, the name is taken, its suffix unknown or the disk full."""
        if self.wants_frame:
            raise InputError(f"expected one recording at a time, but {self._path.name} is not stopped yet: stop it first")
        if self._thread is not None:
            self._thread.join()  # ended by itself, and said so
        encoding_for(path, self._form.encoding)
        if path.suffix not in SUFFIXES:
            raise InputError(f"expected a recording as {' or '.join(SUFFIXES)}, got {path.name}")
        refuse_existing(path, overwrite=False)
        if free_bytes(path.parent) < RESERVE_BYTES:
            raise InputError(f"the disk of {path.parent.name} is full: expected {RESERVE_BYTES >> 20} MB for a recording; make room there")
        self._path, self._ended, self._dropped, self._take = path, None, 0, Take(path, self._form)
        self._frames = queue.Queue(self._waiting)
        self._stopping.clear()
        self._shown_one.clear()
        self._thread = Thread(target=self._work, args=(self._take,), name="recorder", daemon=True)
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
        """End the take with what was shown until now; InputError where nothing was or it could not be written.

        Stopped before the first picture came it waits for one, for a while.
        """
        if self._thread is None:
            raise InputError("expected a recording under way, but none was started")
        if self._thread.is_alive():
            self._shown_one.wait(_FIRST_PICTURE_S)
        self._stopping.set()
        self._thread.join()
        self._thread = None
        assert self._ended is not None, "told by the thread"
        if isinstance(self._ended, InputError):
            raise self._ended
        return self._ended

    def close(self) -> None:
        """Stop if a recording is under way; what went wrong with it goes to the log."""
        self._shown_one.set()  # nothing more is waited for
        try:
            if self._thread is not None:
                self.stop()
        except InputError as error:
            log.warning("%s", error)

    def _work(self, take: Take) -> None:
        note = None
        try:
            try:
                self._write_all(take)
            finally:
                take.close()
        except OSError as error:
            note = (error.strerror or str(error)).lower()
        except InputError as error:
            note = str(error)
        except Exception as error:
            log.debug("the recording failed", exc_info=True)
            note = f"a picture could not be written ({error})"
        self._ended = self._outcome(take, note or take.trouble)
        self._say(self._ended.sentence if isinstance(self._ended, Recording) else str(self._ended))

    def _outcome(self, take: Take, note: str | None) -> Recording | InputError:
        if take.parts:
            # Of what was cut off the files tell how much is left.
            duration_s = take.duration_s if note is None else sum(map(length_s, take.parts))
            parts = tuple(take.parts)
            return Recording(parts=parts, frame_count=take.frame_count, dropped=self._dropped, duration_s=duration_s, note=note)
        if note is None:
            return InputError(f"{self._path.name}: expected at least one picture, got none; nothing was recorded")
        return InputError(f"{self._path.name} could not be written ({note}): check the folder and the space on the disk")

    def _write_all(self, take: Take) -> None:
        warned = False
        for frame in self._shown():
            take.write(frame)
            if take.room_s is not None and take.room_s < _WARN_S and not warned:
                warned = True
                self._say(f"the disk will be full in {take.room_s / 60:.1f} minutes of this recording: make room")

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
    return free_name(folder / f"viewfinder-{datetime.now():%Y%m%d-%H%M%S}{suffix}")

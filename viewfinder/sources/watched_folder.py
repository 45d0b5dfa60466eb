"""A folder into which a tethering tool writes photographs, as a camera that shows the newest."""

import itertools
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Event

from mrbokeh.system.errors import InputError
from viewfinder.flow.frames import CameraFrame
from viewfinder.sources.size_limit import SizeLimit
from viewfinder.sources.tethered_picture import SUFFIXES, NotWholeError, TetheredPicture, read_tethered

DEFAULT_FPS = 10.0

# (time of the last change in ns, bytes): while a file is written they change.
Stamp = tuple[int, int]


class WatchedFolderSource:
    """A FrameSource. The newest whole JPEG, PNG or TIFF, `fps` times a second, so that the stream goes on between two photographs.

    captured_s of its frames is when they are shown again. Frames carry the Exif's focus distance, f-number and focal length. A file
    counts once it has kept its size and date for one look and can be decoded to its end. max_width_px, max_height_px: larger
    pictures are scaled down with their aspect. Raises InputError where there is no such folder at the start.
    """

    transfer = "srgb"

    def __init__(self, folder: Path, max_width_px: int | None = None, max_height_px: int | None = None, fps: float = DEFAULT_FPS) -> None:
        if not folder.is_dir():
            raise InputError(f"--source folder: expected the folder into which photographs come, but there is none at {folder}")
        self.name = f"folder {folder.name}"
        self._waiting = f"waiting for the first photograph in {folder}"
        self.status: str | None = self._waiting
        self._folder, self._limit, self._pause_s = folder, SizeLimit(max_width_px, max_height_px), 1 / fps
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
        """The newest whole photograph if it is not the one that is shown already."""
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
        """Every photograph with its stamp and the number of its arrival, a new one where the stamp is another than before.

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

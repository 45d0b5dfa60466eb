"""Folder into which a tethering tool writes photographs, as a camera that shows the newest whole one, with its Exif."""

import itertools
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np

from mrbokeh.lens_measuring.matching.photo_facts import read_facts
from mrbokeh.system.errors import InputError
from viewfinder.frames import Bgr, CameraFrame, LensState
from viewfinder.sources.frame_source import UNLIMITED, SizeLimit

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


DEFAULT_FPS = 10.0

# (time of the last change in ns, bytes): while a file is written they change.
Stamp = tuple[int, int]


class WatchedFolderSource:
    """FrameSource of the newest whole JPEG, PNG or TIFF, `fps` times a second, so that the stream goes on between two photographs.

    captured_s of its frames is when they are shown again. Frames carry the Exif's focus distance, f-number and focal length. A file
    counts once it has kept its size and date for one look and can be decoded to its end. limit: larger
    pictures are scaled down with their aspect. Raises InputError where there is no such folder at the start.
    """

    transfer = "srgb"

    def __init__(self, folder: Path, limit: SizeLimit = UNLIMITED, fps: float = DEFAULT_FPS) -> None:
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

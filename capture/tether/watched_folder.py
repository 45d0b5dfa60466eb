"""A folder as a camera: the maker's own software or a wireless card drops files there, the photographer focuses and releases."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from capture.photos.metadata import require_whole_tiff
from capture.photos.photo_files import PHOTO_SUFFIXES, natural_key
from capture.photos.raw import RAW_SUFFIXES
from capture.tether.camera_driver import CameraDescription, CameraError, CameraSettings, Preview, Shot, Stop
from mrbokeh.system.errors import InputError

_LAST_BYTES = 64
_ENDS = {".jpg": b"\xff\xd9", ".jpeg": b"\xff\xd9", ".png": b"IEND\xaeB`\x82"}


def is_whole(path: Path) -> bool:
    """Tell whether a photograph that may still be being written is complete.

    JPEG and PNG have an end mark; TIFF and most RAW state where their pixels are. Other formats count as whole unless empty.
    """
    try:
        size = path.stat().st_size
        if size == 0:
            return False
        end = _ENDS.get(path.suffix.lower())
        if end is not None:
            with path.open("rb") as file:
                file.seek(max(0, size - _LAST_BYTES))
                return end in file.read()
        if path.suffix.lower() in (*RAW_SUFFIXES, ".tif", ".tiff"):
            require_whole_tiff(path)
    except (InputError, OSError):
        return False
    return True


@dataclass
class WatchedFolder:
    """A CameraDriver without shutter, motor and live view. Files that are in the folder at the start are ignored.

    stable_s: how long a file must not have grown. raw_wait_s: how long a JPEG waits for a RAW of the same name.
    timeout_s: how long to wait for a photograph. The files stay where they are; the shoot gets copies.
    """

    folder: Path
    stable_s: float = 1.0
    raw_wait_s: float = 3.0
    timeout_s: float = 600.0
    poll_s: float = 0.25
    sleep: Callable[[float], None] = time.sleep
    clock: Callable[[], float] = time.monotonic
    _taken: set[str] = field(default_factory=set, repr=False)
    _watched: dict[Path, tuple[int, float]] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        if not self.folder.is_dir():
            raise InputError(f"expected the folder into which photographs come, but there is none at {self.folder}")
        self._taken = {path.stem for path in self._photographs()}

    def describe(self) -> CameraDescription:
        return CameraDescription("watched folder", str(self.folder), frozenset())

    def configure(self, settings: CameraSettings) -> dict[str, str]:
        wanted = [name for name, value in vars(settings).items() if value is not None]
        if wanted:
            raise InputError(f"a watched folder cannot set {', '.join(wanted)}: set these on the camera, with manual exposure")
        return {}

    def preview(self) -> Preview:
        raise CameraError("a watched folder has no live view")

    def focus_step(self, steps: int) -> None:  # noqa: ARG002
        raise CameraError("a watched folder has no focus motor")

    def home(self, stop: Stop) -> None:  # noqa: ARG002
        raise CameraError("a watched folder has no focus motor")

    def capture(self) -> Shot:
        """Return the next new photograph once it is whole; if one shot makes RAW and JPEG, the RAW."""
        start = self.clock()
        while self.clock() - start < self.timeout_s:
            path = next(self._whole(), None)
            if path is not None:
                self._taken.add(path.stem)
                return Shot(path.read_bytes(), path.name)
            self.sleep(self.poll_s)
        unfinished = ", ".join(path.name for path in self._new()) or "nothing"
        raise CameraError(f"no whole photograph came into {self.folder} within {self.timeout_s:g} s (unfinished: {unfinished})")

    def close(self) -> None:
        pass

    def _photographs(self) -> list[Path]:
        found = [path for path in self.folder.iterdir() if path.suffix.lower() in PHOTO_SUFFIXES and not path.name.startswith(".")]
        return sorted((path for path in found if path.is_file()), key=natural_key)

    def _new(self) -> list[Path]:
        return [path for path in self._photographs() if path.stem not in self._taken]

    def _whole(self) -> Iterator[Path]:
        """Yield new files that have stopped growing and are whole; a JPEG only after its time to wait for a RAW."""
        new = self._new()
        raw = {path.stem for path in new if path.suffix.lower() in RAW_SUFFIXES}
        for path in new:
            age_s = self._unchanged_s(path)
            is_raw = path.suffix.lower() in RAW_SUFFIXES
            if not is_raw and (path.stem in raw or age_s < self.raw_wait_s):
                continue
            if age_s >= self.stable_s and is_whole(path):
                yield path

    def _unchanged_s(self, path: Path) -> float:
        """Return the seconds since the file last grew, as far as it was watched."""
        try:
            size, now = path.stat().st_size, self.clock()
        except FileNotFoundError:
            # Renamed by whoever writes it.
            return 0.0
        before = self._watched.get(path)
        if before is None or before[0] != size:
            self._watched[path] = size, now
            return 0.0
        return now - before[1]

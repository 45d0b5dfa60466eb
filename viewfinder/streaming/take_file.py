"""TakeWriter: a VideoWriter whose file can be played up to its last half second whatever ends it; recover_takes finds what was cut off.

A take is written under NAME.recording.mp4 as fragments of half a second, each of which is in the system's hands at once. A good end turns
them into a plain file (FFmpeg's hybrid MP4) under the proper name. Where the disk is full or the process was killed, what is not a whole
fragment is cut off: the rest plays and seeks as it is.
"""

import os
import shutil
import struct
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

from mrbokeh.system.atomic_files import writing_alone
from mrbokeh.system.errors import InputError
from mrbokeh.video.writer import VideoWriter

_UNDER_WAY = ".recording"
SUFFIXES = (".mp4", ".mov")
_FRAGMENT_S = 0.5
_MICROSECONDS = 1_000_000
# The compositor must not starve: the quality of files that are made at leisure in half of the time, at 2.5 times the size. No picture
# waits in the encoder for the next one, and players can begin at every thirtieth.
_LIVE_H264 = {"crf": "14", "preset": "superfast", "tune": "zerolatency", "g": "30"}
_HEAD = struct.Struct(">I4s")
_LARGE = struct.Struct(">Q")


class TakeFile:
    """File that FFmpeg writes to; nothing waits in this process. After the first error (a full disk) it takes nothing more."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("x+b", buffering=0)
        self.trouble: OSError | None = None
        self.seek, self.tell, self.read, self.close = self._file.seek, self._file.tell, self._file.read, self._file.close

    def write(self, data: bytes) -> int:
        if self.trouble is not None:
            raise self.trouble
        left = memoryview(data)
        try:
            while left:
                left = left[self._put(left) :]
        except OSError as error:
            self.trouble = error
            raise
        return len(data)

    def _put(self, data: memoryview) -> int:
        return self._file.write(data) or 0


class TakeWriter(VideoWriter):
    """Writer of one file, MP4 or QuickTime; the end of a `with` block gives it its name, and what the block raises loses nothing.

    A full disk raises OSError from `write`. `kept`: whether anything is left under the name once the block has ended.
    """

    kept = False

    def __enter__(self) -> "TakeWriter":
        import av

        if self.encoding.codec == "libx264":
            self.encoding = self.encoding._replace(options=_LIVE_H264)
        self._working = under_way(self.path)
        with ExitStack() as stack:
            self._working.parent.mkdir(parents=True, exist_ok=True)
            stack.enter_context(writing_alone(self._working))
            self._file = TakeFile(self._working)
            stack.callback(self._file.close)
            self._container: Any = av.open(self._file, "w", format=self.suffix[1:], container_options=self._container_options())
            self._stream, self._audio = self._add_stream(), None
            self._stack = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        with self._stack:
            # Where the disk is full, or a picture could not be encoded, the fragments before are whole.
            for end in (self._flush, self._container.close, self._file.close):
                with suppress(Exception):
                    end()
            self.kept = settle(self._working, self.path)

    def _container_options(self) -> dict[str, str]:
        fragments = {"movflags": "+hybrid_fragmented+default_base_moof", "frag_duration": str(round(_FRAGMENT_S * _MICROSECONDS))}
        return {**super()._container_options(), **fragments, "flush_packets": "1"}

    @property
    def trouble(self) -> str | None:
        """Reason why the file did not take everything, None where it did."""
        error = self._file.trouble
        return None if error is None else (error.strerror or str(error)).lower()

    @property
    def size_bytes(self) -> int:
        return self._working.stat().st_size


def under_way(path: Path) -> Path:
    """Return the name under which a take is written."""
    return path.with_name(f"{path.stem}{_UNDER_WAY}{path.suffix}")


def is_under_way(path: Path) -> bool:
    """Tell by its name whether a take is being written, or was when a process was killed."""
    return path.stem.endswith(_UNDER_WAY)


def settle(working: Path, path: Path) -> bool:
    """Cut a file to what plays and give it its name; one without a picture is removed, and False returned."""
    with working.open("r+b") as file:
        length = playable_bytes(file)
        file.truncate(length)
    if length == 0:
        working.unlink()
        return False
    os.replace(working, path)
    return True


def playable_bytes(file: BinaryIO) -> int:
    """Return how much of a file plays: all of one that was ended, of fragments those that are whole; 0 where there is no picture.

    Boxes of ISO/IEC 14496-12, 4.2: a length and four letters, the index (moov) of fragments comes before the first of them.
    """
    size, at, playable, has_index = file.seek(0, os.SEEK_END), 0, 0, False
    while at + _HEAD.size <= size:
        file.seek(at)
        length, name = _HEAD.unpack(file.read(_HEAD.size))
        if length == 1:
            length = _LARGE.unpack(file.read(_LARGE.size).ljust(_LARGE.size, b"\0"))[0]
        at += length
        if length < _HEAD.size or at > size:
            break
        if name == b"moov":
            if has_index or playable:
                return playable if has_index else at  # a second one: the end was under way; one behind all data: it was reached
            has_index = True
        elif name == b"mdat":
            playable = at
    return playable if has_index else 0


def recover_takes(folder: Path) -> list[str]:
    """Give takes that a killed process left in a folder their names; return a sentence for each. Those of running ones are left."""
    told = []
    for working in sorted(each for suffix in SUFFIXES for each in folder.glob(f"*{_UNDER_WAY}{suffix}")):
        path = free_name(working.with_name(working.name.replace(_UNDER_WAY, "")), own=working)
        with suppress(InputError), writing_alone(working):
            if settle(working, path):
                told.append(f"a take that was cut off was recovered: {path.name} ({length_s(path):.0f} s)")
    return told


def free_name(path: Path, own: Path | None = None) -> Path:
    """Return the path, with a number where it, or a take under way to it other than one's own, exists."""
    free, number = path, 1
    while free.exists() or (under_way(free) != own and under_way(free).exists()):
        number += 1
        free = path.with_stem(f"{path.stem}-{number}")
    return free


def length_s(path: Path) -> float:
    """Return how long a video is."""
    import av

    with av.open(str(path)) as container:
        return float((container.duration or 0) / _MICROSECONDS)


def free_bytes(folder: Path) -> int:
    """Return the free space of the disk on which a folder is, or will be."""
    return shutil.disk_usage(next(each for each in (folder, *folder.absolute().parents) if each.exists())).free

"""Files into the data set: hard links where the disk allows it, copies elsewhere; and their hashes."""

import hashlib
import os
import shutil
from pathlib import Path

from mrbokeh.stacks.focal_stack_dataset import FileRecord
from mrbokeh.system.atomic_files import atomic_path

_CHUNK_BYTES = 1 << 20


def place(source: Path, target: Path, *, copy: bool = False) -> None:
    """Give the file a second name, or copy it. A link costs no space, and is safe: all of mrbokeh's files are replaced, never changed."""
    with atomic_path(target) as temporary:
        temporary.unlink(missing_ok=True)
        if copy:
            shutil.copyfile(source, temporary)
            return
        try:
            os.link(source, temporary)
        except OSError:
            shutil.copyfile(source, temporary)


def record_of(path: Path) -> FileRecord:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            digest.update(chunk)
    return FileRecord(digest.hexdigest(), path.stat().st_size)

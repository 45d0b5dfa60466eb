"""A full disk in one clear line: no half file, and what is finished stays."""

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mrbokeh.system.errors import InputError

_FULL = (errno.ENOSPC, errno.EDQUOT)
_MIB = 2**20


class DiskFullError(InputError):
    """Nothing can be written any more; going on with the next file would not help."""


@contextmanager
def told_when_full(path: Path, needed_bytes: int = 0) -> Iterator[None]:
    """Turn a write that fails for want of space into DiskFullError.

    Libraries in C++ say so in words at best: otherwise it is the disk if it has less left than needed_bytes.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in _FULL:
            raise
        raise DiskFullError(_message(path)) from None
    except RuntimeError as error:
        said = any(os.strerror(code) in str(error) for code in _FULL)
        if not said and shutil.disk_usage(_existing(path)).free >= needed_bytes:
            raise
        raise DiskFullError(_message(path)) from None


def _existing(path: Path) -> Path:
    return next(each for each in (path, *path.parents) if each.exists())


def _message(path: Path) -> str:
    free_mib = shutil.disk_usage(_existing(path)).free / _MIB
    return (
        f"the disk of {path.parent} is full ({free_mib:.0f} MiB left): make room or give another --out, then run the same command again; "
        f"finished slices are kept"
    )

"""Claims: who works on what, as files on a disk that all workers share; processes of one machine or of many, without a scheduler.

A claim is made by whoever can create its file, and touched as long as its owner works. One that nobody touches any more is taken over; one
whose owner has died on this machine, at once. Should two ever work on the same, nothing is lost but time: results are written aside and
renamed, and are the same to the bit.
"""

import os
import secrets
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

HEARTBEAT_S = 5.0
"""How often a claim is touched."""

STALE_S = 60.0
"""How long a claim may stay untouched: longer than a shared disk is away for a moment, or the compiler holds all threads up."""


@contextmanager
def claimed(path: Path, stale_s: float = STALE_S) -> Iterator[bool]:
    """Hold a claim during the block; False where somebody else does, or its folder is gone."""
    owner = f"{_machine()} {os.getpid()} {secrets.token_hex(4)}"
    if not _create(path, owner) and not (_is_left(path, stale_s) and _create(path, owner)):
        yield False
        return
    done = threading.Event()
    heart = threading.Thread(target=_beat, args=(path, done), daemon=True)
    heart.start()
    try:
        yield True
    finally:
        done.set()
        heart.join()
        if _owner_of(path) == owner:
            path.unlink(missing_ok=True)


def _create(path: Path, owner: str) -> bool:
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(owner)
    except (FileExistsError, FileNotFoundError):
        return False
    return True


def _beat(path: Path, done: threading.Event) -> None:
    while not done.wait(HEARTBEAT_S):
        with suppress(OSError):
            os.utime(path)


def _is_left(path: Path, stale_s: float) -> bool:
    """Return whether a claim was given up by its owner, and is out of the way now."""
    owner = _owner_of(path)
    if owner is None or not (_has_died(owner) or _untouched_s(path) > stale_s):
        return False
    aside = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        path.rename(aside)  # only one can do that
    except OSError:
        return False
    aside.unlink(missing_ok=True)
    return True


def _owner_of(path: Path) -> str | None:
    try:
        return path.read_text(encoding="utf-8")
    except OSError:
        return None


def _has_died(owner: str) -> bool:
    """Return whether the owner was a process of this machine that is no more. Windows has no way to ask that does no harm."""
    machine, _, rest = owner.partition(" ")
    if machine != _machine() or os.name == "nt":
        return False
    try:
        os.kill(int(rest.split()[0]), 0)
    except ProcessLookupError:
        return True
    except (OSError, ValueError, IndexError):
        return False
    return False


def _untouched_s(path: Path) -> float:
    """Return for how long a claim was not touched, by the clock of the disk, for those of machines differ."""
    clock = path.with_name(f".clock.{secrets.token_hex(4)}")
    try:
        clock.touch()
        return clock.stat().st_mtime - path.stat().st_mtime
    except OSError:
        return 0.0
    finally:
        clock.unlink(missing_ok=True)


def _machine() -> str:
    """Return a name for what process numbers are unique in: a running system, and a container on it."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot}-{os.stat('/proc/self/ns/pid').st_ino}"
    except OSError:
        import platform

        return platform.node().replace(" ", "-") or "unknown"

"""Files that are either whole or absent: written under a temporary name, then renamed."""

import json
import os
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from mrbokeh.system.errors import InputError, require_file
from mrbokeh.system.messages import finished, say, unfinished


@contextmanager
def atomic_path(path: Path | str, is_result: bool = True) -> Iterator[Path]:
    """Open a temporary path beside `path` with its suffix; rename it to `path` if the block ends well, else remove it.

    is_result: False for what is only kept to be faster next time.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with _staged(path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}"), path, is_result) as temporary:
        yield temporary


@contextmanager
def atomic_folder(folder: Path | str) -> Iterator[Path]:
    """Open a temporary folder, renamed to `folder` if the block ends well, else removed. Raises InputError if `folder` exists."""
    folder = Path(folder)
    refuse_existing(folder, overwrite=False)
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    _remove(temporary)
    temporary.mkdir()
    with _staged(temporary, folder):
        yield temporary


@contextmanager
def _staged(temporary: Path, path: Path, is_result: bool = True) -> Iterator[Path]:
    made = None
    unfinished(temporary)
    try:
        yield temporary
        os.replace(temporary, path)
        made = path
    finally:
        _remove(temporary)
        finished(temporary, made if is_result else None)


def _remove(temporary: Path) -> None:
    if temporary.is_dir():
        shutil.rmtree(temporary, ignore_errors=True)
    else:
        temporary.unlink(missing_ok=True)


@contextmanager
def writing_alone(path: Path | None) -> Iterator[None]:
    """Hold a lock beside a result, which goes with the process. Raises InputError if another process holds it.

    None, and a place where nothing can be written, are not locked.
    """
    missing: list[Path] = []
    with ExitStack() as held:
        if path is not None and (name := Path(os.path.realpath(path)).name):
            lock = Path(os.path.realpath(path)).with_name(f".{name}.lock")
            with suppress(OSError):
                missing = [each for each in lock.parents if not each.exists()]
                for folder in reversed(missing):
                    held.callback(_tried, folder.rmdir)  # where nothing was written
                lock.parent.mkdir(parents=True, exist_ok=True)
                file = held.enter_context(lock.open("a+"))
                if not _lock(file):
                    file.seek(0)
                    process = f" (process {number})" if (number := file.read()) else ""
                    raise InputError(f"another run{process} is writing {path}: wait for it, or give this one another name")
                held.callback(_tried, lock.unlink)
                if os.name == "nt":
                    held.callback(file.close)  # an open file cannot be removed there
                held.callback(finished, lock, None)
                unfinished(lock)
                file.truncate(0)
                file.write(str(os.getpid()))
                file.flush()
        yield
        if path is not None and missing and path.exists():
            say(f"the folder {path.parent} did not exist and was made")


def _lock(file: Any) -> bool:
    """Lock an open file against other processes; return whether that succeeded."""
    try:
        if sys.platform == "win32":
            import msvcrt

            file.seek(1000)  # beyond what is written, so that others can read it
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    return os.name == "nt" or os.fstat(file.fileno()).st_nlink > 0


def _tried(action: Callable[[], None]) -> None:
    with suppress(OSError):
        action()


def write_json(path: Path | str, document: Any) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")


def read_json(path: Path | str, expected: str) -> Any:
    """Read a JSON document; `expected` says in error messages what the file should have been."""
    require_file(path, expected)
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"expected {expected} at {path}, but it is not JSON: {error}") from None
    except RecursionError:
        raise InputError(f"expected {expected} at {path}, but its brackets lie too deep in one another") from None


def refuse_existing(path: Path | str, overwrite: bool, advice: str = "give another name") -> None:
    """Refuse to replace an existing result unless the user asked for it with --overwrite. advice: what to do else."""
    if Path(path).exists() and not overwrite:
        raise InputError(f"{path} exists already: {advice}, or --overwrite to replace it")


def require_safe_outputs(outputs: Iterable[Path | str | None], inputs: Iterable[Path | str | None], overwrite: bool) -> None:
    """Require that outputs can be written, differ from each other and from all inputs (also through links), and do not exist yet.

    None stands for what was not asked for. Raises InputError; `overwrite` allows replacing what exists, but never what is read.
    """
    read, written = {_real(path) for path in inputs if path is not None}, set[Path]()
    for path in (Path(each) for each in outputs if each is not None):
        if _real(path) in read:
            raise InputError(f"{path} is read and would be written over: give the result another name")
        if _real(path) in written:
            raise InputError(f"{path} is named for two results, of which the second would replace the first: give each its own name")
        written.add(_real(path))
        refuse_existing(path, overwrite)
        _require_writable(path)


def _require_writable(path: Path) -> None:
    """Raise InputError if the folder of a result takes no file, before the work rather than after it."""
    folder = next((each for each in path.absolute().parents if each.exists()), Path("/"))
    try:
        TemporaryFile(dir=folder).close()
    except OSError as error:
        raise InputError(f"cannot write {path}: {folder} takes no file ({error.strerror}): choose another folder") from None


def _real(path: Path | str) -> Path:
    return Path(os.path.realpath(path))

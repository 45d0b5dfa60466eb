"""Compiled kernels, kept for all checkouts of a machine under the contents of their sources.

numba keeps a compiled function beside its file and stamps it with that file alone: a changed callee in another file leaves a stale kernel
behind, every checkout and installation compiles for itself, and two processes that start together compile everything twice. Here a kernel
lies in the user's cache folder under the hash of its module and of all modules of ours which that imports, and whoever needs a kernel that
another process compiles at the moment waits for it. A wheel brings the kernels of its platform (`make wheel`), compiled for x86-64 with
AVX2; what it lacks is compiled once on the machine, and that is said.
"""

import gc
import hashlib
import importlib
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding
import numba
import numpy as np
from numba.core import event
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator
from numba.core.compiler_lock import global_compiler_lock
from numba.core.runtime import rtsys
from numba.misc.appdirs import AppDirs

from mrbokeh.system.compiled_libraries import link_once
from mrbokeh.system.messages import say

_config: Any = numba.config

KEPT_UNUSED_DAYS = 90
"""Kernels of sources that nothing has loaded for so long are removed when new ones are written."""
MOST_BYTES = 1_000_000_000
"""Where all kernels take more than this, those that have not been loaded for longest are removed as well."""

OURS = ("mrbokeh", "capture", "training", "viewfinder", "datasets_scripts")
"""Packages whose modules count into the hash of a kernel that imports them, beside its own."""
LONGEST_WAIT_S = 300.0
"""A process that was stopped while it compiled does not hold up others for ever."""

SHIPPED = Path(__file__).resolve().parents[1] / "compiled_kernels"
"""Folders of kernels in a wheel, named and filled as those in the user's cache folder are; a checkout has none."""
PORTABLE_CPU, PORTABLE_FEATURES = "x86-64-v3", ("avx2", "bmi2", "f16c", "fma", "lzcnt", "movbe")
"""The processor that shipped kernels are compiled for, and what this one must have for it. Kernels for this very one are no faster."""
TELL_EVERY_S = 5.0

_STARTED_S = time.time()
_DAY_S = 86400.0
_LOOK_S = 0.02
_IMPORT = re.compile(r"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t]+(\([^)]*\)|[^\n]*)|import[ \t]+([^\n]+))", re.MULTILINE)


@contextmanager
def _without_blas() -> Iterator[None]:
    """Hide SciPy's linear algebra from numba, which links kernels that multiply matrices to it: 0.15 s, and ours multiply none."""
    names = ("scipy.linalg", "scipy.linalg.cython_blas")
    hidden = [name for name in names if name not in sys.modules]
    sys.modules.update(dict.fromkeys(hidden))  # type: ignore[arg-type]
    try:
        yield
    finally:
        for name in hidden:
            del sys.modules[name]


# Only in the process of a command: elsewhere somebody else's kernels may multiply matrices.
_started = getattr(sys.modules.get("__main__"), "__spec__", None)
if ("mrbokeh.cli" in sys.modules or getattr(_started, "name", "") == "mrbokeh.cli") and "numba.np.arraymath" not in sys.modules:
    with _without_blas():
        importlib.import_module("numba.np.arraymath")


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile as numba.njit does; with cache=True the machine code is kept as this module describes."""
    kept = options.pop("cache", False)

    def compiled(function: Callable[..., Any]) -> Any:
        kernel = numba.njit(**options)(function)
        if not _config.DISABLE_JIT:
            link_once(kernel)
        folder = None if _config.DISABLE_JIT or not kept else folder_of(Path(function.__code__.co_filename), function.__module__)
        if folder is not None:
            kernel._cache = _KernelCache(function)
            kernel.compile = _once_at_a_time(kernel.compile, kernel.overloads, folder / f"{function.__qualname__}.lock")
        return kernel

    return compiled


def fingerprint(file: Path, module: str) -> str | None:
    """Return the hash of a module, of all of ours that it imports and of the compiler's versions; None where a source is not at hand."""
    root = file.resolve().parents[module.count(".")]
    if root / _path_of(module) != file.resolve() or not file.is_file():
        return None
    sources = sorted(_with_imported(root, module))
    versions = f"{numba.__version__} {llvmlite.__version__} {np.__version__.split('.')[:2]} {sys.version_info[:2]}"
    # Kernels for the processor of a wheel lie apart: in a folder of this machine's own numba would not find them.
    hashed = hashlib.sha256(f"{versions} {_config.CPU_NAME or ''}".encode())
    for source in sources:
        hashed.update(source.encode() + b"\0" + hashlib.sha256(_text_of(root, source).encode()).digest())
    return hashed.hexdigest()[:32]


def forget_unused(folder: Path) -> None:
    """Remove the folders of kernels in `folder` that have not been loaded for KEPT_UNUSED_DAYS, and the oldest beyond MOST_BYTES."""
    total_bytes = 0
    for each in sorted((each for each in folder.iterdir() if each.is_dir()), key=_used_s, reverse=True):
        total_bytes += sum(file.stat().st_size for file in each.iterdir())
        if total_bytes > MOST_BYTES or time.time() - _used_s(each) > KEPT_UNUSED_DAYS * _DAY_S:
            shutil.rmtree(each, ignore_errors=True)


def _used_s(folder: Path) -> float:
    return folder.stat().st_mtime


class _KernelLocator(_CacheLocator):  # type: ignore[misc]
    """Place of the kernels of a module, for numba; what they depend on is in the name of the folder."""

    def __init__(self, folder: Path, py_file: str, line: int) -> None:
        self._folder, self._py_file, self._line = folder, py_file, line

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return self._folder.name

    def get_disambiguator(self) -> str:
        return str(self._line)

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> "_KernelLocator | None":
        folder = folder_of(Path(py_file), py_func.__module__)
        return cls(folder, py_file, py_func.__code__.co_firstlineno) if folder else None


class _KernelCacheImpl(CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes = [_KernelLocator]  # type: ignore[assignment, list-item]  # noqa: RUF012


class _KernelCache(FunctionCache):  # type: ignore[misc]
    """numba's cache of a kernel's signatures; a full disk or a damaged file costs time and not the picture."""

    _impl_class = _KernelCacheImpl

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            # As numba does, but without telling its compiler of all functions that it knows, 0.1 s: it is told when it compiles.
            rtsys.initialize(target_context)
            with self._guard_against_spurious_io_errors():
                return self._load_overload(sig, target_context)
        except Exception:  # what unpickling a damaged file raises is anything
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        with suppress(OSError):
            super().save_overload(sig, data)


@cache
def folder_of(file: Path, module: str) -> Path | None:
    """Return the folder of a module's kernels, marked as used today; None where nothing can be written or the source is not at hand.

    Sources that were changed since this process began may not be what it has loaded: their kernels are not kept.
    """
    base, name = _writable_base(), fingerprint(file, module)
    if name is None or _newest_s(file, module) > _STARTED_S:
        return None
    shipped = SHIPPED / name if (SHIPPED / name).is_dir() else None
    if base is None:
        return shipped
    folder = base / name
    with suppress(OSError):
        if not folder.is_dir():
            _begin(folder, shipped)
            _forget_once(base)
        elif time.time() - folder.stat().st_mtime > _DAY_S:
            os.utime(folder)
    return folder if folder.is_dir() else None


def _begin(folder: Path, shipped: Path | None) -> None:
    """Make a folder of kernels, with those that the wheel brought; another process may do the same at this moment."""
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".") as aside, suppress(OSError):
        new = Path(aside) / "new"
        new.mkdir()
        for file in shipped.iterdir() if shipped else ():
            shutil.copyfile(file, new / file.name)  # without its mode and its age, by which old kernels are removed
        new.rename(folder)


_forget_once = cache(forget_unused)


@cache
def _writable_base() -> Path | None:
    """Return a folder that can be written: in NUMBA_CACHE_DIR where that is set, else the user's cache folder, else __pycache__ here."""
    user = Path(AppDirs(appname="mrbokeh", appauthor=False).user_cache_dir)
    bases = [user / "kernels", Path(__file__).parent / "__pycache__" / "kernels"]
    if not _config.CACHE_DIR:
        return next(filter(_can_be_written, bases), None)
    named = Path(_config.CACHE_DIR) / "mrbokeh"
    if _can_be_written(named):
        return named
    temporary = Path(tempfile.gettempdir()) / f"mrbokeh_kernels_{os.getuid() if hasattr(os, 'getuid') else 'user'}"
    kept = temporary if _can_be_written(temporary) else None
    told = f"they are kept in {kept}" if kept else "they are compiled anew each time"
    print(
        f"NUMBA_CACHE_DIR: compiled kernels cannot be written to {named}, or it is another user's: {told}; name one that can be written",
        file=sys.stderr,
    )
    return kept


def _can_be_written(folder: Path) -> bool:
    """Return whether kernels can be kept in a folder, which is made; one of another user could hold foreign code."""
    with suppress(OSError):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        ours = not hasattr(os, "getuid") or folder.stat().st_uid in (os.getuid(), 0)
        return ours and os.access(folder, os.W_OK | os.X_OK)
    return False


def _once_at_a_time(compile_one: Callable[[Any], Any], known: Any, lock: Path) -> Callable[[Any], Any]:
    """Compile, or load what another process has compiled meanwhile; the lock also keeps numba's index of a kernel's signatures whole."""

    def compile_or_wait(signature: Any) -> Any:
        # Within numba's own lock, which is taken again inside: threads that held one lock each would wait for one another.
        with global_compiler_lock:
            if signature in known:
                return compile_one(signature)
            with _locked(lock), _garbage_left():
                return compile_one(signature)

    return compile_or_wait


@contextmanager
def _garbage_left() -> Iterator[None]:
    """Collect no garbage meanwhile: a compiler makes millions of objects that live until the end, and Python would look through them."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()


_HELD: set[Path] = set()
"""Locks of this process, guarded by numba's own: a kernel that needs itself while it is compiled does not wait for itself."""


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold a file locked against other processes, where the system and the file system can do that, or go on after LONGEST_WAIT_S."""
    if path in _HELD:
        yield
        return
    with ExitStack() as held:
        with suppress(ImportError, OSError):
            import fcntl

            file, until_s = held.enter_context(path.open("a")), time.monotonic() + LONGEST_WAIT_S
            while time.monotonic() < until_s:
                with suppress(BlockingIOError):
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                time.sleep(_LOOK_S)
        _HELD.add(path)
        held.callback(_HELD.discard, path)
        yield


_now_s = time.monotonic


class _Compiling(event.Listener):  # type: ignore[misc]
    """Says on standard error that kernels are being compiled, how many, and that this happens once a machine."""

    def __init__(self) -> None:
        self._depth, self.count, self._took_s, self._began_s, self._told_s = 0, 0, 0.0, 0.0, 0.0

    def on_start(self, event: Any) -> None:
        self._depth += self._depth > 0 or isinstance(event.data["dispatcher"]._cache, _KernelCache)
        if self._depth != 1:  # what a kernel calls
            return
        self.count, self._began_s = self.count + 1, _now_s()
        if self.count == 2:
            say("compiling for this machine, which happens once and takes up to a minute ...", err=True)
            self._told_s = self._began_s
        elif self.count > 2 and self._began_s - self._told_s > TELL_EVERY_S:
            say(f"compiled {self.count - 1} kernels in {self._took_s:.0f} s ...", err=True)
            self._told_s = self._began_s

    def on_end(self, _event: Any) -> None:
        self._depth = max(0, self._depth - 1)
        if self._depth == 0 and self._began_s:
            self._took_s, self._began_s = self._took_s + _now_s() - self._began_s, 0.0


def kernels_compiled() -> int:
    """Return how many kernels this process compiled, or began to, because nobody had done it on this machine."""
    return _COMPILING.count


def _path_of(module: str) -> str:
    return module.replace(".", "/") + ".py"


@cache
def _text_of(root: Path, module: str) -> str:
    """Return the source of a module below `root`; empty where it is not one of ours."""
    for path in (root / _path_of(module), root / module.replace(".", "/") / "__init__.py"):
        if path.is_file():
            return path.read_text(encoding="utf-8")
    return ""


@cache
def _imported(root: Path, module: str) -> frozenset[str]:
    """Return our modules that a module imports, wherever in it."""
    names = set()
    for source, members, plain in _IMPORT.findall(_text_of(root, module)):
        words = re.findall(r"[\w.]+", re.sub(r"#[^\n]*|\bas\s+\w+", "", members or plain))
        names.update([source, *(f"{source}.{word}" for word in words)] if source else words)
    ours = {*OURS, module.partition(".")[0]}
    return frozenset(name for name in names if name.partition(".")[0] in ours and _text_of(root, name))


def _with_imported(root: Path, module: str) -> set[str]:
    """Return a module and all that it imports, directly or through others."""
    found, waiting = set(), [module]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting.extend(_imported(root, name))
    return found


def _newest_s(file: Path, module: str) -> float:
    """Return when the last of a module and all that it imports was changed, in seconds since the epoch."""
    root = file.resolve().parents[module.count(".")]
    paths = (root / _path_of(name) for name in _with_imported(root, module))
    return max((path.stat().st_mtime for path in paths if path.is_file()), default=0.0)


def _as_shipped() -> None:
    """Let numba compile for the processor of the shipped kernels, where there are any and this one can run them.

    This holds for the whole process: kernels of others are compiled for that processor too.
    """
    if SHIPPED.is_dir() and not _config.CPU_NAME and all(map(llvmlite.binding.get_host_cpu_features().get, PORTABLE_FEATURES)):
        _config.CPU_NAME, _config.CPU_FEATURES = PORTABLE_CPU, ""


def _as_optimised() -> None:
    """Let LLVM optimise at level 2, unless NUMBA_OPT says another: level 3 took a tenth longer to compile all kernels.

    Of four renderers none was slower for it, and their pictures were the same bit for bit. This holds for the whole process too.
    """
    if "NUMBA_OPT" not in os.environ:
        _config.OPT = type(_config.OPT)(2)


_as_shipped()
_as_optimised()
_COMPILING = _Compiling()
event.register("numba:compile", _COMPILING)

"""Shapes and types of array annotations are checked while tests run (jaxtyping + beartype); shared places of test data."""

import contextlib
import dataclasses
import functools
import gc
import importlib
import inspect
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import CodeType
from typing import Any

# Each of the workers has a core of its own: threads of libraries would wait for one another, and spin. They read this when imported.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import jaxtyping
import pytest

import tests

PACKAGES = ("mrbokeh", "capture", "training", "viewfinder", "datasets_scripts")
ROOT = Path(__file__).resolve().parent.parent
SHARED_DATA = ROOT.parent / "shared" / "data"
_AWAITS_OR_YIELDS = inspect.CO_GENERATOR | inspect.CO_COROUTINE | inspect.CO_ASYNC_GENERATOR


def _modules() -> list[str]:
    """Every module but the compiled ones, whose functions numba and not Python calls."""
    files = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    names = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in files if not path.stem.endswith("_numba")]
    return [name for name in names if not name.endswith("__init__")]


class _ChecksOfFirstCalls:
    """Check each function, and each dataclass that is made, on calls 1, 2, 4, 8, ... of the whole run.

    Checking all calls, as jaxtyping does, takes 40 % of the time. A function within another one is a new one each time, and
    to prepare its check takes milliseconds: all of them count as one.
    """

    def __init__(self) -> None:
        self._always = jaxtyping.jaxtyped
        self._calls: dict[tuple[str, str, CodeType], list[int]] = {}

    def __call__(self, *, typechecker: Any) -> Callable[[Any], Any]:
        check = self._always(typechecker=typechecker)

        def checked(decorated: Any) -> Any:
            if inspect.isfunction(decorated):
                return self._checked_at_first(decorated, check)
            plain = decorated.__dict__.get("__init__") if dataclasses.is_dataclass(decorated) and inspect.isclass(decorated) else None
            if plain is None:
                return check(decorated)
            decorated.__init__ = self._checked_at_first(plain, check)  # as jaxtyping does, but not before one is made
            return decorated

        return checked

    def _checked_at_first(self, plain: Callable[..., Any], check: Callable[..., Any]) -> Callable[..., Any]:
        calls, checked = self._calls.setdefault((plain.__module__, plain.__qualname__, plain.__code__), [0]), None

        @functools.wraps(plain)
        def either(*args: Any, **kwargs: Any) -> Any:
            nonlocal checked
            calls[0] += 1
            if calls[0] & (calls[0] - 1):
                return plain(*args, **kwargs)
            checked = checked or _checked(plain, check)
            return checked(*args, **kwargs)

        return either


def _checked(plain: Callable[..., Any], check: Callable[..., Any]) -> Callable[..., Any]:
    """Check a plain function once; jaxtyping prepares two of each, for its words: 7400 in three folders of tests, 4 s.

    What fails is called again with those, which tell the shapes. Annotations in quotes and what awaits or yields are left to it.
    """
    if any(isinstance(each, str) for each in plain.__annotations__.values()) or plain.__code__.co_flags & _AWAITS_OR_YIELDS:
        return check(plain)
    from beartype.roar import BeartypeCallHintViolation

    once = tests.checked(plain)

    def either(*args: Any, **kwargs: Any) -> Any:
        try:
            with _always_jaxtyped("context"):
                return once(*args, **kwargs)
        except BeartypeCallHintViolation:
            check(plain)(*args, **kwargs)
            raise

    return either


_always_jaxtyped = jaxtyping.jaxtyped
if tests.checked is not None:
    jaxtyping.jaxtyped = _ChecksOfFirstCalls()
    jaxtyping.install_import_hook(_modules(), "tests.checked")


def pytest_collection() -> None:
    """Import test modules from the last to the first in the second worker, and from the middle on in the third.

    In a fresh clone each is compiled, and that is kept: workers that went the same way at once would all compile everything.
    What is imported stays: Python need not look through it for waste, now and after each test.
    """
    gc.disable()
    paths, worker = sorted((ROOT / "tests").glob("*/test_*.py")), int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:]) % 3
    for path in ([], paths[::-1], paths[len(paths) // 2 :])[worker]:
        with contextlib.suppress(pytest.skip.Exception, Exception):  # told when the file is collected
            importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))


def pytest_collection_finish() -> None:
    """Look for waste again, seldom through all that has lived for long: torch's modules alone take 0.2 s each time."""
    gc.freeze()
    gc.set_threshold(2000, 10, 100)
    gc.enable()


LONG_FILES = (
    "renderers/test_layered_reconstruction.py",
    "renderers/test_bank_renderers.py",
    "training/test_evaluate.py",
    "compositing/test_composite_command.py",
    "photos/test_raw_stack.py",
    "training/test_train_one_stack.py",
    "viewfinder/test_page_browser.py",
    "compositing/test_compositing_rims.py",
    "project/test_demo.py",
    "tracking/test_simple_cameras.py",
    "training/test_ablation.py",
    "views/test_depth.py",
    "project/test_packaging.py",
    "views/test_scale_scene.py",
    "training/test_fast_export.py",
    "training/test_export_onnx.py",
)
"""Files with tests or fixtures of many seconds: they begin among those of their kind."""
COMPILING = ("renderers", "compositing", "layering", "psf_models")
"""Folders that need most kernels in a fresh clone, a third of all tests: one worker takes them. Whoever compiles a kernel also compiles
what it needs of numba's own, a third of the work, and that is not kept: three workers would do it three times."""
LATE = ("depth", "views", "scene", "viewfinder", "video", "shots", "project", "training", "hosts", "refocus", "datasets_scripts")
"""Folders that need some of those kernels as well, which are there by then."""


@pytest.hookimpl(trylast=True)  # once those that do not run are left out
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give the first worker what compiles, and the others some of the long files: one at the end would leave the rest without work.

    Workers get consecutive shares of all tests, of equal number (pytest-xdist, worksteal).
    """
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    if workers == 1:
        return
    files: dict[Path, list[pytest.Item]] = {}
    for item in items:
        files.setdefault(item.path, []).append(item)
    long = [ROOT / "tests" / name for name in LONG_FILES if ROOT / "tests" / name in files]
    waiting = sorted([*long, *(path for path in files if path not in long)], key=lambda path: path.parent.name in LATE)
    shares: list[list[pytest.Item]] = [[] for _ in range(workers)]
    others = 0
    for path in waiting:
        compiles = path.parent.name in COMPILING
        shares[0 if compiles else 1 + others % (workers - 1)] += files[path]
        others += not compiles
    items[:] = [item for share in shares for item in share]


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Print where the time went, beside the slowest tests that --durations lists."""
    if terminalreporter.config.option.durations is None:
        return
    seconds: dict[str, float] = {}
    for report in (each for reports in terminalreporter.stats.values() for each in reports if hasattr(each, "duration")):
        folder = "/".join(report.nodeid.partition("::")[0].split("/")[1:-1])
        seconds[folder] = seconds.get(folder, 0.0) + report.duration
    terminalreporter.section("seconds by folder, of all workers together")
    for folder, each in sorted(seconds.items(), key=lambda row: -row[1]):
        terminalreporter.write_line(f"{each:7.1f}s {folder}")


# Tests send Ctrl-C to themselves and to programs they start; what runs in the background of a shell is deaf to it, and so are its children.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def without_exiftool(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only tests of photographs' data ask exiftool: it takes 0.08 s for each photograph that any other test opens."""
    metadata = sys.modules.get("capture.photos.metadata")
    if metadata is not None and request.path.parent.name != "photos":
        monkeypatch.setattr(metadata, "read_with_exiftool", lambda paths: [metadata.PhotoMetadata()] * len(paths))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real photographs, stacks and objects that lie beside the checkout and are not shipped with the project."""
    if not SHARED_DATA.is_dir():
        pytest.skip("the shared test data folder (../shared/data) is not beside the checkout")
    return SHARED_DATA

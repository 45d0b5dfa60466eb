"""Compiled kernels lie in one folder for all checkouts, under the contents of their sources."""

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from mrbokeh.system import compiled

CALLEE = "from mrbokeh.system.compiled import njit\n\n@njit(cache=True)\ndef factor():\n    return {factor}\n"
CALLER = (
    "from mrbokeh.system.compiled import njit\nfrom room import (  # in brackets\n    callee_numba as callee,\n)\nfactor = callee.factor\n"
)
CALLER += "\n@njit(cache=True)\ndef scaled(x):\n    return x * factor()\n"
OTHER = "VALUE = 1\n"
CALL = """
import json, sys
from pathlib import Path
from numba.core import event
cache, *folders = sys.argv[1:]
for folder in folders:
    if folder == "damage":
        for path in Path(cache).rglob("*.nb[ci]"):
            path.write_bytes(b"")
        continue
    sys.path.insert(0, folder)
    for name in [each for each in sys.modules if each.partition(".")[0] == "room"]:
        del sys.modules[name]
    with event.install_recorder("numba:compile") as compiled:
        from room.caller_numba import scaled
        value = scaled(2.0)
    ours = [e for _, e in compiled.buffer if e.is_start and e.data["dispatcher"].py_func.__module__.startswith("room")]
    print(json.dumps({"value": value, "compiled": len(ours), "hits": sum(scaled.stats.cache_hits.values())}))
"""
"""What became of the kernel of each folder, one after the other; at the word damage, all that is kept is emptied."""
ROOT = Path(__file__).resolve().parents[2]


def checkout(folder: Path, factor: int = 3) -> Path:
    room = folder / "room"
    room.mkdir(parents=True, exist_ok=True)
    for name, text in {"__init__": "", "callee_numba": CALLEE.format(factor=factor), "caller_numba": CALLER, "other": OTHER}.items():
        (room / f"{name}.py").write_text(text)
    return folder


def start(cache: Path, *folders: Path | str) -> "subprocess.Popen[str]":
    environment = os.environ | {
        "PYTHONPATH": str(ROOT),
        "XDG_CACHE_HOME": str(cache),
        "NUMBA_CACHE_DIR": "",
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    return subprocess.Popen([sys.executable, "-c", CALL, cache, *folders], env=environment, stdout=subprocess.PIPE, text=True)


def answers(process: "subprocess.Popen[str]") -> list[dict[str, float]]:
    out, _ = process.communicate(timeout=120)
    assert process.returncode == 0
    return [json.loads(line) for line in out.splitlines()]


def test_a_second_checkout_finds_what_the_first_compiled_and_a_changed_callee_is_never_stale(tmp_path: Path) -> None:
    first, second, cache = checkout(tmp_path / "a"), checkout(tmp_path / "b"), tmp_path / "cache"
    found, compiled = {"value": 6.0, "compiled": 0, "hits": 1}, {"value": 6.0, "compiled": 2, "hits": 0}
    # Two at once: one compiles both functions, the other waits for it and loads what it called.
    both = [answers(process)[0] for process in [start(cache, first), start(cache, second)]]
    assert sorted(both, key=lambda each: each["compiled"]) == [found, compiled]
    checkout(tmp_path / "b", factor=5)
    # A damaged file costs time: everything is compiled anew, once.
    changed, *later = answers(start(cache, second, first, "damage", first, first))
    assert changed == {"value": 10.0, "compiled": 2, "hits": 0} and later == [found, compiled, found]


def test_sources_changed_since_the_process_began_are_not_kept(tmp_path: Path) -> None:
    """What this process has loaded may be the text of before."""
    caller = checkout(tmp_path / "a") / "room/caller_numba.py"
    assert compiled.folder_of(caller, "room.caller_numba") is None
    for path in caller.parent.iterdir():
        os.utime(path, (time.time() - 86400,) * 2)
    compiled.folder_of.cache_clear()
    assert compiled.folder_of(caller, "room.caller_numba") is not None


def test_kernels_that_a_wheel_brings_are_found_and_copied_to_where_more_can_be_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    caller = checkout(tmp_path / "a") / "room/caller_numba.py"
    for path in caller.parent.iterdir():
        os.utime(path, (time.time() - 86400,) * 2)
    brought = tmp_path / "shipped" / str(compiled.fingerprint(caller, "room.caller_numba"))
    brought.mkdir(parents=True)
    (brought / "scaled.nbc").write_bytes(b"machine code")
    os.utime(brought, (time.time() - 86400 * 100,) * 2)
    monkeypatch.setattr(compiled, "SHIPPED", brought.parent)
    for base, found in ((tmp_path, tmp_path / brought.name), (None, brought)):
        monkeypatch.setattr(compiled, "_writable_base", lambda base=base: base)
        assert compiled.folder_of.__wrapped__(caller, "room.caller_numba") == found
        assert (found / "scaled.nbc").read_bytes() == b"machine code"
    assert time.time() - (tmp_path / brought.name).stat().st_mtime < 3600, "a wheel may be old; its copy is not"


class _KeptNowhere(compiled._KernelCache):
    def __init__(self) -> None:
        """Stand for the cache of a kernel of ours."""


def test_compiling_is_said_once_and_counted_now_and_then(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Kernels that another one calls do not count, and a single small one is not worth a word."""
    compiling, clock = compiled._Compiling(), iter(range(1, 100, 2))
    ours, others = (SimpleNamespace(data={"dispatcher": SimpleNamespace(_cache=each)}) for each in (_KeptNowhere(), None))
    monkeypatch.setattr(compiled, "_now_s", lambda: float(next(clock)))
    for _ in range(4):
        for event in (ours, others):
            compiling.on_start(event)
            compiling.on_end(event)
            compiling.on_start(event)
            compiling.on_start(others)
            compiling.on_end(others)
            compiling.on_end(event)
    first, *later = capsys.readouterr().err.splitlines()
    assert "happens once" in first and later == [f"compiled {n} kernels in {2 * n} s ..." for n in (3, 5, 7)]


def test_a_lock_that_another_process_never_gives_back_is_waited_for_only_so_long(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fcntl = pytest.importorskip("fcntl")
    monkeypatch.setattr(compiled, "LONGEST_WAIT_S", 0.1)
    with (tmp_path / "lock").open("a") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with compiled._locked(tmp_path / "lock"), compiled._locked(tmp_path / "lock"):
            pass  # and a kernel that needs itself does not wait for itself


def test_a_kernel_depends_on_its_module_and_on_what_that_imports_alone(tmp_path: Path) -> None:
    caller = checkout(tmp_path / "a") / "room/caller_numba.py"
    other, callee = checkout(tmp_path / "b"), checkout(tmp_path / "c", factor=5)
    (other / "room/other.py").write_text("VALUE = 2\n")
    made = compiled.fingerprint(caller, "room.caller_numba")
    assert made == compiled.fingerprint(other / "room/caller_numba.py", "room.caller_numba")
    assert made != compiled.fingerprint(callee / "room/caller_numba.py", "room.caller_numba")
    assert compiled.fingerprint(caller, "elsewhere.caller_numba") is None


@pytest.mark.skipif(os.name == "nt", reason="folders that cannot be written are made otherwise there")
def test_a_kernel_runs_where_nothing_can_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither where NUMBA_CACHE_DIR says nor in the temporary folder: compiled each time, and told in one line."""
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setattr(compiled.numba.config, "CACHE_DIR", str(tmp_path / "file" / "below"))
    monkeypatch.setattr(compiled.tempfile, "gettempdir", lambda: str(tmp_path / "file"))
    compiled._writable_base.cache_clear()
    compiled.folder_of.cache_clear()
    try:
        kernel = compiled.njit(cache=True)(_doubled)
        assert kernel(2) == 4 and kernel.stats.cache_path is None
        told = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("compil")]
        assert len(told) == 1 and "compiled anew each time" in told[0]
        monkeypatch.setattr(compiled.tempfile, "gettempdir", lambda: str(tmp_path))
        compiled._writable_base.cache_clear()
        kept, text = compiled._writable_base(), capsys.readouterr().err
        assert kept is not None and kept.parent == tmp_path and kept.stat().st_mode & 0o077 == 0
        assert text.count("\n") == 1 and f"kept in {kept}" in text
    finally:
        compiled._writable_base.cache_clear()
        compiled.folder_of.cache_clear()


def _doubled(x: int) -> int:
    return 2 * x


@compiled.njit(nogil=True)
def fibonacci(n: int) -> int:
    if n < 2:
        return n
    return fibonacci(n - 1) + fibonacci(n - 2)


@compiled.njit(nogil=True)
def next_of_fibonacci(n: int) -> int:
    if n < 0:
        raise ValueError("a negative place")
    return fibonacci(n) + 1


def test_what_kernels_call_becomes_machine_code_only_where_python_calls_it() -> None:
    assert next_of_fibonacci(10) == 56 and not fibonacci.signatures
    assert fibonacci(10) == 55 and len(fibonacci.signatures) == 1
    with pytest.raises(ValueError, match="a negative place"):
        next_of_fibonacci(-1)


def test_kernels_unused_for_long_and_beyond_the_most_bytes_are_removed_the_oldest_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, days in {"old": compiled.KEPT_UNUSED_DAYS + 1, "new": compiled.KEPT_UNUSED_DAYS - 1}.items():
        (tmp_path / name).mkdir()
        os.utime(tmp_path / name, (time.time() - 86400 * days,) * 2)
    compiled.forget_unused(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["new"]
    monkeypatch.setattr(compiled, "MOST_BYTES", 250)
    for hours, name in enumerate(("newest", "middle", "oldest")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "kernel.nbc").write_bytes(bytes(100))
        os.utime(tmp_path / name, (time.time() - 3600 * hours,) * 2)
    compiled.forget_unused(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} >= {"newest", "middle"} and not (tmp_path / "oldest").exists()


def test_every_kernel_of_the_product_is_kept_this_way() -> None:
    sources = [
        path for name in ("mrbokeh", "capture", "training", "viewfinder", "datasets_scripts") for path in (ROOT / name).rglob("*.py")
    ]
    direct = [path for path in sources if re.search(r"numba import.*\bn?jit\b|numba\.n?jit\b", path.read_text(encoding="utf-8"))]
    assert [path.name for path in direct] == ["compiled.py"]

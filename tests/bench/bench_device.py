"""Every benchmark and test of a device of torch, on one page: `python -m tests.bench.bench_device [--out FOLDER] [--parts a,b]`.

`make gpu` runs it. On a machine with an NVIDIA GPU it takes less than 8 minutes; without one the processor stands in, with smaller
pictures. Each part is a module of `tests/bench/device/` and runs in a process and a time of its own, as a kernel that goes wrong spoils
the device for the whole process. One that fails leaves its last lines on the page. The page (device.md, device.json) is written anew
after every row.
"""

import argparse
import importlib
import json
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from tests.bench.device.page import Page, PartResult
    from tests.bench.device.rows import Run

WHOLE_S = 465.0
"""For all parts together, so that starting and ending fit into 8 minutes as well."""
TRACEBACK_LINES = 12
NEEDED = ("torch", "numpy", "scipy", "numba", "cv2", "jaxtyping")
WANTED = {
    "triton": "splatting and sweeps go by torch alone on a GPU, and their kernels are not tested",
    "pytest": "the part `tests` is left out",
    "beartype": "types of annotations are not checked while the tests run",
    "rich": "the part `training` is left out",
}
"""Packages without which something is left out, and what."""


class Part(NamedTuple):
    """A part: the module whose `rows(run)` yields its rows, how many seconds it may take, and what it is."""

    module: str
    seconds: float
    about: str


PARTS = {
    "polygon": Part("tests.bench.device.polygon", 60.0, "polygonal differences"),
    "spreadlets": Part("tests.bench.device.spreadlets", 50.0, "Laplacian spreadlets"),
    "lrdm": Part("tests.bench.device.reconstruction", 60.0, "layered reconstruction for defocus and motion"),
    "sweep": Part("tests.bench.device.sweep", 25.0, "plane sweep"),
    "tracing": Part("tests.bench.device.tracing", 35.0, "rays of lens models"),
    "tests": Part("tests.bench.device.device_tests", 90.0, "tests of what runs on a device"),
    "training": Part("tests.bench.device.training_steps", 50.0, "training steps of the published network"),
    "network": Part("tests.bench.device.networks", 70.0, "the published network"),
}
DEFAULT_S, GRACE_S, LOOK_S = 60.0, 20.0, 0.3


class OutOfTimeError(BaseException):
    """The time of a part is up; no exception, so that nothing on the way takes it for a mistake of its own."""


@contextmanager
def at_most(seconds: float) -> Iterator[None]:
    """Stop what runs inside when the time is up; by a signal, which Python hears between two of its steps."""

    def stop(_number: int, _frame: FrameType | None) -> None:
        raise OutOfTimeError(f"stopped after its {seconds:.0f} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, max(seconds, 0.01))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def run_part(name: str, run: "Run", keep: Callable[["PartResult"], None]) -> "PartResult":
    """Run a part in this process, whatever becomes of it; what there is so far is kept after each of its rows."""
    from tests.bench.device.page import PartResult, in_words

    part, begun_s = part_named(name), time.monotonic()
    result = PartResult(name, part.about)
    try:
        with at_most(run.left_s):
            for row in importlib.import_module(part.module).rows(run):
                row = replace(row, bar_ms=None, bar_ratio=None) if run.small else row  # bars are for GPUs
                result.rows.append(row)
                result.seconds = time.monotonic() - begun_s
                run.tell(f"  {in_words(row)}")
                keep(result)
    except OutOfTimeError as late:
        result.failed = str(late)
    except Exception:
        result.failed = "\n".join(traceback.format_exc().strip().splitlines()[-TRACEBACK_LINES:])
    result.seconds = time.monotonic() - begun_s
    if result.failed:
        run.tell(f"  failed: {result.failed.splitlines()[-1]}")
    keep(result)
    return result


def run_alone(name: str, seconds: float, page: "Page", out: Path) -> None:
    """Run a part in a process of its own; the page follows what that has kept."""
    from tests.bench.device.page import PartResult

    kept = out / "parts" / f"{name}.json"
    kept.unlink(missing_ok=True)
    page.parts.append(PartResult(name, part_named(name).about))
    command = [sys.executable, "-m", __spec__.name if __name__ == "__main__" else __name__, "--alone", name]
    running = subprocess.Popen([*command, "--seconds", f"{seconds:.1f}", "--out", str(out)])
    begun_s, seen = time.monotonic(), ""
    while (ended := running.poll() is not None) or time.monotonic() - begun_s < seconds + GRACE_S:
        if kept.is_file() and (text := kept.read_text(encoding="utf-8")) != seen:
            seen = text
            page.parts[-1] = PartResult.of(json.loads(text))
            page.write()
        if ended:
            break
        time.sleep(LOOK_S)
    else:
        running.kill()
        running.wait()
    if running.returncode and not page.parts[-1].failed:
        page.parts[-1].failed = f"its process ended with {running.returncode} after {time.monotonic() - begun_s:.0f} s"
        tell(f"  failed: {page.parts[-1].failed}")
    page.write()
    kept.unlink(missing_ok=True)
    with suppress(OSError):
        kept.parent.rmdir()


def alone(name: str, seconds: float, out: Path) -> int:
    """Run a part in this process and keep what it yields in a file; returns 0 whatever became of it."""
    import torch

    from tests.bench.device.page import written
    from tests.bench.device.rows import Run

    device = "cuda" if torch.cuda.is_available() else "cpu"
    if device == "cpu":
        torch.set_num_threads(1)  # small pictures gain nothing from threads, which wait for one another
    path = out / "parts" / f"{name}.json"
    run = Run(torch.device(device), device == "cpu", time.monotonic() + seconds, tell)
    run_part(name, run, lambda result: written(path, json.dumps(result.to_json(), indent=1)))
    return 0


def part_named(name: str) -> Part:
    """Return a part by its name, or any module with `rows(run)` by its own name with dots."""
    return PARTS.get(name) or Part(name, DEFAULT_S, "")


def lacking(names: Sequence[str]) -> list[str]:
    return [name for name in names if find_spec(name) is None]


def unusable(names: Sequence[str]) -> list[str]:
    """Return what cannot be imported and why: numba, for one, refuses a numpy that is newer than it knows."""
    found = []
    for name in names:
        try:
            importlib.import_module(name)
        except ImportError as error:
            found.append(f"{name} ({' '.join(str(error).split())})")
    return found


def tell(words: str) -> None:
    print(words, flush=True)


def chosen(words: str) -> list[str]:
    """Return the names of parts in a list with commas; all where it is empty."""
    names = [name.strip() for name in words.split(",") if name.strip()] or list(PARTS)
    unknown = [name for name in names if name not in PARTS and "." not in name]
    if unknown:
        sys.exit(f"expected parts of {', '.join(PARTS)}, or modules with dots, got {', '.join(unknown)}")
    return names


def first_line() -> tuple[str, str]:
    """Return (device for torch, what the first line says)."""
    import torch

    if torch.cuda.is_available():
        return "cuda", f"Run on {torch.cuda.get_device_name()}, CUDA {torch.version.cuda}, torch {torch.__version__}."
    why = f"torch {torch.__version__} sees no CUDA device"
    return "cpu", f"No GPU here ({why}): the same code by torch on the processor, smaller. These are not a GPU's times."


def arguments(words: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("bench_out/device"), help="folder of device.md and device.json")
    parser.add_argument("--parts", default="", help=f"with commas between them, of {', '.join(PARTS)}")
    parser.add_argument("--seconds", type=float, default=WHOLE_S, help="for all parts together")
    parser.add_argument("--commit", default="", help="where git is not there to say it")
    parser.add_argument("--alone", default="", help=argparse.SUPPRESS)
    return parser.parse_args(words)


def main(words: Sequence[str] | None = None) -> int:
    """Run the chosen parts; returns 1 if any failed."""
    begun_s, asked = time.monotonic(), arguments(words)
    if asked.alone:
        return alone(asked.alone, asked.seconds, asked.out)
    if missing := unusable(NEEDED):
        sys.exit(f"nothing can be measured without what everything here imports: {', '.join(missing)}")
    names = chosen(asked.parts)
    from tests.bench.device.page import Page, machine_facts

    device, first = first_line()
    tell(first)
    page = Page(asked.out, machine_facts(device, first, asked.commit))
    page.lacking = [f"{name} is missing: {WANTED[name]}" for name in lacking(tuple(WANTED))]
    for sentence in page.lacking:
        tell(sentence)
    for name in names:
        part, left_s = part_named(name), asked.seconds - (time.monotonic() - begun_s)
        seconds = min(part.seconds, max(left_s, 1.0))
        tell(f"{name}: {part.about or part.module}, at most {seconds:.0f} s of {left_s:.0f} s left")
        run_alone(name, seconds, page, asked.out)
    tell(f"{asked.out / 'device.md'}, after {time.monotonic() - begun_s:.0f} s")
    return int(any(part.failed for part in page.parts))


if __name__ == "__main__":
    sys.exit(main())

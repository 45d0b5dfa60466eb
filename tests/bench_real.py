"""Real focus stacks and pairs from strangers' cameras: `python -m tests.bench_real DATA --out PAGE.html [--only PATTERN] [--workers N]`."""

import argparse
import fnmatch
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

from capture.report.detail import SharpestSlices
from tests.machine import machine_line
from tests.real_bench_sets import RealStack, find_stacks, missing_sets
from tests.real_bench_stack import Figures, capture, own_figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", help="folder with sets of real stacks; what is not there is skipped")
    parser.add_argument("--only", default="*", help="stacks whose name matches, such as 'lytro_stacks/1*'")
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    if options.data is None:
        print("no folder of real stacks was given: nothing is measured")
        return
    stacks = [stack for stack in find_stacks(options.data) if fnmatch.fnmatch(stack.name, options.only)]
    print(f"{len(stacks)} stacks; not there: {', '.join(missing_sets(options.data)) or 'nothing'}")
    with ProcessPoolExecutor(options.workers) as pool:
        for done in as_completed([pool.submit(measure, stack) for stack in stacks]):
            print(done.result(), flush=True)
    print(machine_line())


def measure(stack: RealStack) -> str:
    with tempfile.TemporaryDirectory() as folder:
        captured = capture(stack, Path(folder))
        if captured.failure:
            return f"{stack.name:24s} {captured.failure}"
        made = captured.stack()
        figures = own_figures(captured, SharpestSlices.of(made.iter_rgb()).measure(made.all_in_focus()))
        return line(stack.name, figures)


def line(name: str, figures: Figures) -> str:
    return f"{name:24s} lost {100 * figures.lost:6.2f} %  flat {figures.flat:5.2f}  top {figures.top:6.2f}  {figures.cpu_s:6.1f} CPU s {figures.memory_mb:6.0f} MB"


if __name__ == "__main__":
    sys.exit(main())

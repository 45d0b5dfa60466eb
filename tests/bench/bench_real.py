"""Real focus stacks from strangers' cameras: `python -m tests.bench.bench_real DATA --out PAGE.html`.

Every stack and pair in DATA goes through `mrbokeh capture` with no option set, each command a process of its own. Measured, without truth
(capture.report.picture_sharpness): lost, the share of textured blocks with less than 60 % of the detail of their sharpest slice; flat, how
much flat blocks are raised by seams and noise; top, the largest value over that of the slices; unlike, the share of ours that no
slice shows (capture.merging.ghosts). The first three of FocusWeave and of enfuse after
align_image_stack where they are installed (on the path, or where FOCUSWEAVE, ENFUSE and ALIGN_IMAGE_STACK say), CPU seconds and memory of
all, slices left out and made again by refocusing, focus positions beside stated ones, and the rank of fused pairs among published methods.

What is measured is kept in a folder beside PAGE, by photographs, program and peers, so that a run that was stopped goes on.
`--pairs FOLDER` only ranks fused pictures (PAIR.png), whoever made them.
"""

import argparse
import fnmatch
import traceback
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from pathlib import Path

from tests.bench.fusion_measures import MEASURES
from tests.bench.machine import machine_line, memory_line
from tests.bench.real_page import Bench, summary_lines, write_bench_page
from tests.bench.real_pairs import OURS, Ranking, agreements, fused_beside, rank_fused, scores_by_others
from tests.bench.real_peers import peers_present
from tests.bench.real_result import PEERS, REFOCUS, Measuring, StackResult
from tests.bench.real_sets import PAIR_SET, RealStack, find_stacks, missing_sets
from tests.bench.real_stack import Figures

PAGE = Path("bench_out") / "real.html"
SHOWN_METHODS = 6


def main() -> None:
    options = _options()
    if options.data is None or not options.data.is_dir():
        print(f"nothing is measured: expected a folder of real stacks, got {options.data}")
        return
    cache = options.out.with_name(options.out.stem + "_cache")
    cache.mkdir(parents=True, exist_ok=True)
    if options.pairs:
        print_ranking(rank_fused(options.data, cache, fused_beside(options.pairs, options.data)))
        return
    peers = {} if PEERS in options.skip else peers_present()
    told = [machine_line(), f"peers: {', '.join(f'{name} {version}' for name, version in peers.items()) or 'none'}"]
    told.append(f"not in the folder: {', '.join(missing_sets(options.data)) or 'nothing'}")
    print("\n".join(told))
    stacks = [stack for stack in find_stacks(options.data) if fnmatch.fnmatch(stack.name, options.only)]
    measuring = Measuring(cache, peers, REFOCUS not in options.skip, options.redo)
    results = sorted(
        measure_all(stacks, measuring, options.workers), key=lambda result: [stack.name for stack in stacks].index(result.name)
    )
    ranking = _ranking(options.data, measuring, results)
    published = agreements(options.data, scores_by_others(options.data, cache)) if ranking else []
    bench = Bench(results, list(peers), told, measuring.crop_folder(), ranking, published)
    write_bench_page(options.out, bench)
    if ranking:
        print_ranking(ranking)
    print("\n".join([*summary_lines(bench), memory_line(), f"wrote {options.out}"]))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", help="folder with sets of real stacks; what is not there is skipped")
    parser.add_argument("--out", type=Path, default=PAGE, help="the page; results are kept beside it")
    parser.add_argument("--only", default="*", metavar="PATTERN", help="stacks whose name matches, such as 'lytro_stacks/1*'")
    parser.add_argument("--workers", type=int, default=1, help="stacks measured at once")
    parser.add_argument("--skip", nargs="*", default=[], choices=(PEERS, REFOCUS), help="what not to measure")
    parser.add_argument("--redo", action="store_true", help="measure again what was measured before; what peers made is kept")
    parser.add_argument("--pairs", type=Path, metavar="FOLDER", help="only rank the fused pairs in this folder")
    return parser.parse_args()


def measure_all(stacks: list[RealStack], measuring: Measuring, workers: int) -> Iterator[StackResult]:
    with ProcessPoolExecutor(workers) as pool:
        waiting = [pool.submit(partial(_measured, measuring), stack) for stack in stacks]
        for number, done in enumerate(as_completed(waiting), 1):
            result = done.result()
            print(f"{number:3d} of {len(stacks)}  {line(result)}", flush=True)
            yield result


def _measured(measuring: Measuring, stack: RealStack) -> StackResult:
    """A fault of the bench itself is that stack's failure, not the end of the run."""
    try:
        return measuring.of(stack)
    except Exception as error:
        traceback.print_exc()
        return StackResult(stack.name, len(stack.photographs), f"the bench failed: {error!r}", {})


def line(result: StackResult) -> str:
    figures = "   ".join(f"{name}: {_words(each)}" for name, each in result.figures.items())
    refocus = f"   left out {result.refocus.rendered_db:.1f} dB" if result.refocus and result.refocus.rendered_db is not None else ""
    return f"{result.name:22s} {figures}{refocus} {result.failure}"


def _words(figures: Figures) -> str:
    if figures.lost is None or figures.flat is None or figures.top is None:
        return figures.said
    cost = "" if figures.cpu_s is None or figures.memory_mb is None else f" {figures.cpu_s:5.1f} s {figures.memory_mb:4.0f} MB"
    unlike = "" if figures.unlike is None else f" unlike {100 * figures.unlike:5.3f} %"
    return f"lost {100 * figures.lost:5.2f} % flat {figures.flat:4.2f} top {figures.top:5.2f}{unlike}{cost}"


def _ranking(data: Path, measuring: Measuring, results: list[StackResult]) -> Ranking | None:
    """Of the pairs that this run measured."""
    names = {result.name for result in results if result.name.startswith(PAIR_SET + "/") and result.figures}
    if not names:
        return None
    fused = {path.stem: path for path in (measuring.cache / "fused").glob("*.png") if f"{PAIR_SET}/{path.stem}" in names}
    try:
        return rank_fused(data, measuring.cache, fused)
    except ValueError as error:
        print(f"pairs are not ranked: {error}")
        return None


def print_ranking(ranking: Ranking) -> None:
    print(f"{len(ranking.pairs)} pairs, {len(ranking.methods)} methods: mean ranks, by {', '.join(MEASURES)}, and mean values")
    rows = ranking.table()
    for number, (method, rank, by_measure, means) in enumerate(rows, 1):
        if number <= SHOWN_METHODS or method == OURS:
            ranks, values = "  ".join(f"{each:5.2f}" for each in by_measure), "  ".join(f"{each:.4f}" for each in means)
            print(f"{number:3d}. {method:10s} {rank:5.2f}   {ranks}   {values}")


if __name__ == "__main__":
    main()

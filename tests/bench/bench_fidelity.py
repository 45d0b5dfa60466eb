"""How close to the truth every renderer comes: `python -m tests.bench.bench_fidelity [--truth DIR] [--methods a,b] [--keep DIR]`.

Cards: flat cards with an exact thin-lens truth; PSNR of displayed pictures, from a picture with depth and from all layers.
Ray traced: folders of datasets_scripts.render_truth; PSNR of linear light clipped to [0, 1]. Prints Markdown. lrdm, which traces minutes of
rays for a picture with depth, is measured where it is named.
"""

import argparse
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.choose import BY_NAME, make_renderer
from tests.bench.fidelity_baselines import BASELINES, gegl_lens_blur, has_gegl
from tests.bench.machine import tell
from tests.support.fidelity_cases import CARD_RADII_PX, Case, card_cases, truth_cases

Blur = Callable[[Sequence[Layer], Lens], np.ndarray]
Rows = dict[tuple[str, str], list[tuple[Case, dict[str, float]]]]
RGBD, LAYERS = "RGB + depth", "layers"


def methods(wanted: Sequence[str]) -> dict[str, Blur]:
    """Baselines and renderers by name; all but lrdm where none is wanted."""

    def of_baseline(name: str) -> Blur:
        return lambda layers, lens: BASELINES[name](layers[0], lens)

    def of_renderer(name: str) -> Blur:
        renderer = make_renderer(name)
        return lambda layers, lens: renderer.render(layers, lens).rgb

    every = {name: of_baseline(name) for name in BASELINES}
    if has_gegl():
        every["GEGL lens-blur"] = lambda layers, lens: gegl_lens_blur(layers[0], lens)
    every |= {name: of_renderer(name) for name in BY_NAME}
    return {name: blur for name, blur in every.items() if (name in wanted if wanted else name != "lrdm")}


def measured(cases: Iterable[Case], blurs: dict[str, Blur]) -> Rows:
    """Every method on every case; layers only go to renderers, GEGL only knows discs."""
    rows: Rows = defaultdict(list)
    for case in cases:
        for name, blur in blurs.items():
            if name == "GEGL lens-blur" and case.shape != "disc":
                continue
            inputs = {RGBD: [case.picture], **({LAYERS: case.layers} if case.layers and name in BY_NAME else {})}
            for kind, layers in inputs.items():
                started_s = time.perf_counter()
                result = blur(layers, case.lens)
                seconds = time.perf_counter() - started_s
                rows[name, kind].append((case, {**case.measure(result), "seconds": seconds}))
        print(f"  {case.group} {case.name}", file=sys.stderr, flush=True)
    return rows


def _mean(results: Iterable[tuple[Case, dict[str, float]]], measure: str, **where: str) -> str:
    """Mean of a measure over the cases whose fields are as said; of energy the mean and the worst excess, of times the median."""
    chosen = [values[measure] for case, values in results if all(getattr(case, key) == value for key, value in where.items())]
    chosen = [value for value in chosen if not np.isnan(value)]
    if not chosen:
        return "-"
    if measure == "energy":
        return f"{100 * (np.mean(chosen) - 1):+.2f} ({100 * max(abs(value - 1) for value in chosen):.2f})"
    return f"{np.median(chosen) if measure == 'seconds' else np.mean(chosen):.1f}"


def _table(title: str, head: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    lines = [f"### {title}", "", "| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in body), ""])


def card_table(rows: Rows) -> str:
    head, body = ["method", "from"], []
    for radius_px in CARD_RADII_PX:
        head += [f"{radius_px} px", "edges", "lights", "energy % (worst)"]
    for (name, kind), results in rows.items():
        cells = [name, kind]
        for radius_px in CARD_RADII_PX:
            cells += [_mean(results, each, group=f"cards {radius_px} px") for each in ("frame", "edges", "lights", "energy")]
        body.append([*cells, _mean(results, "seconds")])
    return _table("Cards: display PSNR in dB at a largest CoC radius of 12 and 32 px", [*head, "s"], body)


def truth_table(rows: Rows) -> str:
    head = ["method", "from", "thin", "edges", "lights", "open", "edges", "lights", "energy % (worst)", "s"]
    body = []
    for (name, kind), results in rows.items():
        cells = [_mean(results, each, group=group) for group in ("thin", "open") for each in ("frame", "edges", "lights")]
        body.append([name, kind, *cells, _mean(results, "energy"), _mean(results, "seconds")])
    return _table("Ray traced: linear PSNR in dB", head, body)


def shape_table(rows: Rows) -> str:
    shapes = list(dict.fromkeys(case.shape for results in rows.values() for case, _ in results))
    head = ["method", "from", *(f"{shape}, {what}" for shape in shapes for what in ("frame", "lights"))]
    body = []
    for (name, kind), results in rows.items():
        body.append([name, kind, *(_mean(results, each, shape=shape) for shape in shapes for each in ("frame", "lights"))])
    return _table("Ray traced, by the shape of the aperture: whole frame, and where lights reach", head, body)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--truth", type=Path, default=Path(__file__).parents[1] / "data" / "truth", help="folder of ray-traced scenes")
    parser.add_argument("--methods", default="", help="names of methods, separated by commas; all but lrdm where left out")
    parser.add_argument("--card-seeds", type=int, nargs="*", default=[0, 1], help="card scenes; none: leave them out")
    parser.add_argument("--keep", type=Path, help="folder in which the truths of the cards are kept from run to run")
    arguments = parser.parse_args()
    blurs = methods([name for name in arguments.methods.split(",") if name])
    if arguments.card_seeds:
        print(card_table(measured(card_cases(arguments.card_seeds, arguments.keep), blurs)))
    traced = measured(truth_cases(arguments.truth), blurs)
    if traced:
        print(truth_table(traced))
        print(shape_table(traced))
    print("'Lights' are the pixels that a light reaches; 'energy' is what the picture has too much, as a mean and at worst.")
    tell()


if __name__ == "__main__":
    main()

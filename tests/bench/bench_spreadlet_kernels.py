"""Fig. 10 and the ablation of Leimkuehler et al. 2018 for our spreadlets, in numbers.

    python -m tests.bench.bench_spreadlet_kernels OUT [--largest 128 --kernels 80 --parts codes,ablation]

OUT/PART.json holds the numbers of a part. Finished parts are kept, so an interrupted run goes on where it stopped.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from mrbokeh.optics.psf_bank import physical_boxes
from mrbokeh.optics.psf_grid import NestedGrid
from mrbokeh.psf_models.build import Combined
from mrbokeh.renderers.kernels.laplacian_integration import laplacian
from mrbokeh.renderers.kernels.spreadlets import (
    Sparsification,
    Spreadlet,
    fitted_values,
    moments,
    outline_px,
    potential_of,
    sparsify,
    table_for,
    whole_laplacian,
)
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError
from tests.bench.kernel_codes import (
    Corpus,
    Kernel,
    Likeness,
    QuadTree,
    Window,
    alike,
    around,
    clean,
    is_line,
    likeness_of,
    mean_of,
    picture_of,
    quad_tree,
    quad_tree_points,
)

OPERATIONAL_POINTS = (0.5, 1.0, 2.0)
SAMPLE_STEPS = (12, 25, 50, 75, 110, 150)
SPARSITIES = (0.001, 0.002, 0.005, 0.01, 0.02, 0.04)
GAUSSIANS_PX, RADII_PX, CAPSULES_PX = (25.0, 40.0, 55.0), (25.0, 50.0, 100.0), ((50.0, 50.0), (50.0, 128.0), (100.0, 128.0))
_DEGREE = 3
PLAIN = Sparsification(least_points=1, lloyd_steps=0, annealing_steps=0)
SUMS = replace(PLAIN, fit=False)
Part = dict[str, Any]
_SLOW = {"ablation": 3, "sample_counts": 2}
"""Parts that take a share of the kernels: annealing tries 400 sets of points for each."""


def codes(corpus: Corpus) -> Part:
    """Fig. 10 a to c: spreadlets against quad trees of as many points, sparsity and similarity of every kernel."""
    kernels = corpus.kernels()
    return {f"{factor:g}": _codes_at(kernels, factor, corpus.window_px) for factor in OPERATIONAL_POINTS[:2]}


def _codes_at(kernels: Sequence[np.ndarray], points_per_px: float, window_px: int) -> Part:
    found: dict[str, list[Likeness]] = {"spreadlets": [], "spreadlets, sums": [], "quad tree": [], "Laplacian quad tree": []}
    for kernel in track(kernels, f"quad trees, {points_per_px:g} points per pixel"):
        points = sparsify(kernel, replace(PLAIN, points_per_px=points_per_px))
        sums, count = sparsify(kernel, replace(SUMS, points_per_px=points_per_px)), len(points.points)
        forms: Sequence[Spreadlet | QuadTree] = (points, sums, quad_tree(kernel, count), quad_tree_points(kernel, count, fit=True))
        for each, form in zip(found.values(), forms, strict=True):
            each.append(likeness_of(form, kernel, window_px))
    return {name: {"mean": mean_of(each), "each": [asdict(one) for one in each]} for name, each in found.items()}


def operational_points(corpus: Corpus) -> Part:
    """Fig. 10 d: half, once and twice as many points."""
    kernels, out = corpus.kernels(), {}
    for factor in OPERATIONAL_POINTS:
        settings = replace(PLAIN, points_per_px=factor)
        found = [likeness_of(sparsify(k, settings), k, corpus.window_px) for k in track(kernels, f"{factor:g} points per pixel")]
        out[f"{factor:g}"] = mean_of(found)
    return out


def sample_counts(corpus: Corpus) -> Part:
    """Fig. 10 e: the kernel of the nearest sample of the paper's grid against that of random coordinates, whole and as spreadlets."""
    coords = np.random.default_rng(corpus.seed).uniform(0.0, corpus.largest_px, (corpus.count, 2))
    out: Part = {}
    for steps in SAMPLE_STEPS:
        model, grid = Combined(corpus.largest_px, corpus.largest_px, (steps, steps)), NestedGrid((steps, steps))
        boxes = physical_boxes(model.axes, grid)
        cells = grid.index_of(np.stack([axis.to_unit(coords[:, index]) for index, axis in enumerate(model.axes)], axis=1))
        forms = _forms_of(partial(_cell_kernel, model, boxes), corpus.window_px)
        rows = []
        for coordinate, cell in track(list(zip(coords, cells.tolist(), strict=True)), f"{len(grid)} samples"):
            truth = clean(model.exact(coordinate))
            rows.append([alike(form, around(truth, corpus.window_px), len(truth))[1] for form in forms(cell)])
        names = ("whole", *(f"{factor:g}" for factor in OPERATIONAL_POINTS))
        out[str(len(grid))] = dict(zip(names, np.mean(rows, axis=0).tolist(), strict=True))
    return out


def shapes(corpus: Corpus) -> Part:  # noqa: ARG001
    """Fig. 10 f: Gaussians, discs and capsules of the paper's sizes at several sparsities, with fitted values and with the paper's sums."""
    out: Part = {}
    for name, kernel in track(list(_shapes()), "shapes"):
        taps, outline = np.count_nonzero(kernel), outline_px(kernel)
        for values, base in (("fitted", PLAIN), ("sums", SUMS)):
            settings = [replace(base, points_per_px=share * taps / outline) for share in SPARSITIES]
            found = [asdict(likeness_of(sparsify(kernel, each), kernel, len(kernel) + 2)) for each in settings]
            out.setdefault(values, {})[name] = found
    return out


def ablation(corpus: Corpus) -> Part:
    """Section 7.3, "Optimization": L1 error of each set of steps relative to darts alone, for three kinds of values.

    "sums" over Voronoi cells are the paper's; "moments" are those with the least change that keeps light and centroid;
    "fitted" are mrbokeh's.
    """
    steps = {"darts": (0, 0), "+ Lloyd": (50, 0), "+ annealing": (0, 400), "all": (50, 400)}
    errors: dict[str, dict[str, list[Likeness]]] = {values: {name: [] for name in steps} for values in ("sums", "moments", "fitted")}
    for kernel in track(corpus.kernels(), "ablation"):
        fitted, settled = _values_of(kernel)
        for name, (lloyd, annealing) in steps.items():
            points = sparsify(kernel, replace(SUMS, lloyd_steps=lloyd, annealing_steps=annealing))
            for named, form in zip(errors.values(), (points, settled(points), fitted(points)), strict=True):
                named[name].append(likeness_of(form, kernel, corpus.window_px))
    out: Part = {values: {name: mean_of(each) for name, each in named.items()} for values, named in errors.items()}
    for named in out.values():
        for each in named.values():
            each["of_darts"] = each["l1"] / named["darts"]["l1"]
    return out


PARTS: Mapping[str, Callable[[Corpus], Part]] = {
    "codes": codes,
    "operational_points": operational_points,
    "sample_counts": sample_counts,
    "shapes": shapes,
    "ablation": ablation,
}


def _cell_kernel(model: Combined, boxes: np.ndarray, cell: int) -> Kernel:
    return clean(model.kernel(boxes[cell], 0, 0))


def _forms_of(kernel_of: Callable[[int], Kernel], window_px: int) -> Callable[[int], Sequence[Window]]:
    """Pictures of a cell's kernel, whole and as spreadlets of each operational point; each cell is computed once."""

    @cache
    def forms(cell: int) -> Sequence[Window]:
        kernel = kernel_of(cell)
        picture = around(kernel, window_px)
        if is_line(kernel):
            return [picture] * (1 + len(OPERATIONAL_POINTS))
        sparse = (sparsify(kernel, replace(PLAIN, points_per_px=factor)) for factor in OPERATIONAL_POINTS)
        return [picture, *(picture_of(each, window_px) for each in sparse)]

    return forms


def _values_of(kernel: Kernel) -> tuple[Callable[[Spreadlet], Spreadlet], Callable[[Spreadlet], Spreadlet]]:
    """Other values for given points: by least squares, as `sparsify` fits them, and the same with moments mended."""
    whole, dense = whole_laplacian(kernel), laplacian(kernel[..., None])
    table, scale_px = table_for(len(dense)), 0.5 * len(dense)
    potential, xy = potential_of(dense, table), whole.points.astype(np.int64)
    wanted = moments(xy, scale_px, _DEGREE).T @ whole.values

    def fitted(sparse: Spreadlet) -> Spreadlet:
        return Spreadlet(sparse.points, fitted_values(sparse.points.astype(np.int64), xy, whole.values, potential, table))

    def settled(sparse: Spreadlet) -> Spreadlet:
        held = moments(sparse.points.astype(np.int64), scale_px, _DEGREE)
        change = np.linalg.lstsq(held.T, wanted - held.T @ sparse.values, rcond=None)[0]
        return Spreadlet(sparse.points, sparse.values + change)

    return fitted, settled


def _shapes() -> Iterable[tuple[str, np.ndarray]]:
    for size, sigma_px in zip("SML", GAUSSIANS_PX, strict=True):
        radius = int(np.ceil(3.5 * sigma_px))
        x = np.arange(-radius, radius + 1)
        bell = np.exp(-0.5 * (x / sigma_px) ** 2)
        yield f"Gaussian {size}", np.outer(bell, bell) / bell.sum() ** 2
    model = Combined()
    for size, radius_px in zip("SML", RADII_PX, strict=True):
        yield f"disc {size}", clean(model.exact(np.array([2.0 * radius_px, 0.0])))
    for size, (radius_px, length_px) in zip("SML", CAPSULES_PX, strict=True):
        yield f"capsule {size}", clean(model.exact(np.array([2.0 * radius_px, length_px])))


def analyse(out: Path, parts: list[str], largest_px: float, count: int, seed: int) -> int:
    """Compute the parts that are missing and return their number."""
    if unknown := [name for name in parts if name not in PARTS]:
        raise InputError(f"expected parts out of {', '.join(PARTS)}, got {', '.join(unknown)}")
    settings = {"largest_px": largest_px, "kernels": count, "seed": seed}
    waiting = [name for name in parts if not _is_there(out, name, settings)]
    for name in waiting:
        corpus = Corpus(largest_px, max(1, count // _SLOW.get(name, 1)), seed)
        write_json(_path(out, name), {"settings": settings, "found": PARTS[name](corpus)})
    return len(waiting)


def _is_there(out: Path, name: str, settings: dict) -> bool:
    if not _path(out, name).is_file():
        return False
    if read_json(_path(out, name), "a part of the analysis")["settings"] != settings:
        raise InputError(f"{_path(out, name)} was made with other settings: choose another folder, or remove it")
    return True


def _path(out: Path, name: str) -> Path:
    return out / f"{name}.json"


def main(
    out: Annotated[Path, typer.Argument(help="Folder for the numbers.")],
    parts: Annotated[str, typer.Option(help="With commas between them; all unless given.")] = ",".join(PARTS),
    largest: Annotated[float, typer.Option(help="Largest diameter and motion in pixels; 256 in the paper.")] = 128.0,
    kernels: Annotated[int, typer.Option(help="How many kernels are drawn from the bank of 392.")] = 80,
    seed: int = 0,
) -> None:
    """Compute the missing parts."""
    try:
        made = analyse(out, parts.split(","), largest, kernels, seed)
    except InputError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from None
    typer.echo(f"{out}: {made} parts computed")


if __name__ == "__main__":
    typer.run(main)

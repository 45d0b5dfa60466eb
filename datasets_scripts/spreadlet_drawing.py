"""The analysis of spreadlets drawn as in Leimkuehler et al. 2018, Fig. 10."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mrbokeh.system.atomic_files import atomic_path

_OURS, _TREE, _GREY = "#c0392b", "#2c6fbb", "#777777"
_AS_SPARSE = "0.5"
"""The operational point whose mean sparsity is that of the paper."""
_SHAPE_COLOURS = {"Gaussian": _GREY, "disc": _OURS, "capsule": _TREE}
_TICKS = (0.2, 0.5, 1.0, 2.0, 4.0)
_STYLES = {"S": ":", "M": "--", "L": "-"}


def draw_parts(parts: Mapping[str, Any], path: Path) -> None:
    """All parts that are there in one picture; the panels of the others stay empty."""
    figure = Figure(figsize=(11.0, 6.6), dpi=80, layout="constrained")
    axes = figure.subplots(2, 3).reshape(-1)
    panels: tuple[tuple[str, Callable[[Axes, Any], None]], ...] = (
        ("codes", lambda axis, found: _means(axis, found[_AS_SPARSE])),
        ("codes", lambda axis, found: _histogram(axis, found[_AS_SPARSE], "sparsity")),
        ("codes", lambda axis, found: _histogram(axis, found[_AS_SPARSE], "similarity_near")),
        ("operational_points", _operational_points),
        ("sample_counts", _sample_counts),
        ("shapes", _shapes),
    )
    for letter, axis, (name, draw) in zip("abcdef", axes, panels, strict=True):
        axis.set_title(f"{letter})", loc="left")
        if name in parts:
            draw(axis, parts[name])
        axis.spines[["top", "right"]].set_visible(False)
    with atomic_path(path) as temporary:
        figure.savefig(temporary)


def _means(axis: Axes, found: Any) -> None:
    names = list(found)
    places = np.arange(len(names))
    for shift, measure, colour in ((-0.2, "similarity_near", _OURS), (0.2, "sparsity", _TREE)):
        bars = axis.bar(places + shift, [found[name]["mean"][measure] for name in names], 0.4, color=colour, label=measure.split("_")[0])
        axis.bar_label(bars, fmt="%.3f", fontsize=7)
    axis.set_xticks(places, [name.replace("spreadlets, sums", "\nsums").replace("Laplacian ", "Laplacian\n") for name in names], fontsize=8)
    axis.set_ylim(0.0, 1.25)
    axis.legend(frameon=False, fontsize=8, loc="upper right", ncols=2)


def _histogram(axis: Axes, found: Any, measure: str) -> None:
    for name, colour in (("spreadlets", _OURS), ("quad tree", _TREE)):
        axis.hist([each[measure] for each in found[name]["each"]], bins=20, range=(0.0, 1.0), histtype="step", color=colour, label=name)
    axis.set_xlabel(measure.split("_")[0])
    axis.set_ylabel("kernels")
    axis.legend(frameon=False, fontsize=8)


def _operational_points(axis: Axes, found: Any) -> None:
    points = [(100.0 * each["sparsity"], each["similarity_near"], f"{name} per px") for name, each in found.items()]
    axis.plot([x for x, _, _ in points], [y for _, y, _ in points], "o-", color=_OURS)
    for x, y, name in points:
        axis.annotate(name, (x, y), textcoords="offset points", xytext=(4, -12), fontsize=8)
    axis.set_xlabel("sparsity (%)")
    axis.set_ylabel("similarity")
    axis.margins(0.2)


def _sample_counts(axis: Axes, found: Any) -> None:
    counts = [int(count) for count in found]
    for name, style in (("whole", "-"), ("2", "-."), ("1", "--"), ("0.5", ":")):
        label = "whole kernels" if name == "whole" else f"{name} points per px"
        axis.plot(counts, [each[name] for each in found.values()], style, color=_OURS, marker=".", label=label)
    axis.set_xscale("log")
    axis.minorticks_off()
    axis.set_xticks(counts, [str(count) for count in counts])
    axis.set_xlabel("samples of the bank")
    axis.set_ylabel("similarity to the exact kernel")
    axis.legend(frameon=False, fontsize=8)


def _shapes(axis: Axes, found: Any) -> None:
    for name, each in found["fitted"].items():
        kind, size = name.split()
        x, y = [100.0 * one["sparsity"] for one in each], [one["similarity"] for one in each]
        axis.plot(x, y, _STYLES[size], color=_SHAPE_COLOURS[kind], label=name)
    axis.set_xscale("log")
    axis.minorticks_off()
    axis.set_xticks(_TICKS, [f"{tick:g}" for tick in _TICKS])
    axis.set_xlabel("sparsity (%)")
    axis.set_ylabel("similarity")
    axis.legend(frameon=False, fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))

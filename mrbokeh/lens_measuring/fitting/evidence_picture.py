"""A picture of how well a measured lens explains the slices it was measured on, and of what it was measured from."""

from typing import TYPE_CHECKING

import numpy as np

from mrbokeh.lens_measuring.fitting.lens_fit import LensFit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SIDES = ("in front", "behind")


def draw_evidence(fit: LensFit) -> "Figure":
    """What is left of each slice by a disc, the stated aperture and the kernels; pixels and lights of each knot."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 5), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.6, 1.0))
    _draw_scores(left, fit)
    _draw_counts(right, fit)
    return figure


def _draw_scores(axes: "Axes", fit: LensFit) -> None:
    places = np.arange(len(fit.scores))
    for name, label, marker in (("disc", "a disc", "x"), ("stated", "aperture of the stack", "+"), ("fitted", "this lens", "o")):
        axes.plot(places, [getattr(score, name) for score in fit.scores], marker, label=label, mfc="none")
    axes.set_xticks(places, [f"{score.stack} {score.index}" for score in fit.scores], rotation=90, fontsize=7)
    held_out = any(score.held_out for score in fit.scores)
    axes.set_title("what is left of slices " + ("that the fit has not seen" if held_out else "of the fit"), fontsize=9)
    axes.set_ylabel("rms over the root of radiance")
    axes.grid(alpha=0.3)
    if len(places):
        axes.legend(fontsize=8)
    else:
        axes.text(0.5, 0.5, "lights alone", ha="center", transform=axes.transAxes)


def _draw_counts(axes: "Axes", fit: LensFit) -> None:
    shape = fit.knots.shape
    names = [f"{side} {diameter:.0f} px" for side in _SIDES for diameter in fit.knots.diameters_px]
    pixels, lights = (counts.reshape(shape[0] * shape[1], shape[2]) for counts in (fit.pixels, fit.lights))
    axes.imshow(np.log1p(pixels), aspect="auto", cmap="viridis")
    for row, column in np.ndindex(*pixels.shape):
        text = f"{pixels[row, column]}" + (f"\n{lights[row, column]} lights" if lights[row, column] else "")
        axes.text(column, row, text, ha="center", va="center", fontsize=6, color="white")
    axes.set_yticks(np.arange(len(names)), names, fontsize=8)
    axes.set_xticks(np.arange(shape[2]))
    axes.set_xlabel("ring, from the middle" if fit.knots.rings else "region, row by row")
    axes.set_title("pixels (and lights) that tell", fontsize=9)

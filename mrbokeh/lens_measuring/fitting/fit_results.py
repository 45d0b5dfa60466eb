"""Results of a fit: its kernels as a bank of PSFs, and a picture of its evidence (residuals of slices, pixels and lights of knots)."""

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float32, Float64

from mrbokeh.lens_measuring.fitting.lens_fit import LensFit
from mrbokeh.lens_measuring.fitting.pupil_picture import kernel_of
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import stated_facts
from mrbokeh.optics.psf_bank import Axis, PsfBank, physical_boxes
from mrbokeh.optics.psf_grid import NestedGrid
from mrbokeh.psf_models.base import centred
from mrbokeh.system.console import track

EXPONENT = 1.5  # steps are fine in focus, where a pixel's step changes a kernel most
_STEP_PX, _STEP_SHARE = 0.5, 0.03
_NODES = 3


def bank_of(fit: LensFit, lens: Lens | None = None) -> PsfBank:
    """Return a bank over signed diameters and, if the lens varies over the field, positions (or eccentricity, for a symmetric lens).

    Kernels have one channel where colours share theirs, else three. lens: what the kernels are of, if that is known.
    Each kernel is averaged over its cell's diameters. settings hold for each cell of the bank how many pixels and lights tell of it, and
    how far they disagree with it.
    """
    axes, counts = _axes(fit)
    boxes = physical_boxes(axes, NestedGrid(counts, nested=False))
    kernels = tuple(_kernel(fit, box) for box in track(list(boxes), "bank"))
    turns = "field" if fit.knots.rings else "none"
    settings = ({} if lens is None else {"lens": stated_facts(lens)}) | _settings(fit, boxes)
    return PsfBank(model="measured", axes=axes, counts=counts, kernels=kernels, turns=turns, nested=False, settings=settings)


def _axes(fit: LensFit) -> tuple[tuple[Axis, ...], tuple[int, ...]]:
    high = fit.largest_px
    step = max(_STEP_PX, _STEP_SHARE * high)
    axes = [Axis("diameter_px", -high, high, EXPONENT)]
    counts = [2 * int(np.ceil(EXPONENT * high / step)) + 1]
    if fit.knots.rings:
        axes.append(Axis("eccentricity", 0.0, 1.0))
        counts.append(fit.knots.rings)
    elif fit.knots.fields > 1:
        axes += [Axis(name, -end, end) for name, end in zip(("field_x", "field_y"), fit.knots.highs, strict=True)]
        counts += fit.knots.regions
    return tuple(axes), tuple(counts)


def _field(fit: LensFit, box: Float64[np.ndarray, "axes 2"]) -> int:
    if fit.knots.fields == 1:
        return 0
    middle = box[1:].mean(axis=1)
    return int(fit.knots.fields_at(np.array([middle[0], 0.0 if fit.knots.rings else middle[1]])))


def _kernel(fit: LensFit, box: Float64[np.ndarray, "axes 2"]) -> Float32[np.ndarray, "size size channels"]:
    """Return the mean over diameters of a cell; the cell around the focus holds the focus."""
    low, high = box[0]
    diameters = [0.0] if low < 0.0 < high else low + (np.arange(_NODES) + 0.5) / _NODES * (high - low)
    channels = slice(0, 1 if fit.sharing.colours else 3)
    made = [kernel_of(fit.grid, picture_at(fit, float(each), _field(fit, box))[:, channels], float(each)) for each in diameters]
    size = max(kernel.shape[0] for kernel in made)
    mean = np.mean([centred(kernel, size) for kernel in made], axis=0, dtype=np.float64)
    return (mean / mean.sum(axis=(0, 1))).astype(np.float32)


def picture_at(fit: LensFit, diameter_px: float, field: int) -> Float64[np.ndarray, "cells 3"]:
    """Return the pupil at a signed diameter, for each colour: between the knots' diameters in proportion to the logarithm."""
    pictures = fit.pictures.reshape(*fit.knots.shape, *fit.pictures.shape[1:])[int(diameter_px > 0), :, field]
    known = np.log(fit.knots.diameters_px)
    place = float(np.interp(np.log(max(abs(diameter_px), 1e-6)), known, np.arange(len(known))))
    first = min(int(place), max(len(known) - 2, 0))
    second, share = min(first + 1, len(known) - 1), place - first
    return np.asarray(((1.0 - share) * pictures[first] + share * pictures[second]).T)


def _settings(fit: LensFit, boxes: Float64[np.ndarray, "cells axes 2"]) -> dict[str, Any]:
    knots = [_knot(fit, box) for box in boxes]
    return {
        "pupil_side": fit.grid.side,
        "shared": [name for name, is_one in vars(fit.sharing).items() if is_one],
        "knot_diameters_px": [float(each) for each in fit.knots.diameters_px],
        "pixels": [int(fit.pixels[knot]) for knot in knots],
        "lights": [int(fit.lights[knot]) for knot in knots],
        "errors": [None if np.isnan(fit.errors[knot]) else round(float(fit.errors[knot]), 4) for knot in knots],
        "slices": [vars(score) for score in fit.scores],
    }


def _knot(fit: LensFit, box: Float64[np.ndarray, "axes 2"]) -> int:
    """Return the knot from which most of a cell of the bank comes."""
    in_the_middle = int(fit.knots.at(np.array([box[0].mean()]), np.zeros((1, 2)))[0])
    return in_the_middle // fit.knots.fields * fit.knots.fields + _field(fit, box)


if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SIDES = ("in front", "behind")


def draw_evidence(fit: LensFit) -> "Figure":
    """Draw the residual of each slice under a disc, the stated aperture and the kernels; and the pixels and lights of each knot."""
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

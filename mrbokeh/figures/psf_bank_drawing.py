"""Sheet of a bank of PSFs (kernels over its coordinates, their cells and sizes), and its kernels as pictures for Nuke or Blender."""

import csv
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float64

from mrbokeh.figures.lens_drawing import shown_light
from mrbokeh.images.image_io import write_image
from mrbokeh.optics.psf_bank import Axis, PsfBank
from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError


def export_bank(bank: PsfBank, folder: Path | str, suffix: Literal["exr", "png"], overwrite: bool = False) -> int:
    """Write one picture per cell, 00000.exr and so on, and index.csv with their coordinates. Returns how many pictures.

    EXR holds the values as they are (float). PNG has 16 bits, linear, its largest value white; `peak` in the index is what
    white stands for. The index names for each axis the middle of the cell and its two ends; it is written last.
    """
    folder = Path(folder)
    if suffix not in ("exr", "png"):
        raise InputError(f"kernels are exported as exr or png, got {suffix!r}")
    if folder.exists() and not (folder.is_dir() and (overwrite or not any(folder.iterdir()))):
        raise InputError(f"{folder} exists already: give another name, or --overwrite to write into it")
    rows = []
    for cell, kernel in track(list(enumerate(bank.kernels)), "kernels"):
        peak = float(kernel.max())
        rgb = np.broadcast_to(kernel if suffix == "exr" else kernel / peak, (*kernel.shape[:2], 3))
        name = f"{cell:05d}.{suffix}"
        write_image(folder / name, np.ascontiguousarray(rgb), "linear", half=False)
        places = [value for centre, ends in zip(bank.centres[cell], bank.boxes[cell], strict=True) for value in (centre, *ends)]
        rows.append([name, kernel.shape[0], f"{peak:.9g}", *(f"{value:.9g}" for value in places)])
    titles = [title for axis in bank.axes for title in (axis.name, f"{axis.name}_low", f"{axis.name}_high")]
    with atomic_path(folder / "index.csv") as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([["file", "size_px", "peak", *titles], *rows])
    return len(rows)


if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec

KERNELS_IN_ROW = 6
_TICKS = np.linspace(0.0, 1.0, 5)
_COLOURS = {1: ("black",), 3: ("tab:red", "tab:green", "tab:blue")}
_SHORT = {
    "diameter_px": "circle of confusion, px",
    "motion_px": "motion, px",
    "depth_m": "depth, m",
    "eccentricity": "eccentricity",
    "field_x": "right of the middle, half diagonals",
    "field_y": "below the middle, half diagonals",
}


def draw_bank(bank: PsfBank) -> "Figure":
    """Draw the sheet of a bank."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 8), layout="constrained")
    megabytes = sum(kernel.nbytes for kernel in bank.kernels) / 1e6
    figure.suptitle(
        f"{bank.model}: {len(bank.kernels)} kernels, {bank.channels} channel{'s' * (bank.channels > 1)}, up to "
        f"{2 * bank.radius_px + 1} px, {megabytes:.1f} MB" + (f"; turned by {bank.turns}" if bank.turns != "none" else "")
    )
    columns = figure.add_gridspec(1, 2, width_ratios=(1.5, 1.0))
    _draw_kernels(figure, columns[0, 0], bank)
    right = columns[0, 1].subgridspec(2, 1, height_ratios=(1.4, 1.0))
    (_draw_cells if len(bank.axes) > 1 else _draw_widths)(figure.add_subplot(right[0, 0]), bank)
    absorbs = bool((bank.throughput < 0.999).any())
    (_draw_throughput if absorbs else _draw_sizes)(figure.add_subplot(right[1, 0]), bank)
    return figure


def sampled_cells(bank: PsfBank) -> list[int]:
    """Return the cells whose kernels are drawn: at even steps of the unit coordinates, the second axis downwards, others in their middle.

    In a bank with a knee the steps are those of the logarithm beyond it.
    """
    steps = (np.arange(KERNELS_IN_ROW) + 0.5) / KERNELS_IN_ROW
    if bank.knee_px is not None:
        ends = [axis.high / bank.knee_px for axis in bank.axes]
        columns, rows = (np.expm1(steps * np.log1p(end)) / end for end in ends)
        return [int(cell) for cell in bank.grid.index_of(np.stack(np.meshgrid(columns, rows), axis=-1)).ravel()]
    if len(bank.axes) == 1:
        fine = (np.arange(KERNELS_IN_ROW**2) + 0.5) / KERNELS_IN_ROW**2
        return [int(cell) for cell in bank.grid.index_of(fine[:, None])]
    places = np.full((KERNELS_IN_ROW, KERNELS_IN_ROW, len(bank.axes)), 0.5)
    places[..., 0], places[..., 1] = steps[None, :], steps[:, None]
    return [int(cell) for cell in bank.grid.index_of(places).ravel()]


def _draw_kernels(figure: "Figure", place: "SubplotSpec", bank: PsfBank) -> None:
    cells = sampled_cells(bank)
    grid = place.subgridspec(KERNELS_IN_ROW, KERNELS_IN_ROW)
    for index, cell in enumerate(cells):
        axes = figure.add_subplot(grid[index // KERNELS_IN_ROW, index % KERNELS_IN_ROW])
        kernel = bank.kernels[cell]
        axes.imshow(shown_light(np.broadcast_to(kernel, (*kernel.shape[:2], 3))), interpolation="nearest")
        axes.set_title(", ".join(f"{value:.3g}" for value in bank.centres[cell].round(9) + 0.0), fontsize=7)
        axes.axis("off")


def _draw_cells(axes: "Axes", bank: PsfBank) -> None:
    """Draw the cells over the first two unit coordinates, coloured by how far they reach along the first."""
    from matplotlib.collections import PolyCollection

    low, high = bank.grid.boxes[:, :2, 0], bank.grid.boxes[:, :2, 1]
    corners = np.stack([low, np.stack([high[:, 0], low[:, 1]], 1), high, np.stack([low[:, 0], high[:, 1]], 1)], axis=1)
    cells = PolyCollection(list(corners), array=(high - low).max(axis=1), cmap="viridis", edgecolors="white", linewidths=0.4)
    axes.add_collection(cells)
    axes.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0), aspect="equal")
    _label(axes, bank.axes[0], vertical=False)
    _label(axes, bank.axes[1], vertical=True)
    axes.set_title("cells, each of which shares one kernel", fontsize=9)


def _draw_widths(axes: "Axes", bank: PsfBank) -> None:
    """Draw the width of cells against where they lie, for one coordinate."""
    boxes = bank.boxes[:, 0]
    finite = np.isfinite(boxes).all(axis=1)
    axes.plot(bank.centres[finite, 0], boxes[finite, 1] - boxes[finite, 0], ".", ms=3)
    axes.set_xlabel(_SHORT[bank.axes[0].name])
    axes.set_title("width of the cells, each of which shares one kernel", fontsize=9)
    axes.grid(alpha=0.3)


def _draw_sizes(axes: "Axes", bank: PsfBank) -> None:
    """Draw the size of kernels over the first coordinate."""
    axes.plot(_unit_centres(bank), [kernel.shape[0] for kernel in bank.kernels], ".", ms=3)
    _label(axes, bank.axes[0], vertical=False)
    axes.set_title("width of the kernels in px", fontsize=9)
    axes.grid(alpha=0.3)


def _draw_throughput(axes: "Axes", bank: PsfBank) -> None:
    """Draw how much light arrives, by colour, over the first coordinate."""
    for colour, light in zip(_COLOURS[bank.channels], bank.throughput.T, strict=True):
        axes.plot(_unit_centres(bank), light, ".", ms=3, color=colour)
    _label(axes, bank.axes[0], vertical=False)
    axes.set_ylim(0.0, 1.05)
    axes.set_title("light that arrives", fontsize=9)
    axes.grid(alpha=0.3)


def _unit_centres(bank: PsfBank) -> Float64[np.ndarray, " cells"]:
    return bank.grid.boxes[:, 0].mean(axis=1)


def _label(axes: "Axes", axis: Axis, vertical: bool) -> None:
    """Mark a side over a unit coordinate with the physical one."""
    names = [f"{value:.3g}" for value in axis.from_unit(_TICKS)]
    if vertical:
        axes.set_yticks(_TICKS, names)
        axes.set_ylabel(_SHORT[axis.name])
    else:
        axes.set_xticks(_TICKS, names)
        axes.set_xlabel(_SHORT[axis.name])

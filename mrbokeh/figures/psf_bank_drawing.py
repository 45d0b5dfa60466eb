"""Sheets of a lens (its kernels over blur and field, its outlines, how its blur grows with depth) and of a bank of PSFs (kernels over its
coordinates, their cells and sizes); and a bank's kernels as pictures for Nuke or Blender.
"""

import csv
import math
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float, Float64

from mrbokeh.images.image_io import write_image
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.aperture_shapes import closed
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.psf_bank import Axis, PsfBank
from mrbokeh.renderers.kernels.low_rank_kernel import aperture_errors
from mrbokeh.renderers.polygon.rectification import rectify
from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec

KERNEL_COC_PX = (-48.0, -24.0, -8.0, -3.0, 3.0, 8.0, 24.0, 48.0)
FIELD_COC_PX = 40.0
FIELD_GRID = (5, 3)
LARGEST_RANK = 12
COLOURS = ("tab:red", "tab:green", "tab:blue")
_FRAME_ASPECT = 1.5
_MOST_RECTIFIED = 3
_MOST_NAMED = 4


def draw_lens(lens: Lens, image_width_px: int) -> "Figure":
    """Draw the sheet of a lens: kernels over signed diameter and, if they vary, over the field; outlines, low-rank error, depth."""
    from matplotlib.figure import Figure

    varies = lens.aperture.varies_over_field
    figure = Figure(figsize=(13, 11.5 if varies else 8), layout="constrained")
    focus = f"{lens.focus_distance_m:g} m" if np.isfinite(lens.focus_distance_m) else "infinity"
    figure.suptitle(f"{lens.focal_length_mm:g} mm f/{lens.f_number:g} focused at {focus}, sensor {lens.sensor_width_mm:g} mm")
    rows = figure.add_gridspec(3 if varies else 2, 1, height_ratios=(1.0, 1.8, 2.6) if varies else (1.0, 2.6))
    _draw_diameters(figure, rows[0, 0], lens.aperture)
    if varies:
        columns = rows[1, 0].subgridspec(1, 2)
        for column, side in enumerate((-1, 1)):
            draw_field(figure.add_subplot(columns[0, column]), lens.aperture, side * FIELD_COC_PX)
    columns = rows[-1, 0].subgridspec(1, 3 if lens.has_flat_focus else 4)
    draw_outlines(figure.add_subplot(columns[0, 0]), lens.aperture)
    draw_low_rank_error(figure.add_subplot(columns[0, 1]), lens.aperture)
    draw_depth(figure.add_subplot(columns[0, 2]), lens, image_width_px)
    if not lens.has_flat_focus:
        draw_focus(figure.add_subplot(columns[0, 3]), lens, image_width_px)
    return figure


def kernel_rgb(aperture: Aperture, coc_px: float, field_xy: tuple[float, float] = (0.0, 0.0)) -> Float64[np.ndarray, "size size 3"]:
    """Return the PSF of red, green and blue light at a signed diameter and place in the frame; each sums to 1."""
    side = 1 if coc_px > 0 else -1
    scales = aperture.channel_scale(side)
    kernels = [aperture.seen(side, field_xy, channel).rasterize(coc_px * scales[channel]).kernel for channel in range(3)]
    size = max(len(kernel) for kernel in kernels)
    return np.stack([np.pad(kernel, (size - len(kernel)) // 2) for kernel in kernels], axis=2)


def _draw_diameters(figure: "Figure", place: "SubplotSpec", aperture: Aperture) -> None:
    grid = place.subgridspec(1, len(KERNEL_COC_PX))
    for column, coc_px in enumerate(KERNEL_COC_PX):
        axes = figure.add_subplot(grid[0, column])
        axes.imshow(shown_light(kernel_rgb(aperture, coc_px)))
        axes.set_title(f"{coc_px:+.0f} px " + ("behind" if coc_px > 0 else "in front"), fontsize=9)
        axes.axis("off")


def draw_field(axes: "Axes", aperture: Aperture, coc_px: float) -> None:
    """Draw kernels of one diameter at places from corner to corner of a 3:2 frame, each where it lies."""
    columns, rows = FIELD_GRID
    x_field, y_field = _FRAME_ASPECT / np.hypot(_FRAME_ASPECT, 1.0), 1.0 / np.hypot(_FRAME_ASPECT, 1.0)
    places = [(x, y) for y in np.linspace(-y_field, y_field, rows) for x in np.linspace(-x_field, x_field, columns)]
    kernels = [kernel_rgb(aperture, coc_px, (float(x), float(y))) for x, y in places]
    cell = max(len(kernel) for kernel in kernels) + 4
    sheet = np.zeros((rows * cell, columns * cell, 3))
    for index, kernel in enumerate(kernels):
        top = index // columns * cell + (cell - len(kernel)) // 2
        left = index % columns * cell + (cell - len(kernel)) // 2
        sheet[top : top + len(kernel), left : left + len(kernel)] = kernel
    axes.imshow(shown_light(sheet))
    axes.set_title(f"over the frame, {coc_px:+.0f} px " + ("behind" if coc_px > 0 else "in front"), fontsize=9)
    axes.axis("off")


def shown_light(light: Float[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width 3"]:
    """Return light as a display shows it, its largest value white."""
    from mrbokeh.images.color import linear_to_srgb

    return linear_to_srgb(np.clip(light / light.max(), 0.0, 1.0).astype(np.float32))


def draw_outlines(axes: "Axes", aperture: Aperture) -> None:
    """Draw the opening as the middle of the frame sees it behind the focus, and the few-edged polygons that fast sums use."""
    opening = aperture.seen(1)
    for index, (outline, weight) in enumerate(zip(opening.outlines, opening.weights, strict=True)):
        label = f"{len(outline)} vertices, weight {weight:+.3g}" if index < _MOST_NAMED else None
        axes.plot(*closed(outline).T, color="tab:blue" if weight > 0 else "tab:red", lw=1.2, marker=".", ms=3, label=label)
    if len(opening.outlines) > _MOST_NAMED:
        axes.plot([], [], " ", label=f"and {len(opening.outlines) - _MOST_NAMED} more")
    edges = []
    for outline in opening.outlines[:_MOST_RECTIFIED]:
        with suppress(InputError):
            simple = rectify(outline)
            axes.plot(*closed(simple).T, color="black", lw=0.8, ls="--")
            edges.append(str(len(simple)))
    axes.plot([], [], color="black", lw=0.8, ls="--", label=f"rectified: {', '.join(edges) or 'not possible with so few'} edges")
    axes.plot(0, 0, "+", color="grey")
    axes.set_aspect("equal")
    axes.invert_yaxis()
    axes.set_title("opening behind the focus (unit pupil)", fontsize=9)
    axes.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.08))


def draw_low_rank_error(axes: "Axes", aperture: Aperture) -> None:
    """Draw the relative error of the kernel's approximation by a few separable passes (McGraw, Eq. 4), behind the focus."""
    errors = aperture_errors(aperture, KERNEL_COC_PX[-1])[:LARGEST_RANK]
    axes.semilogy(np.arange(1, len(errors) + 1), np.maximum(errors, 1e-6), marker="o", ms=3)
    axes.set_xlabel("rank")
    axes.set_xticks(np.arange(1, len(errors) + 1))
    axes.set_title(f"relative low-rank error at {KERNEL_COC_PX[-1]:.0f} px", fontsize=9)
    axes.grid(alpha=0.3)


def draw_depth(axes: "Axes", lens: Lens, image_width_px: int) -> None:
    """Draw the signed circle of confusion on the axis against depth, by colour if the colours differ."""
    dioptres = np.linspace(1.0 / 50.0, min(3.0 / lens.focus_distance_m if np.isfinite(lens.focus_distance_m) else 2.0, 20.0), 400)
    coc_px = lens.coc_px(1.0 / dioptres, image_width_px)
    if any(lens.aperture.axial_chromatic):
        scales = np.where(coc_px[:, None] > 0, lens.aperture.channel_scale(1), lens.aperture.channel_scale(-1))
        for colour, scale in zip(COLOURS, scales.T, strict=True):
            axes.semilogx(1.0 / dioptres, coc_px * scale, color=colour)
    else:
        axes.semilogx(1.0 / dioptres, coc_px)
    axes.axhline(0.0, color="grey", lw=0.5)
    axes.set_xlabel("depth in m")
    axes.set_title(f"circle of confusion in px of {image_width_px}", fontsize=9)


def draw_focus(axes: "Axes", lens: Lens, image_width_px: int) -> None:
    """Draw the depth that is in focus over a 3:2 frame, of a tilted lens or one with a curved field; in dioptres."""
    dioptres = lens.focus_dioptres(image_width_px, round(image_width_px / _FRAME_ASPECT))
    picture = axes.imshow(dioptres, cmap="viridis")
    axes.set_anchor("S")
    axes.set_title("in focus, in 1 / m", fontsize=9)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.figure.colorbar(picture, ax=axes, location="bottom", pad=0.02)


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

KERNELS_IN_ROW, _DECADES = 6, 6
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
    figure.supxlabel(f"each kernel twice: as a display shows light, and the logarithm of its last {_DECADES} decades", fontsize=8)
    right = columns[0, 1].subgridspec(2, 1, height_ratios=(1.4, 1.0))
    (_draw_cells if len(bank.axes) > 1 else _draw_widths)(figure.add_subplot(right[0, 0]), bank)
    absorbs = bool((bank.throughput < 0.999).any())
    (_draw_throughput if absorbs else _draw_sizes)(figure.add_subplot(right[1, 0]), bank)
    return figure


def sampled_cells(bank: PsfBank) -> list[int]:
    """Return the cells whose kernels are drawn: at even steps of the unit coordinates, the second axis downwards, others in their middle.

    Along a single axis each cell comes once. In a bank with a knee the steps are those of the logarithm beyond it.
    """
    steps = (np.arange(KERNELS_IN_ROW) + 0.5) / KERNELS_IN_ROW
    if bank.knee_px is not None:
        ends = [axis.high / bank.knee_px for axis in bank.axes]
        columns, rows = (np.expm1(steps * np.log1p(end)) / end for end in ends)
        return [int(cell) for cell in bank.grid.index_of(np.stack(np.meshgrid(columns, rows), axis=-1)).ravel()]
    if len(bank.axes) == 1:
        fine = (np.arange(KERNELS_IN_ROW**2) + 0.5) / KERNELS_IN_ROW**2
        return list(dict.fromkeys(int(cell) for cell in bank.grid.index_of(fine[:, None])))
    places = np.full((KERNELS_IN_ROW, KERNELS_IN_ROW, len(bank.axes)), 0.5)
    places[..., 0], places[..., 1] = steps[None, :], steps[:, None]
    return [int(cell) for cell in bank.grid.index_of(places).ravel()]


def _draw_kernels(figure: "Figure", place: "SubplotSpec", bank: PsfBank) -> None:
    """Draw kernels twice, side by side: as a display shows light, and its logarithm over the last decades, where faint light is seen."""
    cells = sampled_cells(bank)
    in_row = KERNELS_IN_ROW if len(bank.axes) > 1 else math.ceil(math.sqrt(len(cells) / 2))
    grid = place.subgridspec(math.ceil(len(cells) / in_row), in_row)
    for index, cell in enumerate(cells):
        # Said where titles stand and that there are no ticks: else matplotlib lays out the hidden ticks, 60 % of the time.
        axes = figure.add_subplot(grid[index // in_row, index % in_row], xticks=(), yticks=())
        kernel = bank.kernels[cell]
        light = np.broadcast_to(kernel, (*kernel.shape[:2], 3))
        decades = np.clip(1.0 + np.log10(np.maximum(light / light.max(), 1e-30)) / _DECADES, 0.0, 1.0)
        between = np.ones((len(light), max(1, len(light) // 20), 3))
        axes.imshow(np.concatenate([shown_light(light), between, decades], axis=1), interpolation="nearest")
        axes.set_title(", ".join(f"{value:.3g}" for value in bank.centres[cell].round(9) + 0.0), fontsize=7, y=1.0)
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
    axes.set_ylim(0.0, 1.1 * float((boxes[finite, 1] - boxes[finite, 0]).max(initial=1e-9)))
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

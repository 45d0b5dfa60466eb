"""Choose a model by name, and build its bank in a folder, cell by cell; an interrupted build continues where it stopped.

`Combined` (defocus and motion, a disc swept along a line during the shutter, Leimkuehler 2018, Section 5.1) lies here too. What its bank
is worth (`python -m tests.bench.bench_combined_bank`): the overlap (sum of the smaller of both) of a cell's kernel with the exact one at
1,000 random places, mean and worst of 20. The L1 distance is twice what it lacks to 1.

                                       even over 256 x 256 px     even over octaves from 0.5 px
    paper's nested grid, 392 cells     0.928, 0.849               0.897, 0.739
    `ProportionalGrid`, 388 cells      0.951, 0.912               0.932, 0.874
    paper's nested grid, 1986 cells    0.962, 0.921               0.950, 0.865
    `ProportionalGrid`, 1989 cells     0.977, 0.959               0.970, 0.943

Where the paper's loses: mostly in the diameter (with the motion exact 0.934 are left of the 0.928, with the diameter exact
0.982), most of all for small circles in long motion; the prefilter costs 0.003. It is the better one for large circles that
hardly move, of which it has many kernels that differ little.
"""

import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.psf import kernel_radius_px
from mrbokeh.optics.psf_bank import Axis, PsfBank, Turns, check_kernel, physical_boxes
from mrbokeh.optics.psf_bank_file import (
    HEAD,
    BankHead,
    clear_bank,
    missing_cells,
    read_bank,
    read_head,
    refuse_existing_bank,
    write_cell,
    write_head,
)
from mrbokeh.optics.psf_grid import ProportionalGrid
from mrbokeh.psf_models.base import Kernel, PsfModel, check_positive, nodes, sobol_blocks
from mrbokeh.system.console import flag, track
from mrbokeh.system.errors import InputError
from mrbokeh.system.resources import cores

CELLS = 400
LARGEST_PX = 256.0
PAPER_EXPONENTS, PAPER_COUNTS = (2.0, 1.0), (75, 75)
"""Table 1's power remapping; 75 x 75 steps of the nested grid give 392 cells, where the table has 400."""
_KNEE_PX, _STEP_RATIO = 5.0, 2.0
_STEPS_PX = (0.25, 1.0)
"""Diameters and motions of the closed form lie so near to one another when it is averaged: eight of them or the wider step."""


class Combined:
    """Thin lens with a round opening before a point that moves evenly in a straight line: a capsule with soft ends.

    Coordinates: the diameter of the circle of confusion and the length of the path per shutter, without its direction (by
    which the kernel is turned where it is used). The source in the middle of the kernel is the point at half time.
    diameter_px, motion_px: the largest of the bank (256 each fill the paper's 512 pixels). cells: at most so many, laid out in
    proportion (`ProportionalGrid`). counts: steps of the paper's nested grid instead; PAPER_COUNTS make that of its Table 1.
    """

    name = "combined"
    turns: Turns = "motion"
    near_side_turned = False
    channels = 1
    default_rays = 0

    def __init__(
        self,
        diameter_px: float = LARGEST_PX,
        motion_px: float = LARGEST_PX,
        counts: tuple[int, ...] | None = None,
        cells: int = CELLS,
        device: str = "",
    ) -> None:
        self.device = device
        largest_px = check_positive("the largest diameter of combined blur", diameter_px)
        longest_px = check_positive("the longest motion of combined blur", motion_px)
        exponents = (1.0, 1.0) if counts is None else PAPER_EXPONENTS
        self.axes = (Axis("diameter_px", 0.0, largest_px, exponents[0]), Axis("motion_px", 0.0, longest_px, exponents[1]))
        self.knee_px = _KNEE_PX if counts is None else None
        self.counts = counts or ProportionalGrid.of_cells(cells, (largest_px, longest_px), _KNEE_PX, _STEP_RATIO).counts

    @property
    def settings(self) -> dict[str, Any]:
        return {}

    def kernel(self, box: Float64[np.ndarray, "axes 2"], rays: int, seed: int) -> Kernel:
        """See `PsfModel.kernel`."""
        from mrbokeh.psf_models._rays_numba import fill_capsule

        size = _size(float(box[0, 1]), float(box[1, 1]))
        total = np.zeros((size, size))
        if rays:
            trace, box = _tracer(self.device), np.ascontiguousarray(box)
            total /= sum(trace(total, box, shares) for shares in sobol_blocks(5, rays, seed, self.device))
        else:
            diameters, motions = (
                nodes(axis, low, high, _step_px(high - low)) for axis, (low, high) in zip(self.axes, box.tolist(), strict=True)
            )
            for diameter_px in diameters.tolist():
                for motion_px in motions.tolist():
                    fill_capsule(total, diameter_px, motion_px, 1.0 / (len(diameters) * len(motions)))
        return np.maximum(total, 0.0)[..., None].astype(np.float32)

    def exact(self, coords: Float64[np.ndarray, " axes"]) -> Kernel:
        """Return the capsule with its true profile: over a pixel, the light of the disc during the time in which it covers it."""
        return self.kernel(np.stack([coords, coords], axis=1), 0, 0)


def _tracer(device: str) -> Callable[..., float]:
    if device:
        from mrbokeh.psf_models.torch_tracing import trace_capsule as trace_on

        return partial(trace_on, device)
    from mrbokeh.psf_models._rays_numba import trace_capsule

    return trace_capsule


def _step_px(width_px: float) -> float:
    return min(max(width_px / 8.0, _STEPS_PX[0]), _STEPS_PX[1])


def _size(diameter_px: float, motion_px: float) -> int:
    return 2 * kernel_radius_px(abs(diameter_px) + motion_px) + 1


@dataclass(frozen=True)
class ModelOptions:
    """Options that a user may give a model; None is the model's own default. Names and units are those of the models' constructors.

    lens: file of the lens whose aperture is swept over diameters. image: the picture of a stylised PSF. diameter_px, motion_px:
    the largest of the bank. prescription: a .dat file of lens surfaces. counts: steps of the grid along each axis. cells: of the
    proportional grid. device: of torch, on which rays are traced.
    """

    lens: Path | None = None
    image: Path | None = None
    diameter_px: float | None = None
    motion_px: float | None = None
    prescription: Path | None = None
    focus_distance_m: float | None = None
    f_number: float | None = None
    sensor_width_mm: float | None = None
    sensor_height_mm: float | None = None
    image_width_px: int | None = None
    nearest_m: float | None = None
    farthest_m: float | None = None
    vignetting: bool | None = None
    sharpest: bool | None = None
    density_per_m: float | None = None
    anisotropy: float | None = None
    focal_px: float | None = None
    counts: tuple[int, ...] | None = None
    cells: int | None = None
    device: str | None = None


def _simple(options: ModelOptions) -> PsfModel:
    from mrbokeh.optics.lens_file import read_lens, stated_facts
    from mrbokeh.psf_models.simple_lens import SimpleLens

    lens, given = None if options.lens is None else read_lens(options.lens), _given(options, "diameter_px", "counts", "device")
    return SimpleLens(**given) if lens is None else SimpleLens(lens.aperture, lens=stated_facts(lens), **given)


def _combined(options: ModelOptions) -> PsfModel:
    if options.counts is not None and options.cells is not None:
        raise InputError("give either --counts (the paper's nested grid) or --cells (a proportional one), not both")
    return Combined(**_given(options, "diameter_px", "motion_px", "counts", "cells", "device"))


def _physical(options: ModelOptions) -> PsfModel:
    from mrbokeh.psf_models.physical_lens import PhysicalLens

    width_mm = _SENSOR_WIDTH_MM if options.sensor_width_mm is None else options.sensor_width_mm
    height_mm = width_mm * 2.0 / 3.0 if options.sensor_height_mm is None else options.sensor_height_mm
    return PhysicalLens(sensor_mm=(width_mm, height_mm), **_given(options, *_PHYSICAL))


def _volume(options: ModelOptions) -> PsfModel:
    from mrbokeh.psf_models.volume import Volume

    return Volume(**_given(options, *_VOLUME))


def _stylized(options: ModelOptions) -> PsfModel:
    from mrbokeh.images.image_io import read_image
    from mrbokeh.psf_models.simple_lens import Stylized

    if options.image is None:
        raise InputError("a stylized PSF is made from a picture: give one with --psf-picture")
    return Stylized(read_image(options.image), **_given(options, "diameter_px", "counts", "device"))


_SENSOR_WIDTH_MM = 36.0
_PHYSICAL = (
    "prescription",
    "focus_distance_m",
    "f_number",
    "image_width_px",
    "nearest_m",
    "farthest_m",
    "vignetting",
    "sharpest",
    "counts",
    "device",
)
_VOLUME = ("density_per_m", "anisotropy", "focal_px", "farthest_m", "counts", "device")
_MODELS: dict[str, tuple[Callable[[ModelOptions], PsfModel], frozenset[str]]] = {
    "simple": (_simple, frozenset({"lens", "diameter_px", "counts", "device"})),
    "combined": (_combined, frozenset({"diameter_px", "motion_px", "counts", "cells", "device"})),
    "physical": (_physical, frozenset({*_PHYSICAL, "sensor_width_mm", "sensor_height_mm"})),
    "volume": (_volume, frozenset(_VOLUME)),
    "stylized": (_stylized, frozenset({"image", "diameter_px", "counts", "device"})),
}
MODEL_NAMES = tuple(_MODELS)


def _given(options: ModelOptions, *names: str) -> dict:
    return {name: getattr(options, name) for name in names if getattr(options, name) is not None}


def choose_model(name: str, options: ModelOptions | None = None) -> PsfModel:
    """Return the model of a name; refuse options that it has no use for."""
    options = options or ModelOptions()
    if name not in _MODELS:
        raise InputError(f"expected a model out of {', '.join(MODEL_NAMES)}, got {name!r}")
    make, known = _MODELS[name]
    named = _given(options, *(each.name for each in fields(options)))
    if stray := [flag(key) for key in named if key not in known]:
        raise InputError(f"{', '.join(stray)} does nothing for the model {name}: leave it out, or choose another model")
    return make(options)


def bank_head(model: PsfModel, rays: int, seed: int) -> BankHead:
    """Return the description of a model's bank: a nested grid over several coordinates, or a proportional one if the model has a knee.

    One coordinate keeps the regular grid after its power remapping: nesting saves cells only where coordinates multiply, and
    100 cells up to 512 px (exponent 2) are then 10 px wide at the far end instead of 20. Signed diameters must not be nested.
    """
    nested = model.knee_px is None and len(model.axes) > 1 and not any(axis.is_signed for axis in model.axes)
    settings = json.loads(json.dumps({**model.settings, "rays": rays, "seed": seed}))
    return BankHead(
        model=model.name,
        channels=model.channels,
        axes=model.axes,
        counts=model.counts,
        nested=nested,
        turns=model.turns,
        near_side_turned=model.near_side_turned,
        settings=settings,
        knee_px=model.knee_px,
    )


def build_bank(
    model: PsfModel,
    folder: Path | str,
    rays: int | None = None,
    seed: int = 0,
    progress: bool = True,
    overwrite: bool = False,
    threads: int = 0,
) -> PsfBank:
    """Build (or go on building) a bank and read it.

    rays: per kernel; None is what suits the model, 0 its closed form. Cell i is traced with the seed `seed` + i, so that it
    is the same whoever traces it, when and beside how many others. threads: 0 takes all cores (on the
    device 'cpu' one, as torch shares out each kernel itself).
    A folder that holds a part of the very same bank is completed; a finished bank, another one, or other files are an
    InputError unless `overwrite` (which only ever removes a bank).
    """
    rays = model.default_rays if rays is None else rays
    if rays < 0:
        raise InputError(f"a number of rays is 0 (closed form) or positive, got {rays}")
    if model.device and not rays:
        raise InputError(f"the closed form of {model.name} is not traced, so it has no use for the device {model.device!r}: give rays too")
    head = bank_head(model, rays, seed)
    boxes = physical_boxes(head.axes, head.grid)
    if overwrite or not _is_part_of(folder, head):
        refuse_existing_bank(folder, overwrite)
        first = model.kernel(boxes[0], rays, seed)  # before anything is written: what is wrong with a model shows here
        check_kernel(first, f"the first kernel of {model.name}")
        clear_bank(folder)
        write_head(folder, head)
        write_cell(folder, 0, first)

    threads = threads or (1 if model.device.startswith("cpu") else cores())
    with ThreadPoolExecutor(threads) as pool:
        building = [pool.submit(_build_cell, model, folder, cell, boxes[cell], rays, seed) for cell in missing_cells(folder, head)]
        try:
            for future in track(building, f"kernels of {model.name}") if progress else building:
                future.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return read_bank(folder)


def _build_cell(model: PsfModel, folder: Path | str, cell: int, box: Float64[np.ndarray, "axes 2"], rays: int, seed: int) -> None:
    write_cell(folder, cell, model.kernel(box, rays, seed + cell))


def _is_part_of(folder: Path | str, head: BankHead) -> bool:
    """Return whether a folder holds some but not all cells of this very bank."""
    return (Path(folder) / HEAD).is_file() and read_head(folder) == head and bool(missing_cells(folder, head))

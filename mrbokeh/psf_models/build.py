"""Choose a model by name, and build its bank in a folder, cell by cell; an interrupted build continues where it stopped."""

import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.psf_bank import PsfBank, check_kernel, physical_boxes
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
from mrbokeh.psf_models.base import PsfModel
from mrbokeh.system.console import flag, track
from mrbokeh.system.errors import InputError
from mrbokeh.system.resources import cores


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
    density_per_m: float | None = None
    anisotropy: float | None = None
    focal_px: float | None = None
    counts: tuple[int, ...] | None = None
    cells: int | None = None
    device: str | None = None


def _simple(options: ModelOptions) -> PsfModel:
    from mrbokeh.optics.aperture import Aperture
    from mrbokeh.optics.lens_file import read_lens
    from mrbokeh.psf_models.simple_lens import SimpleLens

    aperture = Aperture.disc() if options.lens is None else read_lens(options.lens).aperture
    return SimpleLens(aperture, **_given(options, "diameter_px", "counts", "device"))


def _combined(options: ModelOptions) -> PsfModel:
    from mrbokeh.psf_models.combined import Combined

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
    from mrbokeh.psf_models.stylized import Stylized

    if options.image is None:
        raise InputError("a stylized PSF is made from a picture: give one with --image")
    return Stylized(read_image(options.image), **_given(options, "diameter_px", "counts", "device"))


_SENSOR_WIDTH_MM = 36.0
_PHYSICAL = ("prescription", "focus_distance_m", "f_number", "image_width_px", "nearest_m", "farthest_m", "vignetting", "counts", "device")
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

"""Models by name, imported when asked for."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path

from mrbokeh.psf_models.base import PsfModel
from mrbokeh.system.console import flag
from mrbokeh.system.errors import InputError


@dataclass(frozen=True)
class ModelOptions:
    """What a user may say about a model; None is the model's own default. Names and units are those of the models' constructors.

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
    """The model of a name; an option that it has no use for is a mistake."""
    options = options or ModelOptions()
    if name not in _MODELS:
        raise InputError(f"expected a model out of {', '.join(MODEL_NAMES)}, got {name!r}")
    make, known = _MODELS[name]
    named = _given(options, *(each.name for each in fields(options)))
    if stray := [flag(key) for key in named if key not in known]:
        raise InputError(f"{', '.join(stray)} does nothing for the model {name}: leave it out, or choose another model")
    return make(options)

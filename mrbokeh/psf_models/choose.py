"""Models by name, imported when asked for."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path

from mrbokeh.errors import InputError
from mrbokeh.psf_models.base import PsfModel


@dataclass(frozen=True)
class ModelOptions:
    """What a user may say about a model; None is the model's own default.

    lens: file of the lens whose aperture is swept over diameters. image: the picture of a stylised PSF. prescription: a .dat
    file of lens surfaces. diameter_px, motion_px: the largest of the bank. counts: steps of the grid along each axis.
    """

    lens: Path | None = None
    image: Path | None = None
    prescription: Path | None = None
    diameter_px: float | None = None
    motion_px: float | None = None
    counts: tuple[int, ...] | None = None


def _simple(options: ModelOptions) -> PsfModel:
    from mrbokeh.aperture import Aperture
    from mrbokeh.lens_file import read_lens
    from mrbokeh.psf_models.simple_lens import SimpleLens

    aperture = Aperture.disc() if options.lens is None else read_lens(options.lens).aperture
    return SimpleLens(aperture, **_given(options, "diameter_px", "counts"))


def _combined(options: ModelOptions) -> PsfModel:
    from mrbokeh.psf_models.combined import Combined

    return Combined(**_given(options, "diameter_px", "motion_px", "counts"))


def _physical(options: ModelOptions) -> PsfModel:
    from mrbokeh.psf_models.physical_lens import PhysicalLens

    return PhysicalLens(**_given(options, "prescription", "counts"))


def _volume(options: ModelOptions) -> PsfModel:
    from mrbokeh.psf_models.volume import Volume

    return Volume(**_given(options, "counts"))


def _stylized(options: ModelOptions) -> PsfModel:
    from mrbokeh.image_io import read_image
    from mrbokeh.psf_models.stylized import Stylized

    if options.image is None:
        raise InputError("a stylized PSF is made from a picture: give one with --image")
    return Stylized(read_image(options.image), **_given(options, "diameter_px", "counts"))


_MODELS: dict[str, tuple[Callable[[ModelOptions], PsfModel], frozenset[str]]] = {
    "simple": (_simple, frozenset({"lens", "diameter_px", "counts"})),
    "combined": (_combined, frozenset({"diameter_px", "motion_px", "counts"})),
    "physical": (_physical, frozenset({"prescription", "counts"})),
    "volume": (_volume, frozenset({"counts"})),
    "stylized": (_stylized, frozenset({"image", "diameter_px", "counts"})),
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
    if stray := [f"--{key.removesuffix('_px')}" for key in named if key not in known]:
        raise InputError(f"{', '.join(stray)} does nothing for the model {name}: leave it out, or choose another model")
    return make(options)

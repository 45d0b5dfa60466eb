"""The five lens openings that the truth is rendered with: disc, seven curved blades, heart, ring and cat-eye."""

from collections.abc import Callable
from dataclasses import replace

from mrbokeh.optics.aperture import Aperture
from mrbokeh.system.errors import InputError

_MAKERS: dict[str, Callable[[], Aperture]] = {
    "disc": Aperture.disc,
    "blades7": lambda: Aperture.blades(7, 0.3, 0.35),
    "heart": Aperture.heart,
    "ring": lambda: Aperture.ring(0.55),
    "cat_eye": lambda: replace(Aperture.disc(), cat_eye=0.7),
}
SHAPE_NAMES = tuple(_MAKERS)


def lens_shape(name: str) -> Aperture:
    if name not in _MAKERS:
        raise InputError(f"expected an aperture out of {', '.join(SHAPE_NAMES)}, got {name!r}")
    return _MAKERS[name]()

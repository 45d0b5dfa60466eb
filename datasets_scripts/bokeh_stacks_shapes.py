"""The four openings of Neural Bokeh's synthetic sets (Mandl et al. 2024, Figure 5): heart, circle, bladed, round."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from datasets_scripts.truth_field_stop import FieldStop
from mrbokeh.optics.aperture import Aperture
from mrbokeh.system.errors import InputError

_RING = FieldStop()
_ROUND_WITH_RIM = replace(Aperture.disc(), cat_eye=0.35)


@dataclass(frozen=True, eq=False)
class BokehShape:
    """aperture, stop: what rays go through. stated: the aperture as a lens file can say it; where a stop moves, that of the middle."""

    aperture: Aperture
    stated: Aperture
    stop: FieldStop | None = None

    def seen(self, side: int, field_xy: tuple[float, float]) -> Aperture:
        """The plain aperture at a place of the frame (half diagonals), whether the lens file can state it or not."""
        return self.aperture.seen(side, field_xy) if self.stop is None else self.stop.seen(self.aperture, field_xy)

    def document(self) -> dict[str, Any]:
        """For the manifest: what the lens file leaves out."""
        if self.stop is None:
            return {"lens_file": "states the opening exactly"}
        return {
            "lens_file": "states the opening of the middle of the frame and the rim; the stop also changes with x, as follows",
            "rim": "a circle of radius 1 about -cat_eye * field_xy clips the unit pupil",
            "stop": "a disc: radius + (radius_left - radius) * clip(-x / edge, 0, 1), moved right by shift_right * clip(x / edge, 0, 1)",
            "cat_eye": self.aperture.cat_eye,
            **vars(self.stop),
        }


def _same(aperture: Aperture) -> BokehShape:
    return BokehShape(aperture, aperture)


SHAPES: dict[str, Callable[[], BokehShape]] = {
    "heart": lambda: _same(Aperture.heart()),
    "ring": lambda: BokehShape(_ROUND_WITH_RIM, _ROUND_WITH_RIM.obstructed(_RING.radius), _RING),
    "bladed": lambda: _same(Aperture.blades(7, -0.5 * np.pi)),
    "round": lambda: _same(Aperture.disc()),
}


def bokeh_shape(name: str) -> BokehShape:
    if name not in SHAPES:
        raise InputError(f"expected a shape out of {', '.join(SHAPES)}, got {name!r}")
    return SHAPES[name]()

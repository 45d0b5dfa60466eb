"""Optics: what the light of a slice goes through on its way to the picture, and how far it travels there.

Renderers that differ in how they sum the kernels of an opening give a `Spread` alone; `ThroughAperture` does the rest for all
of them. Kernels that come from elsewhere may be wide where the opening's are points, hold motion themselves, or lose light:
a renderer that has such kernels brings an Optics of its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.layer import Layer
from mrbokeh.layering.motion import farthest_px, motion_channels, moved
from mrbokeh.layering.slice_sorting import Part
from mrbokeh.layering.spreading import FIELD_CELLS, Frame, Spread, reach_px, spread_light
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.drawn_diameters import drawn_diameters_px

Plane = Float32[np.ndarray, "height width"]
Channels = Float32[np.ndarray, "height width _"]


@runtime_checkable
class Optics(Protocol):
    """How light travels from the sharp picture to the blurred one.

    coverages: 1, or 3 where red, green and blue each cover their own share of the pupil.
    """

    @property
    def coverages(self) -> int: ...

    def drawn_px(self, coc_px: Plane) -> Plane:
        """The signed diameters by which kernels are chosen for circles of confusion, in the same order."""
        ...

    def margin_px(self, layers: Sequence[Layer], coc_px: Sequence[Plane]) -> int:
        """How many whole pixels the light of any pixel of the layers, with these signed diameters, travels at most."""
        ...

    def reach_px(self, parts: Sequence[Part], largest_coc_px: float, frame: Frame) -> int:
        """The same of the pixels of a slice, none of whose diameters is larger. Nothing beyond it is kept."""
        ...

    def spread(self, values: Channels, coc_px: Plane, frame: Frame) -> Channels:
        """The light (R, G, B, coverage, others, premultiplied) where it arrives, of the same height and width.

        R, G, B, then `coverages` of coverage, then others. Coverage counts shares of the pupil as this place sees it: where
        something opaque fills all of it, it is 1, however much light is lost on the way. Other channels go with coverage.
        """
        ...


@dataclass(frozen=True)
class ThroughAperture:
    """An Optics of an opening, by a renderer's Spread; motion is drawn out along its path before (mrbokeh.layering.motion).

    motion: the channels that hold it, if anything moves, and farthest_px: by how many whole pixels at most.
    """

    aperture: Aperture
    kernels: Spread
    field_cells: tuple[int, int] = FIELD_CELLS
    motion: slice | None = None
    farthest_px: int = 0

    @classmethod
    def of(cls, layers: Sequence[Layer], aperture: Aperture, kernels: Spread, field_cells: tuple[int, int]) -> "ThroughAperture":
        """With the motion that these layers have."""
        farthest = farthest_px(layers)
        return cls(aperture, kernels, field_cells, motion_channels(layers[0].extra) if farthest else None, farthest)

    @property
    def coverages(self) -> int:
        return 3 if self.aperture.is_chromatic else 1

    def drawn_px(self, coc_px: Plane) -> Plane:
        return drawn_diameters_px(coc_px, self.aperture)

    def margin_px(self, layers: Sequence[Layer], coc_px: Sequence[Plane]) -> int:  # noqa: ARG002
        return reach_px(self.aperture, max(float(np.abs(each).max()) for each in coc_px)) + self.farthest_px

    def reach_px(self, parts: Sequence[Part], largest_coc_px: float, frame: Frame) -> int:  # noqa: ARG002
        return reach_px(self.aperture, largest_coc_px) + self.farthest_px

    def spread(self, values: Channels, coc_px: Plane, frame: Frame) -> Channels:
        drawn, drawn_coc_px = (values, coc_px) if self.motion is None else moved(values, coc_px, self.motion)
        return spread_light(self.kernels, drawn, drawn_coc_px, self.aperture, frame, self.field_cells)

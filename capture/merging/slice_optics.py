"""How blurred every depth is in every registered slice: the focus of each slice and how its circle of confusion grows."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.optics.aperture import Aperture
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.errors import InputError

Plane = Float32[np.ndarray, "height width"]


@dataclass(frozen=True)
class SliceOptics:
    """focus_dioptres: 1 / metres, per slice. px_per_dioptre: how many pixels of a registered slice the circle of confusion
    grows for each dioptre away from the focus. aperture: the shape of that circle.
    """

    focus_dioptres: tuple[float, ...]
    px_per_dioptre: tuple[float, ...]
    aperture: Aperture

    @classmethod
    def of_slices(cls, focus_dioptres: Sequence[float], px_per_dioptre: Sequence[float], aperture: Aperture | None = None) -> "SliceOptics":
        """Raises InputError unless there is one of each for every slice."""
        if len(focus_dioptres) != len(px_per_dioptre) or len(focus_dioptres) == 0:
            raise InputError(
                f"expected a focus and a growth of blur for each slice, got {len(focus_dioptres)} and {len(px_per_dioptre)} of them"
            )
        return cls(tuple(map(float, focus_dioptres)), tuple(map(float, px_per_dioptre)), aperture or Aperture.disc())

    @classmethod
    def of_stack(cls, stack: FocalStack, width_px: int) -> "SliceOptics":
        """The focus distances and the growth of blur that the stack states."""
        lenses = [stack.lens_of(index) for index in range(len(stack))]
        growth = [stack.coc_px_per_dioptre(index, width_px) for index in range(len(stack))]
        return cls.of_slices([1.0 / lens.focus_distance_m for lens in lenses], growth, lenses[0].aperture)

    def __len__(self) -> int:
        return len(self.focus_dioptres)

    def reduced(self, shrink: int) -> "SliceOptics":
        """For pictures `shrink` times smaller."""
        return replace(self, px_per_dioptre=tuple(growth / shrink for growth in self.px_per_dioptre))

    def coc_px(self, index: int, dioptres: Float[np.ndarray, "height width"]) -> Plane:
        """Signed diameter in slice `index` of what lies at these dioptres: + behind its focus."""
        return (self.px_per_dioptre[index] * (self.focus_dioptres[index] - dioptres)).astype(np.float32)

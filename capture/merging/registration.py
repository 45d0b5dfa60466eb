"""How the slices of a focal stack fit together: one transform per slice."""

from dataclasses import dataclass

from capture.merging.breathing import Breathing
from capture.merging.plane_transforms import Transform, middle_of, scale_of


@dataclass(frozen=True)
class Registration:
    """How the slices of a stack fit together.

    reference: index of the slice with the narrowest field of view; all others are enlarged to match it.
    reference_from_slice: (2, 3) per slice, or (3, 3) where the camera turned in the hand; pixel coordinates with (0.5, 0.5) at the centre
      of the first pixel.
    correlations: ECC correlation of each neighbour pair (1 is perfect, below 0.6 counts as none).
    residuals_px: per slice, how far a corner of the picture lies off by the worst of its pairs; None where no pair of the
      slice held and the breathing model alone has placed it.
    size_px: (width, height) of the slices.
    breathing: the model that served as prior.
    camera_moved: False where the model was kept as it is because no slice departs from it.
    """

    reference: int
    reference_from_slice: tuple[Transform, ...]
    correlations: tuple[float, ...]
    residuals_px: tuple[float | None, ...] = ()
    size_px: tuple[int, int] | None = None
    breathing: Breathing | None = None
    camera_moved: bool = True

    @property
    def scales(self) -> tuple[float, ...]:
        """How much larger the middle of each slice becomes."""
        middle_px = middle_of(self.size_px or (0, 0))
        return tuple(scale_of(transform, middle_px) for transform in self.reference_from_slice)

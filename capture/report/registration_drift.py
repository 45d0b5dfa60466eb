"""How the slices of a stack moved against one another, as registration found it."""

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mrbokeh.focal_stack import FocalStack

FILE_NAME = "registration.json"


@dataclass(frozen=True)
class RegistrationDrift:
    """Per slice, against the reference. shift_px: (N, 2) of the picture's middle, right and down. rotation_rad, magnification: (N,).

    correlations: of each pair of neighbours, () where they are not known. width_px: of the pictures.
    """

    shift_px: Float[np.ndarray, "slices 2"]
    rotation_rad: Float[np.ndarray, " slices"]
    magnification: Float[np.ndarray, " slices"]
    correlations: tuple[float, ...]
    width_px: int

    @property
    def largest_jump_px(self) -> float:
        """The largest move between neighbours that a steady drift does not explain: half the second difference of the shift."""
        if len(self.shift_px) < 3:
            return 0.0
        bends = self.shift_px[1:-1] - 0.5 * (self.shift_px[:-2] + self.shift_px[2:])
        return float(np.hypot(*bends.T).max())

    @property
    def least_correlation(self) -> float | None:
        return min(self.correlations) if self.correlations else None


def registration_drift(stack: FocalStack, width_px: int, height_px: int) -> RegistrationDrift | None:
    """None where the stack is not registered or does not say how."""
    found = [each.metadata.get("reference_from_slice") for each in stack.slices]
    if not stack.registered or any(each is None for each in found):
        return None
    return drift_of([np.asarray(each, np.float64) for each in found], width_px, height_px, _correlations(stack))


def drift_of(
    reference_from_slice: Sequence[Float[np.ndarray, "2 3"]], width_px: int, height_px: int, correlations: Sequence[float] = ()
) -> RegistrationDrift:
    transforms = np.stack(list(reference_from_slice))
    middle = np.array([0.5 * width_px, 0.5 * height_px])
    shift_px = transforms[:, :, :2] @ middle + transforms[:, :, 2] - middle
    magnification = np.sqrt(np.abs(np.linalg.det(transforms[:, :, :2])))
    rotation_rad = np.arctan2(transforms[:, 1, 0], transforms[:, 0, 0])
    return RegistrationDrift(shift_px, rotation_rad, magnification, tuple(float(each) for each in correlations), width_px)


def _correlations(stack: FocalStack) -> list[float]:
    try:
        document = json.loads((stack.folder / FILE_NAME).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return []
    values = document.get("correlations") if isinstance(document, dict) else None
    return [float(each) for each in values] if isinstance(values, list) and all(isinstance(v, int | float) for v in values) else []

"""How the slices of a stack moved against one another, as registration found it."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from capture.merging.plane_transforms import Transform, middle_of, moved, scale_of
from mrbokeh.stacks.focal_stack import FocalStack

FILE_NAME = "registration.json"


@dataclass(frozen=True)
class RegistrationDrift:
    """Per slice, against the reference. shift_px: (N, 2) of the picture's middle, right and down. rotation_rad, magnification: (N,).

    correlations: of each pair of neighbours, () where they are not known. width_px: of the pictures.
    residuals_px: how far a corner lies off by the worst pair that a slice was registered with; None where no pair held, () if not known.
    """

    shift_px: Float[np.ndarray, "slices 2"]
    rotation_rad: Float[np.ndarray, " slices"]
    magnification: Float[np.ndarray, " slices"]
    correlations: tuple[float, ...]
    width_px: int
    residuals_px: tuple[float | None, ...] = ()

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
    document = _document(stack)
    transforms = [np.asarray(each, np.float64) for each in found]
    return drift_of(transforms, width_px, height_px, _numbers(document, "correlations"), _numbers(document, "residuals_px"))


def drift_of(
    reference_from_slice: Sequence[Transform],
    width_px: int,
    height_px: int,
    correlations: Sequence[float | None] = (),
    residuals_px: Sequence[float | None] = (),
) -> RegistrationDrift:
    middle = np.array([[0.5 * width_px, 0.5 * height_px], [0.5 * width_px + 1.0, 0.5 * height_px]])
    ends = np.stack([moved(each, middle) for each in reference_from_slice])
    shift_px, along = ends[:, 0] - middle[0], ends[:, 1] - ends[:, 0]
    magnification = np.array([scale_of(each, middle_of((width_px, height_px))) for each in reference_from_slice])
    rotation_rad = np.arctan2(along[:, 1], along[:, 0])
    known = [float(each) for each in correlations if each is not None]
    all_known = tuple(known) if len(known) == len(correlations) else ()
    return RegistrationDrift(shift_px, rotation_rad, magnification, all_known, width_px, tuple(residuals_px))


def _document(stack: FocalStack) -> dict[str, Any]:
    try:
        document = json.loads((stack.folder / FILE_NAME).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return document if isinstance(document, dict) else {}


def _numbers(document: dict[str, Any], name: str) -> list[float | None]:
    """A list of numbers or null; empty where the document has none."""
    values = document.get(name)
    if not isinstance(values, list) or not all(each is None or isinstance(each, int | float) for each in values):
        return []
    return [None if each is None else float(each) for each in values]

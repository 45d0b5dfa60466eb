"""What each way to find the scale answers: metres per unit of the model, how sure, and what it rests on."""

from dataclasses import dataclass, field
from typing import Any

METHODS = ("board", "distance", "focus")
"""The best trusted first."""


@dataclass(frozen=True)
class ScaleAnswer:
    """metres_per_unit; uncertainty: one standard deviation, relative. facts: counts and residuals, for people to judge by.

    outlines_px: by view, the corners (x, y) of a board in the picture, so that training can leave it out.
    """

    method: str
    metres_per_unit: float
    uncertainty: float
    facts: dict[str, Any] = field(default_factory=dict)
    outlines_px: dict[str, list[list[float]]] = field(default_factory=dict)

"""The scale from the measured distance between two camera centres (entrance pupils)."""

import numpy as np

from capture.poses.sparse_model import SparseModel
from capture.scale.answer import ScaleAnswer
from mrbokeh.system.errors import InputError

_RULER_M = 0.001


def distance_scale(model: SparseModel, view_a: str, view_b: str, metres: float) -> ScaleAnswer:
    """As good as the ruler: the uncertainty stands for 1 mm."""
    if not 0.0 < metres < float("inf"):
        raise InputError(f"the distance between {view_a} and {view_b} must be a positive number of metres, got {metres}")
    units = float(np.linalg.norm(model.view(view_a).centre - model.view(view_b).centre))
    if units == 0.0:
        raise InputError(f"{view_a} and {view_b} stand at one place: name two different views")
    return ScaleAnswer("distance", metres / units, _RULER_M / metres, {"views": [view_a, view_b], "metres": metres})


def parse_distance(text: str) -> tuple[str, str, float]:
    """ "VIEW_A,VIEW_B,METRES"."""
    try:
        view_a, view_b, metres = (each.strip() for each in text.split(","))
        return view_a, view_b, float(metres)
    except ValueError:
        told = "--distance must be VIEW_A,VIEW_B,METRES such as view_0,view_3,0.25 (with a decimal point)"
        raise InputError(f"{told}, got {text!r}") from None

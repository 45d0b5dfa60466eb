"""Answers of the ways to find the scale: metres per unit, uncertainty and facts; the answer of a measured distance; scale.json.

scale.json holds every answer, how far they disagree, and which one is used:

{"format": "mrbokeh-scale", "version": 1, "metres_per_unit", "used": method, "answers": [{"method", "metres_per_unit", "uncertainty",
"facts", "outlines_px"}], "disagreement": {method: relative difference from the one used}, "missing": {method: why there is no answer}}
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from capture.poses.sparse_model import SCALE_NAME, SparseModel
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError

METHODS = ("board", "distance", "focus")
"""The best trusted first."""
_RULER_M = 0.001
FORMAT = "mrbokeh-scale"
VERSION = 1
_NOTEWORTHY = 0.02
_DEVIATIONS = 3.0


@dataclass(frozen=True)
class ScaleAnswer:
    """The scale by one method.

    metres_per_unit; uncertainty: one standard deviation, relative. facts: counts and residuals for people to judge by.
    outlines_px: by view, the corners (x, y) of a board in the picture, so that training can leave it out.
    """

    method: str
    metres_per_unit: float
    uncertainty: float
    facts: dict[str, Any] = field(default_factory=dict)
    outlines_px: dict[str, list[list[float]]] = field(default_factory=dict)


def distance_scale(model: SparseModel, view_a: str, view_b: str, metres: float) -> ScaleAnswer:
    """Return the scale from the measured distance between two camera centres (entrance pupils); its uncertainty stands for 1 mm."""
    if not 0.0 < metres < float("inf"):
        raise InputError(f"the distance between {view_a} and {view_b} must be a positive number of metres, got {metres}")
    units = float(np.linalg.norm(model.view(view_a).centre - model.view(view_b).centre))
    if units == 0.0:
        raise InputError(f"{view_a} and {view_b} stand at one place: name two different views")
    return ScaleAnswer("distance", metres / units, _RULER_M / metres, {"views": [view_a, view_b], "metres": metres})


def parse_distance(text: str) -> tuple[str, str, float]:
    """Parse "VIEW_A,VIEW_B,METRES"."""
    try:
        view_a, view_b, metres = (each.strip() for each in text.split(","))
        return view_a, view_b, float(metres)
    except ValueError:
        told = "--distance must be VIEW_A,VIEW_B,METRES such as view_0,view_3,0.25 (with a decimal point)"
        raise InputError(f"{told}, got {text!r}") from None


@dataclass(frozen=True)
class ScaleResult:
    """All answers, the most trusted first, which is the one used. missing: why other methods have no answer."""

    answers: tuple[ScaleAnswer, ...]
    missing: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, answers: Sequence[ScaleAnswer], missing: Mapping[str, str]) -> "ScaleResult":
        """Sort the answers by trust. Raises InputError if no method has an answer, with what each looked for."""
        if not answers:
            reasons = "; ".join(f"{method}: {missing[method]}" for method in METHODS if method in missing)
            raise InputError(f"the scale in metres stays unknown. {reasons}")
        return cls(tuple(sorted(answers, key=lambda each: METHODS.index(each.method))), dict(missing))

    @property
    def used(self) -> ScaleAnswer:
        return self.answers[0]

    @property
    def disagreement(self) -> dict[str, float]:
        """Return the relative excess of each other answer over the one used."""
        return {each.method: each.metres_per_unit / self.used.metres_per_unit - 1.0 for each in self.answers[1:]}

    @property
    def contradictions(self) -> tuple[str, ...]:
        """Return the methods that differ from the one used by more than 2 % and more than three joint standard deviations."""
        return tuple(
            each.method
            for each in self.answers[1:]
            if abs(difference := self.disagreement[each.method]) > _NOTEWORTHY
            and abs(difference) > _DEVIATIONS * (each.uncertainty**2 + self.used.uncertainty**2) ** 0.5
        )


def write_scale(folder: Path, result: ScaleResult) -> None:
    document = {
        "format": FORMAT,
        "version": VERSION,
        "metres_per_unit": result.used.metres_per_unit,
        "used": result.used.method,
        "answers": [asdict(each) for each in result.answers],
        "disagreement": result.disagreement,
        "missing": dict(result.missing),
    }
    write_json(folder / SCALE_NAME, document)


def read_scale(folder: Path) -> ScaleResult:
    path = folder / SCALE_NAME
    document = read_json(path, "the metric scale (run `mrbokeh capture scale` on the scene)")
    try:
        return ScaleResult(tuple(ScaleAnswer(**each) for each in document["answers"]), document["missing"])
    except (KeyError, TypeError) as error:
        raise InputError(f"{path} is incomplete ({error!r}): run `mrbokeh capture scale --overwrite`") from None

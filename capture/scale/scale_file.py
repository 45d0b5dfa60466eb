"""scale.json: what every way to find the scale answered, how far they disagree, and which one counts.

{"format": "mrbokeh-scale", "version": 1, "metres_per_unit", "used": method, "answers": [{"method", "metres_per_unit", "uncertainty",
"facts", "outlines_px"}], "disagreement": {method: relative difference from the one used}, "missing": {method: why there is no answer}}
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from capture.poses.sparse_model_file import SCALE_NAME
from capture.scale.answer import METHODS, ScaleAnswer
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError

FORMAT = "mrbokeh-scale"
VERSION = 1

_NOTEWORTHY = 0.02
_DEVIATIONS = 3.0


@dataclass(frozen=True)
class ScaleResult:
    """answers: the most trusted first, which is the one used. missing: why other methods have no answer."""

    answers: tuple[ScaleAnswer, ...]
    missing: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, answers: Sequence[ScaleAnswer], missing: Mapping[str, str]) -> "ScaleResult":
        """Raises InputError where no method has an answer, with what each looked for."""
        if not answers:
            reasons = "; ".join(f"{method}: {missing[method]}" for method in METHODS if method in missing)
            raise InputError(f"the scale in metres stays unknown. {reasons}")
        return cls(tuple(sorted(answers, key=lambda each: METHODS.index(each.method))), dict(missing))

    @property
    def used(self) -> ScaleAnswer:
        return self.answers[0]

    @property
    def disagreement(self) -> dict[str, float]:
        """How much larger than the one used each other answer is, relative."""
        return {each.method: each.metres_per_unit / self.used.metres_per_unit - 1.0 for each in self.answers[1:]}

    @property
    def contradictions(self) -> tuple[str, ...]:
        """Methods that differ from the one used by more than 2 % and more than three of their joint standard deviations."""
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

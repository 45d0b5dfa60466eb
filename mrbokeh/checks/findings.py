"""Findings: what a check has against a picture, and the measures that it took on the way."""

from dataclasses import dataclass, field
from typing import Any

FORMAT = "mrbokeh-picture-check"
VERSION = 1


@dataclass(frozen=True)
class Finding:
    """check: its name (nan, alpha, negative, energy, leak, flicker, pop, frozen, missing, damaged, size). where: a picture or its frame.

    value: what was measured; limit: what is allowed, in the same unit.
    """

    check: str
    where: str
    text: str
    value: float
    limit: float


@dataclass
class CheckReport:
    """measures: numbers by name. skipped: checks that could not be made, with what they would need."""

    pictures: int = 0
    findings: list[Finding] = field(default_factory=list)
    measures: dict[str, float] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)

    @property
    def is_clean(self) -> bool:
        return not self.findings

    def raise_measure(self, name: str, value: float) -> None:
        """Keep the largest of all pictures."""
        self.measures[name] = max(self.measures.get(name, float("-inf")), float(value))

    def to_json(self) -> dict[str, Any]:
        return {
            "format": FORMAT,
            "version": VERSION,
            "clean": self.is_clean,
            "pictures": self.pictures,
            "findings": [{name: _json_value(value) for name, value in vars(each).items()} for each in self.findings],
            "measures": {name: _json_value(value) for name, value in self.measures.items()},
            "skipped": self.skipped,
        }


def _json_value(value: Any) -> Any:
    """JSON has neither infinity nor NaN; they are written as words."""
    return str(value) if isinstance(value, float) and not abs(value) < float("inf") else value

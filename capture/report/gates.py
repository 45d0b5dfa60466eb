"""Gates: what a stack must reach to be trusted, each with its number, its limit, the reason and the remedy."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from capture.report.json_numbers import finite


class Verdict(StrEnum):
    """absent: what the gate looks at is not there (yet), which neither passes nor fails."""

    PASSED = "passed"
    FAILED = "failed"
    ABSENT = "absent"


@dataclass(frozen=True)
class Gate:
    """One question to a stack or scene.

    name: short. where: the stack, or "scene". measured: the number as text with its unit. value: the number, None where absent.
    limit: what was wanted, as text. why: why it matters. advice: what to do where it fails, or to bring about what is absent.
    """

    name: str
    where: str
    verdict: Verdict
    measured: str
    value: float | None
    limit: str
    why: str
    advice: str

    @property
    def failed(self) -> bool:
        return self.verdict is Verdict.FAILED

    def as_json(self) -> dict[str, Any]:
        return vars(self) | {"verdict": str(self.verdict), "value": finite(self.value)}


@dataclass(frozen=True)
class Rule:
    """What a gate asks of every stack; `judge` makes gates of it."""

    name: str
    limit: str
    why: str
    advice: str

    def judge(self, where: str, value: float, measured: str, passed: bool) -> Gate:
        return Gate(self.name, where, Verdict.PASSED if passed else Verdict.FAILED, measured, value, self.limit, self.why, self.advice)

    def absent(self, where: str, missing: str) -> Gate:
        """missing: what is not there and how to make it."""
        return Gate(self.name, where, Verdict.ABSENT, missing, None, self.limit, self.why, self.advice)


def failed(gates: Sequence[Gate]) -> list[Gate]:
    return [each for each in gates if each.failed]


def absent(gates: Sequence[Gate]) -> list[Gate]:
    return [each for each in gates if each.verdict is Verdict.ABSENT]


def tally(gates: Sequence[Gate]) -> str:
    """How many were judged, how many of them failed, and the names of those that were not."""
    names = absent_names(gates)
    return f"{counts(gates)}: {names}" if names else counts(gates)


def absent_names(gates: Sequence[Gate]) -> str:
    missing = Counter(each.name for each in absent(gates))
    return ", ".join(name if count == 1 else f"{name} ({count} times)" for name, count in missing.items())


def verdict_lines(gates: Sequence[Gate]) -> list[str]:
    """A line for each gate that failed, with what to do, and one for each reason why some were not judged."""
    lines = [f"failed: {each.where}: {each.name}: {each.measured} (wanted: {each.limit}). {each.advice}" for each in failed(gates)]
    reasons: dict[str, list[str]] = {}
    for each in absent(gates):
        names = reasons.setdefault(each.measured, [])
        if each.name not in names:
            names.append(each.name)
    return [*lines, *(f"absent: {', '.join(names)}: {reason}" for reason, names in reasons.items())]


def counts(gates: Sequence[Gate]) -> str:
    missing = len(absent(gates))
    return f"{len(gates) - missing} of {len(gates)} gates judged, {len(failed(gates))} failed, {missing} absent"

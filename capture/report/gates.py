"""Gates: what a stack must reach to be trusted, each with its number, its limit, the reason and the remedy."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any


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
        return vars(self) | {"verdict": str(self.verdict)}


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

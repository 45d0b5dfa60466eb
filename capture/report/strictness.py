"""`--strict`: which gates make a command fail, and which absent ones the user allows."""

from collections.abc import Sequence

from capture.report.gates import Gate
from capture.report.scene_gates import SCENE_RULES
from capture.report.scene_page import SceneReport
from capture.report.stack_rules import STACK_RULES
from mrbokeh.system.errors import InputError

GATE_NAMES = tuple(each.name for each in (*SCENE_RULES, *STACK_RULES))


def require_gates(allow_absent: Sequence[str], strict: bool) -> tuple[str, ...]:
    """Names of gates as the report writes them. Raises InputError for a name that is none, and where nothing is strict."""
    if allow_absent and not strict:
        raise InputError(
            "--allow-absent says which gates --strict may leave unjudged, but --strict is not given: add it, or leave both out"
        )
    known = {name.casefold(): name for name in GATE_NAMES}
    for name in allow_absent:
        if name.strip().casefold() not in known:
            listed = ", ".join(f'"{each}"' for each in GATE_NAMES)
            raise InputError(f'--allow-absent "{name}": expected the name of a gate as the report shows it: {listed}')
    return tuple(known[name.strip().casefold()] for name in allow_absent)


def unmet(report: SceneReport, allowed: Sequence[str]) -> list[Gate]:
    """Gates that failed, and those that could not be judged although nobody allowed that."""
    return [*report.failures, *(each for each in report.absences if each.name not in allowed)]

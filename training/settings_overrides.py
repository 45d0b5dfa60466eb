"""Single settings from the command line: `--set name=value`, of the type that the dataclass states."""

import difflib
import types
from collections.abc import Callable, Sequence
from dataclasses import is_dataclass, replace
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from mrbokeh.system.errors import InputError
from training.settings import TrainSettings

_TRUTH = {"true": True, "false": False}
_BUDGETS = {"minutes": "epochs", "epochs": "minutes"}


def with_overrides(settings: TrainSettings, assignments: Sequence[str]) -> TrainSettings:
    """Settings with each "name=value" replaced; names of the network's shape begin with "network.".

    Giving one budget (minutes or epochs) takes the other away. Raises InputError where a name is unknown or a value of the wrong type.
    """
    types_of = _types(TrainSettings)
    given = dict(_assignment(each, types_of) for each in assignments)
    for name, other in _BUDGETS.items():
        if given.get(name) is not None:
            given.setdefault(other, None)
    shape = {name.removeprefix("network."): value for name, value in given.items() if name.startswith("network.")}
    own = {name: value for name, value in given.items() if not name.startswith("network.")}
    return replace(settings, **own, network=replace(settings.network, **shape))


def _types(kind: type, prefix: str = "") -> dict[str, Any]:
    """Type by name of all settings, those inside of others with a dot."""
    found: dict[str, Any] = {}
    for name, hint in get_type_hints(kind).items():
        found |= _types(hint, f"{prefix}{name}.") if isinstance(hint, type) and is_dataclass(hint) else {prefix + name: hint}
    return found


def _assignment(text: str, types_of: dict[str, Any]) -> tuple[str, Any]:
    name, sign, value = (part.strip() for part in text.partition("="))
    if not sign:
        raise InputError(f"expected a setting as name=value, got {text!r}: for example --set batch=4")
    if name not in types_of:
        near = difflib.get_close_matches(name, types_of, n=3)
        raise InputError(f"there is no setting {name!r}: expected one of {', '.join(near or sorted(types_of))}")
    expected, read = _reading(types_of[name])
    try:
        return name, read(value)
    except ValueError:
        raise InputError(f"the setting {name} takes {expected}, got {value!r}") from None


def _reading(hint: Any) -> tuple[str, Callable[[str], Any]]:
    """How values of a type are called, and what reads one from its text."""
    if get_origin(hint) is Literal:
        choices = {str(choice): choice for choice in get_args(hint)}
        return "one of " + ", ".join(choices), lambda text: _among(choices, text)
    if get_origin(hint) in (Union, types.UnionType):
        name, read = _reading(next(each for each in get_args(hint) if each is not types.NoneType))
        return f"{name}, or none", lambda text: None if text.lower() == "none" else read(text)
    if hint is bool:
        return "true or false", lambda text: _among(_TRUTH, text.lower())
    return {int: ("a whole number", int), float: ("a number", float), str: ("a word", str)}[hint]


def _among(choices: dict[str, Any], text: str) -> Any:
    if text not in choices:
        raise ValueError
    return choices[text]

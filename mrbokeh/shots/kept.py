"""Kept: a function that is not called again while it is given the very same things."""

from collections.abc import Callable
from typing import Generic, ParamSpec, TypeVar

_Given = ParamSpec("_Given")
_Result = TypeVar("_Result")


class Kept(Generic[_Given, _Result]):
    """Keeps the last result only. Things count as the same when they are one object (numbers and texts: when they are equal)."""

    def __init__(self, function: Callable[_Given, _Result]) -> None:
        self._function = function
        self._given: tuple[object, ...] = ()
        self._result: list[_Result] = []

    def __call__(self, *given: _Given.args, **named: _Given.kwargs) -> _Result:
        all_given = (*_flat(given), *_flat(tuple(named.values())))
        if not self._result or len(all_given) != len(self._given) or not all(map(_same, all_given, self._given)):
            self._result.clear()
            self._result.append(self._function(*given, **named))
            self._given = all_given
        return self._result[0]


def _flat(given: tuple[object, ...]) -> tuple[object, ...]:
    """Sequences by what is in them, for they are often made anew."""
    return tuple(each for one in given for each in ((len(one), *one) if isinstance(one, (tuple, list)) else (one,)))


def _same(one: object, other: object) -> bool:
    return one is other or (isinstance(one, (int, float, str)) and type(one) is type(other) and one == other)

"""Numbers as a user types them into an option; what is none is answered with what was expected."""

import re
from collections.abc import Callable, Collection
from typing import TypeVar, overload

from mrbokeh.system.errors import InputError

_Number = TypeVar("_Number")


def without_f(text: object) -> object:
    """Return what is typed for an f-number without the f/ or F before its digits."""
    return re.sub(r"^\s*f/?(?=[\d.])", "", text, flags=re.IGNORECASE) if isinstance(text, str) else text


def pixels_in(text: str, expected: str, count: int) -> tuple[tuple[float, float], ...]:
    """Return so many pixels X,Y in a text, with colons between. Raises InputError if they are others."""
    pixels = [numbers_in(each, expected, (2,)) for each in text.split(":")]
    if len(pixels) != count:
        raise InputError(f"{expected}, got {text!r}")
    return tuple((x_px, y_px) for x_px, y_px in pixels)


@overload
def numbers_in(text: str, expected: str, counts: Collection[int] = ..., *, separator: str = ...) -> tuple[float, ...]: ...
@overload
def numbers_in(text: str, expected: str, counts: Collection[int] = ..., *, number: Callable[[str], _Number]) -> tuple[_Number, ...]: ...
def numbers_in(text, expected, counts=(), *, number=float, separator=","):  # type: ignore[no-untyped-def]
    """Return the numbers in a text, one at least. counts: how many there may be, without it any. Raises InputError if they are others."""
    try:
        numbers = tuple(number(part) for part in text.split(separator))
    except (ValueError, ZeroDivisionError):
        numbers = ()
    if not numbers or (counts and len(numbers) not in counts):
        raise InputError(f"{expected}, got {text!r}")
    return numbers

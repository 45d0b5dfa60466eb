"""Lengths and distances in a stack that its user knows, and the options of `mrbokeh capture scale` that tell them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.stacks.guessed_metres import TOLD, is_near_first, metres_facts
from mrbokeh.system.errors import InputError

NEAREST_OPTION = "--nearest"


@dataclass(frozen=True)
class KnownLength:
    """metres between what is seen at two pixels."""

    x1: float
    y1: float
    x2: float
    y2: float
    metres: float

    @property
    def pixels(self) -> tuple[tuple[float, float], ...]:
        return (self.x1, self.y1), (self.x2, self.y2)

    @property
    def option(self) -> str:
        return f"--ruler {_numbers_text(self.x1, self.y1, self.x2, self.y2, self.metres)}"

    def __str__(self) -> str:
        return f"the length of {self.metres:g} m from pixel {self.x1:g},{self.y1:g} to {self.x2:g},{self.y2:g}"


@dataclass(frozen=True)
class KnownDistance:
    """metres from the lens, along its axis, to what is seen at a pixel."""

    x: float
    y: float
    metres: float

    @property
    def pixels(self) -> tuple[tuple[float, float], ...]:
        return ((self.x, self.y),)

    @property
    def option(self) -> str:
        return f"--distance-at {_numbers_text(self.x, self.y, self.metres)}"

    def __str__(self) -> str:
        return f"the distance of {self.metres:g} m at pixel {self.x:g},{self.y:g}"


def _numbers_text(*numbers: float) -> str:
    return ",".join(f"{each:.10g}" for each in numbers)


Fact = KnownLength | KnownDistance


def parse_length(text: str) -> KnownLength:
    return KnownLength(*_numbers(text, 5, "--ruler", "X1,Y1,X2,Y2,METRES such as 310,220,480,224,0.05"))


def parse_known_distance(text: str) -> KnownDistance:
    return KnownDistance(*_numbers(text, 3, "--distance-at", "X,Y,METRES such as 310,220,0.35"))


def _numbers(text: str, count: int, option: str, expected: str) -> list[float]:
    try:
        numbers = [float(each) for each in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all() or numbers[-1] <= 0.0:
        raise InputError(f"{option}: expected {expected}, got {text!r}")
    if count == 5 and numbers[:2] == numbers[2:4]:
        raise InputError(f"{option}: expected two different pixels, got the same one twice in {text!r}")
    return numbers


def told_facts(stack: FocalStack) -> list[Fact]:
    """Return the lengths and distances that were told of a stack."""
    return [_fact(each) for each in metres_facts(stack).get(TOLD, ())]


def _fact(document: Mapping[str, float]) -> Fact:
    return KnownLength(**document) if "x1" in document else KnownDistance(**document)


def told_options(stack: FocalStack) -> str:
    """Return the options of `mrbokeh capture scale` that tell again what was told of a stack; empty where nothing was."""
    options = [each.option for each in told_facts(stack)]
    if (metres_facts(stack).get("gauge") or {}).get("near_first_from") == NEAREST_OPTION:
        options.append(f"{NEAREST_OPTION} {'first' if is_near_first(stack) else 'last'}")
    return " ".join(options)

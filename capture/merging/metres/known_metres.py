"""Lengths and distances in a stack that its user knows (options of `mrbokeh capture scale`), and the files of stacks with other metres."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float32

from capture.merging.merged_pictures import write_depth_picture
from capture.merging.preferred_side import PREFERRED
from mrbokeh.figures.stack_pictures import write_merge_sheet
from mrbokeh.images.exr_io import read_exr, write_exr
from mrbokeh.stacks.focal_stack import FocalStack, Slice, write_focal_stack
from mrbokeh.stacks.guessed_metres import POSITION, SLICE_POSITION, TOLD, is_near_first, metres_facts
from mrbokeh.system.errors import InputError

NEAREST_OPTION = "--nearest"


@dataclass(frozen=True)
class KnownLength:
    """Metres between what is seen at two pixels."""

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
    """Metres from the lens, along its axis, to what is seen at a pixel."""

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


Fact = KnownLength | KnownDistance


def parse_length(text: str) -> KnownLength:
    return KnownLength(*_numbers(text, 5, "--ruler", "X1,Y1,X2,Y2,METRES such as 310,220,480,224,0.05"))


def parse_known_distance(text: str) -> KnownDistance:
    return KnownDistance(*_numbers(text, 3, "--distance-at", "X,Y,METRES such as 310,220,0.35"))


def stored_facts(stack: FocalStack) -> list[Fact]:
    """Return the lengths and distances that were told of a stack."""
    return [KnownLength(**each) if "x1" in each else KnownDistance(**each) for each in metres_facts(stack).get(TOLD, ())]


def scale_options(stack: FocalStack) -> str:
    """Return the options of `mrbokeh capture scale` that tell again what was told of a stack; empty where nothing was."""
    options = [each.option for each in stored_facts(stack)]
    if (metres_facts(stack).get("gauge") or {}).get("near_first_from") == NEAREST_OPTION:
        options.append(f"{NEAREST_OPTION} {'first' if is_near_first(stack) else 'last'}")
    return " ".join(options)


def with_known_nearest(stack: FocalStack, turned: bool) -> FocalStack:
    """Return the stack with what was recorded of near and far put right. turned: what was taken for near is far."""
    metadata = dict(stack.metadata)
    if PREFERRED in metadata:
        metadata[PREFERRED] = _known_side(metadata[PREFERRED], turned)
    return replace(stack, slices=tuple(map(_turned_slice, stack.slices)) if turned else stack.slices, metadata=metadata)


def write_changed_metres(stack: FocalStack, depth_m: Float32[np.ndarray, "height width"], turned: bool) -> None:
    """Write the stack and its new depth, and the pictures that show them. turned: what was taken for near is far."""
    part = read_exr(stack.depth_path)[0]
    channels = dict(part.channels) | {"Z": depth_m}
    if turned and POSITION in channels:
        channels[POSITION] = -channels[POSITION]
    write_exr(stack.depth_path, replace(part, channels=channels), compress=False)
    write_focal_stack(stack)
    write_depth_picture(stack)
    write_merge_sheet(stack)


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


def _numbers_text(*numbers: float) -> str:
    return ",".join(f"{each:.10g}" for each in numbers)


def _known_side(record: dict[str, Any], turned: bool) -> dict[str, Any]:
    if turned:
        other = "far" if record["side"] == "near" else "near"
        record = record | {"side": other, "first_is_near": not record["first_is_near"]}
    return record | {"sure": True}


def _turned_slice(each: Slice) -> Slice:
    if SLICE_POSITION not in each.metadata:
        return each
    return replace(each, metadata=each.metadata | {SLICE_POSITION: -each.metadata[SLICE_POSITION]})

"""Options of a state in the groups of `mrbokeh composite`, and the command line that says the same."""

import math
import os
import shlex
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args, get_type_hints

from mrbokeh.commands._composite_options import CompositeOptions, LensOptions, ObjectOptions, PlateOptions
from mrbokeh.commands._insertion_options import LensFacts, LookGroup, VirtualOptions
from mrbokeh.optics.lens_library import FOLDER as LIBRARY
from mrbokeh.system.errors import InputError
from viewfinder.studio.state import StudioState


def options_of(state: StudioState) -> CompositeOptions:
    """Return the options of a complete state. Raises InputError if a photograph, an object or its place is missing."""
    if state.photo is None:
        raise InputError("there is no photograph yet: drop one on the page, or give PHOTO on the command line")
    if state.object is None:
        raise InputError("there is no object yet: drop a GLB file on the page, choose a shipped one, or give --object")
    if state.at_px is None:
        raise InputError("the object has no place yet: click into the photograph where it is to stand")
    objects = state.objects
    # What has no height yet gets one with the metres of its place; until then any serves.
    known = [each.height for each in objects if each.height is not None]
    turns = [each.turn_deg for each in objects]
    standing = ObjectOptions(
        object_=[each.object for each in objects],
        at_pixel=[_numbers(each.at_px) for each in objects],
        height=[each.height or known[0] for each in objects] if known else None,
        turn=turns if any(turns) else None,
        pitch=state.pitch_deg,
        roll=state.roll_deg,
        camera_height=None if state.plain or state.depth is not None else state.camera_height_m,
        sun=None if state.sun_deg is None else _numbers(state.sun_deg),
        exposure=state.exposure,
        shadow=state.shadow,
        plain=state.plain,
    )
    focus_at = None if state.focus_at_px is None else ",".join(str(int(each)) for each in state.focus_at_px)
    unmatched = None if state.matched else "off"
    return CompositeOptions(
        photo=state.photo,
        taken=PlateOptions(slice_=state.slice, depth=state.depth, matte=state.matte),
        standing=standing,
        virtual=VirtualOptions(camera=state.camera),
        look=LookGroup(match_white=state.warmth_k, grain=unmatched, match_black=unmatched),
        optics=LensOptions(lens=state.lens, focus=state.focus_m, focus_at=focus_at),
        facts=LensFacts(focal_length_mm=state.focal_length_mm, f_number=state.f_number, sensor_width_mm=state.sensor_width_mm),
    )


def words_of(options: CompositeOptions, out: Path) -> list[str]:
    """Return the words after `mrbokeh`, for a result at `out`; what has its default is left out."""
    groups = (getattr(options, each.name) for each in fields(options) if each.name != "photo")
    said = [word for group in groups for word in _said(group)]
    return ["composite", _file(options.photo), *said, "--out", _file(out)]


def command_line(options: CompositeOptions, out: Path) -> str:
    """Return the command line as one types it in a shell."""
    return shlex.join(["mrbokeh", *words_of(options, out)])


def _said(group: Any) -> Iterator[str]:
    """Yield the words of a group's options that differ from their defaults."""
    hints, plain = get_type_hints(type(group), include_extras=True), type(group)()
    for each in fields(group):
        value = getattr(group, each.name)
        if value == getattr(plain, each.name):
            continue
        option = _option(each.name, hints[each.name])
        for one in value if isinstance(value, list | tuple) else [value]:
            yield from [option] if one is True else [option, _word(one)]


def _option(name: str, hint: Any) -> str:
    """Return the option of a field: its first declared name, or its own."""
    # The first positional argument of `typer.Option` is a name too, where the type is annotated.
    named = [word for each in get_args(hint) for word in (getattr(each, "default", ""), *(getattr(each, "param_decls", None) or ()))]
    declared = [word for word in named if isinstance(word, str) and word.startswith("--")]
    return declared[0] if declared else f"--{name.rstrip('_').replace('_', '-')}"


def _word(value: Any) -> str:
    return _file(value) if isinstance(value, Path) else f"{value:.9g}" if isinstance(value, float) else str(value)


def _file(path: Path) -> str:
    """Return a path in the working folder by its short name; one that looks like an option is whole."""
    if path.parent == LIBRARY and not Path(path.stem).exists():
        return path.stem
    shown = os.path.relpath(path) if path.is_absolute() and path.is_relative_to(Path.cwd()) else str(path)
    return str(path.absolute()) if shown.startswith("-") else shown


def _numbers(values: tuple[float, ...]) -> str:
    return ",".join(f"{each:.9g}" for each in values)


def preview_scale(width_px: int, height_px: int, most_px: float) -> float:
    """Return the scale at which a picture has at most so many pixels; 1 if it has no more."""
    return min(1.0, math.sqrt(most_px / (width_px * height_px)))

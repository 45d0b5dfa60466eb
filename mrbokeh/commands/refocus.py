"""`mrbokeh refocus`: new slices of a focal stack at any focus, with its own lens or another."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from mrbokeh.commands._insertion_options import ANY_LENS, ANY_RENDERER, FocusAtOption, LensFacts, require_one_focus, typed_place
from mrbokeh.commands._option_groups import grouped
from mrbokeh.refocus import Refocusing
from mrbokeh.stacks.focal_stack import FocalStack, Slice
from mrbokeh.stacks.guessed_metres import unit_of
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import guess, tell, warn

app = typer.Typer(add_completion=False)

_SETTINGS = "refocus.json"


@dataclass(frozen=True)
class BlurOptions:
    """Lens and renderer of the new slices."""

    lens: Annotated[Path | None, typer.Option(help=f"{ANY_LENS}, in place of the stack's.")] = None
    renderer: Annotated[str | None, typer.Option("--renderer", help=ANY_RENDERER)] = None
    residuals: Annotated[
        bool,
        typer.Option(
            "--residuals/--no-residuals",
            help="Carry over what rendering misses of the slices next to the focus. Without: all rendered alike, for a focus pull.",
        ),
    ] = True


@dataclass(frozen=True)
class ResultOptions:
    """Files beside OUT, and its replacement."""

    sheet: Annotated[Path | None, typer.Option(help="Also write a contact sheet of the new slices (.png).")] = None
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace OUT where it exists.")] = False


@app.command()
@grouped
def refocus(
    stack: Annotated[Path, typer.Argument(help="Folder of a merged focal stack.")],
    out: Annotated[Path, typer.Option(help="Folder for the new focal stack.")],
    blur: BlurOptions,
    facts: LensFacts,
    result: ResultOptions,
    focus: Annotated[
        str | None,
        typer.Option(
            help="Where to focus: metres, such as 0.8,1.2,inf; @X,Y on what is seen at that pixel; #2.5 between slices 2 and 3, counted "
            "from 0; or FROM:TO:COUNT of these, such as 0.5:inf:12 or #0:#13:24, evenly in dioptres and so in blur."
        ),
    ] = None,
    focus_at: FocusAtOption = None,
) -> None:
    """Make slices between and beyond the captured ones, from the all-in-focus picture and the depth, through the lens of the stack.

    A captured focus gives the captured slice, unless --no-residuals. OUT is a focal stack again, with a PNG beside each slice; an
    interrupted run goes on.

    Example: mrbokeh refocus SCENE/view_0 --focus 0.5:inf:12 --out refocused

    Example: mrbokeh refocus STACK --focus @300,200,#2.5 --out refocused
    """
    from mrbokeh.images.image_io import require_suffix
    from mrbokeh.stacks.focal_stack import read_focal_stack, write_focal_stack
    from mrbokeh.stacks.focus_places import FocusLookup, parse_focus
    from mrbokeh.stacks.guessed_metres import growth_note, guess_metres, inherited_facts
    from mrbokeh.system.atomic_files import require_safe_outputs
    from mrbokeh.system.console import kept_when_interrupted

    require_one_focus(focus=focus, focus_at=focus_at)
    if focus_at is None and focus is None:
        raise InputError("where to focus? Give --focus, such as --focus 0.8,1.2 in metres, or --focus-at X,Y on what is seen at a pixel")
    if out.resolve() == stack.resolve():
        raise InputError("--out must be another folder than the stack's own")
    if result.sheet is not None:
        require_suffix(result.sheet, (".png",), "--sheet")
        require_safe_outputs((result.sheet,), (blur.lens, out), result.overwrite)
    source = read_focal_stack(stack)
    way = _refocusing(source, blur, facts)
    seen = FocusLookup.of(source)
    if focus_at is not None:
        x_px, y_px, *radius_px = typed_place(focus_at)
        focus, seen = f"@{x_px},{y_px}", replace(seen, within_px=float(*radius_px)) if radius_px else seen
    distances_m = parse_focus(str(focus), seen)
    guess_metres(source)
    guess(growth_note(source, way.lens))
    _tell_of_mush(way, distances_m)
    _make_room(out, result.overwrite)
    settings = {"stack": str(stack.resolve()), **vars(blur), **facts.given, "lens": str(blur.lens)}
    with kept_when_interrupted(f"finished slices are kept in {out}", result.overwrite):
        slices = _write_slices(way, distances_m, out, settings, result.overwrite)
    asked = {"focus": focus} if focus_at is None else {"focus_at": focus_at}
    metadata = {"refocused": settings | asked} | inherited_facts(source, with_lens=way.lens is None)
    made = FocalStack(out, slices, way.lens_at(distances_m[0]), source.camera, registered=True, merged=True, metadata=metadata)
    _write_sharp(source, made, distances_m)
    write_focal_stack(made)
    if result.sheet is not None:
        _write_sheet(result.sheet, made)
    focused = ", ".join(f"{each:.3g}" for each in distances_m)
    told = f"wrote {out} ({len(slices)} slice{'' if len(slices) == 1 else 's'}, in focus at {focused} {unit_of(source)} from the lens)"
    lens_facts, figures = (way.lens_at(distances_m[0]).facts, {"focus_distances_m": distances_m}) if source.metres_known else ({}, {})
    tell(told, known=lens_facts, slices=len(slices), **figures)


def _tell_of_mush(way: Refocusing, distances_m: tuple[float, ...]) -> None:
    """Warn of focus at which hardly anything lies."""
    depth_m, ends_m = way.stack.depth_m(), [each for each in way.stack.focus_distances_m if each is not None]
    for focus_m in distances_m:
        least_px = float(np.percentile(np.abs(way.lens_at(focus_m).coc_px(depth_m[::4, ::4], -(-depth_m.shape[1] // 4))), 1.0)) * 4.0
        if least_px > _MUSH_PX:
            unit, slices = unit_of(way.stack), f"{min(ends_m):.3g} to {max(ends_m):.3g}"
            warn(f"nothing is sharp at {focus_m:.3g} {unit}: all is blurred by {least_px:.0f} px or more (slices are focused at {slices})")


_MUSH_PX = 4.0


def _write_sharp(source: FocalStack, made: FocalStack, distances_m: tuple[float, ...]) -> None:
    """Write all_in_focus.exr and depth.exr with all that the source knows, its focus index counted in the new slices."""
    from mrbokeh.images.camera_rgb import write_camera_rgb
    from mrbokeh.images.exr_io import read_exr, write_exr
    from mrbokeh.stacks.focus_places import index_between

    write_camera_rgb(made.all_in_focus_path, source.all_in_focus(), None, half=False)
    part = read_exr(source.depth_path)[0]
    index = index_between(distances_m, 1.0 / source.depth_m())
    write_exr(made.depth_path, replace(part, channels=dict(part.channels) | {"focus_index": index}), compress=False)


def _make_room(out: Path, overwrite: bool) -> None:
    """Remove a finished result of this command, if --overwrite asks for it; a run that was stopped has no stack.json yet and goes on."""
    from mrbokeh.stacks.focal_stack import FILE_NAME, read_focal_stack
    from mrbokeh.system.atomic_files import refuse_existing

    if out.exists() and not (out / _SETTINGS).is_file():
        raise InputError(f"{out} exists and was not made by refocus: give another name")
    if not (out / FILE_NAME).is_file():
        return
    refuse_existing(out, overwrite)
    for each in read_focal_stack(out).slices:
        for path in (out / each.path, (out / each.path).with_suffix(".png")):
            path.unlink(missing_ok=True)
    (out / FILE_NAME).unlink()


def _refocusing(source: FocalStack, blur: BlurOptions, facts: LensFacts) -> Refocusing:
    from mrbokeh.renderers.choose import lens_and_renderer

    lens, renderer = lens_and_renderer(blur.lens, blur.renderer)
    if facts.given:
        lens = facts.on(lens or source.lens_of(source.reference), renderer)
    return Refocusing(source, renderer, lens, blur.residuals)


def _write_slices(way: Refocusing, distances_m: tuple[float, ...], out: Path, settings: dict, overwrite: bool) -> tuple[Slice, ...]:
    """Write the slices; those that a stopped run made with the same settings are kept."""
    from mrbokeh.figures.stack_pictures import write_upright_png
    from mrbokeh.images.image_io import write_image
    from mrbokeh.stacks.focus_places import slice_names
    from mrbokeh.system.atomic_files import read_json, write_json
    from mrbokeh.system.console import track

    kept = not overwrite and (out / _SETTINGS).is_file() and read_json(out / _SETTINGS, "settings of refocus") == settings
    write_json(out / _SETTINGS, settings)
    slices = tuple(
        Slice(name, distance_m, metadata=_growth(way, distance_m))
        for name, distance_m in zip(slice_names(distances_m), distances_m, strict=True)
    )
    for each, distance_m in track(list(zip(slices, distances_m, strict=True)), "refocusing"):
        if not (kept and (out / each.path).is_file()):
            rgb = way.slice_at(distance_m)
            write_upright_png((out / each.path).with_suffix(".png"), rgb, way.stack)
            write_image(out / each.path, rgb, half=False)
    return slices


def _growth(way: Refocusing, distance_m: float) -> dict:
    """Return how fast blur grows in a new slice, if that was measured in the captured ones."""
    from mrbokeh.stacks.focal_stack import GROWTH, GROWTH_WIDTH

    width_px = way.stack.slices[0].metadata.get(GROWTH_WIDTH)
    if way.lens is not None or width_px is None:
        return {}
    return {GROWTH: way.lens_at(distance_m).coc_px_per_dioptre(width_px), GROWTH_WIDTH: width_px}


def _write_sheet(path: Path, made: FocalStack) -> None:
    from mrbokeh.images.image_io import SheetRow, write_contact_sheet

    pictures = {f"{each.focus_distance_m:.5g} {unit_of(made)}": made.slice_rgb(index) for index, each in enumerate(made.slices)}
    write_contact_sheet(path, [SheetRow("focus", pictures)])

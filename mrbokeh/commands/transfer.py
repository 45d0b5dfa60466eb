"""`mrbokeh transfer`: the blur of any lens, measured, learned or modelled, on a photograph in which all is sharp.

The result is one picture, a folder that is a focal stack, or a focus pull as a film.
"""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from jaxtyping import Float32

from mrbokeh.commands._insertion_options import (
    ANY_LENS,
    ANY_RENDERER,
    DisparityOption,
    ExactDepthOption,
    FocusAtOption,
    LensFacts,
    focused_at_pixel,
    require_depth_file,
    require_one_focus,
)
from mrbokeh.commands._option_groups import grouped
from mrbokeh.depth.depth_map import DepthSettings, parse_known, parse_near_far, parse_stereo
from mrbokeh.optics.lens import Lens
from mrbokeh.refocus import SharpPhotograph
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import tell, warn

Rgb = Float32[np.ndarray, "height width 3"]
Blurred = Callable[[float], Rgb]

FILMS = (".mov", ".mp4", ".mkv")
_HARDLY_PX = 3.0
_MADE = "transferred_with_depth"

app = typer.Typer(add_completion=False)


@dataclass(frozen=True)
class DepthOptions:
    """Depth of the photograph."""

    depth: Annotated[
        Path | None,
        typer.Option(
            help="EXR with Z, PNG or TIFF, an array (.npz), a phone's photograph, or a depth network (.onnx). Default: PHOTO's own."
        ),
    ] = None
    disparity: DisparityOption = None
    depth_scale: Annotated[float | None, typer.Option(help="--depth holds distance: metres for each step; 0 is unknown.")] = None
    stereo: Annotated[
        str | None, typer.Option("--stereo-cameras", metavar="FOCAL_PX,BASELINE_M,OFFSET_PX", help="Cameras of a disparity file.")
    ] = None
    depth_model_gives: Annotated[str, typer.Option(help="What a depth network gives: inverse (up to scale) or metric (metres).")] = (
        "inverse"
    )
    known: Annotated[
        list[str] | None, typer.Option("--distance-at", metavar="X,Y,METRES", help="A known distance; twice to scale a network.")
    ] = None
    refine: Annotated[
        bool | None,
        typer.Option(
            "--refine/--no-refine",
            help="Enlarge depth smaller than the photograph along its edges. Default: where that is soft.",
        ),
    ] = None

    exact_depth: ExactDepthOption = False

    @property
    def settings(self) -> DepthSettings:
        """Statements of these options about the depth, parsed."""
        return DepthSettings(
            near_far_m=None if self.disparity is None else parse_near_far(self.disparity),
            metres_per_unit=self.depth_scale,
            stereo=None if self.stereo is None else parse_stereo(self.stereo),
            model_gives=self.depth_model_gives,
            known=tuple(parse_known(each) for each in self.known or ()),
            refined=self.refine,
            exact=self.exact_depth,
        )


@dataclass(frozen=True)
class FocusOptions:
    """Distances to focus at."""

    focus: Annotated[
        str | None,
        typer.Option(help="Metres, such as 1.2 or 0.8,1.2,inf; @X,Y at a pixel; #2.5 of a stack; FROM:TO:COUNT, evenly in dioptres."),
    ] = None
    focus_at: FocusAtOption = None


@dataclass(frozen=True)
class BlurOptions:
    """Renderer, field of view and highlights."""

    renderer: Annotated[str | None, typer.Option("--renderer", help=ANY_RENDERER)] = None
    same_view: Annotated[
        bool, typer.Option("--same-view", help="Give the lens PHOTO's field of view (from its Exif), keep its f-number.")
    ] = False
    highlights: Annotated[float, typer.Option(min=0.0, max=20.0, help="What is clipped was so many stops brighter. 0: as stored.")] = 0.0


@dataclass(frozen=True)
class ResultOptions:
    """Rate of a film, files beside OUT, and replacement."""

    rate: Annotated[str, typer.Option(help="Frames per second of a film: 25, 23.976, 24000/1001.")] = "25"
    sheet: Annotated[Path | None, typer.Option(help="Also write a contact sheet of all distances (.png).")] = None
    save_depth: Annotated[Path | None, typer.Option(help="Also write the depth that was used (.exr).")] = None
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files that exist.")] = False


@app.command()
@grouped
def transfer(
    photo: Annotated[
        Path,
        typer.Argument(help="All-in-focus photograph, or a merged focal stack; of a phone's photograph with depth the sharp original."),
    ],
    out: Annotated[Path, typer.Option(help="A picture, a film (.mov, .mp4, .mkv: a focus pull), or a folder (a focal stack).")],
    depth: DepthOptions,
    focusing: FocusOptions,
    blur: BlurOptions,
    facts: LensFacts,
    result: ResultOptions,
    lens: Annotated[Path | None, typer.Option(help=f"{ANY_LENS}. Default: 50 mm f/1.8.")] = None,
) -> None:
    """Blur a sharp photograph with depth as another lens would.

    Example: mrbokeh transfer phone.jpg --lens helios.onnx --disparity 0.6:8 --focus-at 512,400 --out portrait.png

    Example: mrbokeh transfer aif.png --depth midas.onnx --disparity 0.5:inf --lens lens.json --focus 0.5:inf:48 --out pull.mp4
    """
    from mrbokeh.refocus import open_sharp, seen_like, with_recovered_highlights
    from mrbokeh.renderers.choose import lens_and_renderer
    from mrbokeh.stacks.guessed_metres import guess_metres, stack_of_file
    from mrbokeh.stacks.photograph import lens_for_photograph
    from mrbokeh.video.picture_source import parse_rate

    _require_outputs(out, result, (photo, lens, depth.depth))
    require_depth_file(depth.depth)
    settings = depth.settings
    given, blurs = lens_and_renderer(lens, blur.renderer)
    sharp = open_sharp(photo, depth.depth, settings)
    stacks = [stack for stack in (sharp.stack, stack_of_file(depth.depth)) if stack is not None]
    for stack in stacks:
        guess_metres(stack)
    held = lens_for_photograph(facts.on(given, blurs), sharp.photograph, photo)
    chosen = seen_like(held, sharp.photograph, photo) if blur.same_view else held
    distances_m = _distances(chosen, sharp, focusing)
    check_out(out, len(distances_m))
    rgb = sharp.photograph.rgb if blur.highlights == 0.0 else with_recovered_highlights(sharp.photograph.rgb, blur.highlights)

    def blurred(distance_m: float) -> Float32[np.ndarray, "height width 3"]:
        from mrbokeh.images.layer import opaque

        return blurs.render([opaque(rgb, sharp.depth.depth_m)], chosen.focused_at(distance_m)).rgb

    write_blurred(out, sharp, chosen, distances_m, blurred, parse_rate(result.rate))
    if result.sheet is not None:
        write_sheet(result.sheet, distances_m, blurred, sharp.photograph.rgb)
    if result.save_depth is not None:
        _write_depth(result.save_depth, sharp)
    coc_px = max(float(np.abs(chosen.focused_at(each).coc_px(sharp.depth.depth_m, rgb.shape[1])).max()) for each in distances_m)
    focus = "" if len(distances_m) > 1 else f"{chosen.focused_at(distances_m[0]).described}; "
    if coc_px < _HARDLY_PX:
        warn(
            f"hardly anything is blurred ({coc_px:.1f} px at most): a smaller --f-number blurs more; where the depth has no unit, "
            f"--disparity NEAR:FAR gives it one"
        )
    focused = {"focus_distance_m": distances_m}
    tell(
        f"wrote {out} ({focus}depth: {sharp.depth.note}; largest circle of confusion {coc_px:.1f} px)",
        known=chosen.facts | {"depth": sharp.depth.note} | (focused if all(stack.metres_known for stack in stacks) else {}),
        largest_coc_px=coc_px,
    )


def _require_outputs(out: Path, result: ResultOptions, inputs: tuple[Path | None, ...]) -> None:
    from mrbokeh.images.image_io import INTEGER_SUFFIXES, require_suffix
    from mrbokeh.system.atomic_files import require_safe_outputs

    named = (
        (out, ("", ".exr", *INTEGER_SUFFIXES, *FILMS), "--out"),
        (result.sheet, (".png",), "--sheet"),
        (result.save_depth, (".exr",), "--save-depth"),
    )
    for path, suffixes, name in named:
        if path is not None:
            require_suffix(path, suffixes, name)
    require_safe_outputs((out, result.sheet, result.save_depth), inputs, result.overwrite)
    if out.is_dir() and not is_transferred(out):
        raise InputError(f"{out} is a folder that was not made by transfer: give another name")


def _distances(lens: Lens, sharp: SharpPhotograph, focusing: FocusOptions) -> tuple[float, ...]:
    """Return the focus distances: from --focus, from the depth at a pixel, else of the phone, else of the lens file."""
    from mrbokeh.stacks.focus_places import FocusLookup, parse_focus

    require_one_focus(focus=focusing.focus, focus_at=focusing.focus_at)
    if focusing.focus is not None:
        slices_m = () if sharp.stack is None else tuple(each for each in sharp.stack.focus_distances_m if each is not None)
        return parse_focus(focusing.focus, FocusLookup(lens, sharp.depth.depth_m, slices_m))
    if focusing.focus_at is not None:
        return (focused_at_pixel(lens, sharp.depth.depth_m, focusing.focus_at).focus_distance_m,)
    return (lens.focus_distance_m if sharp.focus_m is None else sharp.focus_m,)


def _write_depth(path: Path, sharp: SharpPhotograph) -> None:
    from mrbokeh.images.exr_io import ExrPart, write_exr

    channels = {"Z": sharp.depth.depth_m, "mask.valid": sharp.depth.valid.astype(np.float16)}
    write_exr(path, ExrPart(channels, attributes={"comments": sharp.depth.note}))


def check_out(out: Path, count: int) -> None:
    """Raise InputError if several pictures would go into one file."""
    if count > 1 and out.suffix and out.suffix.lower() not in FILMS:
        raise InputError(f"--focus states {count} distances: give a folder or a film ({', '.join(FILMS)}) to write to, got {out}")


def write_blurred(out: Path, sharp: SharpPhotograph, lens: Lens, distances_m: tuple[float, ...], blurred: Blurred, rate: Fraction) -> None:
    if out.suffix.lower() in FILMS:
        _write_film(out, distances_m, blurred, rate)
    elif out.suffix:
        from mrbokeh.images.image_io import write_image

        write_image(out, blurred(distances_m[0]))
    else:
        _write_stack(out, sharp, lens, distances_m, blurred)


def _write_film(out: Path, distances_m: Sequence[float], blurred: Blurred, rate: Fraction) -> None:
    from mrbokeh.video.writer import VideoWriter

    first = blurred(distances_m[0])
    with VideoWriter(out, first.shape[1], first.shape[0], rate) as writer:
        for index, distance_m in enumerate(track(distances_m, "pulling focus")):
            writer.write(first if index == 0 else blurred(distance_m), float(index / rate))


def is_transferred(folder: Path) -> bool:
    """Return whether a folder is a focal stack of this command, which --overwrite may replace."""
    from mrbokeh.stacks.focal_stack import FILE_NAME, read_focal_stack

    return (folder / FILE_NAME).is_file() and _MADE in read_focal_stack(folder).metadata


def _write_stack(out: Path, sharp: SharpPhotograph, lens: Lens, distances_m: tuple[float, ...], blurred: Blurred) -> None:
    from mrbokeh.refocus import write_made_stack
    from mrbokeh.stacks.guessed_metres import inherited_facts
    from mrbokeh.system.atomic_files import atomic_folder

    if out.is_dir() and is_transferred(out):
        shutil.rmtree(out)
    metadata = {_MADE: sharp.depth.note} | ({} if sharp.stack is None else inherited_facts(sharp.stack, with_lens=False))
    with atomic_folder(out) as folder:
        write_made_stack(folder, sharp, lens, track(distances_m, "blurring"), blurred, metadata)


def write_sheet(path: Path, distances_m: Sequence[float], blurred: Blurred, sharp_rgb: Rgb) -> None:
    from mrbokeh.images.image_io import SheetRow, write_contact_sheet

    pictures = {"all in focus": sharp_rgb} | {f"{each:.4g} m": blurred(each) for each in distances_m}
    write_contact_sheet(path, [SheetRow("focus", pictures)])

"""`mrbokeh transfer`: the blur of any lens, measured, learned or modelled, on a photograph in which all is sharp."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from jaxtyping import Float32

from mrbokeh.commands._former_names import formerly
from mrbokeh.depth.depth_map import DepthSettings, parse_known, parse_near_far, parse_stereo
from mrbokeh.optics.lens import Lens
from mrbokeh.refocus.transferring import SharpPhotograph
from mrbokeh.system.errors import InputError

app = typer.Typer(add_completion=False)


@app.command(cls=formerly("frame_rate"))
def transfer(
    photo: Annotated[
        Path, typer.Argument(help="All-in-focus photograph, or a merged focal stack; of a phone's JPEG with depth the sharp original.")
    ],
    lens: Annotated[Path, typer.Option(help="LENS.json, or LENS.onnx to blur with a trained network.")],
    out: Annotated[Path, typer.Option(help="A picture, a film (.mov, .mp4, .mkv: a focus pull), or a folder (a focal stack).")],
    depth: Annotated[
        Path | None,
        typer.Option(help="EXR with Z, PNG or TIFF, disparity (.npz), a phone's JPEG, or a depth network (.onnx). Default: PHOTO's own."),
    ] = None,
    disparity: Annotated[
        str | None, typer.Option(metavar="NEAR:FAR", help="--depth is even in 1/distance, largest number at NEAR, 0 at FAR metres.")
    ] = None,
    depth_scale: Annotated[float | None, typer.Option(help="--depth holds distance: metres for each step; 0 is unknown.")] = None,
    stereo: Annotated[str | None, typer.Option(metavar="FOCAL_PX,BASELINE_M,OFFSET_PX", help="Cameras of a disparity file.")] = None,
    depth_model_gives: Annotated[
        str, typer.Option(help="What a depth network gives: inverse (up to scale) or metric (metres).")
    ] = "inverse",
    known: Annotated[list[str] | None, typer.Option(metavar="X,Y,METRES", help="A known distance; twice to scale a network.")] = None,
    refine: Annotated[
        bool | None,
        typer.Option("--refine/--no-refine", help="Sharpen soft depth edges along the photograph. Default: where depth is soft."),
    ] = None,
    focus: Annotated[
        str | None,
        typer.Option(help="Metres, such as 1.2 or 0.8,1.2,inf; @X,Y at a pixel; #2.5 of a stack; FROM:TO:COUNT, evenly in dioptres."),
    ] = None,
    focus_at: Annotated[str | None, typer.Option(help="Focus on pixel X,Y, or on what lies within R pixels of it: X,Y,R.")] = None,
    renderer: Annotated[
        str | None, typer.Option("--renderer", "--method", help="polygon, low-rank, scatter or NETWORK.onnx. Default: --lens if a network.")
    ] = None,
    same_view: Annotated[
        bool, typer.Option("--same-view", help="Give the lens PHOTO's field of view (from its Exif), keep its f-number.")
    ] = False,
    highlights: Annotated[float, typer.Option(min=0.0, help="Take what is clipped to be so many stops brighter. 0: as stored.")] = 0.0,
    frame_rate: Annotated[float, typer.Option("--rate", min=1.0, help="Frames per second of a film.")] = 25.0,
    sheet: Annotated[Path | None, typer.Option(help="Also write a contact sheet of all distances (.png).")] = None,
    save_depth: Annotated[Path | None, typer.Option(help="Also write the depth that was used (.exr).")] = None,
    overwrite: Annotated[bool, typer.Option(help="Replace files that exist.")] = False,
) -> None:
    """Blur a sharp photograph with depth as another lens would.

    Example: mrbokeh transfer phone.jpg --lens helios.onnx --disparity 0.6:8 --focus-at 512,400 --out portrait.png

    Example: mrbokeh transfer aif.png --depth midas.onnx --disparity 0.5:inf --lens lens.json --focus 0.5:inf:48 --out pull.mp4
    """
    from mrbokeh.commands._transfer_outputs import check_out, write_blurred, write_sheet
    from mrbokeh.refocus.transferring import open_sharp, seen_like, with_recovered_highlights
    from mrbokeh.renderers.choose import lens_and_renderer
    from mrbokeh.stacks.guessed_metres import metres_note, note_of_file
    from mrbokeh.stacks.photograph import lens_as_held

    _require_outputs(out, sheet, save_depth, (photo, lens, depth), overwrite)
    settings = DepthSettings(
        None if disparity is None else parse_near_far(disparity),
        depth_scale,
        None if stereo is None else parse_stereo(stereo),
        depth_model_gives,
        tuple(parse_known(each) for each in known or ()),
        refine,
    )
    given, blurs = lens_and_renderer(lens, renderer)
    assert given is not None
    sharp = open_sharp(photo, depth, settings)
    for note in dict.fromkeys(filter(None, (metres_note(sharp.stack) if sharp.stack else "", note_of_file(depth)))):
        typer.echo(note)
    held = lens_as_held(given, sharp.photograph, photo)
    chosen = seen_like(held, sharp.photograph, photo) if same_view else held
    distances_m = _distances(chosen, sharp, focus, focus_at)
    check_out(out, len(distances_m))
    rgb = sharp.photograph.rgb if highlights == 0.0 else with_recovered_highlights(sharp.photograph.rgb, highlights)

    def blurred(distance_m: float) -> Float32[np.ndarray, "height width 3"]:
        from mrbokeh.images.layer import opaque

        return blurs.render([opaque(rgb, sharp.depth.depth_m)], chosen.focused_at(distance_m)).rgb

    write_blurred(out, sharp, chosen, distances_m, blurred, frame_rate)
    if sheet is not None:
        write_sheet(sheet, distances_m, blurred, sharp.photograph.rgb)
    if save_depth is not None:
        _write_depth(save_depth, sharp)
    coc_px = max(float(np.abs(chosen.focused_at(each).coc_px(sharp.depth.depth_m, rgb.shape[1])).max()) for each in distances_m)
    typer.echo(f"wrote {out} (depth: {sharp.depth.note}; largest circle of confusion {coc_px:.1f} px)")


def _require_outputs(out: Path, sheet: Path | None, save_depth: Path | None, inputs: tuple[Path | None, ...], overwrite: bool) -> None:
    from mrbokeh.commands._transfer_outputs import FILMS, is_transferred
    from mrbokeh.images.image_io import INTEGER_SUFFIXES, require_suffix
    from mrbokeh.system.atomic_files import require_safe_outputs

    named = (
        (out, ("", ".exr", *INTEGER_SUFFIXES, *FILMS), "--out"),
        (sheet, (".png",), "--sheet"),
        (save_depth, (".exr",), "--save-depth"),
    )
    for path, suffixes, name in named:
        if path is not None:
            require_suffix(path, suffixes, name)
    require_safe_outputs((out, sheet, save_depth), inputs, overwrite)
    if out.is_dir() and not is_transferred(out):
        raise InputError(f"{out} is a folder that was not made by transfer: give another name")


def _distances(lens: Lens, sharp: SharpPhotograph, focus: str | None, focus_at: str | None) -> tuple[float, ...]:
    """From --focus, from the depth at a pixel, else where the phone had focused, else as the lens file says."""
    from mrbokeh.commands._render_method import focused
    from mrbokeh.stacks.focus_places import Seen, parse_focus

    if focus is not None and focus_at is not None:
        raise InputError("give either --focus or --focus-at, not both")
    if focus is not None:
        slices_m = () if sharp.stack is None else tuple(each for each in sharp.stack.focus_distances_m if each is not None)
        return parse_focus(focus, Seen(lens, sharp.depth.depth_m, slices_m))
    if focus_at is not None:
        return (focused(lens, {"photo": sharp.layer}, None, focus_at).focus_distance_m,)
    return (lens.focus_distance_m if sharp.focus_m is None else sharp.focus_m,)


def _write_depth(path: Path, sharp: SharpPhotograph) -> None:
    from mrbokeh.images.exr_io import ExrPart, write_exr

    channels = {"Z": sharp.depth.depth_m, "mask.valid": sharp.depth.valid.astype(np.float16)}
    write_exr(path, ExrPart(channels, attributes={"comments": sharp.depth.note}))

"""Options of `mrbokeh video` alone, in groups."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from mrbokeh.commands import _insertion_options as shared
from mrbokeh.commands._insertion_options import LENS, PLATE, RESULT, VIRTUAL
from mrbokeh.renderers.choose import DEFAULT
from mrbokeh.shots.shot import SEGMENT_S

WORK = "Who works"

ClipArgument = Annotated[
    Path,
    typer.Argument(metavar="CLIP", help="A video; or, with --rate, numbered pictures: frames.%04d.exr, frames.####.exr or their folder."),
]
LensOption = Annotated[
    Path, typer.Option(metavar="LENS.json", help="The lens, focused as it was when the clip was shot.", rich_help_panel=LENS)
]
OutOption = Annotated[
    Path,
    typer.Option(
        metavar="VIDEO",
        help=".mov (ProRes 4444), .mp4 (H.264), .mxf (DNxHR), .mkv (FFV1, lossless) or frames.%04d.exr|png|tif|jpg.",
        rich_help_panel=RESULT,
    ),
]


@dataclass(frozen=True)
class ClipOptions(shared.NearOptions):
    """Options of the clip: which frames are taken, their numbers, and depth."""

    rate: Annotated[
        str | None, typer.Option(help="Frames per second of numbered pictures: 25, 23.976, 24000/1001.", rich_help_panel=PLATE)
    ] = None
    frames: Annotated[
        str, typer.Option(metavar="START:STOP", help="Frames to take, counted from 0; STOP is left out.", rich_help_panel=PLATE)
    ] = ":"
    first_number: Annotated[
        int | None,
        typer.Option(
            help="What the clip's frame 0 is called in sequences, tracks and focus pulls; default: as its own files, or 0.",
            rich_help_panel=PLATE,
        ),
    ] = None
    depth: Annotated[
        Path | None,
        typer.Option(metavar="DEPTH.exr", help="Depth of the filmed scene in metres, one file or depth.%04d.exr.", rich_help_panel=PLATE),
    ] = None
    steady_depth: Annotated[
        bool, typer.Option("--steady-depth", help="Filter numbered depth in time, against flicker.", rich_help_panel=PLATE)
    ] = False


@dataclass(frozen=True)
class RenderingOptions(shared.RenderingOptions):
    """Options of filming --scene. shutter: angle in degrees; readout, scene_begin: in seconds."""

    scene_begin: Annotated[
        float, typer.Option(help="Second of the clip at which the animations of --scene begin.", rich_help_panel=VIRTUAL)
    ] = 0.0
    shutter: Annotated[
        float | None,
        typer.Option(min=0.0, max=360.0, metavar="DEGREES", help="Shutter angle: --scene is blurred by its motion.", rich_help_panel=LENS),
    ] = None
    readout: Annotated[
        float, typer.Option(help="Seconds from the first to the last row of a rolling shutter, with --shutter.", rich_help_panel=LENS)
    ] = 0.0


@dataclass(frozen=True)
class BlurOptions:
    """Focus by frame, and the renderer."""

    focus_pull: Annotated[
        str | None,
        typer.Option(
            metavar="KEYS|FILE.csv", help="Focus by frame: FRAME:METRES,FRAME:METRES or metadata of a camera.", rich_help_panel=LENS
        ),
    ] = None
    renderer: Annotated[
        str, typer.Option("--renderer", "--method", help="polygon, low-rank, scatter, or a network (.onnx).", rich_help_panel=LENS)
    ] = DEFAULT


@dataclass(frozen=True)
class ResultOptions:
    """Options of the written result."""

    encoding: Annotated[
        str | None,
        typer.Option(
            help="h264, h264-10bit, h265-10bit, prores4444, prores4444-alpha, prores422, dnxhr-hqx, ffv1 or ffv1-alpha; by default the "
            "usual one of OUT, with alpha where CLIP has some.",
            rich_help_panel=RESULT,
        ),
    ] = None
    constant_rate: Annotated[
        str | None,
        typer.Option(
            metavar="FPS",
            help="Hold or leave out pictures of a clip of uneven times, so that OUT has this even rate (as MXF needs it).",
            rich_help_panel=RESULT,
        ),
    ] = None
    virtual_only: Annotated[
        bool,
        typer.Option("--virtual-only", help="Write the blurred virtual layer with alpha: EXR files, .mov or .mkv.", rich_help_panel=RESULT),
    ] = False
    overwrite: shared.OverwriteOption = False


@dataclass(frozen=True)
class WorkOptions:
    """Options of the workers. workers: processes here; cluster: a scheduler elsewhere; segment: in seconds."""

    workers: Annotated[int, typer.Option(min=0, help="Processes on this machine; 0 takes one for each core.", rich_help_panel=WORK)] = 0
    cluster: Annotated[
        str | None, typer.Option(metavar="tcp://HOST:8786", help="Dask scheduler whose workers see the same files.", rich_help_panel=WORK)
    ] = None
    segment: Annotated[
        float, typer.Option(min=0.01, help="Seconds of a segment, the least that a kill can lose.", rich_help_panel=WORK)
    ] = SEGMENT_S

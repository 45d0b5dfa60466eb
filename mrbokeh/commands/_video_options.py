"""Options of `mrbokeh video`, in groups."""

from pathlib import Path
from typing import Annotated

import typer

CLIP, VIRTUAL, LENS, RESULT, WORK = "The clip", "What is put in", "The lens", "The result", "Who works"

ClipArgument = Annotated[Path, typer.Argument(metavar="CLIP", help="A video, or numbered pictures (frames.%04d.exr) with --rate.")]
RateOption = Annotated[
    str | None, typer.Option(help="Frames per second of numbered pictures: 25, 23.976, 24000/1001.", rich_help_panel=CLIP)
]
FramesOption = Annotated[
    str, typer.Option(metavar="START:STOP", help="Frames to take, counted from 0; STOP is left out.", rich_help_panel=CLIP)
]
NumberOption = Annotated[
    int | None,
    typer.Option(
        help="What the clip's frame 0 is called in sequences, tracks and focus pulls; default: as its own files, or 0.",
        rich_help_panel=CLIP,
    ),
]
DepthOption = Annotated[
    Path | None,
    typer.Option(metavar="DEPTH.exr", help="Depth of the filmed scene in metres, one file or depth.%04d.exr.", rich_help_panel=CLIP),
]
MatteOption = Annotated[
    Path | None,
    typer.Option(
        metavar="MATTE.png", help="White where something real stands in front, sharp; one file or matte.%04d.png.", rich_help_panel=CLIP
    ),
]
NearDistanceOption = Annotated[
    float | None, typer.Option(metavar="METRES", help="How far what --matte shows is, where there is no depth.", rich_help_panel=CLIP)
]
SteadyOption = Annotated[bool, typer.Option("--steady-depth", help="Filter numbered depth in time, against flicker.", rich_help_panel=CLIP)]

LayerOption = Annotated[
    list[Path] | None,
    typer.Option(
        metavar="RGBAZ.exr",
        help="All-in-focus virtual layer (linear, premultiplied, Z in metres), one file or layer.%04d.exr; front first.",
        rich_help_panel=VIRTUAL,
    ),
]
SceneOption = Annotated[
    Path | None, typer.Option(metavar="SCENE.toml", help="Scene file whose objects are rendered per frame.", rich_help_panel=VIRTUAL)
]
CameraOption = Annotated[
    Path | None,
    typer.Option(
        metavar="CAMERA",
        help="For --scene: a fixed camera (JSON) or a track (JSON, .chan, nerfstudio, COLMAP, OpenTrackIO).",
        rich_help_panel=VIRTUAL,
    ),
]
BackendOption = Annotated[str, typer.Option(help="Who renders --scene: auto, embree, wgpu or mitsuba.", rich_help_panel=VIRTUAL)]
SamplesOption = Annotated[int, typer.Option(min=1, help="Paths per pixel of mitsuba.", rich_help_panel=VIRTUAL)]
CatchOption = Annotated[
    str,
    typer.Option(help="What the ground of --scene catches: shadow or light (with mitsuba also reflections).", rich_help_panel=VIRTUAL),
]
ShutterOption = Annotated[
    float | None,
    typer.Option(min=0.0, max=360.0, metavar="DEGREES", help="Shutter angle: --scene is blurred by its motion.", rich_help_panel=LENS),
]
ReadoutOption = Annotated[
    float, typer.Option(help="Seconds from the first to the last row of a rolling shutter, with --shutter.", rich_help_panel=LENS)
]
DistortionOption = Annotated[
    Path | None,
    typer.Option(metavar="DISTORTION.json", help="How the lens bends straight lines: --scene is bent alike.", rich_help_panel=LENS),
]
BeginOption = Annotated[float, typer.Option(help="Second of the clip at which the animations of --scene begin.", rich_help_panel=VIRTUAL)]
ModeOption = Annotated[
    str | None,
    typer.Option(
        help="How layers go in: front, over (by depth), matte, between (behind blurred near things) or rerender.", rich_help_panel=VIRTUAL
    ),
]

LensOption = Annotated[
    Path, typer.Option(metavar="LENS.json", help="The lens, focused as it was when the clip was shot.", rich_help_panel=LENS)
]
FocusOption = Annotated[
    str | None,
    typer.Option(metavar="KEYS|FILE.csv", help="Focus by frame: FRAME:METRES,FRAME:METRES or metadata of a camera.", rich_help_panel=LENS),
]
RendererOption = Annotated[
    str, typer.Option("--renderer", "--method", help="polygon, low-rank, scatter, or a network (.onnx).", rich_help_panel=LENS)
]

OutOption = Annotated[
    Path,
    typer.Option(
        metavar="VIDEO",
        help=".mov (ProRes 4444), .mp4 (H.264), .mxf (DNxHR), .mkv (FFV1, lossless) or frames.%04d.exr|png|tif.",
        rich_help_panel=RESULT,
    ),
]
EncodingOption = Annotated[
    str | None,
    typer.Option(
        help="h264, h264-10bit, h265-10bit, prores4444, prores4444-alpha, prores422, dnxhr-hqx or ffv1; by default the usual one of OUT.",
        rich_help_panel=RESULT,
    ),
]
VirtualOption = Annotated[
    bool,
    typer.Option(
        "--virtual-only", help="Write the blurred virtual layer with alpha: EXR files, or prores4444-alpha.", rich_help_panel=RESULT
    ),
]
OverwriteOption = Annotated[
    bool, typer.Option("--overwrite", help="Replace OUT, and finished segments of other settings.", rich_help_panel=RESULT)
]

WorkersOption = Annotated[int, typer.Option(min=0, help="Processes on this machine; 0 takes one for each core.", rich_help_panel=WORK)]
ClusterOption = Annotated[
    str | None, typer.Option(metavar="tcp://HOST:8786", help="Dask scheduler whose workers see the same files.", rich_help_panel=WORK)
]
SegmentOption = Annotated[float, typer.Option(min=0.01, help="Seconds of a segment, the least that a kill can lose.", rich_help_panel=WORK)]

"""Options of `mrbokeh composite`, in groups."""

from pathlib import Path
from typing import Annotated

import typer

PLATE, VIRTUAL, LIGHT, LENS, RESULT = "The photograph", "What is put in", "Its light", "The lens", "The result"

PhotoArgument = Annotated[
    Path,
    typer.Argument(
        metavar="PHOTO",
        help="A photograph (RAW, JPEG, TIFF, PNG, EXR), the folder of a merged focal stack, or a capture bundle of the viewfinder.",
    ),
]
SliceOption = Annotated[int | None, typer.Option("--slice", help="Which slice of the focal stack to put it into.", rich_help_panel=PLATE)]
AllSlicesOption = Annotated[
    bool, typer.Option("--all-slices", help="Put it into every slice of the stack; OUT is a new stack.", rich_help_panel=PLATE)
]
DepthOption = Annotated[
    Path | None,
    typer.Option(
        help="Depth of the photograph: EXR with Z, PNG or TIFF, a phone's JPEG, disparity (.npz) or a depth network (.onnx).",
        rich_help_panel=PLATE,
    ),
]
DisparityOption = Annotated[
    str | None,
    typer.Option(metavar="NEAR:FAR", help="--depth is even in 1/distance, largest number at NEAR, 0 at FAR metres.", rich_help_panel=PLATE),
]
DepthScaleOption = Annotated[
    float | None, typer.Option(help="--depth holds distance: metres for each step; 0 is unknown.", rich_help_panel=PLATE)
]
MatteOption = Annotated[
    Path | None,
    typer.Option(metavar="MATTE.png", help="White where something real stands in front, sharp; for --mode between.", rich_help_panel=PLATE),
]
NearDistanceOption = Annotated[
    float | None, typer.Option(metavar="METRES", help="How far what --matte shows is, where there is no depth.", rich_help_panel=PLATE)
]
InputSpaceOption = Annotated[
    str | None, typer.Option(help="OpenColorIO space of the photograph's numbers, such as ACEScg.", rich_help_panel=PLATE)
]

LayerOption = Annotated[
    list[Path] | None,
    typer.Option(help="EXR with R, G, B, A, Z, deep EXR too; may be given several times, front first.", rich_help_panel=VIRTUAL),
]
ObjectsOption = Annotated[
    str | None, typer.Option(metavar="NAME,NAME", help="Only these objects of the layers, by their Cryptomatte.", rich_help_panel=VIRTUAL)
]
ObjectOption = Annotated[Path | None, typer.Option("--object", help="GLB file to render and put in.", rich_help_panel=VIRTUAL)]
AtOption = Annotated[
    str | None, typer.Option(help="X,Y,Z in metres where the object stands: right, down, forward of the lens.", rich_help_panel=VIRTUAL)
]
AtPixelOption = Annotated[
    str | None, typer.Option(help="X,Y of the pixel on which the object stands; needs depth.", rich_help_panel=VIRTUAL)
]
HeightOption = Annotated[
    float | None, typer.Option(help="Height of the object in metres; default: as in the file.", rich_help_panel=VIRTUAL)
]
TurnOption = Annotated[float, typer.Option(help="Turn of the object about the vertical in degrees.", rich_help_panel=VIRTUAL)]
TiltOption = Annotated[float, typer.Option(help="How far the camera looks down, in degrees.", rich_help_panel=VIRTUAL)]
SceneOption = Annotated[
    Path | None, typer.Option(metavar="SCENE.toml", help="Scene file with objects, lights and shadow.", rich_help_panel=VIRTUAL)
]
CameraOption = Annotated[
    Path | None,
    typer.Option(
        metavar="CAMERA", help="For --scene: the camera with its pose; default: it looks along z from the origin.", rich_help_panel=VIRTUAL
    ),
]
TimeOption = Annotated[float, typer.Option(help="Second of the animations that is shown.", rich_help_panel=VIRTUAL)]
ModeOption = Annotated[
    str | None,
    typer.Option(
        help="front, over, matte, between or rerender. Default: between in a focal stack, over with depth, else front.",
        rich_help_panel=VIRTUAL,
    ),
]

BackendOption = Annotated[str, typer.Option(help="Who renders objects: auto, embree, wgpu or mitsuba.", rich_help_panel=LIGHT)]
SamplesOption = Annotated[int, typer.Option(min=1, help="Paths per pixel of mitsuba.", rich_help_panel=LIGHT)]
EnvironmentOption = Annotated[Path | None, typer.Option(help="Panorama (.hdr, .exr) that lights the --object.", rich_help_panel=LIGHT)]
ExposureOption = Annotated[float, typer.Option(help="Factor on the object's light.", rich_help_panel=LIGHT)]
ShadowOption = Annotated[float, typer.Option(help="Darkness of the object's shadow, 0 to 1.", rich_help_panel=LIGHT)]
CatchOption = Annotated[
    str,
    typer.Option(help="What the ground under a shadow catches: shadow, or light (also reflections, with mitsuba).", rich_help_panel=LIGHT),
]

LensOption = Annotated[
    Path | None,
    typer.Option(help="LENS.json, or LENS.onnx to blur with a trained network. Default: what the photograph tells.", rich_help_panel=LENS),
]
FocusOption = Annotated[float | None, typer.Option(help="Focus distance of the photograph in metres.", rich_help_panel=LENS)]
RendererOption = Annotated[
    str | None,
    typer.Option(
        "--renderer",
        "--method",
        help="polygon, low-rank, scatter or NETWORK.onnx. Default: --lens if a network, else polygon.",
        rich_help_panel=LENS,
    ),
]
DistortionOption = Annotated[
    Path | None,
    typer.Option(metavar="DISTORTION.json", help="How the lens bends straight lines: objects are bent alike.", rich_help_panel=LENS),
]

OutOption = Annotated[
    Path,
    typer.Option(
        help="The picture: .exr stays linear and holds all layers, .png and .tif are 16-bit sRGB, .jpg is 8-bit.", rich_help_panel=RESULT
    ),
]
SaveLayerOption = Annotated[
    Path | None, typer.Option(help="Also write the blurred virtual layer (EXR with alpha).", rich_help_panel=RESULT)
]
OutputSpaceOption = Annotated[
    str | None,
    typer.Option(help="OpenColorIO space of OUT, such as ACEScg; OUT then holds the picture alone.", rich_help_panel=RESULT),
]
OcioOption = Annotated[
    str, typer.Option(metavar="CONFIG", help="OpenColorIO configuration: aces, aces-cg or a file.", rich_help_panel=RESULT)
]
OverwriteOption = Annotated[bool, typer.Option(help="Replace files that exist.", rich_help_panel=RESULT)]

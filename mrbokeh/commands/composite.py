"""`mrbokeh composite`: virtual objects into a photograph."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mrbokeh.errors import InputError

if TYPE_CHECKING:
    from mrbokeh.camera import Camera
    from mrbokeh.layer import Layer
    from mrbokeh.staging.one_object import OneObject

app = typer.Typer(add_completion=False)


@app.command()
def composite(
    photo: Annotated[
        Path,
        typer.Argument(help="A photograph, the folder of a merged focal stack (then give --slice), or a capture bundle of the viewfinder."),
    ],
    out: Annotated[Path, typer.Option(help="Where the picture goes: .exr stays linear, .png and .tif are 16-bit sRGB, .jpg is 8-bit.")],
    layer: Annotated[list[Path] | None, typer.Option(help="EXR layer with R, G, B, A, Z; may be given several times, front first.")] = None,
    object_: Annotated[Path | None, typer.Option("--object", help="GLB file to render and put in.")] = None,
    lens: Annotated[
        Path | None, typer.Option(help="LENS.json, or LENS.onnx to blur with a trained network. A stack brings its own.")
    ] = None,
    renderer: Annotated[
        str | None,
        typer.Option(
            "--renderer", "--method", help="polygon, low-rank, scatter or NETWORK.onnx. Default: --lens if a network, else polygon."
        ),
    ] = None,
    slice_: Annotated[int | None, typer.Option("--slice", help="Which slice of the focal stack to put it into.")] = None,
    depth: Annotated[
        Path | None, typer.Option(help="Depth of the photograph in metres (EXR with Z): real things hide virtual ones.")
    ] = None,
    focus: Annotated[float | None, typer.Option(help="Focus distance of the photograph in metres.")] = None,
    at: Annotated[str | None, typer.Option(help="X,Y,Z in metres where the object stands: right, down, forward of the lens.")] = None,
    at_pixel: Annotated[str | None, typer.Option(help="X,Y of the pixel on which the object stands; needs depth.")] = None,
    height: Annotated[float | None, typer.Option(help="Height of the object in metres; default: as in the file.")] = None,
    turn: Annotated[float, typer.Option(help="Turn of the object about the vertical in degrees.")] = 0.0,
    tilt: Annotated[float, typer.Option(help="How far the camera looks down, in degrees.")] = 0.0,
    environment: Annotated[Path | None, typer.Option(help="Panorama (.hdr, .exr) that lights the object.")] = None,
    exposure: Annotated[float, typer.Option(help="Factor on the object's light.")] = 1.0,
    shadow: Annotated[float, typer.Option(help="Darkness of the object's shadow, 0 to 1.")] = 0.0,
    save_layer: Annotated[Path | None, typer.Option(help="Also write the blurred virtual layer (EXR with alpha).")] = None,
    overwrite: Annotated[bool, typer.Option(help="Replace files that exist.")] = False,
) -> None:
    """Put virtual objects into a photograph, blurred by its lens.

    Example: mrbokeh composite SCENE/view_2 --slice 1 --object cake.glb --at-pixel 300,250 --height 0.1 --lens lens.onnx --out out.png

    Example: mrbokeh composite captures/20261122-101500 --out captured.png
    """
    import math

    from mrbokeh.atomic_files import refuse_existing
    from mrbokeh.capture_bundle import is_bundle, read_bundle
    from mrbokeh.compositing.choose import DEFAULT_MODE, insertion_of
    from mrbokeh.image_io import read_layer, write_image, write_layer
    from mrbokeh.plate import bundle_plate, open_plate
    from mrbokeh.renderers.choose import lens_and_renderer
    from mrbokeh.staging.one_object import OneObject
    from mrbokeh.staging.scene_description import Lighting

    for path in (out, save_layer):
        if path is not None:
            refuse_existing(path, overwrite)
    bundle = read_bundle(photo) if is_bundle(photo) else None
    used_lens, used_renderer = lens_and_renderer(lens, renderer or (bundle.renderer if bundle and lens is None else None))
    plate = open_plate(photo, slice_, depth, used_lens, focus) if bundle is None else bundle_plate(bundle, depth, used_lens, focus)
    layers = [read_layer(path) for path in layer or ()] + list(bundle.layers if bundle else ())
    if object_ is not None:
        foot_m = _triple(at) if at else plate.point_under_pixel_m(*_pair(at_pixel))
        light = Lighting(environment, exposure=exposure)
        layers += _rendered(OneObject(object_, foot_m, height, math.radians(turn), math.radians(tilt), light, shadow), plate.camera)
    if not layers:
        raise InputError("nothing to put into the photograph: give --object OBJ.glb or --layer RGBAZ.exr")
    inserted = insertion_of(DEFAULT_MODE).insert(plate, layers, used_renderer)
    write_image(out, inserted.rgb)
    if save_layer is not None:
        write_layer(save_layer, inserted.virtual)
    typer.echo(f"wrote {out}")


def _rendered(one: "OneObject", camera: "Camera") -> "list[Layer]":
    from mrbokeh.scene.choose import scene_renderer
    from mrbokeh.staging.assets import Assets
    from mrbokeh.staging.staged_layers import staged_layers
    from mrbokeh.staging.staged_scene import StagedScene

    return staged_layers(StagedScene.load(one.described(), Assets()), one.seen_by(camera), scene_renderer("embree"))


def _triple(text: str) -> tuple[float, float, float]:
    x_m, y_m, z_m = _numbers(text, 3, "--at")
    return x_m, y_m, z_m


def _pair(at_pixel: str | None) -> tuple[float, float]:
    if at_pixel is None:
        raise InputError("where does the object stand? Give --at X,Y,Z in metres, or --at-pixel X,Y on a photograph with depth")
    x_px, y_px = _numbers(at_pixel, 2, "--at-pixel")
    return x_px, y_px


def _numbers(text: str, count: int, option: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count:
        raise InputError(f"{option} expects {count} numbers with commas between, got {text!r}")
    return numbers

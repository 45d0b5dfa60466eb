"""`mrbokeh composite`: virtual objects into a photograph, or into all slices of a focal stack."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from mrbokeh.commands import _composite_options as options
from mrbokeh.commands import _look_options as look

if TYPE_CHECKING:
    from mrbokeh.commands._composite_layers import LayersFor
    from mrbokeh.compositing.base import Insertion
    from mrbokeh.lens import Lens
    from mrbokeh.renderers.base import Renderer

app = typer.Typer(add_completion=False)


@app.command()
def composite(
    photo: options.PhotoArgument,
    out: options.OutOption,
    slice_: options.SliceOption = None,
    all_slices: options.AllSlicesOption = False,
    depth: options.DepthOption = None,
    disparity: options.DisparityOption = None,
    depth_scale: options.DepthScaleOption = None,
    matte: options.MatteOption = None,
    near_distance: options.NearDistanceOption = None,
    input_space: options.InputSpaceOption = None,
    layer: options.LayerOption = None,
    objects: options.ObjectsOption = None,
    object_: options.ObjectOption = None,
    at: options.AtOption = None,
    at_pixel: options.AtPixelOption = None,
    height: options.HeightOption = None,
    turn: options.TurnOption = 0.0,
    tilt: options.TiltOption = 0.0,
    scene: options.SceneOption = None,
    camera: options.CameraOption = None,
    time: options.TimeOption = 0.0,
    mode: options.ModeOption = None,
    scene_renderer: options.BackendOption = "embree",
    samples: options.SamplesOption = 64,
    environment: options.EnvironmentOption = None,
    exposure: options.ExposureOption = 1.0,
    shadow: options.ShadowOption = 0.0,
    catch: options.CatchOption = "shadow",
    match_grey: look.MatchGreyOption = None,
    grey_value: look.GreyValueOption = 0.18,
    match_exposure: look.MatchExposureOption = None,
    match_white: look.MatchWhiteOption = None,
    match_black: look.MatchBlackOption = None,
    vignetting: look.VignettingOption = None,
    grain: look.GrainOption = None,
    light_wrap: look.LightWrapOption = None,
    seed: look.SeedOption = 0,
    lens: options.LensOption = None,
    focus: options.FocusOption = None,
    renderer: options.RendererOption = None,
    distortion: options.DistortionOption = None,
    save_layer: options.SaveLayerOption = None,
    output_space: options.OutputSpaceOption = None,
    ocio: options.OcioOption = "aces",
    overwrite: options.OverwriteOption = False,
) -> None:
    """Put virtual objects into a photograph, blurred by its lens, behind and before what is blurred in it.

    Example: mrbokeh composite SCENE/view_2 --slice 1 --object cake.glb --at-pixel 300,250 --height 0.1 --lens lens.onnx --out out.png

    Example: mrbokeh composite IMG_2041.NEF --layer lantern.exr --depth phone.jpg --grain auto --out out.exr

    Example: mrbokeh composite captures/20261122-101500 --out captured.png
    """
    from mrbokeh.atomic_files import refuse_existing
    from mrbokeh.capture_bundle import is_bundle, read_bundle
    from mrbokeh.commands._composite_layers import ObjectOptions, SceneOptions, VirtualOptions, layers_by
    from mrbokeh.commands._composite_outputs import write_picture
    from mrbokeh.commands._composite_plate import PlateOptions, insertion_for, plate_by
    from mrbokeh.image_io import write_layer
    from mrbokeh.plate_look.finishing import finished
    from mrbokeh.plate_look.look_options import LookOptions, finishing_of
    from mrbokeh.renderers.choose import lens_and_renderer

    for path in (out, save_layer):
        if path is not None:
            refuse_existing(path, overwrite)
    bundle = read_bundle(photo) if is_bundle(photo) else None
    used_lens, used_renderer = lens_and_renderer(lens, renderer or (bundle.renderer if bundle and lens is None else None))
    plate_options = PlateOptions(photo, 0 if all_slices else slice_, focus, depth, disparity, depth_scale, matte, input_space, ocio)
    plate = plate_by(plate_options, used_lens, bundle)
    standing = ObjectOptions(object_, at, at_pixel, height, turn, tilt, environment, exposure, shadow)
    rendering = SceneOptions(scene, camera, time, scene_renderer, samples, catch, distortion)
    layers_for = layers_by(VirtualOptions(tuple(layer or ()), objects, standing, rendering), plate, bundle)
    insertion = insertion_for(mode, plate, near_distance)
    if all_slices:
        _into_all_slices(photo, out, layers_for, insertion, used_renderer, used_lens)
        return
    wanted = LookOptions(match_grey, grey_value, match_exposure, match_white, match_black, vignetting, grain, light_wrap, seed)
    finishing = finishing_of(wanted, plate.rgb, None if photo.is_dir() else photo)
    sharp = layers_for(plate)
    inserted = finished(insertion.insert(plate, sharp, used_renderer), plate, finishing)
    write_picture(out, inserted, plate, sharp, output_space, ocio)
    if save_layer is not None:
        write_layer(save_layer, inserted.virtual)
    typer.echo(f"wrote {out}")


def _into_all_slices(
    stack: Path, out: Path, layers_for: "LayersFor", insertion: "Insertion", renderer: "Renderer", lens: "Lens | None"
) -> None:
    from mrbokeh.focal_stack import read_focal_stack
    from mrbokeh.stack_compositing import composite_stack

    composite_stack(read_focal_stack(stack), layers_for, insertion, renderer, out, lens)
    typer.echo(f"wrote the focal stack {out}")

"""`mrbokeh composite`: virtual objects into a photograph, or into all slices of a focal stack."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from mrbokeh.commands import _composite_options as options
from mrbokeh.commands._insertion_options import ColourOptions, LensFacts, LookGroup, VirtualOptions, focused_at_pixel, require_one_focus
from mrbokeh.commands._option_groups import grouped
from mrbokeh.system.channel import guess, say, tell, warn

if TYPE_CHECKING:
    from mrbokeh.commands._composite_parts import LayersFor
    from mrbokeh.compositing.plate import Insertion, Plate
    from mrbokeh.compositing.plate_look.finishing import Finishing
    from mrbokeh.optics.lens import Lens
    from mrbokeh.renderers.base import Renderer

app = typer.Typer(add_completion=False)


@app.command()
@grouped
def composite(
    photo: options.PhotoArgument,
    taken: options.PlateOptions,
    virtual: VirtualOptions,
    standing: options.ObjectOptions,
    rendering: options.RenderingOptions,
    look: LookGroup,
    optics: options.LensOptions,
    facts: LensFacts,
    out: options.OutOption,
    colour: ColourOptions,
    result: options.ResultOptions,
) -> None:
    """Put virtual objects into a photograph, blurred by its lens, behind and before what is blurred in it.

    Example: mrbokeh composite SCENE/view_2 --slice 1 --object cake.glb --at-pixel 300,250 --height 0.1 --lens lens.onnx --out out.png

    Example: mrbokeh composite IMG_2041.NEF --layer lantern.exr --depth phone.jpg --grain auto --out out.exr

    Example: mrbokeh composite STACK --slice 3 --object cake.glb --at-pixel 300,250 --height 120px --out out.png

    Example: mrbokeh composite captures/20261122-101500 --out captured.png
    """
    from mrbokeh.commands._composite_parts import (
        alpha_lost,
        blur_told,
        check_outputs,
        held_upright,
        layers_by,
        nothing_seen,
        placing_warning,
        plate_by,
        require_options_of_stacks,
        write_results,
    )
    from mrbokeh.commands._level_ground import focused_on_foot, on_level_ground, pair_of, with_camera_of_file
    from mrbokeh.commands._preview import smaller, write_preview_of
    from mrbokeh.compositing.choose import best_mode, insertion_of
    from mrbokeh.compositing.ground import with_ground_behind
    from mrbokeh.compositing.plate_look.finishing import finished
    from mrbokeh.renderers.choose import lens_and_renderer
    from mrbokeh.stacks.capture_bundle import is_bundle, read_bundle
    from mrbokeh.system.console import working
    from mrbokeh.system.errors import InputError, require_file

    read = (
        photo,
        taken.depth,
        taken.rgb,
        taken.matte,
        *virtual.files,
        standing.object_,
        standing.environment,
        rendering.distortion,
        optics.lens,
    )
    if taken.all_slices:
        require_options_of_stacks(taken, optics, look, colour, result)
    standing.require_meant(photo, taken.depth, rendering.catch)
    require_one_focus(focus=optics.focus, focus_at=optics.focus_at)
    if standing.object_ is not None:
        require_file(standing.object_, "a GLB file")
    result.require_meant(out, only_object=standing.object_ is not None and not virtual.layer, all_slices=taken.all_slices)
    if virtual.camera is not None and virtual.scene is None and standing.object_ is None:
        raise InputError(f"--camera {virtual.camera} is for a --scene or an --object: give one, or leave it out")
    check_outputs(out, result, read, all_slices=taken.all_slices)
    bundle = read_bundle(photo) if is_bundle(photo) else None
    lens, renderer = lens_and_renderer(optics.lens, optics.renderer or (bundle.renderer if bundle and optics.lens is None else None))
    lens = lens and facts.on(lens, renderer)
    on_ground = standing.object_ is not None and bool(standing.at_pixel) and not photo.is_dir() and not standing.plain
    stated = {} if lens else facts.given
    open_focused = partial(plate_by, photo, taken, colour, bundle, lens=lens, facts=stated, guessing=on_ground)
    plate = open_focused(focus_m=optics.focus if optics.focus_at is None else 1.0)  # then only its depth is asked for
    if optics.focus_at is not None:
        plate = open_focused(focus_m=focused_at_pixel(plate.lens, plate.depth_m, optics.focus_at).focus_distance_m)
    if plate.depth_m is not None:
        standing.require_no_depth()
    _tell_metres(photo, virtual, standing, lens)
    guess(plate.depth_note)
    known_height_m, scale = None, 1.0
    if virtual.camera is not None and virtual.scene is None:
        plate, known_height_m = with_camera_of_file(plate, virtual.camera)
    if on_ground and plate.depth_m is None:
        plate, standing = on_level_ground(plate, standing, known_height_m)
    elif on_ground:
        plate = focused_on_foot(plate, standing)
    matching = standing.object_ is not None and not standing.plain and out.suffix.lower() != ".exr"
    uncompressed = result.preview or colour.of_plate is not None or colour.of_result is not None
    finishing = _finishing(photo, plate, look, matching=matching, uncompressed=uncompressed)
    if result.preview:
        plate, standing, scale = smaller(plate, standing)
    if standing.object_ is not None:
        plate = held_upright(plate, standing)
    layers_for = layers_by(virtual, standing, rendering, plate, bundle)
    mode = virtual.mode or best_mode(plate)
    insertion = insertion_of(mode, taken.near_distance, exact_depth=taken.exact_depth)
    if taken.all_slices:
        _into_all_slices(photo, out, layers_for, insertion, renderer, lens)
        return
    sharp = layers_for(plate)
    if not any((layer.alpha > 0).any() for layer in sharp):
        nothing_seen(standing, virtual)
    if standing.at_pixel:
        plate = with_ground_behind(plate, pair_of(standing.at_pixel), sharp)
    if standing.object_ is not None and (warning := placing_warning(sharp, plate, mode, standing.height)):
        warn(warning)
    with working("blurring"):
        inserted = finished(insertion.insert(plate, sharp, renderer), plate, finishing)
    if result.preview:
        tell(f"wrote the preview {out}: {write_preview_of(out, inserted, plate, sharp[0], scale)}")
        return
    write_results(out, inserted, plate, sharp, colour, result)
    if lost := alpha_lost(out, plate):
        warn(lost)
    told, known, figures = blur_told(plate, sharp)
    tell(f"wrote {out} ({mode}; {told})", known, mode=mode, **figures)


def _finishing(photo: Path, plate: "Plate", look: LookGroup, *, matching: bool, uncompressed: bool) -> "Finishing":
    """Return what makes virtual light look photographed: as told, and of a photograph in a file also as it is."""
    from mrbokeh.compositing.plate_look.finishing import finishing_of, matched_finishing

    if photo.is_dir() or not matching:
        return finishing_of(look.wanted, plate.rgb, None if photo.is_dir() else photo)
    finishing, matched = matched_finishing(look.wanted, plate.rgb, photo, uncompressed=uncompressed)
    guess(
        f"black, grain and compression are the photograph's, as far as they can be told ({' off, '.join(matched)} off)" if matched else ""
    )
    return finishing


def _tell_metres(photo: Path, virtual: VirtualOptions, standing: options.ObjectOptions, lens: "Lens | None") -> None:
    """Print which of a stack's metres are guessed, and what follows for layers and for another lens."""
    from mrbokeh.stacks.focal_stack import FILE_NAME, read_focal_stack
    from mrbokeh.stacks.guessed_metres import growth_note, guess_metres

    if not (photo / FILE_NAME).is_file():
        return
    stack = read_focal_stack(photo)
    guess_metres(stack)
    guess(growth_note(stack, lens))
    if not stack.metres_known and virtual.layer and not standing.at_pixel:
        say("the layers' depth is taken for guessed metres: --at-pixel X,Y puts them onto the surface at a pixel")


def _into_all_slices(
    stack: Path, out: Path, layers_for: "LayersFor", insertion: "Insertion", renderer: "Renderer", lens: "Lens | None"
) -> None:
    from mrbokeh.compositing.stack_compositing import composite_stack
    from mrbokeh.stacks.focal_stack import read_focal_stack

    composite_stack(read_focal_stack(stack), layers_for, insertion, renderer, out, lens)
    tell(f"wrote the focal stack {out}")

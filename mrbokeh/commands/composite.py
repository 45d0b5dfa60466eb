"""`mrbokeh composite`: virtual objects into a photograph, or into all slices of a focal stack."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from mrbokeh.commands._composite_options import CompositeOptions, OutOption
from mrbokeh.commands._insertion_options import focused_at_pixel
from mrbokeh.commands._option_groups import grouped
from mrbokeh.system.messages import guess, say, tell, warn

if TYPE_CHECKING:
    from mrbokeh.compositing.plate import Plate
    from mrbokeh.compositing.plate_look.finishing import Finishing, LookOptions
    from mrbokeh.optics.lens import Lens
    from mrbokeh.renderers.base import Renderer
    from mrbokeh.stacks.capture_bundle import CaptureBundle

app = typer.Typer(add_completion=False)

_MODES_TOLD = {"front": "before everything"}
"""How the last line says the way by which layers went in, where the mode's name does not say it."""


@app.command()
@grouped
def composite(options: CompositeOptions, out: OutOption) -> None:
    """Put virtual objects into a photograph, blurred by its lens, behind and before what is blurred in it.

    Example: mrbokeh composite SCENE/view_2 --slice 1 --object cake.glb --at-pixel 300,250 --height 0.1 --lens lens.onnx --out out.png

    Example: mrbokeh composite IMG_2041.NEF --layer lantern.exr --depth phone.jpg --grain auto --out out.exr

    Example: mrbokeh composite STACK --slice 3 --object cake.glb --at-pixel 300,250 --height 120px --out out.png

    Example: mrbokeh composite photo.jpg --object cake.glb --at-pixel 800,900 --object alien.glb --at-pixel 1200,880 --out out.png

    Example: mrbokeh composite captures/20261122-101500 --out captured.png
    """
    from mrbokeh.commands._composite_files import alpha_lost, blur_told, check_outputs, write_results
    from mrbokeh.commands._composite_layers import objects_apart, objects_of
    from mrbokeh.commands._composited import composited, placed
    from mrbokeh.commands._level_ground import with_camera_of_file
    from mrbokeh.commands._preview import smaller, write_preview_of
    from mrbokeh.images.carried_exif import carry_exif
    from mrbokeh.renderers.choose import lens_and_renderer
    from mrbokeh.stacks.capture_bundle import is_bundle, read_bundle

    options.require_meant(out)
    check_outputs(out, options.result, options.read, all_slices=options.taken.all_slices)
    bundle = read_bundle(options.photo) if is_bundle(options.photo) else None
    optics, asked = options.optics, options.standing
    lens, renderer = lens_and_renderer(optics.lens, optics.renderer or (bundle.renderer if bundle and optics.lens is None else None))
    lens = lens and options.facts.on(lens, renderer)
    plate = _opened(options, bundle, lens)
    _tell_metres(options, lens)
    known_height_m, scale = None, 1.0
    if options.virtual.camera is not None and options.virtual.scene is None:
        plate, known_height_m = with_camera_of_file(plate, options.virtual.camera)
    plate, options = placed(plate, options, known_height_m)
    if options.taken.all_slices:
        _into_all_slices(options, plate, bundle, renderer, lens, out)
        return
    finishing = _finishing(options, plate, out)
    if options.result.preview:
        plate, options, scale = smaller(plate, options)
    made = composited(plate, options, renderer, finishing, bundle=bundle, asked=asked)
    if options.result.preview:
        objects = objects_apart(options, made.plate, made.sharp)
        heights_m = [each.height_m for each in objects_of(options.standing, made.plate)]
        tell(f"wrote the preview {out}: {write_preview_of(out, made.inserted, made.plate, objects, heights_m, scale)}")
        return
    told, known, figures = blur_told(made.plate, made.sharp)
    mode, inserted, plate, sharp = made.mode, made.inserted, made.plate, made.sharp
    if out.suffix.lower() != ".exr" and options.result.save_deep is None:
        # What only layered files hold is half of all memory.
        plate, sharp = replace(plate, depth_m=None, sharp_rgb=None), []
    del made
    write_results(out, inserted, plate, sharp, options)
    carry_exif(options.photo, out, plate.rgb.shape[1::-1])
    if lost := alpha_lost(out, plate):
        warn(lost)
    tell(f"wrote {out} ({_MODES_TOLD.get(mode, mode)}; {told})", known, mode=mode, **figures)


def _opened(options: CompositeOptions, bundle: "CaptureBundle | None", lens: "Lens | None") -> "Plate":
    """Return the plate of the options, with its focus where they say."""
    from mrbokeh.commands._composite_files import plate_by

    focus_at = options.optics.focus_at
    # With --focus-at only its depth is asked for at first.
    plate = plate_by(options, bundle, lens=lens, focus_m=options.optics.focus if focus_at is None else 1.0)
    if focus_at is None:
        return plate
    return plate_by(options, bundle, lens=lens, focus_m=focused_at_pixel(plate.lens, plate.depth_m, focus_at).focus_distance_m)


def _finishing(options: CompositeOptions, plate: "Plate", out: Path) -> "Finishing":
    """Return what makes virtual light look photographed: as told, and of a photograph in a file, for a screen, also as it is."""
    from mrbokeh.compositing.plate_look.finishing import finishing_of, matched_finishing

    photo, wanted, standing = options.photo, options.look.wanted, options.standing
    if photo.is_dir() or not standing.object_ or standing.plain or out.suffix.lower() == ".exr":
        return finishing_of(wanted, plate.rgb, None if photo.is_dir() else photo)
    uncompressed = options.result.preview or options.colour.of_plate is not None or options.colour.of_result is not None
    finishing, matched = matched_finishing(wanted, plate.rgb, photo, uncompressed=uncompressed)
    guess(matched_told(wanted, matched))
    return finishing


def matched_told(wanted: "LookOptions", matched: Sequence[str]) -> str:
    """Say which looks of the photograph the object gets unasked, how to leave them out, and which could not be measured."""
    sought = {"--match-black": "black", "--grain": "grain or compression"}
    given = {"--match-black": wanted.match_black or wanted.match_grey, "--grain": wanted.grain}
    found = ", ".join(sought[each] for each in matched).replace(" or ", " and ")
    missed = " and no ".join(word for name, word in sought.items() if name not in matched and given[name] is None)
    put_on = f"the object gets the {found} of the photograph (to leave out: {', '.join(f'{each} off' for each in matched)})"
    left_off = f"no {missed} could be measured in the photograph, so none is put on it"
    return "; ".join([put_on] * bool(matched) + [left_off] * bool(missed))


def _tell_metres(options: CompositeOptions, lens: "Lens | None") -> None:
    """Print which of a stack's metres are guessed, and what follows for layers and for another lens."""
    from mrbokeh.stacks.focal_stack import FILE_NAME, read_focal_stack
    from mrbokeh.stacks.guessed_metres import growth_note, guess_metres

    if not (options.photo / FILE_NAME).is_file():
        return
    stack = read_focal_stack(options.photo)
    guess_metres(stack)
    guess(growth_note(stack, lens))
    if not stack.metres_known and options.virtual.layer and not options.standing.at_pixel:
        say("the layers' depth is taken for guessed metres: --at-pixel X,Y puts them onto the surface at a pixel")


def _into_all_slices(
    options: CompositeOptions, plate: "Plate", bundle: "CaptureBundle | None", renderer: "Renderer", lens: "Lens | None", out: Path
) -> None:
    from mrbokeh.commands._composite_layers import layers_by
    from mrbokeh.commands._composited import MUCH_HIDDEN, hidden_warning, insertion_by
    from mrbokeh.compositing.ground import Standing
    from mrbokeh.compositing.stack_compositing import composite_stack
    from mrbokeh.figures.stack_pictures import write_upright_png
    from mrbokeh.stacks.focal_stack import read_focal_stack

    layers_for, (mode, insertion) = layers_by(options, plate, bundle), insertion_by(options, plate)
    if options.standing.object_ and (warning := hidden_warning(layers_for(plate), plate, mode, MUCH_HIDDEN)):
        warn(warning)
    if options.standing.at_pixel:
        insertion = Standing(insertion, options.standing.pixels)
    made = composite_stack(read_focal_stack(options.photo), layers_for, insertion, renderer, out, lens)
    for index, each in enumerate(made.slices):
        write_upright_png((out / each.path).with_suffix(".png"), made.slice_rgb(index), made)
    write_upright_png(made.all_in_focus_path.with_suffix(".png"), made.all_in_focus(), made)
    tell(f"wrote the focal stack {out}, with a PNG beside each slice")

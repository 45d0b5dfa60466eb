"""One picture of `mrbokeh composite` from an opened plate: the camera held, the object placed, all put in and finished."""

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from mrbokeh.commands._composite_layers import held_upright, layers_by
from mrbokeh.commands._composite_options import CompositeOptions, ObjectOptions, typed_shadow
from mrbokeh.commands._insertion_options import VirtualOptions
from mrbokeh.commands._level_ground import focused_on_foot, held_as_told, held_told, on_level_ground, sun_by_shadow
from mrbokeh.compositing.choose import best_mode, insertion_of, without_what_touches_the_lens
from mrbokeh.compositing.ground import with_ground_behind, without_specks
from mrbokeh.compositing.near_and_far import nearer_than
from mrbokeh.compositing.plate import LEAST_CONFIDENCE, Inserted, Insertion, Plate, same_size
from mrbokeh.compositing.plate_look.finishing import Finishing, finished
from mrbokeh.images.color import luminance
from mrbokeh.images.layer import Layer
from mrbokeh.renderers.base import Renderer
from mrbokeh.stacks.capture_bundle import CaptureBundle
from mrbokeh.system.console import working
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import guess, warn

if TYPE_CHECKING:
    from mrbokeh.commands._composite_kept import KeptParts

_NEARER, MUCH_HIDDEN, _ALL_HIDDEN, _GUESSED_HIDES = 0.03, 0.4, 0.99, 0.01
_RASTER, _COLOURLESS = 200, 0.004


@dataclass(frozen=True)
class Composited:
    """The picture, its plate, its sharp layers, front first, and the mode by which they went in."""

    inserted: Inserted
    plate: Plate
    sharp: list[Layer]
    mode: str


def placed(plate: Plate, options: CompositeOptions, known_height_m: float | None = None) -> tuple[Plate, CompositeOptions]:
    """Return the plate held as its camera was, with its focus, and the options with the objects' places: told, solved or guessed.

    known_height_m: of the camera above the ground. Raises InputError for a pixel that shows no ground.
    """
    standing = options.standing
    if plate.depth_m is not None:
        standing.require_no_depth()
    guess(plate.depth_note)
    if plate.phone_level and plate.world_from_camera is not None and standing.object_ and standing.pitch is None:
        held = held_as_told(plate, standing).world_from_camera
        guess(f"by the phone's own level the camera {held_told(np.eye(3) if held is None else held)} (--pitch DEGREES)")
    if options.guesses_ground and plate.depth_m is None:
        plate, standing = on_level_ground(plate, standing, known_height_m)
    elif options.guesses_ground:
        plate = focused_on_foot(plate, standing)
    if standing.object_:
        plate = held_upright(plate, standing)
    if standing.sun_by is not None:
        standing = replace(standing, sun=sun_by_shadow(plate, *typed_shadow(standing.sun_by)), sun_by=None)
    return plate, replace(options, standing=standing)


def composited(
    plate: Plate,
    options: CompositeOptions,
    renderer: Renderer,
    finishing: Finishing,
    *,
    bundle: CaptureBundle | None = None,
    kept: "KeptParts | None" = None,
    asked: ObjectOptions | None = None,
) -> Composited:
    """Put what the options name into a plate of `placed`. kept: parts of earlier pictures.

    asked: how the object was to stand, for what is said where it cannot be seen or is of no likely size; None says nothing, as of a part
    of a picture. Raises InputError if nothing is seen.
    """
    mode, insertion = insertion_by(options, plate)
    # What the ground catches is made of the photograph, whose light has its colour already.
    given_back = finishing.light_before(plate.rgb if plate.sharp_rgb is None else plate.sharp_rgb)
    drawn = same_size(plate, layers_by(options, plate, bundle, kept)(replace(plate, sharp_rgb=given_back)))
    sharp = [without_what_touches_the_lens(layer, plate) for layer in drawn]
    if asked is not None and not any((layer.alpha > 0).any() for layer in drawn):
        _nothing_seen(asked, options.virtual)
    touching = 1.0 - sum(float(each.alpha.sum()) for each in sharp) / max(1e-9, sum(float(each.alpha.sum()) for each in drawn))
    if asked is not None and touching > 0.0:
        warn(f"{touching:.0%} of what is put in all but touches the lens, where its blur is wider than two pictures: it is left out")
    if options.standing.at_pixel:
        plate = without_specks(with_ground_behind(plate, options.standing.pixels, sharp), sharp)
    if asked is not None and asked.object_ and (warning := placing_warning(drawn, " ".join(asked.height or ()))):
        warn(warning)
    much = MUCH_HIDDEN if asked is not None and asked.object_ else _ALL_HIDDEN  # layers of others may have a sky behind all
    if asked is not None and (warning := hidden_warning(drawn, plate, mode, much)):
        in_metres = "; is Z of the layers in metres along the axis?" if plate.near_alpha is None and not asked.object_ else ""
        warn(warning + in_metres)
    with nullcontext() if kept else working("blurring"):
        inserted = insertion.insert(plate, sharp, renderer)
        if options.standing.object_ and not options.standing.plain and is_monochrome(plate):
            guess("the photograph is black and white, and so is the object (--plain leaves its colours)" if asked else "")
            grey = np.repeat(luminance(inserted.virtual.rgb)[..., None], 3, axis=2).astype(np.float32)
            inserted = replace(inserted, virtual=replace(inserted.virtual, rgb=grey))
        inserted = finished(inserted, plate, finishing)
    return Composited(inserted, plate, sharp, mode)


def is_monochrome(plate: Plate) -> bool:
    """Return whether a photograph is black and white: no pixel of a fine raster has a colour."""
    seen = plate.rgb[:: max(1, plate.rgb.shape[0] // _RASTER), :: max(1, plate.rgb.shape[1] // _RASTER)]
    return bool((np.ptp(seen, axis=2) <= _COLOURLESS * np.abs(seen).max(axis=2) + 1e-6).all())


def insertion_by(options: CompositeOptions, plate: Plate) -> tuple[str, Insertion]:
    """Return the mode of the options, or the best that what is known of the plate allows, and its insertion."""
    mode = options.virtual.mode or best_mode(plate)
    return mode, insertion_of(mode, options.taken.near_distance, exact_depth=options.taken.exact_depth)


def _nothing_seen(standing: ObjectOptions, virtual: VirtualOptions) -> None:
    """Raise InputError if what was rendered is not in the picture; an empty layer of another program is only warned of."""
    if standing.object_:
        where = " ".join([f"--at-pixel {each}" for each in standing.at_pixel or ()] + [f"--at {each}" for each in standing.at or ()])
        raise InputError(
            f"nothing of {', '.join(map(str, standing.object_))} is in the picture: by {where} it stands beside the frame or is too small "
            f"to be seen; choose another place with --at X,Y,Z (metres right, down, forward of the lens) or --at-pixel X,Y, or another "
            f"--height"
        )
    if virtual.scene is not None:
        raise InputError(f"nothing of {virtual.scene} is in the picture: its objects are beside the frame or behind the --camera")
    warn("nothing of the layers is in the picture: their alpha is 0 everywhere")


def placing_warning(sharp: Sequence[Layer], height: str) -> str | None:
    """Return a warning if an object is smaller than a pixel or reaches across the whole picture; None else.

    height: the option --height as typed, which mends it; "" without it.
    """
    alpha = np.maximum.reduce([layer.alpha for layer in sharp])
    rows, columns = np.nonzero(alpha > 0.5)
    unit = "its file may count in another unit: say --height METRES, or such as --height 200px"
    mend = f"--height {height} may be wrong" if height else unit
    if not alpha.any():
        return None
    if max(float(layer.alpha.sum()) for layer in sharp) < 1.0:
        return f"what is put in is smaller than a pixel; {mend}"
    whole = len(rows) and (np.ptp(rows) + 1, np.ptp(columns) + 1) == alpha.shape
    if whole:
        return f"what is put in reaches across the whole picture; {mend}"
    return None


def hidden_warning(sharp: Sequence[Layer], plate: Plate, mode: str, much: float) -> str | None:
    """Return a warning if more than a share of what is put in lies behind what the depth has before it, or all behind the matte.

    Also where depth hides it that nothing told: such holes look torn.
    """
    alpha = np.maximum.reduce([layer.alpha for layer in sharp])
    if not alpha.any():
        return None
    if plate.near_alpha is not None and float(alpha[plate.near_alpha > 0.5].sum()) > _ALL_HIDDEN * float(alpha.sum()):
        return "all of it lies behind what the matte shows in front: white is in front, black is behind"
    if plate.depth_m is None or mode == "front":
        return None
    depth_m = np.minimum.reduce([np.where(layer.alpha > 0.5, layer.depth_m, np.inf) for layer in sharp])
    hides, whole = nearer_than(plate.depth_m, depth_m, _NEARER), max(1, int(np.isfinite(depth_m).sum()))
    if (hidden := float(hides.sum() / whole)) >= much:
        return f"{hidden:.0%} of it lies behind what the depth says is nearer; --mode front ignores depth"
    if plate.depth_confidence is None:
        return None
    if plate.near_alpha is not None:
        hides &= np.isnan(plate.near_alpha)
    guessed = float((hides & (plate.depth_confidence < LEAST_CONFIDENCE)).sum() / whole)
    if guessed < _GUESSED_HIDES:
        return None
    return f"{guessed:.0%} of it is hidden by depth that is a guess (grey in depth.png): --mode front ignores depth, --matte says better"

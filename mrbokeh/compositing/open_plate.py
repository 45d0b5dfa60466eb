"""Opening of plates: a photograph by its lens and a phone's depth, a slice of a focal stack, a capture of the viewfinder."""

import logging
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from mrbokeh.compositing.plate import Plate, plate_of, with_own_alpha
from mrbokeh.depth.depth_map import DepthSettings
from mrbokeh.depth.mended_depth import mended_aloud
from mrbokeh.depth.open_depth import open_depth
from mrbokeh.depth.phone_depth import read_phone_photo
from mrbokeh.depth.phone_photo import PhoneFocus, PhonePhoto
from mrbokeh.depth.stereo_depth import stereo_depth
from mrbokeh.images.alpha_io import read_alpha
from mrbokeh.images.apple_notes import held_by_phone
from mrbokeh.images.heif import HEIF_SUFFIXES
from mrbokeh.images.layer import opaque
from mrbokeh.images.xmp import jpeg_xmp
from mrbokeh.optics.camera import camera_of_lens
from mrbokeh.optics.lens import Lens
from mrbokeh.solving.sun_of_photograph import sun_of_photograph
from mrbokeh.stacks.capture_bundle import CaptureBundle
from mrbokeh.stacks.focal_stack import DEPTH_SOURCE, FILE_NAME, FROM_FOCUS, FocalStack, read_focal_stack
from mrbokeh.stacks.guessed_metres import is_lens_guessed
from mrbokeh.stacks.photograph import Photograph, lens_for_photograph, read_photograph
from mrbokeh.system.errors import InputError, require_file
from mrbokeh.system.messages import guess, say

_log = logging.getLogger(__name__)

_DEVELOPED, _SHADOW_CONTRAST = (".jpg", ".jpeg", *HEIF_SUFFIXES), 1.3
"""Files that cameras write, and the slope of their tones over those of the light, both as logarithms: 1.14 to 1.36 in JPEGs of four cameras
beside their RAW (from 1 to 50 % of white), and 1.4 by the light that was left in seven cast shadows of sunny days."""


def open_plate(
    photo: Path,
    slice_index: int | None = None,
    lens: Lens | None = None,
    focus_m: float | None = None,
    facts: Mapping[str, float] | None = None,
    *,
    guessing: bool = False,
    exact_depth: bool = False,
) -> Plate:
    """Open a photograph with a lens, or a slice of a merged focal stack, which brings its own lens and depth.

    lens: replaces that of the photograph's metadata or of the stack, but keeps the focus of a slice. focus_m replaces all.
    A phone's photograph with depth inside brings that, its sharp original, and a lens with the blur that the phone put on.
    facts: of a photograph's lens, in place of what its metadata state or lack (`Photograph.stating`). guessing: what is lacking then is
    guessed, and said, but the focus. exact_depth: that of a phone is taken as it is.
    """
    if not photo.exists():
        require_file(photo, "a photograph or the folder of a focal stack")
    if photo.is_dir() and not (photo / FILE_NAME).is_file():
        within = ", ".join(str(each.parent) for each in sorted(photo.glob(f"*/{FILE_NAME}")))
        raise InputError(
            f"{photo} is a folder, but no merged focal stack ({FILE_NAME}): "
            f"give {within or 'a photograph, or make a stack of its photographs by `mrbokeh capture process`'}"
        )
    if photo.is_dir():
        return _stack_plate(photo, slice_index, lens, focus_m)
    if slice_index is not None:
        raise InputError(f"--slice chooses a slice of a focal stack, but {photo} is not a folder with {FILE_NAME}: leave it out")
    wishes = LensWishes(lens=lens, focus_m=focus_m, facts=facts or {}, guessing=guessing, exact_depth=exact_depth)
    return photograph_plate(photo, read_photograph(photo), phone_photo(photo), wishes)


def photograph_plate(photo: Path, photograph: Photograph, phone: PhonePhoto | None, wishes: "LensWishes") -> Plate:
    """Return the plate of a photograph that was read from its file, with what a phone put into it."""
    if wishes.lens is None and not wishes.facts:
        _require_no_panorama(photo, photograph)
    held = held_lens(photo, photograph, phone, wishes)
    plate = with_own_alpha(plate_of(photograph.rgb, held.lens), photo, read_alpha(photo, photograph.orientation))
    turn = held_by_phone(photo)
    contrast = _SHADOW_CONTRAST if photo.suffix.lower() in _DEVELOPED else 1.0
    plate = replace(plate, white_lux=held.white_lux, world_from_camera=turn, phone_level=turn is not None, shadow_contrast=contrast)
    plate = replace(plate, sun=None if held.white_lux is None else sun_of_photograph(photo))
    if phone is None:
        return replace(plate, focus_known=held.focus_known, view_known=held.view_known, rough_focus_m=held.rough_focus_m)
    original = phone.original_rgb if phone.original_rgb is not None and phone.original_rgb.shape == plate.rgb.shape else None
    stated = wishes.lens is not None or wishes.focus_m is not None or photograph.focus_distance_m is not None
    own_blur = held.blur_from == _OWN_BLUR
    guessed = [] if phone.focus is None else [phone.focus.note * (not stated), phone.focus.blur_note * own_blur]
    note = "; ".join(each for each in (f"{photo}: {phone.depth.note}", *guessed) if each)
    deep = with_depth(plate, photo, DepthSettings(exact=wishes.exact_depth))
    deep = replace(deep, metres_guessed=not phone.has_unit, slopes_known=phone.has_unit)
    return replace(deep, sharp_rgb=original, blur_from=held.blur_from, depth_note=note)


@dataclass(frozen=True)
class LensWishes:
    """Lens that a photograph is to have, and whether its own depth is exact, as `open_plate` takes them."""

    lens: Lens | None = None
    focus_m: float | None = None
    facts: Mapping[str, float] = field(default_factory=dict)
    guessing: bool = False
    exact_depth: bool = False


@dataclass(frozen=True)
class HeldLens:
    """Lens of a photograph. blur_from, focus_known, view_known, rough_focus_m, white_lux: as in `Plate`."""

    lens: Lens
    blur_from: str = ""
    focus_known: bool = True
    view_known: bool = True
    rough_focus_m: tuple[float, float] | None = None
    white_lux: float | None = None


def held_lens(photo: Path, photograph: Photograph, phone: PhonePhoto | None, wishes: LensWishes) -> HeldLens:
    """Return the lens of a photograph in a file, by what the file states and what is wished; only the size of its rgb counts."""
    lens, focus_m = wishes.lens, wishes.focus_m
    photograph = photograph.stating(wishes.facts)
    blur_from, focus_known, view_known, white_lux = "", True, True, photograph.white_lux
    if wishes.guessing and lens is None and phone is None:
        stated = (photograph.focal_length_mm, photograph.sensor_width_mm)
        photograph, guesses = photograph.guessing()
        view_known = stated == (photograph.focal_length_mm, photograph.sensor_width_mm)
        guess(f"{photo} does not tell its lens, which is guessed: {guesses}" if guesses else "")
        focus_known = focus_m is not None or photograph.focus_distance_m is not None
        photograph = photograph if focus_known else replace(photograph, focus_distance_m=float("inf"))
    phone_focus = None if phone is None else phone.focus
    portrait = phone_focus if lens is None and phone_focus is not None and phone_focus.blur_at_infinity is not None else None
    if portrait is not None and not wishes.facts:
        photograph, blur_from = _with_the_phones_blur(photograph, portrait, photo), _OWN_BLUR
    elif portrait is not None and portrait.f_number is not None and wishes.facts.keys() == {"f_number"}:
        own, wished = _with_the_phones_blur(photograph, portrait, photo), wishes.facts["f_number"]
        assert own.f_number is not None
        photograph = replace(own, f_number=own.f_number * wished / portrait.f_number)
        blur_from = f"blur of full frame at f/{wished:g} in place of the phone's, at f/{portrait.f_number:g}"
    elif phone_focus is not None and photograph.focus_distance_m is None:
        photograph = replace(photograph, focus_distance_m=phone_focus.focus_distance_m)
    lens = photograph.lens(photo, focus_m) if lens is None else lens_for_photograph(lens, photograph, photo)
    rough_m = photograph.rough_focus_m if phone is None and focus_m is None and wishes.lens is None else None
    focused = lens if focus_m is None else lens.focused_at(focus_m)
    return HeldLens(focused, blur_from, focus_known=focus_known, view_known=view_known, rough_focus_m=rough_m, white_lux=white_lux)


def _require_no_panorama(photo: Path, photograph: Photograph) -> None:
    """Raise InputError for a panorama that says so (GPano), and warn of a picture that is shaped as one: a lens draws neither."""
    height_px, width_px = photograph.rgb.shape[:2]
    advice = "cut out a part, and say --focal-length and --sensor-width of that"
    told = {}
    with suppress(InputError):  # what is damaged is told where depth is looked for
        told = jpeg_xmp(photo.read_bytes(), photo) if photo.suffix.lower() in (".jpg", ".jpeg") else {}
    if told.get(_GPANO + "ProjectionType") or told.get(_GPANO + "FullPanoWidthPixels"):
        raise InputError(f"{photo} is a panorama, as its XMP tells (GPano), in which straight lines are bent: {advice}")
    if width_px > _PANORAMIC * height_px and photograph.cut_from_px is None:
        _log.warning(f"{photo} of {width_px}x{height_px} px is shaped as a panorama, for which its lens would be wrong: {advice}")


_OWN_BLUR = "the phone's own blur"
_GPANO = "{http://ns.google.com/photos/1.0/panorama/}"
_PANORAMIC = 2.2


def phone_photo(photo: Path) -> PhonePhoto | None:
    """Return what a phone put into its photograph; None, with one line, if that is damaged."""
    try:
        return read_phone_photo(photo)
    except InputError as error:
        _log.warning(f"{error}; the photograph is taken without its depth")
        return None


def _with_the_phones_blur(photograph: Photograph, focus: PhoneFocus, photo: Path) -> Photograph:
    """State the lens whose blur the phone put on; what its file does not tell is the field of view, which is then guessed."""
    height_px, width_px = photograph.rgb.shape[:2]
    told = replace(photograph, f_number=1.0)
    seen, guesses = told.guessing()
    if guesses:
        _log.warning(f"{photo} does not tell its field of view: {guesses} is taken")
    assert seen.focal_length_mm is not None and seen.sensor_width_mm is not None
    facts: dict[str, Any] = {"focal_length_mm": seen.focal_length_mm, "sensor_width_mm": seen.sensor_width_mm}
    wide_open = Lens(**facts, f_number=1.0, focus_distance_m=photograph.focus_distance_m or focus.focus_distance_m)
    f_number = wide_open.coc_px_per_dioptre(width_px) / focus.coc_px_per_dioptre(width_px, height_px)
    return replace(photograph, **facts, f_number=f_number, focus_distance_m=wide_open.focus_distance_m)  # type: ignore[arg-type]


def with_blur_in_metres(plate: Plate, before_m: Float32[np.ndarray, "height width"], focus_m: float | None) -> Plate:
    """Return the plate with the same blur in pixels by a lens that fits its depth, which was in another unit before.

    Dioptres of both are a + b times one another, so that the focus follows, and the lens has 1 / b of the blur per dioptre. focus_m: given.
    """
    assert plate.depth_m is not None
    ends = [np.unravel_index(int(each), before_m.shape) for each in (before_m.argmax(), before_m.argmin())]
    old, new = ([1.0 / float(depth[place]) for place in ends] for depth in (before_m, plate.depth_m))
    factor, lens, width_px = (new[1] - new[0]) / max(old[1] - old[0], 1e-9), plate.lens, plate.rgb.shape[1]
    dioptres = new[0] + factor * (1.0 / lens.focus_distance_m - old[0])
    focused = lens.focused_at(focus_m or (1.0 / dioptres if dioptres > 0 else float("inf")))
    wanted = lens.coc_px_per_dioptre(width_px) / factor
    f_number = focused.f_number * focused.coc_px_per_dioptre(width_px) / wanted
    return replace(plate, lens=replace(focused, f_number=f_number, widest_f_number=None))


def bundle_plate(bundle: CaptureBundle, lens: Lens | None = None, focus_m: float | None = None) -> Plate:
    """Return the plate of a viewfinder's capture. lens: replaces the optics but keeps the focus. Objects are placed in camera axes."""
    focused = bundle.lens if lens is None else lens.focused_at(bundle.lens.focus_distance_m)
    focused = focused if focus_m is None else focused.focused_at(focus_m)
    camera = replace(bundle.camera, camera_from_world=np.eye(4))
    return Plate(bundle.plate_rgb, None, focused, camera)


def with_depth(plate: Plate, source: Path, settings: DepthSettings) -> Plate:
    """The plate with depth from a file, or from a network that looks at its sharpest picture."""
    depth = open_depth(source, plate.rgb if plate.sharp_rgb is None else plate.sharp_rgb, settings)
    return replace(plate, depth_m=depth.depth_m, depth_confidence=None, depth_error_dioptres=0.0)


def with_stereo(
    plate: Plate, second_rgb: Float32[np.ndarray, "rows columns 3"], baseline_m: float | None, photos: tuple[Path, Path], *, exact: bool
) -> Plate:
    """Return the plate with depth from a second photograph beside it. baseline_m: how far the camera moved; None is guessed, and said.

    exact: the depth is not mended.
    """
    seen_rgb = plate.rgb if plate.sharp_rgb is None else plate.sharp_rgb
    depth = stereo_depth(seen_rgb, second_rgb, plate.camera, baseline_m or _HANDS_BREADTH_M, photos)
    guess(
        f"how far the camera moved from {photos[0]} to {photos[1]} is guessed, {_HANDS_BREADTH_M:g} m, and all metres with it (--baseline "
        f"METRES)"
        if baseline_m is None
        else ""
    )
    depth_m = depth.depth_m if exact else mended_aloud(depth.depth_m, seen_rgb)
    return replace(plate, depth_m=depth_m, depth_confidence=None, depth_note="", metres_guessed=baseline_m is None)


_HANDS_BREADTH_M = 0.1


def _stack_plate(folder: Path, slice_index: int | None, lens: Lens | None, focus_m: float | None) -> Plate:
    stack = read_focal_stack(folder)
    if slice_index is None or not 0 <= slice_index < len(stack):
        raise InputError(
            f"{folder} is a focal stack of {len(stack)} slices: choose one with --slice 0 to {len(stack) - 1}, or --all-slices"
        )
    focused, blur_from = slice_lens(stack, slice_index, lens, focus_m)
    rgb = _with_border(stack, slice_index)
    camera = stack.camera or camera_of_lens(stack.lens_of(stack.reference), rgb.shape[1], rgb.shape[0])
    # A stack of a scene knows where its camera stood; objects are placed in camera axes.
    upright = replace(camera, camera_from_world=np.eye(4))
    depth_m, confidence = stack.depth_planes("Z", "confidence")
    plate = Plate(rgb=rgb, depth_m=depth_m, lens=focused, camera=upright, sharp_rgb=stack.all_in_focus(), depth_confidence=confidence)
    plate = replace(plate, depth_error_dioptres=depth_error_dioptres(stack), blur_from=blur_from)
    return replace(plate, metres_guessed=not stack.metres_known, slopes_known=stack.metres_known)


def _with_border(stack: FocalStack, slice_index: int) -> Float32[np.ndarray, "height width 3"]:
    """Return a slice whose border, where registration moved it out of its photograph, is blurred anew from all slices, and say so."""
    rgb, valid = stack.slice_rgb(slice_index), stack.slice_masks(slice_index).valid
    missing = 1.0 - float(valid.mean())
    if missing == 0.0 or stack.focus_distances_m[slice_index] is None:
        return rgb
    import cv2

    from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences

    say(f"{missing:.1%} of slice {slice_index}, at its border, is in the other slices only: blurred anew from them", err=True)
    sharp = opaque(stack.all_in_focus(), stack.depth_m())
    anew = PolygonDifferences().render([sharp], stack.registered_lens_of(slice_index)).rgb
    # Corners are darker in some slices than in others: the border goes over into the photograph.
    inside_px = cv2.distanceTransform(valid.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    own = np.minimum(inside_px / np.float32(_BORDER_PX), np.float32(1.0))[..., None]
    return np.asarray(own * rgb + (1.0 - own) * anew, np.float32)


_BORDER_PX = 24


def depth_error_dioptres(stack: FocalStack) -> float:
    """Return how far the depth of a merged stack may be off: half of what lies between two slices; 0 if it is not from their focus."""
    dioptres = [1.0 / each for each in stack.focus_distances_m if each is not None]
    if stack.metadata.get(DEPTH_SOURCE) != FROM_FOCUS or len(dioptres) < 2:
        return 0.0
    return 0.5 * float(np.median(np.abs(np.diff(dioptres))))


def slice_lens(stack: FocalStack, slice_index: int, lens: Lens | None, focus_m: float | None) -> tuple[Lens, str]:
    """Return the lens of a slice, and where its blur is from (`Plate.blur_from`). lens, focus_m: in place of its own."""
    focused = stack.registered_lens_of(slice_index) if lens is None else lens.focused_at(stack.lens_of(slice_index).focus_distance_m)
    guessed = lens is None and is_lens_guessed(stack)
    return focused if focus_m is None else focused.focused_at(focus_m), "blur as measured in the slices" if guessed else ""

"""A Finishing from what a user writes on the command line, and from the photograph itself."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.compositing.plate_look.black_level import darkest_black, picked_black
from mrbokeh.compositing.plate_look.colour_match import ColourMatch, Triple, triple_of
from mrbokeh.compositing.plate_look.exposure_match import Exposure, matched_exposure
from mrbokeh.compositing.plate_look.finishing import Finishing
from mrbokeh.compositing.plate_look.grain import Grain, measured_grain, measured_grain_of_pair
from mrbokeh.compositing.plate_look.grain_file import read_grain
from mrbokeh.compositing.plate_look.grey_card import GREY_CARD, PixelBox, grey_card_match
from mrbokeh.compositing.plate_look.lensfun_falloff import falloff_of_photo
from mrbokeh.compositing.plate_look.light_wrap import LightWrap
from mrbokeh.compositing.plate_look.stated_exposure import stated_exposure
from mrbokeh.compositing.plate_look.vignetting import RadialFalloff, Vignetting, falloff_at, read_flat_field
from mrbokeh.compositing.plate_look.white_balance import white_balance_gain
from mrbokeh.system.errors import InputError

Picture = Float32[np.ndarray, "height width 3"]
AUTO, OFF = "auto", "off"
NO_BLACK: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class LookOptions:
    """Texts as typed; None or "off" leaves a step out.

    match_grey: "X,Y[,RADIUS]" of a card; grey_value: its reflectance, or what the renderer gives it. match_exposure: the photograph that
    the virtual light was taken from; plate_exposure: "SECONDS,ISO,F-NUMBER" of the plate, in place of what it states. match_white_k: the
    temperature that the plate was balanced for. match_black: "auto" or "X,Y[,RADIUS]". vignetting: "auto" (lensfun), "K1,K2,K3" or a
    picture of an even surface. grain: "auto" or a grain file. light_wrap: "STRENGTH[,SIGMA]".
    """

    match_grey: str | None = None
    grey_value: float = GREY_CARD
    match_exposure: Path | None = None
    match_white_k: float | None = None
    match_black: str | None = None
    vignetting: str | None = None
    grain: str | None = None
    light_wrap: str | None = None
    seed: int = 0
    plate_exposure: str | None = None


def finishing_of(options: LookOptions, plate_rgb: Picture, photo: Path | None = None, next_rgb: Picture | None = None) -> Finishing:
    """plate_rgb: the photograph, or the first frame of a video; next_rgb: its second frame, if it is a video.

    photo: the file of the plate, where its metadata are asked. Raises InputError where an option cannot be understood or met.
    """
    vignetting = _vignetting(options.vignetting, photo)
    colour = _colour(options, plate_rgb, photo, vignetting)
    grain = _grain(options, plate_rgb, next_rgb)
    return Finishing(None if colour.is_nothing else colour, vignetting, grain, _light_wrap(options.light_wrap))


def _colour(options: LookOptions, plate_rgb: Picture, photo: Path | None, vignetting: Vignetting | None) -> ColourMatch:
    """A card says all that exposure and white balance say, so it excludes them."""
    black = _black(options.match_black, plate_rgb)
    if options.match_grey is not None:
        if options.match_exposure is not None or options.match_white_k is not None:
            raise InputError("--match-grey sets exposure and white balance: leave out --match-exposure and --match-white")
        box = PixelBox.parse(options.match_grey)
        falloff = (1.0, 1.0, 1.0) if vignetting is None else falloff_at(vignetting, box.x_px, box.y_px, plate_rgb.shape[:2])
        return grey_card_match(plate_rgb, box, rendered=options.grey_value, black=black, falloff=falloff)
    gain = np.ones(3)
    if options.match_exposure is not None:
        gain = gain * matched_exposure(_plate_exposure(options, photo), stated_exposure(options.match_exposure)).gain
    elif options.plate_exposure is not None:
        raise InputError("--plate-exposure is for --match-exposure PHOTO, which it is compared with: give both")
    if options.match_white_k is not None:
        gain = gain * white_balance_gain(options.match_white_k)
    return ColourMatch(triple_of(gain), black)


def _plate_exposure(options: LookOptions, photo: Path | None) -> Exposure:
    if options.plate_exposure is not None:
        return Exposure.parse(options.plate_exposure)
    if photo is None:
        raise InputError(
            "--match-exposure needs a photograph that states how it was taken (Exif; an EXR header), but this plate is in no such file: "
            "give --plate-exposure SECONDS,ISO,F-NUMBER"
        )
    return stated_exposure(photo)


def _black(text: str | None, plate_rgb: Picture) -> Triple:
    if text is None or text == OFF:
        return NO_BLACK
    return darkest_black(plate_rgb) if text == AUTO else picked_black(plate_rgb, PixelBox.parse(text, "--match-black"))


def _vignetting(text: str | None, photo: Path | None) -> Vignetting | None:
    if text is None or text == OFF:
        return None
    if text == AUTO:
        return falloff_of_photo(_required(photo, "--vignetting auto"))
    return read_flat_field(text) if Path(text).is_file() else RadialFalloff.parse(text)


def _grain(options: LookOptions, plate_rgb: Picture, next_rgb: Picture | None) -> Grain | None:
    if options.grain is None or options.grain == OFF:
        return None
    if options.grain != AUTO:
        return replace(read_grain(options.grain), seed=options.seed)
    return measured_grain(plate_rgb, options.seed) if next_rgb is None else _grain_of_video(plate_rgb, next_rgb, options.seed)


def _grain_of_video(first: Picture, second: Picture, seed: int) -> Grain:
    """From the pair; from the first frame alone where everything moves or the encoder has copied it."""
    try:
        return measured_grain_of_pair(first, second, seed)
    except InputError:
        return measured_grain(first, seed)


def _light_wrap(text: str | None) -> LightWrap | None:
    if text is None or text == OFF:
        return None
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (1, 2):
        raise InputError(f"--light-wrap: expected STRENGTH or STRENGTH,SIGMA in pixels, such as 0.3,8, got {text!r}")
    return LightWrap(*numbers)


def _required(photo: Path | None, option: str) -> Path:
    if photo is None:
        raise InputError(f"{option} needs a photograph that states how it was taken (Exif; an EXR header): this plate is in no such file")
    return photo

"""Settings that must not change within a bracket, over libgphoto2, for the makers whose names are known.

The names are those of libgphoto2's ptp2 driver (Nikon, Canon, Sony, Fuji share it). What a camera does not have is left out of
the answer, so that the log of a shoot shows what nobody controlled.
"""

import re
from collections.abc import Callable

from capture.tether.camera_driver import CameraSettings
from capture.tether.gphoto2_config import CameraConfig
from mrbokeh.system.errors import InputError

EXPOSURE_MODES = ("expprogram", "autoexposuremode", "shootingmode")
FILE_FORMATS = ("imagequality", "imageformat")
SHUTTER = ("shutterspeed2", "shutterspeed")
APERTURE = ("f-number", "aperture")
FOCUS_MODES = ("focusmode2", "focusmode")
FOCUS_DRIVE = "manualfocusdrive"
_AUTO_ISO = ("isoauto", "autoiso", "isoautocontrol")


def is_manual(word: str) -> bool:
    return word.strip().lower() in ("m", "manual")


def is_raw_only(word: str) -> bool:
    """RAW without a JPEG beside it, which would only cost time."""
    text = word.strip().lower()
    return re.match(r"(nef|raw|craw|uncompressed raw)\b", text) is not None and not re.search(r"jpe?g|fine|normal|basic|\+", text)


def is_fixed_white_balance(word: str) -> bool:
    return re.search(r"auto|awb|^\s*$", word.lower()) is None


def is_off(word: str) -> bool:
    return word.strip().lower() in ("off", "0", "false", "manual", "mf", "m", "manual focus", "mf (fixed)", "manual focus (fixed)")


def configure(config: CameraConfig, settings: CameraSettings) -> dict[str, str]:
    """Apply the settings; what is set now, by what it is. Raises InputError where the exposure is or would be automatic."""
    done = {
        "exposure mode": config.choose(EXPOSURE_MODES, is_manual, "manual exposure (M)"),
        "automatic ISO": config.choose(_AUTO_ISO, is_off, "automatic ISO off"),
        "autofocus": config.choose(("autofocus", "continuousaf"), is_off, "autofocus off"),
        "focus mode": _focus_mode(config),
        "file format": config.choose(FILE_FORMATS, is_raw_only, "RAW"),
        "white balance": config.choose(("whitebalance",), _white_balance(settings.white_balance), "a fixed white balance"),
        "capture target": config.choose(("capturetarget",), lambda word: "ram" in word.lower(), "Internal RAM"),
        "exposure time": _numbered(config, SHUTTER, settings.exposure_time_s, "exposure time in seconds"),
        "ISO": _numbered(config, ("iso",), settings.iso, "ISO"),
        "f-number": _numbered(config, APERTURE, settings.f_number, "f-number"),
    }
    return {what: word for what, word in done.items() if word is not None}


def _focus_mode(config: CameraConfig) -> str | None:
    """Manual where the ring is turned by hand. Motors can only be driven while lens and body are in autofocus: left alone then."""
    if config.first((FOCUS_DRIVE,)) is None:
        return config.choose(FOCUS_MODES, is_off, "manual focus")
    name = config.first(FOCUS_MODES)
    return None if name is None else str(config.value(name))


def _white_balance(wanted: str | None) -> Callable[[str], bool]:
    if wanted is None:
        return is_fixed_white_balance
    return lambda word: word.strip().lower() == wanted.strip().lower() and is_fixed_white_balance(word)


def _numbered(config: CameraConfig, names: tuple[str, ...], wanted: float | None, what: str) -> str | None:
    """Set a number, or say which one is set."""
    if wanted is not None:
        within = 0.12 if names == SHUTTER else 0.05
        word = config.choose_nearest(names, wanted, what, within)
        if word is None:
            raise InputError(f"this camera's {what} cannot be set over the cable: set it on the camera and leave the option out")
        return word
    name = config.first(names)
    word = None if name is None else str(config.value(name))
    if word is not None and word.strip().lower().startswith("auto"):
        raise InputError(f"the {what} is automatic ({word}): set it on the camera or by its option, so that all slices have one exposure")
    return word

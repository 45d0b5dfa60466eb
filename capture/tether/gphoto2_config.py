"""Camera settings over libgphoto2: find, read and choose them, and fix those that must not change within a bracket.

The names are those of libgphoto2's ptp2 driver (Nikon, Canon, Sony and Fuji share it) and differ from maker to maker. A setting
that a camera does not have is left out of the answer, so that the log of a shoot shows what was not controlled.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from capture.tether.camera_driver import CameraError, CameraSettings
from mrbokeh.system.errors import InputError
from mrbokeh.system.gphoto2_library import explanation, library

EXPOSURE_MODES = ("expprogram", "autoexposuremode", "shootingmode")
FILE_FORMATS = ("imagequality", "imageformat")
SHUTTER = ("shutterspeed2", "shutterspeed")
APERTURE = ("f-number", "aperture")
FOCUS_MODES = ("focusmode2", "focusmode")
FOCUS_DRIVE = "manualfocusdrive"
_AUTO_ISO = ("isoauto", "autoiso", "isoautocontrol")


@contextmanager
def explained(doing: str) -> Iterator[None]:
    """Turn libgphoto2's errors within the block into CameraError; `doing` names the attempt."""
    gp = library()
    try:
        yield
    except gp.GPhoto2Error as error:
        raise CameraError(f"{doing} failed: {explanation(error)}") from None


class CameraConfig:
    """One camera's settings. camera: a gphoto2.Camera, already initialised."""

    def __init__(self, camera: Any) -> None:
        self._camera, self._gp = camera, library()

    def first(self, names: Sequence[str]) -> str | None:
        """Return the first of several names that this camera knows."""
        return next((name for name in names if self._widget(name) is not None), None)

    def value(self, name: str) -> Any:
        widget = self._widget(name)
        return None if widget is None else widget.get_value()

    def choices(self, name: str) -> list[str]:
        """Return the possible values of a setting; empty if it is not a choice or unknown."""
        widget = self._widget(name)
        if widget is None or widget.get_type() not in (self._gp.GP_WIDGET_RADIO, self._gp.GP_WIDGET_MENU):
            return []
        return [str(widget.get_choice(index)) for index in range(widget.count_choices())]

    def is_readonly(self, name: str) -> bool:
        widget = self._widget(name)
        return widget is None or bool(widget.get_readonly())

    def set(self, name: str, value: Any) -> None:
        with explained(f"setting {name} to {value}"):
            self.set_raw(name, value)

    def set_raw(self, name: str, value: Any) -> None:
        """Set a value and let libgphoto2's own errors through."""
        widget = self._camera.get_single_config(name)
        widget.set_value(value)
        self._camera.set_single_config(name, widget)

    def choose(self, names: Sequence[str], fits: Callable[[str], bool], what: str) -> str | None:
        """Set the first choice that fits, unless the current one does; return it, or None if the camera has no such setting.

        Raises InputError if it has the setting but none of its choices fits, or if it can only be set on the camera.
        """
        name = self.first(names)
        if name is None:
            return None
        now = str(self.value(name))
        if fits(now):
            return now
        found = next((each for each in self.choices(name) if fits(each)), None)
        if found is None or self.is_readonly(name):
            raise InputError(
                f"{what} must be set on the camera itself: its {name!r} is {now!r} (it offers {self.choices(name) or 'nothing'})"
            )
        self.set(name, found)
        return found

    def choose_nearest(self, names: Sequence[str], wanted: float, what: str, within: float = 0.05) -> str | None:
        """Set the choice whose number is nearest to `wanted`, within a relative error; return None if there is no such setting."""
        name = self.first(names)
        if name is None:
            return None
        numbers = {each: value for each in self.choices(name) if (value := number_in(each)) is not None}
        nearest = min(numbers, key=lambda each: abs(numbers[each] - wanted), default=None)
        if nearest is None or abs(numbers[nearest] / wanted - 1.0) > within:
            raise InputError(f"the camera has no {what} of {wanted:g}: it offers {', '.join(numbers) or 'no choice'}")
        if str(self.value(name)) != nearest:
            self.set(name, nearest)
        return nearest

    def _widget(self, name: str) -> Any:
        try:
            return self._camera.get_single_config(name)
        except self._gp.GPhoto2Error as error:
            if error.code in (self._gp.GP_ERROR_BAD_PARAMETERS, self._gp.GP_ERROR_NOT_SUPPORTED):
                return None
            with explained(f"reading the setting {name}"):
                raise


def number_in(text: str) -> float | None:
    """Parse the number in "f/4", "0.0100s", "1/125", "ISO 200" or "30"; None for words such as Auto and Bulb."""
    found = re.search(r"(\d+(?:\.\d+)?)(?:/(\d+(?:\.\d+)?))?", text)
    if found is None:
        return None
    return float(found[1]) / float(found[2] or 1.0) if float(found[2] or 1.0) else None


def is_manual(word: str) -> bool:
    return word.strip().lower() in ("m", "manual")


def is_raw_only(word: str) -> bool:
    """Tell whether a file format is RAW without a JPEG beside it, which would only cost time."""
    text = word.strip().lower()
    return re.match(r"(nef|raw|craw|uncompressed raw)\b", text) is not None and not re.search(r"jpe?g|fine|normal|basic|\+", text)


def is_fixed_white_balance(word: str) -> bool:
    return re.search(r"auto|awb|^\s*$", word.lower()) is None


def is_off(word: str) -> bool:
    return word.strip().lower() in ("off", "0", "false", "manual", "mf", "m", "manual focus", "mf (fixed)", "manual focus (fixed)")


def configure(config: CameraConfig, settings: CameraSettings) -> dict[str, str]:
    """Apply the settings and return what is set now, by name. Raises InputError if the exposure is or would be automatic."""
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
    """Set manual focus for a ring turned by hand. A motor needs the autofocus position of lens and body, so its mode is only read."""
    if config.first((FOCUS_DRIVE,)) is None:
        return config.choose(FOCUS_MODES, is_off, "manual focus")
    name = config.first(FOCUS_MODES)
    return None if name is None else str(config.value(name))


def _white_balance(wanted: str | None) -> Callable[[str], bool]:
    if wanted is None:
        return is_fixed_white_balance
    return lambda word: word.strip().lower() == wanted.strip().lower() and is_fixed_white_balance(word)


def _numbered(config: CameraConfig, names: tuple[str, ...], wanted: float | None, what: str) -> str | None:
    """Set a number, or return the current one."""
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

"""What a tethered camera tells about its lens, by libgphoto2's names."""

import re
from typing import Any

from mrbokeh.system.gphoto2_library import library
from viewfinder.flow.frames import LensState

_F_NUMBER = ("f-number", "aperture")
# Properties of PTP itself (PIMA 15740, 13.3.8 and 13.3.9), which libgphoto2 lists by number: 1/100 mm, and mm with all ones beyond.
_FOCAL_LENGTH, _FOCUS_DISTANCE, _BEYOND = "5008", "5009", 0xFFFF


def lens_state(camera: Any) -> LensState:
    """camera: an initialised gphoto2.Camera. Most cameras tell the f-number; few the rest.

    PTP does not say where the distance counts from; it is taken as it is.
    """
    f_number = next((number for name in _F_NUMBER if (number := _number(camera, name)) is not None), None)
    hundredths, distance_mm = _number(camera, _FOCAL_LENGTH), _number(camera, _FOCUS_DISTANCE)
    if distance_mm is not None:
        distance_mm = float("inf") if distance_mm >= _BEYOND else distance_mm / 1000
    return LensState(distance_mm, f_number, None if hundredths is None else hundredths / 100)


def _number(camera: Any, name: str) -> float | None:
    """The number above 0 in a setting such as "f/5.6"; None where the camera has no such setting or it says a word."""
    gp = library()
    try:
        text = str(camera.get_single_config(name).get_value())
    except gp.GPhoto2Error as error:
        if error.code in (gp.GP_ERROR_BAD_PARAMETERS, gp.GP_ERROR_NOT_SUPPORTED):
            return None
        raise
    found = re.search(r"\d+(?:\.\d+)?", text)
    return (float(found[0]) or None) if found else None

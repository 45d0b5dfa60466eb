"""Photograph: one picture out of a camera, upright and in linear light, with its lens and exposure; and a lens turned with the sensor.

RAW files are developed by the package `capture`, which is found by its name as the command line finds its sub-commands, and needs the
extra of that name; so does the metadata of JPEG and TIFF. Without it a picture that is no RAW is read, without metadata.

A lens file describes the camera held level, as data sheets do. If EXIF turned a photograph upright, the lens is turned with it: the
stated width lies along the columns, and the opening and the tilt turn too. The lens from metadata comes out alike. If a lens file states
sensor_height_mm, the longer side lies along the longer side of any photograph, whether EXIF tells a turn or not; one of 24 by 36 mm is
described for upright photographs, and is left as it is for them. A network's kernels cannot be turned; only its scale is. The same holds
for clips, which videos turn by their metadata and numbered photographs by EXIF.
"""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.exif import AS_STORED, quarter_turns
from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError

_log = logging.getLogger(__name__)
_USUAL_FOCAL_MM, _LONG_SIDE_MM, _USUAL_F_NUMBER, _SHORTEST_MM = 28.0, 36.0, 8.0, 14.0
"""What most phones have, as of full frame, an f-number at which nearly all is sharp, and what is short on full frame."""
_OPTION_OF = {
    "focal length": "--focal-length MM",
    "f-number": "--f-number N",
    "sensor width": "--sensor-width MM",
    "focus distance": "--focus METRES",
}
_READER = "capture.photos.developing"


@dataclass(frozen=True)
class Photograph:
    """Picture out of a camera, with what its file states; None if it does not.

    rgb: (H, W, 3) linear Rec.709, upright. sensor_width_mm: along the rows of the upright picture. focus_distance_m: from the lens.
    orientation: EXIF's, by which the picture came upright. cut_from_px: width and height of the whole that this is a part of, or None if
    it is the whole. sensor_doubt: what speaks against the stated sensor, in words. rough_focus_m: nearest and farthest distance that the
    stated focus may mean, where that is a wide range.
    """

    rgb: Float32[np.ndarray, "height width 3"]
    focal_length_mm: float | None = None
    f_number: float | None = None
    focus_distance_m: float | None = None
    sensor_width_mm: float | None = None
    exposure_time_s: float | None = None
    iso: float | None = None
    orientation: int = AS_STORED
    cut_from_px: tuple[int, int] | None = None
    sensor_doubt: str = ""
    rough_focus_m: tuple[float, float] | None = None

    @property
    def quarter_turns(self) -> int:
        """Return the counter-clockwise quarter turns that brought the stored picture upright."""
        return quarter_turns(self.orientation)

    @property
    def white_lux(self) -> float | None:
        """Return the illuminance under which a white matte surface shows 1.0, by the exposure; None where the file does not tell it.

        1.0 is where the sensor is full, by the speed of ISO 12232 (78 lx s / S), for a lens that lets 0.65 of the light through.
        """
        if not self.f_number or not self.exposure_time_s or not self.iso:
            return None
        return float(np.pi) * 78.0 / 0.65 * self.f_number**2 / (self.exposure_time_s * self.iso)

    def stating(self, facts: Mapping[str, float]) -> "Photograph":
        """Return the photograph as if its file stated these facts: focal_length_mm, f_number, sensor_width_mm of the camera held level."""
        told = dict(facts)
        doubt = "" if "sensor_width_mm" in told else self.sensor_doubt
        if "sensor_width_mm" in told and self.quarter_turns % 2:
            width_px, height_px = self.cut_from_px or (self.rgb.shape[1], self.rgb.shape[0])
            told["sensor_width_mm"] *= width_px / height_px
        return replace(self, sensor_doubt=doubt, **told)  # type: ignore[arg-type]

    def guessing(self) -> tuple["Photograph", str]:
        """Return the photograph with a guess for all of its lens but the focus that its file does not tell, and the guesses in words."""
        guessed, words = self, []
        if self.focal_length_mm is None and self.sensor_width_mm is not None:
            width_mm, focal_mm = self.sensor_width_mm, _USUAL_FOCAL_MM / _LONG_SIDE_MM * self.sensor_width_mm
        else:
            focal_mm = self.focal_length_mm or _USUAL_FOCAL_MM
            # A lens too short for full frame is that of a phone or a compact camera, whose sensor is as much smaller.
            long_side_mm = _LONG_SIDE_MM * (focal_mm / _USUAL_FOCAL_MM if focal_mm < _SHORTEST_MM else 1.0)
            width_mm = long_side_mm * self.rgb.shape[1] / max(self.cut_from_px or self.rgb.shape[:2])
        if self.focal_length_mm is None or self.sensor_width_mm is None:
            guessed = replace(guessed, focal_length_mm=focal_mm, sensor_width_mm=width_mm)
            words.append(f"the field of view of {focal_mm:.4g} mm on {width_mm:.4g} mm of sensor width (--focal-length, --sensor-width)")
        if self.f_number is None:
            guessed = replace(guessed, f_number=_USUAL_F_NUMBER)
            words.append(f"f/{_USUAL_F_NUMBER:g} (--f-number)")
        return guessed, " and ".join(words)

    def lens(self, path: Path, focus_m: float | None = None) -> Lens:
        """Return the lens with a round opening. focus_m replaces the file's own focus. Raises InputError if parts are unknown."""
        focus = self.focus_distance_m if focus_m is None else focus_m
        told = {
            "focal length": self.focal_length_mm,
            "f-number": self.f_number,
            "sensor width": self.sensor_width_mm,
            "focus distance": focus,
        }
        missing = [name for name, value in told.items() if value is None]
        if self.focal_length_mm is None or self.f_number is None or self.sensor_width_mm is None or focus is None:
            raise InputError(
                f"{path} does not tell its lens (unknown: {', '.join(missing)}): give "
                f"{' '.join(_OPTION_OF[name] for name in missing)}, or --lens LENS.json (see `mrbokeh lens new`)"
            )
        if self.sensor_doubt:
            _log.warning(f"{path}: {self.sensor_doubt} (--sensor-width MM)")
        if self.cut_from_px is not None:
            _log.warning(
                f"{self.cut_told(path)}: {self.sensor_width_mm:.3g} mm of the sensor are taken along its width; if it was made smaller "
                f"too, give --lens with the sensor width of what is left"
            )
        return Lens(self.focal_length_mm, self.f_number, focus, self.sensor_width_mm)

    def cut_told(self, path: Path) -> str:
        """Say that a picture is not the whole; its middle is taken to be that of the whole."""
        assert self.cut_from_px is not None
        height_px, width_px = self.rgb.shape[:2]
        return f"{path} of {width_px}x{height_px} px was cut out of {self.cut_from_px[0]}x{self.cut_from_px[1]} px, as its EXIF tells"


def is_raw(path: Path) -> bool:
    """Return whether a file is RAW, by its suffix."""
    return bool(import_module(_READER).is_raw(path))


def full_value(path: Path) -> float:
    """Return what a white light that filled all photosites of a RAW file reads: the largest multiplier of the white balance."""
    return float(max(import_module("capture.photos.raw").camera_white_balance(path)))


def read_photograph(path: Path | str) -> Photograph:
    """Read a RAW file, JPEG, TIFF, PNG, WebP, HEIC, EXR or HDR.

    Raises InputError where it cannot be read, MissingExtraError for RAW without the extra.
    """
    return import_module(_READER).read_photograph(Path(path))


@dataclass(frozen=True)
class SensorOrientation:
    """Orientation of the sensor when a picture was taken.

    whole_px: (width, height) of all that it took, upright, of which the picture may be a part. quarter_turns: counter-clockwise, that
    brought
    the stored picture upright.
    """

    whole_px: tuple[int, int]
    quarter_turns: int = 0


def lens_for_photograph(lens: Lens, photograph: Photograph, path: Path) -> Lens:
    """Return the lens for the upright picture of a photograph; logs one line about what was assumed if that is not plain."""
    height_px, width_px = photograph.rgb.shape[:2]
    held = lens_for_orientation(lens, SensorOrientation(photograph.cut_from_px or (width_px, height_px), photograph.quarter_turns), path)
    if photograph.cut_from_px is not None:
        left_mm = held.sensor_width_mm * width_px / photograph.cut_from_px[0]
        _log.warning(
            f"{photograph.cut_told(path)}: {held.sensor_width_mm:.3g} mm of the sensor are taken along its width, as --lens says; where "
            f"that is the whole sensor, --lens has to say {left_mm:.3g} mm instead (or more, if it was made smaller too)"
        )
    return held


def lens_for_orientation(lens: Lens, holding: SensorOrientation, path: Path | None = None) -> Lens:
    """Return the lens for upright pictures of a sensor orientation. path: the file to name in a line about what was assumed."""
    held = _held(lens, holding)
    told = _way_told(lens, held, holding)
    if told and path is not None:
        _log.warning(f"{path} {told}")
    return held


def _way_told(lens: Lens, held: Lens, holding: SensorOrientation) -> str:
    """Return what was assumed in words, '' if the lens needs no correction and may well be right."""
    width_px, height_px = holding.whole_px
    if held.sensor_width_mm != lens.sensor_width_mm:
        way = "upright" if height_px > width_px else "level"
        sides = f"{held.sensor_width_mm:.3g} mm of the sensor are taken along its width, {held.sensor_height_mm:.3g} mm along its height"
        return f"was taken with the camera held {way}: {sides}"
    if height_px > width_px and lens.sensor_height_mm is None:
        return (
            f"is higher than wide and does not say that it was turned: {lens.sensor_width_mm:g} mm of the sensor are taken along its "
            f"width; if the camera was held upright, state sensor_height_mm in the lens file too"
        )
    return ""


def turned_by(lens: Lens, quarters: int) -> Lens:
    """Turn the opening and the tilt by quarter turns counter-clockwise in the picture; the sensor stays."""
    right_rad, down_rad = lens.tilt_rad
    for _ in range(quarters):
        right_rad, down_rad = down_rad, -right_rad
    return replace(lens, aperture=lens.aperture.rotated(-quarters * np.pi / 2), tilt_rad=(right_rad, down_rad))


def _held(lens: Lens, holding: SensorOrientation) -> Lens:
    width_px, height_px = holding.whole_px
    is_for_upright = (lens.sensor_height_mm or 0.0) > lens.sensor_width_mm
    held = lens if is_for_upright else turned_by(lens, holding.quarter_turns)
    if width_px == height_px or (lens.sensor_height_mm is None and holding.quarter_turns % 2 == 0):
        return held
    long_mm, long_px = max(lens.sensor_width_mm, lens.sensor_height_mm or 0.0), max(width_px, height_px)
    return replace(held, sensor_width_mm=long_mm * (width_px / long_px), sensor_height_mm=long_mm * (height_px / long_px))

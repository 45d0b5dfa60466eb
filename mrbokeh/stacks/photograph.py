"""Photograph: one picture out of a camera, upright and in linear light, with what it tells of its lens and exposure.

RAW files are developed by the package `capture`, which is found by its name as the command line finds its sub-commands, and needs the
extra of that name; so does the metadata of JPEG and TIFF. Without it a picture that is no RAW is read, and tells nothing.
"""

import logging
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.exif import AS_STORED, quarter_turns
from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError

_log = logging.getLogger(__name__)
_READER = "capture.photos.developing"


@dataclass(frozen=True)
class Photograph:
    """rgb: (H, W, 3) linear Rec.709, upright. None is what the file does not tell.

    sensor_width_mm: along the rows of the upright picture. focus_distance_m: from the lens. orientation: EXIF's, by which the picture came
    upright. cut_from_px: width and height of the whole that this is a part of, or None where it is the whole.
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

    @property
    def quarter_turns(self) -> int:
        """Counter-clockwise, that brought the stored picture upright."""
        return quarter_turns(self.orientation)

    def lens(self, path: Path, focus_m: float | None = None) -> Lens:
        """The lens with a round opening. focus_m takes the place of the file's own focus. Raises InputError where parts are unknown."""
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
                f"{path} does not tell its lens (unknown: {', '.join(missing)}): give --lens LENS.json (see `mrbokeh lens new`)"
                + (" or --focus METRES" if missing == ["focus distance"] else "")
            )
        if self.cut_from_px is not None:
            _log.warning(
                f"{self.cut_told(path)}: {self.sensor_width_mm:.3g} mm of the sensor are taken along its width; if it was made smaller "
                f"too, give --lens with the sensor width of what is left"
            )
        return Lens(self.focal_length_mm, self.f_number, focus, self.sensor_width_mm)

    def cut_told(self, path: Path) -> str:
        """In words, of a picture that is not the whole; its middle is taken to be that of the whole."""
        assert self.cut_from_px is not None
        height_px, width_px = self.rgb.shape[:2]
        return f"{path} of {width_px}x{height_px} px was cut out of {self.cut_from_px[0]}x{self.cut_from_px[1]} px, as its EXIF tells"


def read_photograph(path: Path | str) -> Photograph:
    """A RAW file, JPEG, TIFF, PNG, WebP, EXR or HDR.

    Raises InputError where it cannot be read, MissingExtraError for RAW without the extra.
    """
    return import_module(_READER).read_photograph(Path(path))

"""Photographs with place, time and compass in their EXIF, as phones write them."""

from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

GPS = {
    1: "N",
    2: (39.0, 44.0, 32.914),
    3: "W",
    4: (105.0, 10.0, 42.96),
    7: (19.0, 30.0, 30.0),
    16: "T",
    17: 104.34,
    29: "2003:10:17",
}
"""Golden, Colorado, 39.742476 N 105.1786 W, on October 17, 2003 at 12:30:30 (UTC - 7): the example of NREL's solar position algorithm
(Reda and Andreas, NREL/TP-560-34302, table A5.1) has the sun at azimuth 194.34024 and zenith 50.11162 degrees. The camera looks 90
degrees left of it."""
TAKEN = {0x9003: "2003:10:17 12:30:30"}
EXPOSED = {0x829A: Fraction(1, 100), 0x829D: 16.0, 0x8827: 100, 0x920A: 28.0, 0xA405: 28}
"""By the rule of f/16 a white surface in full sun is just white."""


def write_sunny(path: Path, gps: Mapping[int, Any], exif: Mapping[int, Any]) -> Path:
    """Write a JPEG of even grey, 300x200 px, with these tags of EXIF's GPS directory and of its own."""
    tags = Image.Exif()
    tags[0x010F], tags[0x0110] = "mrbokeh", "phone"
    for number, told in ((0x8825, gps), (0x8769, exif)):
        tags.get_ifd(number).update({tag: _rational(value) for tag, value in told.items()})
    noise = np.random.default_rng(1).integers(-12, 13, (200, 300, 1))
    Image.fromarray(np.repeat(170 + noise, 3, axis=2).astype(np.uint8)).save(path, exif=tags, quality=95)
    return path


def _rational(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(_rational(each) for each in value)
    return IFDRational(Fraction(value).limit_denominator(100_000)) if isinstance(value, float | Fraction) else value

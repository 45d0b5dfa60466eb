"""Focus distances that photographs state, in EXIF, Canon, Nikon, Olympus and Apple maker notes and XMP, and how far to trust them.

Cameras count from the film plane, are coarse (Nikon: steps of 5.9 %) and use sentinels: 0 for "unknown", all ones for "infinity", which
may be anything beyond their last code (`SentinelReading`).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from decimal import Decimal
from typing import ClassVar

from mrbokeh.images.apple_notes import apple_notes
from mrbokeh.optics.lens import MM_PER_M, lens_distance_m

UINT32_MAX = 0xFFFFFFFF
_MOST_DIGITS = 20
UINT16_MAX = 0xFFFF
UINT8_MAX = 0xFF
_CM_PER_M = 100.0
_CANON_INFINITY_CM = 65535.0
_CANON_INFINITY_CODES = (UINT16_MAX // 10, UINT16_MAX)
"""All ones, by bodies of 2007 and later divided by ten and rounded down."""
_CANONS_IN_MM = range(0x1010000, 0x1190000)
"""Model numbers of Canon's PowerShots and IXUS before the G3, which count mm where later ones count cm."""
_MOST_APERTURE_CODE = 500
"""Canon's code of an aperture is 32 times its APEX value, 416 for f/90; more is a maker note whose offsets are lost."""
_ALL_NINES = 9999
"""HP writes 9999/100 m for all that is far."""

Tags = Mapping[str, str]


@dataclass(frozen=True)
class FocusReading:
    """Focus distance with the interval it stands for; 0 < nearest_m <= distance_m <= farthest_m, inf allowed.

    origin: where the distance is counted from, "film_plane" or "lens".
    source: the tag and the number it held, as text.
    is_sentinel: whether that number stands for no distance at all (`SentinelReading`).
    """

    is_sentinel: ClassVar[bool] = False

    distance_m: float
    nearest_m: float
    farthest_m: float
    origin: str
    source: str

    @classmethod
    def from_film_plane(cls, distance_m: float, nearest_m: float, farthest_m: float, source: str) -> "FocusReading":
        return cls(distance_m, nearest_m, farthest_m, origin="film_plane", source=source)

    def lens_distance_m(self, focal_length_mm: float | None, hiatus_mm: float = 0.0) -> float | None:
        """Return the distance from the front principal plane; None if the focal length is needed and unknown, or no lens of it fits."""
        return self._from_lens(self.distance_m, focal_length_mm, hiatus_mm)

    def lens_interval_m(self, focal_length_mm: float | None, hiatus_mm: float = 0.0) -> tuple[float, float] | None:
        """Return (nearest, farthest) from the front principal plane; None where the distance itself is not known from there."""
        distance_m = self.lens_distance_m(focal_length_mm, hiatus_mm)
        farthest_m = self._from_lens(self.farthest_m, focal_length_mm, hiatus_mm)
        if distance_m is None or farthest_m is None:
            return None
        nearest_m = self._from_lens(self.nearest_m, focal_length_mm, hiatus_mm)
        # Nearer than a lens of this focal length reaches: it ends at 1:1, two focal lengths before the lens.
        shortest_m = min(distance_m, 2.0 * (focal_length_mm or 0.0) / MM_PER_M)
        return (shortest_m if nearest_m is None else nearest_m), farthest_m

    def _from_lens(self, stated_m: float, focal_length_mm: float | None, hiatus_mm: float) -> float | None:
        if self.origin == "lens" or math.isinf(stated_m):
            return stated_m
        return None if focal_length_mm is None else lens_distance_m(stated_m, focal_length_mm, hiatus_mm)


@dataclass(frozen=True)
class SentinelReading(FocusReading):
    """Infinity by a number that stands for it (0xFFFFFFFF, 655.35 m).

    Cameras write it for all that lies beyond their last code, be that 3 m or 30 m, and where they do not know. It is a value to start
    from; the photographs of its stack bound it (`capture.stacks.slice_files`).
    """

    is_sentinel: ClassVar[bool] = True


def at_infinity(source: str) -> FocusReading:
    return SentinelReading.from_film_plane(math.inf, math.inf, math.inf, source)


def read_focus(tags: Tags) -> FocusReading | None:
    """Return the focus distance stated by exiv2's tags, from the most to the least trustworthy source; None where unknown."""
    readers: tuple[Callable[[Tags], FocusReading | None], ...] = (
        _canon_interval,
        _subject_distance,
        _nikon,
        _olympus,
        _canon_shot,
        _apple,
        _adobe,
    )
    return next((reading for reader in readers if (reading := reader(tags)) is not None), None)


def canon_reading(nearest_m: float, farthest_m: float, source: str) -> FocusReading | None:
    """Return a reading between two distances in metres: an upper one of 0 says nothing, 655.35 is infinity, a lower one of 0 is missing.

    Infinity with a finite lower end is an interval; without one it is a sentinel.
    """
    if farthest_m <= 0.0:
        return None
    nearest_m, farthest_m = (math.inf if each >= _CANON_INFINITY_CM / _CM_PER_M - 1e-6 else each for each in (nearest_m, farthest_m))
    nearest_m = min(nearest_m, farthest_m) if nearest_m > 0.0 else farthest_m
    if math.isinf(nearest_m):
        return at_infinity(source)
    middle_dioptres = 0.5 * (1.0 / nearest_m + 1.0 / farthest_m)
    return FocusReading.from_film_plane(1.0 / middle_dioptres, nearest_m, farthest_m, source)


def _apple(tags: Tags) -> FocusReading | None:
    """Read the range in which an iPhone was focused; its middle is that of the dioptres."""
    note = tags.get("Exif.Photo.MakerNote", "")
    if not note.startswith(_APPLE):
        return None
    try:
        notes = apple_notes(bytes(int(each) for each in note.split()))
    except ValueError:
        return None
    if notes.focus_m is None or notes.focus_distance_m is None:
        return None
    nearest_m, farthest_m = notes.focus_m
    source = f"Apple's FocusDistanceRange = {nearest_m:.4g} to {farthest_m:.4g} m"
    return FocusReading(notes.focus_distance_m, nearest_m=nearest_m, farthest_m=farthest_m, origin="lens", source=source)


_APPLE = "65 112 112 108 101 "
"""How exiv2 writes the bytes of a note that begins with "Apple"."""


def rational(text: str | None) -> tuple[int, int] | None:
    """Return (numerator, denominator) of "17/10", "17", "1.7" or of the first number of several; None where there is no number.

    Decimals are of files whose writer stored floating point, against Exif's rules; (17, 10) keeps their last digit.
    """
    if not text or not text.split():
        return None
    numerator, _, denominator = text.split()[0].partition("/")
    try:
        whole = Decimal(numerator)
        exponent = int(whole.as_tuple().exponent)  # of what is no number a letter
        if abs(exponent) > _MOST_DIGITS:
            return None
        scale = 1 if whole == whole.to_integral_value() else 10 ** max(0, -exponent)
        return int(whole * scale), int(denominator or 1) * scale
    except (ValueError, ArithmeticError):
        return None


def number(text: str | None) -> float | None:
    """Return the first number of a tag as float; None for nothing, 0/0 and x/0."""
    parts = rational(text)
    return None if parts is None or parts[1] == 0 else parts[0] / parts[1]


def _subject_distance(tags: Tags) -> FocusReading | None:
    return _rational_distance(tags, ("Exif.Photo.SubjectDistance", "Exif.Image.SubjectDistance"))


def _adobe(tags: Tags) -> FocusReading | None:
    """Read the maker note's distance where Adobe's converters copy it."""
    return _rational_distance(tags, ("Xmp.aux.ApproximateFocusDistance",))


def _rational_distance(tags: Tags, names: tuple[str, ...]) -> FocusReading | None:
    """Read metres as a fraction, good to half a unit of its last digit; 0 and 0/0 are unknown, 0xFFFFFFFF is a sentinel for infinity."""
    for name in names:
        parts = rational(tags.get(name))
        if parts is None or parts[0] <= 0:
            continue
        numerator, denominator = parts
        source = f"{name} = {tags[name]}"
        if numerator == UINT32_MAX:
            return at_infinity(source)
        if denominator > 0:
            distance_m, nearest_m, farthest_m = ((numerator + digit) / denominator for digit in (0.0, -0.5, 0.5))
            if parts == (_ALL_NINES, 100):
                return at_infinity(source)
            return FocusReading.from_film_plane(distance_m, nearest_m, farthest_m, source)
    return None


def _canon_interval(tags: Tags) -> FocusReading | None:
    """Read the farthest and the nearest distance in cm from Canon's file info. The middle is taken in dioptres, in which blur is linear."""
    names = ("Exif.CanonFi.FocusDistanceUpper", "Exif.CanonFi.FocusDistanceLower")
    farthest_cm, nearest_cm = (_unsigned(tags, name) for name in names) if is_whole_canon_note(tags) else (0.0, 0.0)
    source = f"Exif.CanonFi.FocusDistanceLower, Upper = {nearest_cm:g}, {farthest_cm:g} cm"
    return canon_reading(nearest_cm / _CM_PER_M, farthest_cm / _CM_PER_M, source)


def _unsigned(tags: Tags, name: str) -> float:
    """Return a distance of Canon's: 16 bits without sign, in arrays that exiv2 reads as signed (-1 is 65535). 0 where there is none."""
    return (number(tags.get(name)) or 0.0) % (UINT16_MAX + 1)


def _canon_shot(tags: Tags) -> FocusReading | None:
    """Read Canon's shot info: cm, but mm in the PowerShots and IXUS before the G3, and in those that write CRW.

    exiv2 and exiftool read cm throughout. JPEGs of a G2, A20, S30 and IXUS 300 say 1.50 m in EXIF and 1503 here; an S40 that fills its
    frame (7.1 mm lens, 7.26 mm sensor) with a box of 0.2 m says 188. A maker note whose other numbers are impossible is not believed.
    """
    name = "Exif.CanonSi.SubjectDistance"
    value = _unsigned(tags, name)
    if value == 0.0 or not is_whole_canon_note(tags):
        return None
    if value in _CANON_INFINITY_CODES:
        return at_infinity(f"{name} = {value:g}")
    of_old = int(number(tags.get("Exif.Canon.ModelID")) or 0) in _CANONS_IN_MM
    in_mm = of_old or (tags.get("mime_type") == "image/x-canon-crw" and "PowerShot" in tags.get("Exif.Image.Model", ""))
    per_m, unit = (MM_PER_M, "mm") if in_mm else (_CM_PER_M, "cm")
    return FocusReading.from_film_plane(value / per_m, (value - 0.5) / per_m, (value + 0.5) / per_m, f"{name} = {value:g} {unit}")


def is_whole_canon_note(tags: Tags) -> bool:
    """Return whether Canon's own code of the widest aperture is one of an aperture; programs that move the note leave other bytes there."""
    code = number(tags.get("Exif.CanonCs.MaxAperture"))
    return code is None or 0 < code <= _MOST_APERTURE_CODE


def _nikon(tags: Tags) -> FocusReading | None:
    """Read Nikon's lens data: d = 0.01 * 10^(v / 40) m with an 8-bit v; Z lenses add 8 bits of fraction: d = 2^((v / 256 - 80) / 12) m.

    The first from exiv2, the second from exiftool (Nikon.pm, LensData0800); both make 1 m of 80. 0 and all ones are unknown.
    """
    for name, metres_of, units in _NIKON_CODES:
        value = number(tags.get(f"Exif.Nikon{name}"))
        if value is not None and 0 < value < (UINT16_MAX if units > 1 else UINT8_MAX):
            code, half_step = value / units, 0.5 / units
            nearest_m, distance_m, farthest_m = (metres_of(each) for each in (code - half_step, code, code + half_step))
            return FocusReading.from_film_plane(distance_m, nearest_m, farthest_m, f"Exif.Nikon{name} = {value:g}")
    return None


def _nikon_f_metres(code: float) -> float:
    return 0.01 * 10.0 ** (code / 40.0)


def _nikon_z_metres(code: float) -> float:
    return 2.0 ** ((code - 80.0) / 12.0)


_NIKON_CODES = (
    ("Ld4.FocusDistance2", _nikon_z_metres, 256),
    ("Ld4.FocusDistance", _nikon_f_metres, 1),
    ("Ld3.FocusDistance", _nikon_f_metres, 1),
    ("Ld2.FocusDistance", _nikon_f_metres, 1),
)


def _olympus(tags: Tags) -> FocusReading | None:
    """Read Olympus' distance: the numerator counts mm whatever the denominator says (E-1: 1, E-300: 10); 0xFFFFFFFF is infinity."""
    name = "Exif.OlympusFi.FocusDistance"
    parts = rational(tags.get(name))
    if parts is None or parts[0] <= 0:
        return None
    if parts[0] == UINT32_MAX:
        return at_infinity(f"{name} = {tags[name]}")
    distance_m = parts[0] / MM_PER_M
    half_m = 0.5 / MM_PER_M
    return FocusReading.from_film_plane(distance_m, distance_m - half_m, distance_m + half_m, f"{name} = {tags[name]}")

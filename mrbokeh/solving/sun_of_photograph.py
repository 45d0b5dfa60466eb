"""The sun over a photograph, by the place, the time and the compass direction that phones write into EXIF.

Its place in the sky is that of the low-precision formulas of the Astronomical Almanac (Michalsky, Solar Energy 40, 1988), within 0.01
degrees from 1950 to 2050, lifted by refraction (Saemundsson 1986). A compass is the weak part: those of phones are often off by 10
degrees, and by much more near iron. A direction from magnetic north is turned to true north by the field of the Earth's core of 2020, of
IGRF-14 (IAGA 2024, doi 10.5281/zenodo.14012302) up to degree 4, on a sphere. Between 45 degrees south and 65 north that is off the whole
model by 0.9 degrees in the median, and by less than 3.2 in 95 of 100 places; the field turns by 0.1 to 0.2 degrees a year.

The time is GPS's, which is UTC, or that of the camera's clock with its offset from UTC. A clock without offset tells nothing: a wrong
time zone turns the sun by 15 degrees an hour. GPS times that contradict the camera's clock by more than time zones do are not believed,
nor those of old phones that wrote local time for UTC.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from mrbokeh.images.exif import exif_and_size

_COEFFICIENTS_NT = {
    (1, 0): (-29403.41, 0.0),
    (1, 1): (-1451.37, 4653.35),
    (2, 0): (-2499.78, 0.0),
    (2, 1): (2981.96, -2991.72),
    (2, 2): (1676.85, -734.62),
    (3, 0): (1363.00, 0.0),
    (3, 1): (-2380.80, -81.96),
    (3, 2): (1236.06, 241.80),
    (3, 3): (525.60, -542.52),
    (4, 0): (902.82, 0.0),
    (4, 1): (809.47, 282.10),
    (4, 2): (86.18, -158.50),
    (4, 3): (-309.47, 199.75),
    (4, 4): (47.44, -350.30),
}
"""Degree and order to g and h, Schmidt semi-normalised."""
_DEGREES, _STEP_RAD = 4, 1e-4
_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825
_TAKEN, _OFFSET = 0x9003, 0x9011
_LATITUDE, _LONGITUDE, _TIME, _DATE, _DIRECTION_REF, _DIRECTION = 2, 4, 7, 29, 16, 17
_DAY_FORMAT = "%Y:%m:%d"
_LEAST_ABOVE_DEG = 3.0
_MOST_OFF_ZONE_H = 4.0
"""By how much a clock may differ from the sun's time: China has one zone for 62 degrees, and summer time adds an hour."""
_UTC_FROM_DEG, _UTC_TO_DEG = -26.0, 4.0
"""Longitudes between which clocks show UTC somewhere."""

Tags = Mapping[int, Any]


@dataclass(frozen=True)
class SunOfPhotograph:
    """Place of the sun: degrees above the horizon, and to the right of the optical axis, seen from above; None without a compass."""

    above_deg: float
    right_deg: float | None = None
    from_magnetic_north: bool = False

    @property
    def is_up(self) -> bool:
        """Return whether it stood high enough to throw shadows that end."""
        return self.above_deg >= _LEAST_ABOVE_DEG


def sun_of_photograph(path: Path) -> SunOfPhotograph | None:
    """Return where the sun stood when a photograph was taken; None where its file does not tell place and time."""
    found = exif_and_size(path)
    if found is None:
        return None
    try:
        return sun_by_tags(found[0].get_ifd(_GPS_IFD), found[0].get_ifd(_EXIF_IFD))
    except (ValueError, TypeError, KeyError, IndexError, OverflowError, ArithmeticError, SyntaxError, OSError):
        return None  # the tags of strangers hold anything


def sun_by_tags(gps: Tags, exif: Tags) -> SunOfPhotograph | None:
    """Return the sun by the tags of EXIF's GPS directory and of its own, by their numbers."""
    place = _degrees(gps, _LATITUDE, "S"), _degrees(gps, _LONGITUDE, "W")
    latitude_deg, longitude_deg = place
    if latitude_deg is None or longitude_deg is None or place == (0.0, 0.0) or abs(latitude_deg) > 90.0:
        return None
    taken_at = _utc(gps, exif, longitude_deg)
    if taken_at is None:
        return None
    azimuth_deg, above_deg = sun_position_deg(taken_at, latitude_deg, longitude_deg)
    looks_deg = float(gps.get(_DIRECTION, math.nan))
    if not 0.0 <= looks_deg <= 360.0:
        return SunOfPhotograph(above_deg)
    is_magnetic = _text(gps, _DIRECTION_REF).upper() == "M"
    looks_deg += declination_deg(latitude_deg, longitude_deg) if is_magnetic else 0.0
    return SunOfPhotograph(above_deg, (azimuth_deg - looks_deg + 180.0) % 360.0 - 180.0, is_magnetic)


def sun_position_deg(at: datetime, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
    """Return the sun's azimuth from north through east, and its apparent altitude. at: with its time zone. East and north count up."""
    days = (at - datetime(2000, 1, 1, 12, tzinfo=UTC)) / timedelta(days=1)
    anomaly = math.radians(357.528 + 0.9856003 * days)
    ecliptic = math.radians(280.460 + 0.9856474 * days + 1.915 * math.sin(anomaly) + 0.020 * math.sin(2.0 * anomaly))
    tilt = math.radians(23.439 - 4e-7 * days)
    ascension = math.atan2(math.cos(tilt) * math.sin(ecliptic), math.cos(ecliptic))
    sine = math.sin(tilt) * math.sin(ecliptic)
    cosine = math.sqrt(1.0 - sine**2)
    # Greenwich's sidereal time, in hours.
    hour_angle = math.radians(15.0 * (18.697375 + 24.0657098242 * days) + longitude_deg) - ascension
    latitude = math.radians(latitude_deg)
    up = math.sin(latitude) * sine + math.cos(latitude) * cosine * math.cos(hour_angle)
    north = math.cos(latitude) * sine - math.sin(latitude) * cosine * math.cos(hour_angle)
    east = -cosine * math.sin(hour_angle)
    above_deg = math.degrees(math.atan2(up, math.hypot(north, east)))
    lifted_deg = 1.02 / 60.0 / math.tan(math.radians(above_deg + 10.3 / (above_deg + 5.11))) if above_deg > -1.0 else 0.0
    return math.degrees(math.atan2(east, north)) % 360.0, above_deg + lifted_deg


def _utc(gps: Tags, exif: Tags, longitude_deg: float) -> datetime | None:
    """Return when a photograph was taken, in UTC; None where that is not sure."""
    clock, offset = _text(exif, _TAKEN)[:19], _text(exif, _OFFSET)
    local = _parsed(clock, f"{_DAY_FORMAT} %H:%M:%S")
    by_gps = _by_gps(gps, local, longitude_deg)
    return by_gps if by_gps is not None else _parsed(f"{clock} {offset}", f"{_DAY_FORMAT} %H:%M:%S %z")


def _by_gps(gps: Tags, local: datetime | None, longitude_deg: float) -> datetime | None:
    """Return GPS's time if the clock of the camera bears it out.

    The clock's day is taken where GPS tells none: one more or less moves the sun by 0.4 degrees.
    """
    hours, minutes, seconds = (float(each) for each in gps.get(_TIME) or (math.nan,) * 3)
    day = _parsed(_text(gps, _DATE), _DAY_FORMAT) or (local and local.replace(hour=0, minute=0, second=0))
    if day is None or not (0.0 <= hours < 24.0 and 0.0 <= minutes < 60.0 and 0.0 <= seconds < 62.0):
        return None
    at = day + timedelta(hours=hours, minutes=minutes, seconds=seconds)
    if local is not None:
        zone_h = (local - at) / timedelta(hours=1)
        is_local_time = abs(_within_a_day(zone_h)) < 0.1 and not _UTC_FROM_DEG < longitude_deg < _UTC_TO_DEG
        if is_local_time or abs(_within_a_day(zone_h - longitude_deg / 15.0)) > _MOST_OFF_ZONE_H:
            return None
    return at.replace(tzinfo=UTC)


def _within_a_day(hours: float) -> float:
    """Return a difference of clocks between -12 and 12 hours, whatever their days."""
    return (hours + 12.0) % 24.0 - 12.0


def _degrees(gps: Tags, tag: int, negative: str) -> float | None:
    """Return a latitude or a longitude, whose reference is the tag before it."""
    degrees, minutes, seconds = (float(each) for each in gps.get(tag) or (math.nan,) * 3)
    total = degrees + minutes / 60.0 + seconds / 3600.0
    if not math.isfinite(total):
        return None
    return -total if _text(gps, tag - 1).upper() == negative else total


def _text(tags: Tags, tag: int) -> str:
    told = tags.get(tag, "")
    return (told.decode("ascii", "ignore") if isinstance(told, bytes) else str(told)).strip("\0 ")


def _parsed(text: str, form: str) -> datetime | None:
    try:
        return datetime.strptime(text, form)
    except ValueError:
        return None


def declination_deg(latitude_deg: float, longitude_deg: float) -> float:
    """Return how many degrees east of true north magnetic north lies at a place; west is negative."""
    latitude, longitude = math.radians(min(max(latitude_deg, -89.0), 89.0)), math.radians(longitude_deg)
    north = _potential(latitude - _STEP_RAD, longitude) - _potential(latitude + _STEP_RAD, longitude)
    east = _potential(latitude, longitude - _STEP_RAD) - _potential(latitude, longitude + _STEP_RAD)
    return math.degrees(math.atan2(east / math.cos(latitude), north))


def _potential(latitude_rad: float, longitude_rad: float) -> float:
    """Return the potential of the field on the surface, in nanotesla times the Earth's radius."""
    legendre = _legendre(latitude_rad)
    waves = {order: (math.cos(order * longitude_rad), math.sin(order * longitude_rad)) for order in range(_DEGREES + 1)}
    return sum(
        legendre[degree, order] * (g * waves[order][0] + h * waves[order][1]) for (degree, order), (g, h) in _COEFFICIENTS_NT.items()
    )


def _legendre(latitude_rad: float) -> dict[tuple[int, int], float]:
    """Return Schmidt's semi-normalised Legendre functions of the sine of the latitude by degree and order, by their recurrences."""
    sine, cosine = math.sin(latitude_rad), math.cos(latitude_rad)
    values = {(0, 0): 1.0}
    for order in range(_DEGREES + 1):
        if order:
            values[order, order] = cosine * values[order - 1, order - 1] * (math.sqrt(1.0 - 0.5 / order) if order > 1 else 1.0)
        for degree in range(order + 1, _DEGREES + 1):
            before = math.sqrt((degree - 1) ** 2 - order**2) * values.get((degree - 2, order), 0.0) if degree > order + 1 else 0.0
            values[degree, order] = ((2 * degree - 1) * sine * values[degree - 1, order] - before) / math.sqrt(degree**2 - order**2)
    return values

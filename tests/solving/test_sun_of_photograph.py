"""Where the sun stood over a photograph, by published positions, and what EXIF has to tell for that."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from mrbokeh.solving.sun_of_photograph import declination_deg, sun_by_tags, sun_of_photograph, sun_position_deg
from tests.support.sunny_photographs import GPS, TAKEN, write_sunny


def without(*tags: int) -> dict[int, Any]:
    return {tag: value for tag, value in GPS.items() if tag not in tags}


def test_the_sun_stands_where_nrels_example_has_it() -> None:
    """Reda and Andreas, NREL/TP-560-34302, table A5.1, with refraction at 1830 m."""
    azimuth_deg, above_deg = sun_position_deg(datetime(2003, 10, 17, 19, 30, 30, tzinfo=UTC), 39.742476, -105.1786)
    assert azimuth_deg == pytest.approx(194.34024, abs=0.02)
    assert above_deg == pytest.approx(90.0 - 50.11162, abs=0.02)


def test_the_sun_is_overhead_where_meeus_has_it() -> None:
    """Meeus, Astronomical Algorithms, 1992 October 13.0: declination -7.78507 (example 25.a); its time runs 13 m 42.6 s ahead (28.b).

    At 0 h UT it is overhead at 180 degrees of longitude less those minutes; 59 s of dynamical time are 0.25 degrees.
    """
    overhead_deg = 180.0 - (13.0 + 42.6 / 60.0) / 4.0
    assert sun_position_deg(datetime(1992, 10, 13, tzinfo=UTC), -7.78507, overhead_deg)[1] == pytest.approx(90.0, abs=0.02)
    azimuth_deg, above_deg = sun_position_deg(datetime(1992, 10, 13, tzinfo=UTC), -37.78507, overhead_deg)
    assert above_deg == pytest.approx(60.0, abs=0.02)
    assert min(azimuth_deg, 360.0 - azimuth_deg) < 0.1, "due north of southern places"


@pytest.mark.parametrize(
    ("latitude_deg", "longitude_deg", "expected_deg"),
    [(37.77, -122.42, 13.5), (40.7, -74.0, -12.9), (52.5, 13.4, 4.3), (35.7, 139.7, -7.7), (-33.9, 151.2, 12.8), (-22.9, -43.2, -22.9)],
)
def test_a_needle_points_beside_true_north(latitude_deg: float, longitude_deg: float, expected_deg: float) -> None:
    """By IGRF-14 of 2020 up to degree 13, of which degrees up to 4 are used here."""
    assert declination_deg(latitude_deg, longitude_deg) == pytest.approx(expected_deg, abs=3.3)


def test_the_sun_is_to_the_right_of_the_view() -> None:
    sun = sun_by_tags(GPS, TAKEN)
    assert sun is not None
    assert (sun.right_deg, sun.above_deg) == pytest.approx((90.0, 39.89), abs=0.05)
    assert sun.is_up and not sun.from_magnetic_north
    behind = sun_by_tags(GPS | {17: 14.34}, TAKEN)
    assert behind is not None and abs(behind.right_deg or 0.0) == pytest.approx(180.0, abs=0.05)
    magnetic = sun_by_tags(GPS | {16: "M"}, TAKEN)
    assert magnetic is not None and magnetic.from_magnetic_north
    assert magnetic.right_deg == pytest.approx(90.0 - declination_deg(39.74, -105.18), abs=0.05)


def test_without_a_compass_the_height_is_known() -> None:
    for gps in (without(16, 17), GPS | {17: float("nan")}, GPS | {17: 1000.0}):
        sun = sun_by_tags(gps, TAKEN)
        assert sun is not None and sun.right_deg is None
        assert sun.above_deg == pytest.approx(39.89, abs=0.05)


@pytest.mark.parametrize(
    ("gps", "exif"),
    [
        (GPS, {}),
        (without(29), TAKEN),
        (GPS | {29: "2003:10:290"}, TAKEN),  # the day of the year, as an iPhone 6 wrote it
        (without(7, 29), TAKEN | {0x9011: "-07:00"}),
        (GPS, {0x9003: "2003:10:16 12:30:30"}),  # a clock whose date is wrong
        (GPS | {1: "N\0", 3: b"W\0"}, TAKEN),
    ],
)
def test_the_time_is_known_in_several_ways(gps: dict[int, Any], exif: dict[int, Any]) -> None:
    sun = sun_by_tags(gps, exif)
    assert sun is not None
    assert (sun.right_deg, sun.above_deg) == pytest.approx((90.0, 39.89), abs=0.05)


@pytest.mark.parametrize(
    ("gps", "exif"),
    [
        (without(7, 29), TAKEN),  # a clock in no time zone
        (GPS | {7: (12.0, 30.0, 30.0)}, TAKEN),  # local time for UTC, as an iPhone 4 wrote it
        (GPS | {7: (9.0, 30.0, 30.0)}, TAKEN),  # of an old fix
        (GPS | {7: (float("nan"), 0.0, 0.0)}, TAKEN),
        (GPS | {7: (25.0, 0.0, 0.0)}, {}),
        (without(29), {}),
        (without(2), TAKEN),
        (GPS | {2: (0.0, 0.0, 0.0), 4: (0.0, 0.0, 0.0)}, TAKEN),
        (GPS | {2: (139.0, 0.0, 0.0)}, TAKEN),
        ({}, {}),
    ],
)
def test_what_is_not_sure_is_not_taken(gps: dict[int, Any], exif: dict[int, Any]) -> None:
    assert sun_by_tags(gps, exif) is None


def test_a_file_tells_the_sun(tmp_path: Path) -> None:
    told = sun_of_photograph(write_sunny(tmp_path / "photo.jpg", GPS, TAKEN))
    assert told is not None
    assert (told.right_deg, told.above_deg) == pytest.approx((90.0, 39.89), abs=0.05)
    assert sun_of_photograph(write_sunny(tmp_path / "bare.jpg", {}, {})) is None
    assert sun_of_photograph(write_sunny(tmp_path / "odd.jpg", GPS | {2: (39.0, 44.0), 29: "soon"}, TAKEN)) is None
    (tmp_path / "none.jpg").write_bytes(b"\xff\xd8\xff")
    assert sun_of_photograph(tmp_path / "none.jpg") is None

"""Focus distances: vendors' tags and sentinels, thin lens and hiatus, intervals."""

import math

import pytest

from capture.photos.focus_metadata import FocusReading, read_focus
from mrbokeh.optics.lens import Lens, lens_distance_m


@pytest.mark.parametrize(
    ("tags", "expected_m"),
    [
        ({"Exif.Photo.SubjectDistance": "0/1"}, None),
        ({"Exif.Photo.SubjectDistance": "0/0"}, None),
        ({"Exif.Photo.SubjectDistance": "5/0"}, None),
        ({"Exif.Photo.SubjectDistance": "4294967295/1"}, math.inf),
        ({"Exif.Photo.SubjectDistance": "4294967295/100"}, math.inf),
        ({"Exif.Photo.SubjectDistance": "850/1000"}, 0.85),
        ({"Exif.CanonFi.FocusDistanceUpper": "0", "Exif.CanonFi.FocusDistanceLower": "0"}, None),
        ({"Exif.CanonFi.FocusDistanceUpper": "65535", "Exif.CanonFi.FocusDistanceLower": "65535"}, math.inf),
        # Between 4 m and infinity the middle in dioptres is at 8 m.
        ({"Exif.CanonFi.FocusDistanceUpper": "65535", "Exif.CanonFi.FocusDistanceLower": "400"}, 8.0),
        ({"Exif.CanonFi.FocusDistanceUpper": "400", "Exif.CanonFi.FocusDistanceLower": "0"}, 4.0),
        ({"Exif.CanonFi.FocusDistanceUpper": "65535", "Exif.CanonFi.FocusDistanceLower": "0"}, math.inf),
        # exiv2 takes these numbers for signed ones.
        ({"Exif.CanonFi.FocusDistanceUpper": "-1", "Exif.CanonFi.FocusDistanceLower": "-1"}, math.inf),
        ({"Exif.CanonFi.FocusDistanceUpper": "-25536", "Exif.CanonFi.FocusDistanceLower": "-25536"}, 400.0),
        ({"Exif.CanonSi.SubjectDistance": "0"}, None),
        ({"Exif.CanonSi.SubjectDistance": "65535"}, math.inf),
        ({"Exif.CanonSi.SubjectDistance": "-1"}, math.inf),
        ({"Exif.CanonSi.SubjectDistance": "150", "Exif.Image.Model": "Canon EOS 20D"}, 1.5),
        # EXIF goes before the maker's number, of which models differ in the unit.
        ({"Exif.CanonSi.SubjectDistance": "1503", "Exif.Photo.SubjectDistance": "1503/1000"}, 1.503),
        ({"Exif.NikonLd3.FocusDistance": "80"}, 1.0),
        ({"Exif.NikonLd3.FocusDistance": "0"}, None),
        ({"Exif.NikonLd3.FocusDistance": "4294967295"}, None),
        # Nikon Z: 8 more bits, 80 * 256 is 1 m, an octave of distance 12 * 256; 0 and all ones are unknown.
        ({"Exif.NikonLd4.FocusDistance2": "20480"}, 1.0),
        ({"Exif.NikonLd4.FocusDistance2": "17408"}, 0.5),
        ({"Exif.NikonLd4.FocusDistance2": "0"}, None),
        ({"Exif.NikonLd4.FocusDistance2": "65535"}, None),
        # An F lens on an adapter leaves the fine field empty.
        ({"Exif.NikonLd4.FocusDistance2": "0", "Exif.NikonLd4.FocusDistance": "80"}, 1.0),
        ({"Exif.NikonLd4.FocusDistance": "255"}, None),
        # Olympus counts mm in the numerator, whether the denominator is 1 or 10.
        ({"Exif.OlympusFi.FocusDistance": "1250/1"}, 1.25),
        ({"Exif.OlympusFi.FocusDistance": "1250/10"}, 1.25),
        ({"Exif.OlympusFi.FocusDistance": "4294967295/1"}, math.inf),
        ({"Exif.OlympusFi.FocusDistance": "0/1"}, None),
        ({"Xmp.aux.ApproximateFocusDistance": "4294967295/1"}, math.inf),
        ({}, None),
    ],
)
def test_focus_tags_and_their_sentinels(tags: dict[str, str], expected_m: float | None) -> None:
    reading = read_focus(tags)
    assert (None if reading is None else reading.distance_m) == (None if expected_m is None else pytest.approx(expected_m, rel=1e-9))
    if reading is not None:
        assert reading.nearest_m <= reading.distance_m <= reading.farthest_m
        assert reading.is_sentinel == math.isinf(reading.distance_m), "no tag states infinity but by a sentinel"


@pytest.mark.parametrize("focus_m", [0.1, 0.3, 1.0, 30.0, math.inf])
@pytest.mark.parametrize("focal_length_mm", [7.0, 35.0, 49.9])
def test_distance_from_the_lens_solves_the_thin_lens(focus_m: float, focal_length_mm: float) -> None:
    """Film plane distance = focus distance + image distance of the thin lens; the way back must find the former (up to 1:1)."""
    lens = Lens(focal_length_mm, 2.0, focus_m, 36.0)
    film_plane_m = focus_m + lens.image_distance_mm / 1000.0
    assert lens_distance_m(film_plane_m, focal_length_mm) == pytest.approx(focus_m, rel=1e-9)


@pytest.mark.parametrize("hiatus_mm", [-8.0, 0.0, 12.0])
def test_hiatus_lies_between_lens_and_film(hiatus_mm: float) -> None:
    """D = d_f + hiatus + d_s: a telephoto lens may have its principal planes the other way round."""
    lens = Lens(35.0, 2.0, 0.4, 36.0)
    film_plane_m = 0.4 + (hiatus_mm + lens.image_distance_mm) / 1000.0
    assert lens_distance_m(film_plane_m, 35.0, hiatus_mm) == pytest.approx(0.4, rel=1e-9)
    assert lens_distance_m(0.14 + 0.9 * hiatus_mm / 1000.0, 35.0, max(hiatus_mm, 1.0)) is None, "4 f + hiatus is the least"


def test_intervals_are_counted_from_the_lens_too() -> None:
    """Nikon's code 66 is 0.4467 m, 0.4340 to 0.4597 from the film plane; with 28 mm and 1:1 as the end of what a lens reaches."""
    focus = read_focus({"Exif.NikonLd3.FocusDistance": "66"})
    interval_m = focus.lens_interval_m(28.0, 5.0)
    for end_m, stated_m in zip(interval_m, (focus.nearest_m, focus.farthest_m), strict=True):
        assert end_m + (5.0 + Lens(28.0, 2.0, end_m, 36.0).image_distance_mm) / 1000.0 == pytest.approx(stated_m, rel=1e-9)
    assert interval_m[0] < (focus.lens_distance_m(28.0, 5.0) or 0.0) < interval_m[1]
    assert lens_distance_m(0.2, 50.0) == pytest.approx(0.1)
    macro = FocusReading(0.21, 0.19, 0.23, "film_plane", "test")
    assert macro.lens_interval_m(50.0) == pytest.approx((0.1, lens_distance_m(0.23, 50.0)))
    assert FocusReading(0.19, 0.18, 0.2, "film_plane", "test").lens_interval_m(50.0) is None
    assert FocusReading(0.3, 0.2, math.inf, "lens", "test").lens_interval_m(None) == (0.2, math.inf)

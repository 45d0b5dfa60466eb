"""Focus distances: vendors' tags, thin lens and hiatus, intervals; and sentinels of infinity, by which nothing is measured."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture.merging.registration.registration_file import breathing_of
from capture.photos.focus_metadata import UINT32_MAX, FocusReading, at_infinity, rational, read_focus
from capture.photos.photo_metadata import PhotoMetadata
from capture.photos.sidecar import StatedFocus
from capture.report.findings import focus_spacing
from capture.scale.focus import FocusSample, focus_scale, sharpness_peaks, stated_sigma_dioptre
from capture.scale.focus_calibration import FOCUS_SIGMA_DIOPTRE, FocusFit, StackFocus, focus_start, lens_calibrations
from capture.stacks.ingest import ingest
from capture.stacks.slice_files import bounded_focus_records, stated_by_sentinel
from mrbokeh.optics.lens import Lens, lens_distance_m
from mrbokeh.stacks.focal_stack import FocalStack, Slice, read_focal_stack
from tests.support.apple_note import apple_note
from tests.support.made_photographs import LENS, make_shoot, only_stack, sources


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
        # A tenth of all ones, and HP's nines, stand for infinity; the models before the G3 count mm, as a G2 that also says 7416/1000 m.
        ({"Exif.CanonSi.SubjectDistance": "6553"}, math.inf),
        ({"Exif.Photo.SubjectDistance": "9999/100"}, math.inf),
        ({"Exif.CanonSi.SubjectDistance": "7416", "Exif.Canon.ModelID": "17825792"}, 7.416),
        # f/5000 as the widest aperture: the maker note was moved, and its bytes mean nothing.
        ({"Exif.CanonSi.SubjectDistance": "384", "Exif.CanonCs.MaxAperture": "21848"}, None),
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


METRES_PER_UNIT = 0.2
# Even steps of 0.14 dioptres from 1 m on; the last slice is focused at 12 m, and its camera states infinity.
TRUE_DIOPTRES = np.append(np.linspace(1.0, 0.16, 7), 1.0 / 12.0)
STATED_DIOPTRES = np.append(TRUE_DIOPTRES[:-1], 0.0)
BY_SENTINEL = {"focus": {"sentinel": True, "lens_interval_dioptre": [0.0, 0.16]}}
EXACT = {"focus": {"sentinel": False, "lens_interval_dioptre": [0.0, 0.0]}}


def stack_of(last: dict[str, object], lens: Lens | None = None) -> FocalStack:
    slices = [Slice(f"{i}.exr", 1.0 / dioptre if dioptre else math.inf) for i, dioptre in enumerate(STATED_DIOPTRES)]
    return FocalStack(Path("stack"), (*slices[:-1], replace(slices[-1], metadata=last)), lens)


def sample_of(stack: FocalStack) -> FocusSample:
    """Points from 1 to 10 m, whose log energy is a parabola about their true dioptre."""
    rng = np.random.default_rng(4)
    dioptre = rng.uniform(0.1, 1.0, 800)
    peaks = sharpness_peaks(np.exp(8.0 - 30.0 * (TRUE_DIOPTRES[:, None] - dioptre) ** 2 + rng.normal(0, 0.05, (8, 800))))
    depth = 1.0 / dioptre[peaks.points] / METRES_PER_UNIT
    return FocusSample("view_0", peaks, np.zeros((len(depth), 2)), depth, STATED_DIOPTRES, stated_sigma_dioptre(stack))


def test_a_sentinel_does_not_pull_the_scale() -> None:
    """Believed, as an explicit `inf` is, the same numbers pull it by a percent: the points before the last slice peak too far away."""
    found, believed = (focus_scale([sample_of(stack_of(last))]) for last in (BY_SENTINEL, EXACT))
    assert found.metres_per_unit == pytest.approx(METRES_PER_UNIT, rel=5e-4)
    assert believed.metres_per_unit / METRES_PER_UNIT - 1.0 > 0.005
    assert found.uncertainty < 0.002


def test_its_trust_is_nil_and_that_of_an_explicit_infinity_is_whole() -> None:
    np.testing.assert_array_equal(stated_sigma_dioptre(stack_of(BY_SENTINEL)), [0.0] * 7 + [np.inf])
    np.testing.assert_array_equal(stated_sigma_dioptre(stack_of(EXACT)), np.zeros(8))
    assert not stated_by_sentinel(stack_of({})).any(), "stacks of earlier versions do not say"


def test_a_calibration_starts_from_infinity_but_hardly_trusts_it() -> None:
    stack = stack_of(BY_SENTINEL, LENS)
    start = focus_start(stack, sample_of(stack), METRES_PER_UNIT, 0.0, 960)
    np.testing.assert_allclose(start.dioptres, STATED_DIOPTRES, atol=1e-3)
    np.testing.assert_allclose(start.sigma_dioptre, [FOCUS_SIGMA_DIOPTRE] * 7 + [0.5])
    assert start.beyond == (7,)


def test_a_lens_calibration_does_not_translate_sentinels() -> None:
    """What this stack's infinity was found to be tells nothing of another's; an explicit infinity is a stated focus like others."""
    fit = FocusFit(TRUE_DIOPTRES, np.full(8, 20.0), np.full(8, 0.01), np.full(8, 9))
    for last, stated in ((BY_SENTINEL, None), (EXACT, 0.0)):
        (calibration,) = lens_calibrations({"view_0": StackFocus(stack_of(last, LENS), fit, 960)}, 0.0)
        assert calibration.rows[0].dioptre == pytest.approx(1.0 / 12.0)
        assert calibration.rows[0].stated_dioptre == stated


def test_intervals_reach_from_the_farthest_real_distance_to_infinity() -> None:
    real = FocusReading(4.0, 3.9, 4.1, "film_plane", "test")
    photos = [
        PhotoMetadata(focal_length_mm=50.0, focus=focus) for focus in (real, replace(real, distance_m=1.0), at_infinity("test"), None)
    ]
    near, _, far, nothing = bounded_focus_records(photos)
    farthest_m = lens_distance_m(4.0, 50.0)
    assert near is not None and far is not None and farthest_m is not None and nothing is None
    assert (near["sentinel"], far["sentinel"], far["lens_dioptre"]) == (False, True, 0.0)
    assert far["lens_interval_dioptre"] == pytest.approx([0.0, 1.0 / farthest_m])
    assert near["lens_interval_dioptre"] == pytest.approx([1.0 / (lens_distance_m(each, 50.0) or 0.0) for each in (4.1, 3.9)])
    alone = bounded_focus_records(photos[2:3])[0]
    assert alone is not None and alone["lens_interval_dioptre"] is None, "nothing bounds it"


def test_an_infinity_that_somebody_states_is_known() -> None:
    focus = StatedFocus.checked([math.inf], "lens.toml").reading("lens", "lens.toml")
    record = bounded_focus_records([PhotoMetadata(focus=focus)])[0]
    assert (record["sentinel"], record["lens_interval_dioptre"]) == (False, [0.0, 0.0])


def test_ingest_says_so_and_a_sidecar_overrides_it(tmp_path: Path) -> None:
    """IMG_11 of the shoot states 0xFFFFFFFF, the farthest of the others 1.4 m; the slices of the first run are kept."""
    shoot = make_shoot(tmp_path / "shoot")
    report = ingest([shoot], tmp_path / "scene")
    stack = only_stack(report)
    assert stack.focus_distances_m[-1] == math.inf and stack.is_metric
    assert stated_by_sentinel(read_focal_stack(stack.folder)).tolist() == [False] * 4 + [True]
    assert stack.slices[-1].metadata["focus"]["lens_interval_dioptre"] == pytest.approx([0.0, 1.0 / 1.4], rel=1e-4)
    (remark,) = (each for each in report.stacks[0].remarks if "sentinel" in each)
    assert remark.startswith("IMG_11.dng states its focus by a sentinel (Exif.Photo.SubjectDistance = 4294967295/1)")
    assert "focus.csv overrides it" in remark
    for told, distance_m in (("inf", math.inf), ("12", 12.0)):
        (shoot / "focus.csv").write_text(f"file,focus_distance_m\nIMG_11.dng,{told}\n")
        report = ingest([shoot], tmp_path / "scene")
        stack = only_stack(report)
        assert report.stacks[0].kept == 5 and sources(stack)[-1] == "IMG_11.dng"
        assert stack.focus_distances_m[-1] == pytest.approx(distance_m)
        assert not stated_by_sentinel(stack).any() and not any("sentinel" in each for each in report.stacks[0].remarks)


def test_pictures_tell_the_breathing_of_a_sentinel() -> None:
    """85 mm at 1, 1.5, 2.5 and 5 m: the last, called infinity, is 1.7 % larger than a lens at infinity would show it."""
    image_mm = [Lens(85.0, 2.0, each, 36.0).image_distance_mm for each in (1.0, 1.5, 2.5, 5.0)]
    stated = [*image_mm[:3], 85.0]
    measured = {(i, j): image_mm[i] / image_mm[j] for i in range(4) for j in (i + 1, i + 3) if j < 4}
    told, believed = breathing_of(4, measured, stated, (3,)), breathing_of(4, measured, stated)
    assert told.source == believed.source == "lens"
    assert told.scale(0, 3) == pytest.approx(image_mm[0] / image_mm[3], rel=1e-9) and told.allows((2, 3), measured[2, 3])
    assert believed.scale(0, 3) > 1.015 * told.scale(0, 3) and not believed.allows((2, 3), measured[2, 3])


def test_what_pictures_tell_of_a_sentinel_stays_within_its_bounds() -> None:
    stated = [90.0, 88.0, 86.0, 85.0]
    beyond = breathing_of(4, {(0, 1): 90 / 88, (1, 2): 88 / 86, (2, 3): 86 / 70}, stated, (3,))
    nearer = breathing_of(4, {(0, 1): 90 / 88, (1, 2): 88 / 86, (2, 3): 86 / 95}, stated, (3,))
    assert beyond.scale(0, 3) == pytest.approx(90 / 85) and nearer.scale(0, 3) == pytest.approx(90 / 86)
    assert breathing_of(4, {}, stated, (3,)).scale(0, 3) == pytest.approx(90 / 85), "nothing measured"


def test_steps_to_a_sentinel_are_not_judged() -> None:
    """1 to 0.4 dioptres in even steps, then two photographs at "infinity", which would be a gap and one taken twice."""
    distances_m = [1.0, 1.25, 1.0 / 0.6, 2.5, math.inf, math.inf]
    believed, told = focus_spacing(distances_m), focus_spacing(distances_m, np.array([True] * 4 + [False] * 2))
    assert (believed.gaps, believed.doubled) == ((3,), (5,))
    assert told.is_even and told.usual_step == pytest.approx(0.2) and told.largest_step == pytest.approx(1.0)
    assert len(told.focus_dioptres) == 6, "charts show all slices"
    assert focus_spacing(distances_m, np.zeros(6, bool)).is_even


def test_the_range_of_an_iphone_is_a_focus() -> None:
    """Between 0.8 and 1.6 m; its middle is that of the dioptres. Other notes and damaged ones tell none."""
    note = " ".join(map(str, apple_note({12: [(16, 10), (8, 10)]})))
    found = read_focus({"Exif.Photo.MakerNote": note})
    assert found is not None and (found.nearest_m, found.farthest_m, found.origin) == (0.8, 1.6, "lens")
    assert found.distance_m == pytest.approx(1.0667, rel=1e-3) and "FocusDistanceRange" in found.source
    assert read_focus({"Exif.Photo.MakerNote": "78 105 107"}) is None and read_focus({"Exif.Photo.MakerNote": note[:60]}) is None
    assert read_focus({"Exif.Photo.MakerNote": "65 112 112 108 101 x"}) is None


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("17/10", (17, 10)),
        ("17", (17, 1)),
        ("2.05", (205, 100)),
        ("1e-05", (1, 10**5)),
        ("2.8 x", (28, 10)),
        ("0/0", (0, 0)),
        ("4294967295.0", (UINT32_MAX, 1)),
    ]
    + [(text, None) for text in ("", "x", "1/x", "nan", "inf", "1e999", "1e-999999999", None)],
)
def test_numbers_of_tags_are_fractions_also_where_a_writer_stored_floating_point(text: str | None, parts: tuple[int, int] | None) -> None:
    assert rational(text) == parts

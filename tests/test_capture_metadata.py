"""Shooting data: known values of real files, vendors' sentinels, thin-lens conversion, sensor width, and lens.toml."""

import json
import math
import stat
from pathlib import Path

import pytest

from capture.photos.exiftool_metadata import metadata_from_exiftool, read_with_exiftool
from capture.photos.focus_metadata import lens_distance_m, read_focus
from capture.photos.metadata import metadata_from_tags, read_metadata
from capture.photos.photo_metadata import PhotoMetadata
from capture.photos.sensor_metadata import SensorReading, read_sensor
from capture.photos.sidecar import Sidecar, find_sidecar, read_sidecar
from mrbokeh.errors import InputError
from mrbokeh.lens import Lens

# file: (focal length mm, f-number, exposure s, film plane distance m, its interval or None)
STATED = {
    # Nikon lens data 66: 0.01 * 10^(66 / 40) = 0.4467 m, half a step either way.
    "exif/nikon_d60_0.45m.jpg": (28.0, 4.5, 1 / 125, 0.4467, (0.4340, 0.4597)),
    "exif/nikon_d70_0.45m.jpg": (70.0, 4.5, 1 / 60, 0.4467, (0.4340, 0.4597)),
    # Canon file info: 446 to 484 cm, in the middle of the dioptres.
    "exif/canon_450d_4.6m.jpg": (100.0, 4.5, 1 / 1000, 2 / (1 / 4.46 + 1 / 4.84), (4.46, 4.84)),
    # Canon shot info 688, 324 and 188. As cm (exiftool's reading) the chart of 0.28 m that fills 0304 at 7 mm would stand
    # 0.3 m away and be focused at 6.9 m; as mm the S40's box, 0.2 m wide and filling the frame, is focused where it stands.
    "raw/canon_g2_0304.crw": (7.0, 3.914, 1 / 52, 0.688, None),
    "raw/canon_g2_0313.crw": (7.0, 4.0, 1 / 53, 0.324, None),
    "raw/canon_s40_0117.crw": (7.094, 2.922, 1 / 4, 0.188, None),
    "raw/kodak_dc120.kdc": (37.0, 4.0, 0.00364, 0.9, (0.85, 0.95)),
    # Adobe's copy of the maker note in XMP.
    "raw/canon_6d_lossy_linear.dng": (65.0, 5.6, 1 / 60, 1.48, None),
}


@pytest.mark.parametrize("name", STATED)
def test_real_files_state_known_values(shared_data: Path, name: str) -> None:
    focal_length_mm, f_number, exposure_time_s, distance_m, interval_m = STATED[name]
    metadata = read_metadata(shared_data / name)
    assert metadata.focal_length_mm == pytest.approx(focal_length_mm, rel=1e-3)
    assert metadata.f_number == pytest.approx(f_number, rel=1e-3)
    assert metadata.exposure_time_s == pytest.approx(exposure_time_s, rel=1e-6)
    assert metadata.focus is not None
    assert metadata.focus.distance_m == pytest.approx(distance_m, rel=1e-4)
    assert metadata.focus.origin == "film_plane"
    if interval_m is not None:
        assert (metadata.focus.nearest_m, metadata.focus.farthest_m) == pytest.approx(interval_m, rel=2e-4)


@pytest.mark.parametrize(
    ("name", "size_px", "width_mm", "tolerance"),
    [
        # Sensor widths from the makers' data sheets; 2 % is what stated pitches are good for.
        ("exif/canon_450d_4.6m.jpg", (4272, 2848), 22.2, 0.02),
        ("exif/nikon_d70_0.45m.jpg", (3008, 2000), 23.7, 0.02),
        # This JPEG was cut from 3872 columns of the D60's 23.6 mm.
        ("exif/nikon_d60_0.45m.jpg", (3064, 2379), 23.6 * 3064 / 3872, 0.02),
        # A DNG reduced from the 6D's half-size RAW of 2736 columns, which show all of 35.8 mm.
        ("raw/canon_6d_lossy_linear.dng", (1224, 816), 35.8, 0.02),
        # 1/1.8 inch type, 7.18 mm for 2272 columns, in a RAW of 2312.
        ("raw/canon_g2_0304.crw", (2312, 1720), 7.18 * 2312 / 2272, 0.02),
    ],
)
def test_sensor_width_of_real_cameras(shared_data: Path, name: str, size_px: tuple[int, int], width_mm: float, tolerance: float) -> None:
    sensor = read_metadata(shared_data / name).sensor
    assert sensor is not None
    assert sensor.width_mm(*size_px) == pytest.approx(width_mm, rel=tolerance)


def test_time_and_models_of_a_real_file(shared_data: Path) -> None:
    metadata = read_metadata(shared_data / "exif" / "canon_450d_4.6m.jpg")
    assert metadata.taken_at is not None
    assert metadata.taken_at.isoformat() == "2008-04-15T13:11:23.030000"
    assert (metadata.camera_model, metadata.lens_model, metadata.iso) == ("Canon EOS 450D", "EF70-200mm f/2.8L IS USM", 100.0)


def test_files_without_metadata_tell_nothing(tmp_path: Path) -> None:
    (tmp_path / "text.jpg").write_text("no photograph")
    assert read_metadata(tmp_path / "text.jpg") == PhotoMetadata()


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
        ({"Exif.CanonSi.SubjectDistance": "0"}, None),
        ({"Exif.CanonSi.SubjectDistance": "65535"}, math.inf),
        ({"Exif.CanonSi.SubjectDistance": "150", "Exif.Image.Model": "Canon EOS 20D"}, 1.5),
        # EXIF goes before the maker's number, of which models differ in the unit.
        ({"Exif.CanonSi.SubjectDistance": "1503", "Exif.Photo.SubjectDistance": "1503/1000"}, 1.503),
        ({"Exif.NikonLd3.FocusDistance": "80"}, 1.0),
        ({"Exif.NikonLd3.FocusDistance": "0"}, None),
        ({"Exif.NikonLd3.FocusDistance": "4294967295"}, None),
        # Nikon Z: 8 more bits, 80 * 256 is 1 m.
        ({"Exif.NikonLd4.FocusDistance2": "20480"}, 1.0),
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


@pytest.mark.parametrize("focus_m", [0.1, 0.3, 1.0, 30.0, math.inf])
@pytest.mark.parametrize("focal_length_mm", [7.0, 35.0, 49.9])
def test_distance_from_the_lens_solves_the_thin_lens(focus_m: float, focal_length_mm: float) -> None:
    """Film plane distance = focus distance + image distance of the thin lens; the way back must find the former (up to 1:1)."""
    lens = Lens(focal_length_mm, 2.0, focus_m, 36.0)
    film_plane_m = focus_m + lens.image_distance_mm / 1000.0
    assert lens_distance_m(film_plane_m, focal_length_mm) == pytest.approx(focus_m, rel=1e-9)


def test_nearer_than_four_focal_lengths_no_thin_lens_focuses() -> None:
    assert lens_distance_m(0.19, 50.0) is None
    assert lens_distance_m(0.2, 50.0) == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("unit", "resolution"),
    [("2", "25400/10"), ("3", "1000/1"), ("4", "100/1"), ("5", "1/10")],  # 100 px/mm in inches, cm, mm, micrometres
)
def test_focal_plane_units(unit: str, resolution: str) -> None:
    tags = {"Exif.Photo.FocalPlaneXResolution": resolution, "Exif.Photo.FocalPlaneResolutionUnit": unit}
    sensor = read_sensor(tags, None, (2400, 1600))
    assert sensor is not None
    assert sensor.width_mm(2400, 1600) == pytest.approx(24.0)


def test_film_equivalent_compares_diagonals() -> None:
    """50 mm that sees like 75 mm has a diagonal of 43.27 / 1.5 mm; at 3:2 that is a width of 24 mm."""
    sensor = read_sensor({"Exif.Photo.FocalLengthIn35mmFilm": "75"}, 50.0, (6000, 4000))
    assert sensor is not None
    assert sensor.width_mm(6000, 4000) == pytest.approx(24.0)
    assert read_sensor({"Exif.Photo.FocalLengthIn35mmFilm": "0"}, 50.0, (6000, 4000)) is None


def test_sensor_width_of_resized_cut_and_turned_pictures() -> None:
    sensor = SensorReading(0.006, (6000, 4000), "test")
    assert sensor.width_mm(6000, 4000) == pytest.approx(36.0)
    assert sensor.width_mm(6020, 4012) == pytest.approx(36.12)  # RAW margins
    assert sensor.width_mm(1500, 1000) == pytest.approx(36.0)  # resized
    assert sensor.width_mm(3000, 3000) == pytest.approx(18.0)  # cut
    assert sensor.width_mm(4000, 6000) == pytest.approx(24.0)  # turned
    assert sensor.width_mm(1000, 1500) == pytest.approx(24.0)  # turned and resized


def test_nonsense_is_unknown() -> None:
    metadata = metadata_from_tags(
        {"Exif.Photo.FNumber": "0/10", "Exif.Photo.FocalLength": "x", "Exif.Photo.DateTimeOriginal": "0000:00:00 00:00:00"}
    )
    assert metadata == PhotoMetadata()
    assert read_sensor({"Exif.Photo.FocalPlaneXResolution": "1/1"}, None, (6000, 4000)) is None  # 152 m wide


EXIFTOOL_ANSWER = {  # what exiftool 12.57 -n -j says of exif/nikon_d70_0.45m.jpg
    "FocalLength": 70,
    "FNumber": 4.5,
    "ExposureTime": 0.01666666667,
    "DateTimeOriginal": "2004:11:21 21:29:12",
    "Make": "NIKON CORPORATION",
    "Model": "NIKON D70",
    "Orientation": 1,
    "ImageWidth": 3008,
    "ImageHeight": 2000,
    "FocusDistance": 0.446683592150963,
}


def test_exiftool_fills_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in on PATH that prints a recorded answer of the real program."""
    program = tmp_path / "exiftool"
    program.write_text(f"#!/bin/sh\ncat <<'END'\n{json.dumps([EXIFTOOL_ANSWER])}\nEND\n")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    (tmp_path / "unreadable.jpg").write_text("")
    metadata = read_metadata(tmp_path / "unreadable.jpg")
    assert (metadata.focal_length_mm, metadata.f_number, metadata.camera_model) == (70.0, 4.5, "NIKON D70")
    assert metadata.focus is not None
    assert metadata.focus.distance_m == pytest.approx(0.4467, rel=1e-4)
    program.write_text("#!/bin/sh\nexit 1\n")
    assert read_with_exiftool(tmp_path / "unreadable.jpg") == PhotoMetadata()


def test_exiftool_sentinels() -> None:
    def distance_m(**found: object) -> float | None:
        focus = metadata_from_exiftool(dict(found)).focus
        return None if focus is None else focus.distance_m

    assert distance_m(FocusDistance=0, Make="OLYMPUS IMAGING CORP.") == math.inf
    assert distance_m(FocusDistance=0, Make="NIKON") is None
    assert distance_m(SubjectDistance=4294967295) == math.inf
    assert distance_m(FocusDistanceLower=4.46, FocusDistanceUpper=4.84) == pytest.approx(4.6422, rel=1e-4)
    assert distance_m(FocusDistanceLower=4, FocusDistanceUpper=655.35) == pytest.approx(8.0)
    # In CRW files exiftool reads mm as cm and finds no lower end: no word at all is better.
    assert distance_m(FocusDistanceLower=0, FocusDistanceUpper=6.88) is None


def write_sidecar(folder: Path, text: str) -> Path:
    path = folder / "lens.toml"
    path.write_text(text)
    return path


def test_sidecar_overrides_and_fills(tmp_path: Path) -> None:
    path = write_sidecar(
        tmp_path,
        'focal_length_mm = 35\nf_number = 1.8\nsensor_width_mm = 23.5\nblades = 7\nfocus_distances_m = [0.5, inf]\nfocus_origin = "lens"',
    )
    sidecar = read_sidecar(path)
    first, second = sidecar.applied(["a.jpg", "b.jpg"], [PhotoMetadata(f_number=4.0, iso=100.0), PhotoMetadata()])
    assert (first.focal_length_mm, first.f_number, first.iso) == (35.0, 1.8, 100.0)
    assert (first.focus_distance_m, second.focus_distance_m) == (0.5, math.inf)
    assert len(sidecar.aperture.outlines[0]) == 7


def test_sidecar_table_and_film_plane(tmp_path: Path) -> None:
    text = 'focal_length_mm = 50\nfocus_origin = "film_plane"\n[focus_distances_m]\n"b.jpg" = 0.2\n"typo.jpg" = 1'
    sidecar = read_sidecar(write_sidecar(tmp_path, text))
    first, second = sidecar.applied(["a.jpg", "b.jpg"], [PhotoMetadata(), PhotoMetadata()])
    assert first.focus_distance_m is None
    # 50 mm at 1:1: lens and sensor 0.1 m apart, 0.1 m to the subject.
    assert second.focus_distance_m == pytest.approx(0.1)
    assert sidecar.unmatched_names(["a.jpg", "b.jpg"]) == ["typo.jpg"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("focal_lenght_mm = 35\naperture = 2", "unknown keys aperture, focal_lenght_mm. Known are focal_length_mm, f_number"),
        ("f_number = 0", "f_number must be positive"),
        ("f_number = inf", "f_number must be positive"),
        ('f_number = "2.8"', "f_number must be a number"),
        ("blades = 2", "blades must be a whole number of at least 3"),
        ('focus_origin = "tripod"', "focus_origin must be one of lens, film_plane"),
        ("focus_distances_m = 1.0", "focus_distances_m must be a list of metres or a table"),
        ("focus_distances_m = [1.0, -2.0]", "focus_distances_m must be positive"),
        ("f_number = ", "not valid TOML"),
    ],
)
def test_sidecar_mistakes_are_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_sidecar(write_sidecar(tmp_path, text))


def test_sidecar_with_too_few_distances(tmp_path: Path) -> None:
    sidecar = read_sidecar(write_sidecar(tmp_path, "focus_distances_m = [1.0, 2.0]"))
    with pytest.raises(InputError, match="lists 2 distances, but there are 3 photographs"):
        sidecar.applied(["a", "b", "c"], [PhotoMetadata()] * 3)


def test_nearest_sidecar_upwards_is_found(tmp_path: Path) -> None:
    inner = tmp_path / "top" / "view_0"
    inner.mkdir(parents=True)
    outside = write_sidecar(tmp_path, "f_number = 1")
    assert find_sidecar(inner, tmp_path / "top") is None, f"{outside} lies above the folder that was named"
    top = write_sidecar(tmp_path / "top", "f_number = 2")
    assert find_sidecar(inner, tmp_path / "top") == top
    own = write_sidecar(inner, "f_number = 4")
    assert find_sidecar(inner, tmp_path / "top") == own
    assert Sidecar().applied(["a"], [PhotoMetadata()]) == [PhotoMetadata()]

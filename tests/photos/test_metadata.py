"""Shooting data: known values of real files through pyexiv2, exiftool and exifread; and the width of the sensor."""

import json
import math
import shutil
import stat
import struct
from pathlib import Path

import pytest

import capture.photos.metadata
from capture.photos.focus_metadata import FocusReading
from capture.photos.metadata import (
    metadata_from_exiftool,
    metadata_from_tags,
    read_metadata,
    read_tags,
    read_tags_with_exifread,
    read_with_exiftool,
)
from capture.photos.photo_metadata import PhotoMetadata, SensorReading, read_sensor, sensor_of_model
from tests.support.made_photographs import make_raw_photo, scene_rgb

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
    assert sensor.width_mm(*size_px) == pytest.approx(width_mm, rel=tolerance)


@pytest.mark.parametrize(
    ("upper_lower_cm", "distance_m"),
    # Its other tag, CanonSi.SubjectDistance, says 0, which is unknown.
    [((65535, 65535), math.inf), ((65535, 0), math.inf), ((0, 0), None), ((65535, 400), 8.0)],
)
def test_sentinels_in_a_real_maker_note(
    shared_data: Path, tmp_path: Path, upper_lower_cm: tuple[int, int], distance_m: float | None
) -> None:
    """Infinity by 655.35 m is a sentinel unless a nearest distance comes with it."""
    data, stated = (shared_data / "exif" / "canon_450d_4.6m.jpg").read_bytes(), struct.pack("<HH", 484, 446)
    assert data.count(stated) == 1
    (tmp_path / "changed.jpg").write_bytes(data.replace(stated, struct.pack("<HH", *upper_lower_cm)))
    focus = metadata_from_tags(read_tags(tmp_path / "changed.jpg")).focus
    assert (None if focus is None else focus.distance_m) == (None if distance_m is None else pytest.approx(distance_m))
    assert focus is None or focus.is_sentinel == (distance_m == math.inf)


def test_time_and_models_of_a_real_file(shared_data: Path) -> None:
    metadata = read_metadata(shared_data / "exif" / "canon_450d_4.6m.jpg")
    assert metadata.taken_at.isoformat() == "2008-04-15T13:11:23.030000"
    assert (metadata.camera_model, metadata.lens_model, metadata.iso) == ("Canon EOS 450D", "EF70-200mm f/2.8L IS USM", 100.0)


def test_nonsense_is_unknown(tmp_path: Path) -> None:
    (tmp_path / "text.jpg").write_text("no photograph")
    assert read_metadata(tmp_path / "text.jpg") == PhotoMetadata()
    tags = {"Exif.Photo.FNumber": "0/10", "Exif.Photo.FocalLength": "x", "Exif.Photo.DateTimeOriginal": "0000:00:00 00:00:00"}
    assert metadata_from_tags(tags) == PhotoMetadata()


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
    answers = [EXIFTOOL_ANSWER | {"SourceFile": str(tmp_path / "unreadable.jpg")}]
    program.write_text(f"#!/bin/sh\ncat <<'END'\n{json.dumps(answers)}\nEND\n")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    (tmp_path / "unreadable.jpg").write_text("")
    metadata = read_metadata(tmp_path / "unreadable.jpg")
    assert (metadata.focal_length_mm, metadata.f_number, metadata.camera_model) == (70.0, 4.5, "NIKON D70")
    assert metadata.focus.distance_m == pytest.approx(0.4467, rel=1e-4)
    program.write_text("#!/bin/sh\nexit 1\n")
    assert read_with_exiftool([tmp_path / "unreadable.jpg"] * 2) == [PhotoMetadata()] * 2


@pytest.mark.skipif(shutil.which("exiftool") is None, reason="exiftool is not on PATH")
def test_the_real_exiftool_agrees_with_exiv2(shared_data: Path, tmp_path: Path) -> None:
    """Where both decode the same tag; CRW's distances it reads as cm with no lower end, and they stay unknown."""
    names = [name for name in STATED if not name.endswith(".crw")]
    (tmp_path / "text.jpg").write_text("no photograph")
    *found, unreadable = read_with_exiftool([*(shared_data / name for name in names), tmp_path / "text.jpg"])
    assert unreadable == PhotoMetadata()
    for name, metadata in zip(names, found, strict=True):
        focal_length_mm, f_number, exposure_time_s, distance_m, _ = STATED[name]
        stated = (metadata.focal_length_mm, metadata.f_number, metadata.exposure_time_s)
        assert stated == pytest.approx((focal_length_mm, f_number, exposure_time_s), rel=1e-3)
        assert metadata.focus.distance_m == pytest.approx(distance_m, rel=1e-4)
    assert read_with_exiftool([shared_data / "raw" / "canon_g2_0304.crw"])[0].focus is None


def test_exiftool_has_decoded_nikons_code() -> None:
    """0.446684 m is code 66 of an F lens, half a step of 10^(1/40) either way; Z lenses have 256 times finer steps."""
    focus = metadata_from_exiftool(EXIFTOOL_ANSWER).focus
    assert (focus.nearest_m, focus.farthest_m) == pytest.approx((0.4340, 0.4597), rel=2e-4)
    z_lens = metadata_from_exiftool(EXIFTOOL_ANSWER | {"FocusDistance": 0.4481, "LensPositionAbsolute": 41250})
    assert z_lens.lens_position == 41250
    assert z_lens.focus.nearest_m == z_lens.focus.farthest_m == 0.4481


def test_exifread_reads_what_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where exiv2 and exiftool say nothing; the same DNG through exiv2 must say the same."""
    path = make_raw_photo(tmp_path / "0.dng", scene_rgb(24, 32), 0.8)
    by_exiv2 = read_metadata(path)
    monkeypatch.setattr(capture.photos.metadata, "read_tags", lambda _: {})
    monkeypatch.setenv("PATH", str(tmp_path))
    by_exifread = read_metadata(path)
    for name in ("focal_length_mm", "f_number", "exposure_time_s", "iso", "taken_at", "camera_model", "lens_model", "orientation"):
        assert getattr(by_exifread, name) == getattr(by_exiv2, name), name
    assert by_exifread.focus_distance_m == pytest.approx(0.8, rel=1e-4)
    # It reduces fractions, and with them the digits that the interval comes from: it can only be wider.
    assert by_exifread.focus_interval_m[0] <= by_exiv2.focus_interval_m[0] < by_exiv2.focus_interval_m[1] <= by_exifread.focus_interval_m[1]
    assert by_exifread.sensor.pitch_mm == pytest.approx(23.5 / 32, rel=1e-6)


@pytest.mark.parametrize("name", [name for name in STATED if not name.endswith(".crw")])
def test_exifread_agrees_on_real_files(shared_data: Path, name: str) -> None:
    """It knows no CRW; exposure and focal length of the others are in plain EXIF (or TIFF) tags."""
    focal_length_mm, f_number, exposure_time_s, _, _ = STATED[name]
    metadata = metadata_from_tags(read_tags_with_exifread(shared_data / name))
    stated = (metadata.focal_length_mm, metadata.f_number, metadata.exposure_time_s)
    assert stated == pytest.approx((focal_length_mm, f_number, exposure_time_s), rel=1e-3)


def test_exiftool_sentinels() -> None:
    def distance_m(**found: object) -> float | None:
        focus = metadata_from_exiftool(dict(found)).focus
        return None if focus is None else focus.distance_m

    assert distance_m(FocusDistance=0, Make="OLYMPUS IMAGING CORP.") == math.inf
    assert distance_m(FocusDistance=0, Make="NIKON") is None
    assert distance_m(FocusDistanceLower=4.46, FocusDistanceUpper=4.84) == pytest.approx(4.6422, rel=1e-4)
    assert distance_m(FocusDistanceLower=4, FocusDistanceUpper=655.35) == pytest.approx(8.0)
    assert distance_m(FocusDistance=1.5, LensPositionAbsolute=-3, Make="NIKON CORPORATION") == math.inf
    assert distance_m(FocusDistance=1.5, LensPositionAbsolute=5210, Make="NIKON CORPORATION") == 1.5
    lens_drive = metadata_from_exiftool({"FocusDistance": 1.5, "LensPositionAbsolute": -3, "Make": "NIKON CORPORATION"}).focus
    assert lens_drive is not None and not lens_drive.is_sentinel, "where the drive stands is measured"
    for sentinel in ({"SubjectDistance": 4294967295}, {"FocusDistanceLower": 655.35, "FocusDistanceUpper": 655.35}):
        focus = metadata_from_exiftool(sentinel).focus
        assert focus.is_sentinel and focus.distance_m == math.inf
    # In CRW files exiftool reads mm as cm and finds no lower end: no word at all is better.
    assert distance_m(FocusDistanceLower=0, FocusDistanceUpper=6.88) is None


@pytest.mark.parametrize(
    ("unit", "resolution"),
    [("2", "25400/10"), ("3", "1000/1"), ("4", "100/1"), ("5", "1/10")],  # 100 px/mm in inches, cm, mm, micrometres
)
def test_focal_plane_units(unit: str, resolution: str) -> None:
    tags = {"Exif.Photo.FocalPlaneXResolution": resolution, "Exif.Photo.FocalPlaneResolutionUnit": unit}
    sensor = read_sensor(tags, None, (2400, 1600))
    assert sensor.width_mm(2400, 1600) == pytest.approx(24.0)


def test_film_equivalent_compares_diagonals() -> None:
    """50 mm that sees like 75 mm has a diagonal of 43.27 / 1.5 mm; at 3:2 that is a width of 24 mm."""
    sensor = read_sensor({"Exif.Photo.FocalLengthIn35mmFilm": "75"}, 50.0, (6000, 4000))
    assert sensor.width_mm(6000, 4000) == pytest.approx(24.0)


@pytest.mark.parametrize(
    ("make", "model", "width_mm", "by_data_sheet_mm"),
    [
        # 43.267 mm over the crop factor 1.523 is a diagonal of 28.41 mm, 23.64 mm wide at 3:2.
        ("NIKON CORPORATION", "NIKON D3300", 23.64, 23.5),
        ("NIKON CORPORATION", "NIKON Z 6", 36.0, 35.9),
        ("SONY", "ILCE-7M3", 36.0, 35.6),
    ],
)
def test_cameras_that_do_not_tell_are_looked_up(make: str, model: str, width_mm: float, by_data_sheet_mm: float) -> None:
    tags = {"Exif.Image.Make": make, "Exif.Image.Model": model}
    sensor = read_sensor(tags, None, (6000, 4000))
    assert "lensfun" in sensor.source
    assert sensor.width_mm(6000, 4000) == pytest.approx(width_mm, rel=1e-3)
    assert sensor.width_mm(6000, 4000) == pytest.approx(by_data_sheet_mm, rel=0.012)
    agreeing = {"Exif.Photo.FocalPlaneXResolution": f"{round(25.4 * 6000 / by_data_sheet_mm)}/1"}
    assert "FocalPlaneXResolution" in read_sensor(tags | agreeing, None, (6000, 4000)).source, "the file goes before the table"


def test_unknown_sensors_are_not_guessed() -> None:
    assert read_sensor({"Exif.Photo.FocalLengthIn35mmFilm": "0"}, 50.0, (6000, 4000)) is None
    assert read_sensor({"Exif.Photo.FocalPlaneXResolution": "1/1"}, None, (6000, 4000)) is None, "152 m wide"
    assert read_sensor({"Exif.Image.Make": "mrbokeh", "Exif.Image.Model": "Simulated Bayer Camera"}, None, (6000, 4000)) is None
    assert sensor_of_model("NIKON CORPORATION", "NIKON D3300", None) is None


def test_sensor_width_of_resized_cut_and_turned_pictures() -> None:
    sensor = SensorReading(0.006, (6000, 4000), "test")
    assert sensor.width_mm(6000, 4000) == pytest.approx(36.0)
    assert sensor.width_mm(6020, 4012) == pytest.approx(36.12)  # RAW margins
    assert sensor.width_mm(1500, 1000) == pytest.approx(36.0)  # resized
    assert sensor.width_mm(3000, 3000) == pytest.approx(18.0)  # cut
    assert sensor.width_mm(4000, 6000) == pytest.approx(24.0)  # turned
    assert sensor.width_mm(1000, 1500) == pytest.approx(24.0)  # turned and resized


CANONS_G2 = {
    "Exif.Image.Make": "Canon",
    "Exif.Photo.FocalPlaneXResolution": "2272000/280",
    "Exif.Photo.FocalPlaneYResolution": "1704000/210",
    "Exif.Photo.FocalPlaneResolutionUnit": "2",
}


@pytest.mark.parametrize(
    ("tags", "stored_px", "width_mm"),
    [
        # 2272 pixels on 0.280 inch, which is 7.112 mm; upright 0.210 inch.
        ({"Exif.Photo.PixelXDimension": "2272", "Exif.Photo.PixelYDimension": "1704"}, (2272, 1704), 7.112),
        ({"Exif.Photo.PixelXDimension": "640", "Exif.Photo.PixelYDimension": "480"}, (640, 480), 7.112),
        ({"Exif.Photo.PixelXDimension": "480", "Exif.Photo.PixelYDimension": "640"}, (480, 640), 5.334),
        ({}, (640, 480), 7.112),
        # A digital zoom shows the middle of the sensor: twice the pixels are counted, on the same 0.280 inch.
        (
            {
                "Exif.Photo.FocalPlaneXResolution": "4544000/280",
                "Exif.Photo.FocalPlaneYResolution": "3408000/210",
                "Exif.Photo.PixelXDimension": "2272",
                "Exif.Photo.PixelYDimension": "1704",
                "Exif.Photo.DigitalZoomRatio": "2272/1136",
            },
            (2272, 1704),
            3.556,
        ),
        # The same without the tag for it, made smaller by a program that left the size that the camera stated.
        (
            {
                "Exif.Photo.FocalPlaneXResolution": "4544000/280",
                "Exif.Photo.FocalPlaneYResolution": "3408000/210",
                "Exif.Photo.PixelXDimension": "2272",
                "Exif.Photo.PixelYDimension": "1704",
            },
            (1136, 852),
            3.556,
        ),
    ],
)
def test_a_canon_made_smaller_keeps_its_sensor(tags: dict[str, str], stored_px: tuple[int, int], width_mm: float) -> None:
    """Canon's fractions count thousandths of pixels and of an inch, whatever size the program that saved the picture wrote elsewhere."""
    told = CANONS_G2 | tags | {"width_px": str(stored_px[0]), "height_px": str(stored_px[1])}
    sensor = read_sensor(told, 21.0, stored_px)
    assert sensor.width_mm(*stored_px) == pytest.approx(width_mm, rel=1e-3)
    assert not sensor.doubt


def test_pixels_that_contradict_the_model_are_doubted() -> None:
    """At 100 pixels a millimetre 640 are 6.4 mm; a 50 mm lens that sees like 75 mm has 23.1 mm at 4:3 (a diagonal of 43.27 / 1.5)."""
    tags = {
        "Exif.Photo.FocalPlaneXResolution": "25400/10",
        "Exif.Photo.PixelXDimension": "640",
        "Exif.Photo.PixelYDimension": "480",
        "Exif.Photo.FocalLengthIn35mmFilm": "75",
    }
    sensor = read_sensor(tags, 50.0, (640, 480))
    assert sensor.width_mm(640, 480) == pytest.approx(23.08, rel=1e-3)
    assert "6.4 mm" in sensor.doubt and "23.1 mm" in sensor.doubt
    related = read_sensor(tags | {"Exif.Iop.RelatedImageWidth": "2400", "Exif.Iop.RelatedImageLength": "1800"}, 50.0, (640, 480))
    assert related.width_mm(640, 480) == pytest.approx(24.0) and not related.doubt
    tiny = {"Exif.Photo.FocalPlaneXResolution": "25400/10", "Exif.Photo.PixelXDimension": "200", "Exif.Photo.PixelYDimension": "150"}
    assert read_sensor(tiny, None, (200, 150)) is None, "a sensor of 2 mm"


def test_lenses_that_nobody_makes_are_unknown() -> None:
    """2.4 mm on a diagonal of 28 mm would see 161 degrees straight, and f/0.2 is beyond what air allows (f/0.5)."""
    sensor = SensorReading(0.004, (6000, 4000), "test")
    assert not PhotoMetadata(focal_length_mm=2.4, f_number=4.0, sensor=sensor).is_possible
    assert not PhotoMetadata(focal_length_mm=50.0, f_number=0.2, sensor=sensor).is_possible
    assert PhotoMetadata(focal_length_mm=8.0, f_number=0.95, sensor=sensor).is_possible


def test_a_focus_beyond_what_the_lens_tells_apart_is_rough() -> None:
    """7 mm f/2.8 on a diagonal of 9 mm has its hyperfocal distance at 7^2 / (2.8 * 9 / 1500) mm = 2.92 m."""
    sensor = SensorReading(9.0 / 2840.0, (2272, 1704), "test")

    def rough(distance_m: float, nearest_m: float, farthest_m: float, focal_mm: float = 7.0) -> tuple[float, float] | None:
        focus = FocusReading(distance_m, nearest_m, farthest_m, "lens", "test")
        return PhotoMetadata(focal_length_mm=focal_mm, f_number=2.8, sensor=sensor, focus=focus).rough_focus_m

    assert rough(0.5, 0.5, 0.5) is None
    assert rough(5.8, 5.8, 5.8) == (pytest.approx(1.0 / (1 / 5.8 + 1 / 2.917), rel=1e-3), math.inf)
    assert rough(5.8, 5.8, 5.8, focal_mm=50.0) is None, "which is 149 m with a lens of 50 mm"
    assert rough(2.7, 1.8, 5.2, focal_mm=50.0) == pytest.approx((1.8, 5.2), rel=1e-6), "a wide zone that the camera states"


@pytest.mark.parametrize(("base", "gain", "iso"), [("128", "0", 50.0), ("160", "39", 232.7), ("160", "65523", 75.5)])
def test_canons_speed_counts_in_32nds_of_a_stop(base: str, gain: str, iso: float) -> None:
    """A base of 160 is ISO 100, five stops above 100 / 32, and the gain has a sign; exiftool gives the same numbers."""
    tags = {"Exif.CanonSi.ISOSpeed": base, "Exif.CanonSi.AutoISO": gain}
    assert metadata_from_tags(tags).iso == pytest.approx(iso, rel=1e-3)
    assert metadata_from_tags(tags | {"Exif.CanonCs.MaxAperture": "21848"}).iso is None, "a maker note that was moved"

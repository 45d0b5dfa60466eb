"""The width of the sensor: stated pitches, lensfun's table, resized and cut pictures."""

import pytest

from capture.photos.sensor_metadata import SensorReading, read_sensor, sensor_of_model


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
    stated = read_sensor(tags | {"Exif.Photo.FocalPlaneXResolution": "25400/10"}, None, (2400, 1600))
    assert "FocalPlaneXResolution" in stated.source, "the file goes before the table"


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

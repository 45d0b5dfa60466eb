"""lens.toml and focus.csv: what they add and override, and how their mistakes are named."""

import math
from pathlib import Path

import pytest

from capture.photos.photo_metadata import PhotoMetadata
from capture.photos.sidecar import Sidecar, find_sidecar, read_sidecar, sidecar_of
from mrbokeh.optics.lens import Lens
from tests.support.refusals import refused


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
        ("focus_distances_m = [[1.0, 1.1, 1.2]]", "must lie between its nearest and farthest, got 1.0, 1.1, 1.2"),
        ("focus_distances_m = [[]]", "focus_distances_m must be a number of metres"),
        ('hiatus_mm = "wide"', "hiatus_mm must be a number"),
        ("f_number = ", "not valid TOML"),
    ],
)
def test_sidecar_mistakes_are_named(tmp_path: Path, text: str, message: str) -> None:
    refused(message, read_sidecar, write_sidecar(tmp_path, text))


def test_sidecar_with_too_few_distances(tmp_path: Path) -> None:
    sidecar = read_sidecar(write_sidecar(tmp_path, "focus_distances_m = [1.0, 2.0]"))
    refused("lists 2 distances, but there are 3 photographs", sidecar.applied, ["a", "b", "c"], [PhotoMetadata()] * 3)


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


def test_hiatus_and_intervals_from_the_sidecar(tmp_path: Path) -> None:
    """0.5 m from the film plane at 50 mm with 10 mm between the principal planes: d_f + d_s = 0.49 m."""
    text = 'focal_length_mm = 50\nhiatus_mm = 10\nfocus_origin = "film_plane"\nfocus_distances_m = [[0.5, 0.48, 0.53], inf]'
    sidecar = read_sidecar(write_sidecar(tmp_path, text))
    first, second = sidecar.applied(["a.jpg", "b.jpg"], [PhotoMetadata(), PhotoMetadata()])
    distance_m = first.focus_distance_m
    assert distance_m + Lens(50.0, 2.0, distance_m, 36.0).image_distance_mm / 1000.0 == pytest.approx(0.49)
    assert first.focus_interval_m[0] < distance_m < first.focus_interval_m[1]
    assert (second.focus_distance_m, second.focus_interval_m) == (math.inf, (math.inf, math.inf))


CSV = "file,focus_distance_m,nearest_m,farthest_m\na.jpg,0.5,0.48,0.52\n b.jpg , 0.6,,\nc.jpg,inf,5,inf\ntypo.jpg,1,,\n"


def test_distances_from_a_table(tmp_path: Path) -> None:
    (tmp_path / "focus.csv").write_text("\ufeff" + CSV, encoding="utf-8")
    write_sidecar(tmp_path, "focal_length_mm = 50\nf_number = 2")
    sidecar = sidecar_of(tmp_path, tmp_path)
    first, second, third = sidecar.applied(["a.jpg", "b.jpg", "c.jpg"], [PhotoMetadata()] * 3)
    assert (first.focus_distance_m, first.focus_interval_m, first.focal_length_mm) == (0.5, (0.48, 0.52), 50.0)
    assert (second.focus_distance_m, second.focus_interval_m) == (0.6, (0.6, 0.6))
    assert (third.focus_distance_m, third.focus_interval_m) == (math.inf, (5.0, math.inf))
    assert first.focus.source == "focus.csv = 0.5 m"
    assert sidecar.unmatched_names(["a.jpg", "b.jpg", "c.jpg"]) == ["typo.jpg"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected a first line file,focus_distance_m"),
        ("name,distance\na,1\n", "expected a first line file,focus_distance_m"),
        ("file,focus_distance_m\na.jpg,near\n", "line 2 must be a number of metres, .* got near"),
        ("file,focus_distance_m\na.jpg,\n", "line 2 must be a number of metres, .* got nothing"),
        ("file,focus_distance_m\na.jpg,1\na.jpg,2\n", "line 3: expected the name of a file that was not named before, got 'a.jpg'"),
        ("file,focus_distance_m\na.jpg,-1\n", "line 2 must be positive"),
        ("file,focus_distance_m,nearest_m\na.jpg,1,1.5\n", "line 2: the distance must lie between"),
    ],
)
def test_mistakes_in_a_table_are_named_with_their_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "focus.csv").write_text(text)
    refused(message, sidecar_of, tmp_path, tmp_path)


def test_distances_must_come_from_one_file(tmp_path: Path) -> None:
    (tmp_path / "focus.csv").write_text(CSV)
    path = write_sidecar(tmp_path, "focus_distances_m = [1.0, 2.0]")
    refused(r"both .*lens\.toml and .*focus\.csv state focus distances", sidecar_of, tmp_path, tmp_path)
    assert sidecar_of(tmp_path, tmp_path, path).focus_where == str(path), "the file that was named goes before those that lie there"
    inner = tmp_path / "inner"
    inner.mkdir()
    (inner / "own.csv").write_text(CSV)
    write_sidecar(inner, "f_number = 4")
    assert sidecar_of(inner, inner, inner / "own.csv").f_number == 4

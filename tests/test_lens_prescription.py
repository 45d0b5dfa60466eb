"""Lens prescriptions: the tables as they are published, first-order optics and glass."""

from math import inf
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.errors import InputError
from mrbokeh.psf_models.glass import LINE_C_UM, LINE_D_UM, LINE_F_UM, estimated_abbe_number, index_at
from mrbokeh.psf_models.lens_prescription import LensPrescription, Surface, biconvex_lens, read_prescription

# An air-spaced pair that is easy to do by hand: two equal thin-ish lenses with the stop in the middle.
PAIR = """# a symmetric pair
  60.0   2.0  1.5  20   # front element
 -60.0   5.0  1    20
   0.0   5.0  0    12
  60.0   2.0  1.5  20
 -60.0   0.0  1    20
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "lens.dat"
    path.write_text(text, encoding="utf-8")
    return path


def thin_lens(focal_mm: float, thickness_mm: float, index: float = 1.5) -> LensPrescription:
    radius = 2.0 * focal_mm * (index - 1.0)
    return LensPrescription("thin", (Surface(radius, thickness_mm, index, 4.0), Surface(-radius, 0.0, 1.0, 4.0)))


# What the published tables of the three lenses promise: focal length in their names, f-number in their headings. The fisheye
# is sold as f/4, the wide-angle's table states none.
@pytest.mark.parametrize(
    ("name", "focal_mm", "f_number"), [("dgauss.50mm", 50.0, 2.0), ("wide.22mm", 22.0, None), ("fisheye.10mm", 10.0, 4.0)]
)
def test_published_lenses_have_the_focal_length_of_their_names(
    shared_data: Path, name: str, focal_mm: float, f_number: float | None
) -> None:
    lens = read_prescription(shared_data / "lens" / "prescriptions" / f"{name}.dat")
    assert lens.focal_length_mm == pytest.approx(focal_mm, rel=0.02)
    assert lens.surfaces[lens.stop].is_stop
    if f_number is not None:
        assert lens.f_number == pytest.approx(f_number, rel=0.03)


def test_reads_surfaces_stop_and_comments(tmp_path: Path) -> None:
    lens = read_prescription(written(tmp_path, PAIR))
    assert [each.radius_mm for each in lens.surfaces] == [60.0, -60.0, inf, 60.0, -60.0]
    assert [each.index for each in lens.surfaces] == [1.5, 1.0, 1.0, 1.5, 1.0]
    assert lens.stop == 2 and lens.surfaces[2].is_stop and lens.surfaces[2].diameter_mm == 12.0
    np.testing.assert_allclose(lens.vertices_mm, [0.0, 2.0, 7.0, 12.0, 14.0])


def test_a_symmetric_lens_has_symmetric_planes_and_pupils(tmp_path: Path) -> None:
    lens = read_prescription(written(tmp_path, PAIR))
    assert lens.paraxial.front_principal_mm == pytest.approx(14.0 - lens.paraxial.rear_principal_mm)
    assert lens.entrance_pupil_mm[0] == pytest.approx(14.0 - lens.exit_pupil_mm[0])
    assert lens.entrance_pupil_mm[1] == pytest.approx(lens.exit_pupil_mm[1])
    # A stop behind a collecting lens is seen enlarged: by 1 / (1 - d / f) for a thin lens of f = 60 mm at d = 6 mm.
    assert lens.entrance_pupil_mm[1] == pytest.approx(12.0 / (1.0 - 6.0 / 60.0), rel=0.01)


def test_weak_thin_lens_follows_the_lensmakers_formula() -> None:
    """1/f = (n - 1)(1/R1 - 1/R2); a thickness t adds -(n - 1)^2 t / (n R1 R2), so f grows by t (n - 1) / (2 n R) to first order."""
    assert thin_lens(1000.0, 0.0).focal_length_mm == pytest.approx(1000.0, rel=1e-12)
    thick = thin_lens(1000.0, 3.0)
    assert thick.focal_length_mm == pytest.approx(1000.0 * (1.0 + 3.0 * 0.5 / (2.0 * 1.5 * 1000.0)), rel=1e-6)
    # Principal planes of a thin equi-convex lens of n = 1.5 lie a third of the thickness inside.
    assert thick.paraxial.front_principal_mm == pytest.approx(1.0, rel=2e-3)
    assert thick.paraxial.rear_principal_mm == pytest.approx(2.0, rel=2e-3)


@pytest.mark.parametrize(("focal_mm", "f_number"), [(50.0, 4.0), (85.0, 2.8), (20.0, 8.0)])
def test_biconvex_lens_is_as_ordered(focal_mm: float, f_number: float) -> None:
    lens = biconvex_lens(focal_mm, f_number)
    assert lens.focal_length_mm == pytest.approx(focal_mm, rel=1e-9) and lens.f_number == pytest.approx(f_number, rel=1e-9)
    front, back = lens.surfaces
    assert front.radius_mm == -back.radius_mm
    sag_mm = front.radius_mm - np.sqrt(front.radius_mm**2 - (0.5 * front.diameter_mm) ** 2)
    assert front.distance_mm - 2.0 * sag_mm == pytest.approx(1.0)


def test_sensor_moves_out_for_near_focus() -> None:
    lens = biconvex_lens(50.0)
    assert lens.paraxial.sensor_mm(np.inf) == pytest.approx(lens.paraxial.rear_principal_mm + 50.0)
    # Newton: the extra distance is f^2 / (s - f).
    assert lens.paraxial.sensor_mm(1.0) - lens.paraxial.sensor_mm(np.inf) == pytest.approx(2500.0 / 950.0)
    with pytest.raises(InputError, match=r"more than 0\.05 m"):
        lens.paraxial.sensor_mm(0.05)


def test_stopping_down() -> None:
    lens = biconvex_lens(50.0, 4.0)
    assert lens.stopped_down(11.0).f_number == pytest.approx(11.0)
    with pytest.raises(InputError, match="opens to f/4 only"):
        lens.stopped_down(2.0)


def test_turned_round_lens_is_the_same_lens(tmp_path: Path) -> None:
    """A table turned round twice is the table; its first column counts from the other end, media move to the other side."""
    lens = read_prescription(written(tmp_path, "30 4 1.6 10\ninf 2 1.7 10\n-80 0 1 12\n"))
    table, turned = lens.optics_table(), lens.reversed_table()
    np.testing.assert_allclose(turned[:, 0], [0.0, 2.0, 6.0])
    np.testing.assert_allclose(turned[:, 1], [1.0 / 80.0, 0.0, -1.0 / 30.0])
    np.testing.assert_allclose(turned[:, 2], table[::-1, 2])
    np.testing.assert_allclose(turned[:, 3:], [table[1, 3:], table[0, 3:], [1.0, 0.0]])


def test_cauchy_gives_index_and_abbe_number_back() -> None:
    n_c, n_d, n_f = index_at(1.5168, 64.17, np.array([LINE_C_UM, LINE_D_UM, LINE_F_UM]))
    assert n_d == pytest.approx(1.5168) and (n_d - 1.0) / (n_f - n_c) == pytest.approx(64.17)
    assert n_c < n_d < n_f
    # BK7 by its Sellmeier formula (Schott catalogue): 1.51432 at 656.27 nm, 1.52238 at 486.13 nm.
    assert n_c == pytest.approx(1.51432, abs=3e-4) and n_f == pytest.approx(1.52238, abs=3e-4)


# Kolb, Mitchell and Hanrahan, A Realistic Camera Model for Computer Graphics (1995): their double Gauss, with Abbe numbers.
DOUBLE_GAUSS_ABBE = (
    (1.67, 47.1, True),
    (1.699, 30.1, False),
    (1.603, 38.0, False),
    (1.658, 57.3, True),
    (1.717, 48.0, True),
)


@pytest.mark.parametrize(("index", "published", "is_positive"), DOUBLE_GAUSS_ABBE)
def test_estimated_dispersion_is_near_the_published_one(index: float, published: float, is_positive: bool) -> None:
    """The flints are met within 1 %; the edge of the diagram is up to 18 % beyond the lanthanum crowns that were chosen."""
    assert estimated_abbe_number(index, is_positive) == pytest.approx(published, rel=0.18 if is_positive else 0.01)


def test_elements_without_abbe_number_get_one_by_their_power(tmp_path: Path) -> None:
    """A cemented doublet: the collecting element gets crown, the diverging one flint; air and stops nothing."""
    lens = read_prescription(written(tmp_path, "30 4 1.62 10\n-25 2 1.62 10\n-200 1 1 10\n0 5 0 8\n"))
    crown, flint, *air = [each.abbe_number for each in lens.surfaces]
    assert crown > 55.0 and flint < 40.0 and air == [inf, inf]


def test_five_columns_state_the_abbe_number(tmp_path: Path) -> None:
    lens = read_prescription(written(tmp_path, "60 2 1.5 55.5 20\n-60 0 1 0 20\n"))
    assert [each.abbe_number for each in lens.surfaces] == [55.5, inf]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("60 2 1.5\n", "line 1: expected 4 or 5 numbers"),
        ("60 2 glass 20\n", "line 1: expected numbers"),
        ("# only a comment\n", "at least two refracting surfaces"),
        ("60 2 1.5 20\n-60 -3 1 20\n", "line 2: expected a distance of at least 0"),
        ("60 2 0.5 20\n-60 0 1 20\n", "line 1: expected a refractive index from 1 to 5"),
        ("60 2 1.5 0\n-60 0 1 20\n", "line 1: expected an aperture diameter above 0"),
        ("6 2 1.5 20\n-60 0 1 20\n", "line 1: expected an aperture diameter above 0 that fits on a sphere of radius 6"),
        ("60 2 1.5 20\n0 2 1.7 20\n-60 0 1 20\n", "line 2: a radius of 0 is the stop"),
        ("0 1 0 9\n60 2 1.5 20\n-60 1 1 20\n0 1 0 9\n", "has several"),
        ("60 2 1.5 20\n-60 0 1.3 20\n", "expected air"),
        ("-60 2 1.5 20\n60 0 1 20\n", "forms no image"),
        ("60 2 1.5 20\n60 nan 1 20\n", "line 2: expected 4 or 5 numbers"),
    ],
)
def test_mistakes_in_a_table_are_named(tmp_path: Path, text: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        read_prescription(written(tmp_path, text))


def test_missing_and_binary_files_are_mistakes(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_prescription(tmp_path / "nothing.dat")
    (tmp_path / "picture.dat").write_bytes(b"\xff\xd8\xff\xe0" * 20)
    with pytest.raises(InputError, match="cannot be read"):
        read_prescription(tmp_path / "picture.dat")

"""Lens prescriptions: the tables as they are published, first-order optics and glass."""

from dataclasses import replace
from math import inf
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.psf_models.lens_prescription import LINE_C_UM, LINE_D_UM, LINE_F_UM, LensPrescription, Surface, estimated_abbe_number, index_at
from mrbokeh.psf_models.physical_lens import biconvex_lens, read_prescription
from mrbokeh.system.errors import InputError

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


def test_a_symmetric_lens_is_read_with_its_stop_and_has_symmetric_planes_and_pupils(tmp_path: Path) -> None:
    lens = read_prescription(written(tmp_path, PAIR))
    assert [each.radius_mm for each in lens.surfaces] == [60.0, -60.0, inf, 60.0, -60.0]
    assert [each.index for each in lens.surfaces] == [1.5, 1.0, 1.0, 1.5, 1.0]
    assert lens.stop == 2 and lens.surfaces[2].is_stop and lens.surfaces[2].diameter_mm == 12.0
    np.testing.assert_allclose(lens.vertices_mm, [0.0, 2.0, 7.0, 12.0, 14.0])
    assert lens.paraxial.front_principal_mm == pytest.approx(14.0 - lens.paraxial.rear_principal_mm)
    assert lens.entrance_pupil_mm[0] == pytest.approx(14.0 - lens.exit_pupil_mm[0])
    assert lens.entrance_pupil_mm[1] == pytest.approx(lens.exit_pupil_mm[1])
    # A stop behind a collecting lens is seen enlarged: by 1 / (1 - d / f) for a thin lens of f = 60 mm at d = 6 mm.
    assert lens.entrance_pupil_mm[1] == pytest.approx(12.0 / (1.0 - 6.0 / 60.0), rel=0.01)


def test_weak_and_turned_lenses_follow_the_lensmakers_formula(tmp_path: Path) -> None:
    """1/f = (n - 1)(1/R1 - 1/R2); a thickness t adds -(n - 1)^2 t / (n R1 R2), so f grows by t (n - 1) / (2 n R) to first order."""
    assert thin_lens(1000.0, 0.0).focal_length_mm == pytest.approx(1000.0, rel=1e-12)
    thick = thin_lens(1000.0, 3.0)
    assert thick.focal_length_mm == pytest.approx(1000.0 * (1.0 + 3.0 * 0.5 / (2.0 * 1.5 * 1000.0)), rel=1e-6)
    # Principal planes of a thin equi-convex lens of n = 1.5 lie a third of the thickness inside.
    assert thick.paraxial.front_principal_mm == pytest.approx(1.0, rel=2e-3)
    assert thick.paraxial.rear_principal_mm == pytest.approx(2.0, rel=2e-3)
    # A table turned round twice is the table; its first column counts from the other end, media move to the other side.
    lens = read_prescription(written(tmp_path, "30 4 1.6 10\ninf 2 1.7 10\n-80 0 1 12\n"))
    table, turned = lens.optics_table(), lens.reversed_table()
    np.testing.assert_allclose(turned[:, 0], [0.0, 2.0, 6.0])
    np.testing.assert_allclose(turned[:, 1], [1.0 / 80.0, 0.0, -1.0 / 30.0])
    np.testing.assert_allclose(turned[:, 2], table[::-1, 2])
    np.testing.assert_allclose(turned[:, 3:], [table[1, 3:], table[0, 3:], [1.0, 0.0]])


@pytest.mark.parametrize(("focal_mm", "f_number"), [(50.0, 4.0), (85.0, 2.8), (20.0, 8.0)])
def test_biconvex_lens_is_as_ordered(focal_mm: float, f_number: float) -> None:
    lens = biconvex_lens(focal_mm, f_number)
    assert lens.focal_length_mm == pytest.approx(focal_mm, rel=1e-9) and lens.f_number == pytest.approx(f_number, rel=1e-9)
    front, back = lens.surfaces
    assert front.radius_mm == -back.radius_mm
    sag_mm = front.radius_mm - np.sqrt(front.radius_mm**2 - (0.5 * front.diameter_mm) ** 2)
    assert front.distance_mm - 2.0 * sag_mm == pytest.approx(1.0)


def test_sensor_moves_out_for_near_focus_and_lenses_are_stopped_down() -> None:
    lens = biconvex_lens(50.0)
    assert lens.paraxial.sensor_mm(np.inf) == pytest.approx(lens.paraxial.rear_principal_mm + 50.0)
    # Newton: the extra distance is f^2 / (s - f).
    assert lens.paraxial.sensor_mm(1.0) - lens.paraxial.sensor_mm(np.inf) == pytest.approx(2500.0 / 950.0)
    with pytest.raises(InputError, match=r"more than 0\.05 m"):
        lens.paraxial.sensor_mm(0.05)
    lens = biconvex_lens(50.0, 4.0)
    assert lens.stopped_down(11.0).f_number == pytest.approx(11.0)
    with pytest.raises(InputError, match="opens to f/4 only"):
        lens.stopped_down(2.0)


def test_cauchy_gives_index_and_abbe_number_back() -> None:
    n_c, n_d, n_f = index_at(1.5168, 64.17, np.array([LINE_C_UM, LINE_D_UM, LINE_F_UM]))
    assert n_d == pytest.approx(1.5168) and (n_d - 1.0) / (n_f - n_c) == pytest.approx(64.17)
    assert n_c < n_d < n_f
    # BK7 by its Sellmeier formula (Schott catalogue): 1.51432 at 656.27 nm, 1.52238 at 486.13 nm.
    assert n_c == pytest.approx(1.51432, abs=3e-4) and n_f == pytest.approx(1.52238, abs=3e-4)


# Schott's catalogue: n_d, V, and the indices at the C and F lines, of the glasses along both edges of the Abbe diagram (SF15 and
# F2 as their successors N-SF15 and N-F2 have them).
SCHOTT = {
    "N-FK5": (1.48749, 70.41, 1.48535, 1.49227), "N-BK7": (1.51680, 64.17, 1.51432, 1.52238),
    "N-SK16": (1.62041, 60.32, 1.61727, 1.62756), "N-LAK9": (1.69100, 54.71, 1.68716, 1.69979),
    "N-LASF44": (1.80420, 46.50, 1.79901, 1.81630), "N-LASF31A": (1.88300, 40.76, 1.87656, 1.89822),
    "LLF1": (1.54814, 45.75, 1.54457, 1.55655), "N-F2": (1.62005, 36.43, 1.61506, 1.63208),
    "SF5": (1.67270, 32.21, 1.66661, 1.68750), "N-SF15": (1.69892, 30.20, 1.69222, 1.71536),
    "SF11": (1.78472, 25.76, 1.77599, 1.80645), "SF6": (1.80518, 25.43, 1.79609, 1.82775),
    "SF57": (1.84666, 23.83, 1.83650, 1.87204),
}  # fmt: skip


@pytest.mark.parametrize("name", SCHOTT)
def test_glasses_are_those_of_the_catalogue(name: str) -> None:
    """The edges of the diagram pass through them, V is what the indices say, and two terms of Cauchy meet the three lines."""
    n_d, abbe, n_c, n_f = SCHOTT[name]
    assert (n_d - 1.0) / (n_f - n_c) == pytest.approx(abbe, rel=2e-3)  # indices have five decimals
    edges = [estimated_abbe_number(n_d, is_positive) for is_positive in (True, False)]
    assert min(abs(edge / abbe - 1.0) for edge in edges) < 5e-3
    np.testing.assert_allclose(index_at(n_d, abbe, np.array([LINE_C_UM, LINE_F_UM])), [n_c, n_f], atol=1e-4 if abbe > 40.0 else 6e-4)


# Kolb, Mitchell and Hanrahan, A Realistic Camera Model for Computer Graphics (1995): their double Gauss, which is that of the shared
# table, with Abbe numbers.
DOUBLE_GAUSS_ABBE = (47.1, 47.1, 30.1, 38.0, 57.3, 48.0)


def with_abbe_numbers(lens: LensPrescription, numbers: tuple[float, ...]) -> LensPrescription:
    left = iter(numbers)
    return replace(lens, surfaces=tuple(replace(each, abbe_number=next(left)) if each.index > 1.01 else each for each in lens.surfaces))


def test_estimated_dispersion_is_near_the_published_one(shared_data: Path) -> None:
    """Within 13 %. Red and blue are as near to one focus as with the published glass, where the edges alone are three times off."""
    lens = read_prescription(shared_data / "lens" / "prescriptions" / "dgauss.50mm.dat")
    glass = [each for each in lens.surfaces if each.index > 1.01]
    np.testing.assert_allclose([each.abbe_number for each in glass], DOUBLE_GAUSS_ABBE, rtol=0.13)
    edges = [
        estimated_abbe_number(each.index, is_positive)
        for each, is_positive in zip(glass, (True, True, False, False, True, True), strict=True)
    ]
    published = with_abbe_numbers(lens, DOUBLE_GAUSS_ABBE).axial_colour_mm
    assert 0.0 < published < 0.07
    assert abs(lens.axial_colour_mm - published) < 0.25 * abs(with_abbe_numbers(lens, tuple(edges)).axial_colour_mm - published)


@pytest.mark.parametrize("name", ["dgauss.50mm", "wide.22mm", "fisheye.10mm"])
def test_published_lenses_are_free_from_axial_colour(shared_data: Path, name: str) -> None:
    """As their designs are; glass from the edges would put red in front of blue in all three."""
    assert read_prescription(shared_data / "lens" / "prescriptions" / f"{name}.dat").axial_colour_mm == pytest.approx(0.0, abs=1e-6)


def test_abbe_numbers_are_estimated_by_power_and_one_glass_keeps_the_edge(tmp_path: Path) -> None:
    """Nothing to correct with: crown for its two collecting elements; f / V is the axial colour of thin lenses."""
    lens = read_prescription(written(tmp_path, PAIR))
    crown = estimated_abbe_number(1.5, True)
    assert [each.abbe_number for each in lens.surfaces if each.index > 1.0] == [crown, crown]
    assert lens.axial_colour_mm == pytest.approx(lens.focal_length_mm / crown, rel=0.15)
    # A doublet with its flint stated: only the crown is estimated, so that red and blue meet.
    lens = read_prescription(written(tmp_path, "30 4 1.62 10\n-25 2 1.62 30.0 10\n-200 1 1 10\n"))
    assert lens.surfaces[1].abbe_number == 30.0 and 30.0 < lens.surfaces[0].abbe_number <= estimated_abbe_number(1.62, True)
    # A cemented doublet: the collecting element gets crown, the diverging one flint; air and stops nothing.
    lens = read_prescription(written(tmp_path, "30 4 1.62 10\n-25 2 1.62 10\n-200 1 1 10\n0 5 0 8\n"))
    crown, flint, *air = [each.abbe_number for each in lens.surfaces]
    assert crown > 55.0 and flint < 40.0 and air == [inf, inf]
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

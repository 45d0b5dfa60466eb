import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrbokeh.aperture import Aperture
from mrbokeh.errors import InputError
from mrbokeh.lens import Lens
from mrbokeh.lens_file import lens_from_json, lens_to_json, read_lens, write_lens

NIKKOR = Lens(focal_length_mm=35.0, f_number=1.8, focus_distance_m=0.8, sensor_width_mm=35.9)


@given(st.floats(0.2, 20.0), st.floats(0.2, 20.0), st.floats(10.0, 85.0), st.floats(1.2, 16.0))
def test_coc_is_eq_1_of_neural_bokeh_with_its_sign(focus_m: float, depth_m: float, focal_mm: float, f_number: float) -> None:
    lens = Lens(focal_mm, f_number, focus_m, 36.0)
    # Eq. 1: c = (w_i / w_s) a d_s |d_p - d_f| / (d_p d_f), everything in millimetres.
    d_p, d_f = depth_m * 1000, focus_m * 1000
    d_s = focal_mm * d_f / (d_f - focal_mm)
    eq_1 = 1920 / 36.0 * focal_mm / f_number * d_s * (d_p - d_f) / (d_p * d_f)
    np.testing.assert_allclose(lens.coc_px(depth_m, 1920), eq_1, rtol=1e-9, atol=1e-9)


def test_coc_equals_the_thin_lens_traced_by_hand() -> None:
    """Similar triangles: the cone from the aperture to the image point, cut by the sensor."""
    depth_m, px_per_mm = 2.5, 6000 / NIKKOR.sensor_width_mm
    image_of_point_mm = 1 / (1 / 35.0 - 1 / (depth_m * 1000))
    cut_mm = 35.0 / 1.8 * (NIKKOR.image_distance_mm - image_of_point_mm) / image_of_point_mm
    np.testing.assert_allclose(NIKKOR.coc_px(depth_m, 6000), cut_mm * px_per_mm, rtol=1e-12)


def test_sign_zero_and_infinity() -> None:
    assert NIKKOR.coc_px(0.5, 1000) < 0 < NIKKOR.coc_px(1.5, 1000)
    assert NIKKOR.coc_px(0.8, 1000) == 0
    assert np.isfinite(NIKKOR.coc_px(np.inf, 1000))
    assert NIKKOR.focused_at(np.inf).coc_px(np.inf, 1000) == 0


def test_infinity_focus_has_the_focal_length_as_image_distance() -> None:
    assert NIKKOR.focused_at(np.inf).image_distance_mm == pytest.approx(35.0)


def test_a_focus_in_millimetres_is_caught_only_when_it_cannot_be() -> None:
    with pytest.raises(InputError, match="is the distance in metres"):
        NIKKOR.focused_at(0.02)


@pytest.mark.parametrize("field", ["focal_length_mm", "f_number", "sensor_width_mm"])
def test_nothing_but_positive_numbers(field: str) -> None:
    values = {"focal_length_mm": 35.0, "f_number": 2.0, "focus_distance_m": 1.0, "sensor_width_mm": 36.0} | {field: 0.0}
    with pytest.raises(InputError, match="positive"):
        Lens(**values)


@pytest.mark.parametrize("focus_m", [0.8, float("inf")])
def test_lens_file_round_trip(tmp_path, focus_m: float) -> None:
    lens = Lens(35.0, 1.8, focus_m, 35.9, Aperture.blades(7, 0.2))
    write_lens(tmp_path / "lens.json", lens)
    again = read_lens(tmp_path / "lens.json")
    assert (again.focal_length_mm, again.f_number, again.focus_distance_m, again.sensor_width_mm) == (35.0, 1.8, focus_m, 35.9)
    np.testing.assert_allclose(again.aperture.outlines[0], lens.aperture.outlines[0], atol=1e-9)


def test_a_lens_file_that_is_none_is_named(tmp_path) -> None:
    path = tmp_path / "lens.json"
    with pytest.raises(InputError, match="no such file"):
        read_lens(path)
    path.write_text("{ not json")
    with pytest.raises(InputError, match="not JSON"):
        read_lens(path)
    path.write_text('{"format": "something else"}')
    with pytest.raises(InputError, match="mrbokeh lens new"):
        read_lens(path)
    with pytest.raises(InputError, match="incomplete"):
        lens_from_json({key: value for key, value in lens_to_json(NIKKOR).items() if key != "aperture"})

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError
from tests.support.refusals import refused

NIKKOR = Lens(focal_length_mm=35.0, f_number=1.8, focus_distance_m=0.8, sensor_width_mm=35.9)


@given(st.floats(0.2, 20.0), st.floats(0.2, 20.0), st.floats(10.0, 85.0), st.floats(1.2, 16.0))
def test_coc_is_eq_1_of_neural_bokeh_with_its_sign(focus_m: float, depth_m: float, focal_mm: float, f_number: float) -> None:
    lens = Lens(focal_mm, f_number, focus_m, 36.0)
    # Eq. 1: c = (w_i / w_s) a d_s |d_p - d_f| / (d_p d_f), everything in millimetres.
    d_p, d_f = depth_m * 1000, focus_m * 1000
    d_s = focal_mm * d_f / (d_f - focal_mm)
    eq_1 = 1920 / 36.0 * focal_mm / f_number * d_s * (d_p - d_f) / (d_p * d_f)
    np.testing.assert_allclose(lens.coc_px(depth_m, 1920), eq_1, rtol=1e-9, atol=1e-9)


def test_sign_zero_and_infinity() -> None:
    assert NIKKOR.coc_px(0.5, 1000) < 0 < NIKKOR.coc_px(1.5, 1000)
    assert NIKKOR.coc_px(0.8, 1000) == 0
    assert np.isfinite(NIKKOR.coc_px(np.inf, 1000))
    assert NIKKOR.focused_at(np.inf).coc_px(np.inf, 1000) == 0
    assert NIKKOR.focused_at(np.inf).image_distance_mm == pytest.approx(35.0)


@pytest.mark.parametrize("field", ["focal_length_mm", "f_number", "sensor_width_mm"])
def test_nothing_but_positive_numbers(field: str) -> None:
    for wrong in (0.0, -2.0, float("nan"), float("inf")):
        values = {"focal_length_mm": 35.0, "f_number": 2.0, "focus_distance_m": 1.0, "sensor_width_mm": 36.0} | {field: wrong}
        with pytest.raises(InputError, match="must be above 0"):
            Lens(**values)


def test_what_no_lens_can_do_is_refused() -> None:
    for depth_m in (0.0, -1.0, 0, np.float32(0.0), np.array(0.0)):
        refused(r"^expected a depth above 0 m, got -?[01] m$", NIKKOR.coc_px, depth_m, 1000)
    for some_m in (1.0, np.ones((4, 8))):
        refused("^expected a picture at least 1 px wide, got 0 px$", NIKKOR.coc_px, some_m, 0)
    tilted, far = replace(NIKKOR, tilt_rad=(0.1, 0.0)), np.full((20, 30), 50.0)
    for wrong, said in (
        (lambda: NIKKOR.focused_at(0.02), "is the distance in metres"),
        (lambda: tilted.coc_px(np.ones((4, 8)), 16), "whole picture"),
        (lambda: replace(NIKKOR, tilt_rad=(0.0, 0.3)).focused_on(far, 15.0, 19.5), "cannot pass through"),
        *((lambda place=place: NIKKOR.focused_on(far, *place), "30 x 20 pixels") for place in OUTSIDE),
    ):
        with pytest.raises(InputError, match=said):
            wrong()


OUTSIDE = ((30.0, 5.0), (-0.1, 5.0), (5.0, 20.0), (float("nan"), 5.0))


def depths_in_focus(lens: Lens, width_px: int, height_px: int) -> np.ndarray:
    """Points (H, W, 3) in metres, camera axes, of what is in focus."""
    z = 1.0 / lens.focus_dioptres(width_px, height_px)
    y, x = np.mgrid[:height_px, :width_px] + 0.5
    focal_px = lens.focal_px(width_px)
    return np.stack([z * (x - width_px / 2) / focal_px, z * (y - height_px / 2) / focal_px, z], axis=-1)


def lens_axis(lens: Lens) -> np.ndarray:
    axis = np.array([*np.tan(lens.tilt_rad), 1.0])
    return axis / np.linalg.norm(axis)


@pytest.mark.parametrize("changed", [{"tilt_rad": (0.05, 0.0)}, {"tilt_rad": (0.0, 0.05)}, {"petzval_radius_mm": 400.0}])
def test_tilt_and_curvature_change_the_blur_and_neutral_ones_change_nothing(changed: dict[str, object]) -> None:
    depth_m = np.linspace(0.5, 4.0, 12 * 18, dtype=np.float32).reshape(12, 18)
    plain = NIKKOR.coc_px(depth_m, 18)
    np.testing.assert_array_equal(plain, np.float32(NIKKOR.coc_px_per_dioptre(18)) * (np.float32(1 / 0.8) - 1 / depth_m))
    neutral = replace(NIKKOR, tilt_rad=(0.0, 0.0), petzval_radius_mm=float("inf"))
    np.testing.assert_array_equal(neutral.coc_px(depth_m, 18), plain)
    assert neutral.image_distance_mm == NIKKOR.image_distance_mm
    bent = replace(NIKKOR, **changed)
    assert np.abs(bent.coc_px(depth_m, 18) - plain).max() > 0.05 and bent.coc_px(depth_m, 18).dtype == np.float32
    assert bent.coc_px(0.8, 18) == 0.0, "a number lies on the axis, where the focus distance holds"


@pytest.mark.parametrize("focus_m", [0.8, 3.0, float("inf")])
@pytest.mark.parametrize("tilt_rad", [(0.1, 0.0), (0.0, -0.06), (0.03, 0.08)])
def test_a_tilted_lens_is_sharp_on_a_plane_that_meets_the_hinge(focus_m: float, tilt_rad: tuple[float, float]) -> None:
    """Scheimpflug: a plane; Merklinger's hinge rule: it meets the lens's plane parallel to the sensor f / sin(tilt) from the lens."""
    lens = replace(NIKKOR, focus_distance_m=focus_m, tilt_rad=tilt_rad)
    points = depths_in_focus(lens, 30, 20).reshape(-1, 3)
    towards = np.tan(tilt_rad) / np.hypot(*np.tan(tilt_rad))
    hinge_m = 0.035 / np.sin(np.arccos(lens_axis(lens)[2]))
    # A plane through the point (0, 0, focus) and the line at z = 0 across `towards` at the hinge's distance.
    np.testing.assert_allclose(points[:, 2] / focus_m + points[:, :2] @ towards / hinge_m, 1.0, atol=1e-9)


@pytest.mark.parametrize("tilt_rad", [(0.1, 0.0), (0.03, 0.08)])
def test_a_tilted_lens_traced_by_hand(tilt_rad: tuple[float, float]) -> None:
    """Image points by the thin-lens equation along the tilted axis, in millimetres; rays from the pupil's rim through them to the sensor.

    Of two opposite points of the tilted rim those at the height of its centre give the diameter without foreshortening.
    """
    lens = replace(NIKKOR, tilt_rad=tilt_rad)
    axis, width_px, height_px = lens_axis(lens), 36, 24
    depth_m = np.full((height_px, width_px), 1.7)
    coc_px = lens.coc_px(depth_m, width_px)
    level = np.cross([0.0, 0.0, 1.0], axis)
    pupil_mm = lens.aperture_diameter_mm / 2 * level / np.linalg.norm(level)
    px_per_mm = width_px / lens.sensor_width_mm
    for row, column in ((0, 0), (23, 35), (5, 30), (12, 17)):
        tangent = np.array([column + 0.5 - width_px / 2, row + 0.5 - height_px / 2]) / lens.focal_px(width_px)
        point_mm = 1700.0 * np.array([*tangent, 1.0])
        image_mm = -point_mm * 35.0 / (point_mm @ axis - 35.0)
        hits = []
        for start in (pupil_mm, -pupil_mm):
            ray = image_mm - start
            hits.append(start + ray * (-lens.image_distance_mm - start[2]) / ray[2])
        # The sensor's picture is turned upright: behind the focus the point is displaced to the side of the ray's pupil point.
        spread_mm = -(hits[0] - hits[1]) @ (pupil_mm / np.linalg.norm(pupil_mm))
        assert coc_px[row, column] == pytest.approx(spread_mm * px_per_mm, rel=1e-9, abs=1e-9)


def test_tilting_the_lens_down_brings_the_ground_into_focus_and_a_curved_field_a_sphere() -> None:
    """As landscape photographers do: 1.6 m above the ground, focus at infinity, sin(tilt) = f / 1.6 m: sharp is y = 1.6 m."""
    lens = replace(NIKKOR.focused_at(np.inf), tilt_rad=(0.0, float(np.arcsin(0.035 / 1.6))))
    points = depths_in_focus(lens, 30, 20)[11:]
    np.testing.assert_allclose(points[..., 1], 1.6, rtol=1e-9)
    lens = replace(NIKKOR, focus_distance_m=2.0, petzval_radius_mm=1000.0)
    points = depths_in_focus(lens, 30, 20)
    np.testing.assert_allclose(np.linalg.norm(points - [0.0, 0.0, 1.0], axis=-1), 1.0, rtol=1e-12)


@pytest.mark.parametrize("radius_mm", [100.0, -300.0])
def test_the_curvature_of_the_field_is_petzvals(radius_mm: float) -> None:
    """Near the axis the surface in focus has the sag rho^2 / 2R towards the camera, and a flat object's image h^2 / 2R towards the lens."""
    lens = replace(NIKKOR, focus_distance_m=3.0, petzval_radius_mm=radius_mm)
    x, y, z = depths_in_focus(lens, 2000, 2)[0, 1020]
    assert 3.0 - z == pytest.approx(np.hypot(x, y) ** 2 / (2 * radius_mm / 1000), rel=1e-2)
    height_mm = np.hypot(20.5, 0.5) * 35.9 / 2000
    image_mm = 1 / (1 / 35.0 - 1 / (1000 * z))
    assert image_mm - lens.image_distance_mm == pytest.approx(height_mm**2 / (2 * radius_mm), rel=1e-3)


@pytest.mark.parametrize(
    "wrong", [{"tilt_rad": (0.0, 0.8)}, {"tilt_rad": (0.1, float("nan"))}, {"petzval_radius_mm": 0.0}, {"petzval_radius_mm": float("nan")}]
)
def test_impossible_tilts_and_curvatures_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(InputError, match=r"tilted|petzval_radius_mm"):
        replace(NIKKOR, **wrong)


def two_planes() -> np.ndarray:
    depth_m = np.full((20, 30), np.inf, np.float32)
    depth_m[5:15, 5:15], depth_m[5:15, 15:25] = 1.0, 2.0
    return depth_m


def test_autofocus_on_a_pixel_and_on_a_region() -> None:
    depth_m = two_planes()
    assert NIKKOR.focused_on(depth_m, 14.9, 10.0).focus_distance_m == 1.0
    assert NIKKOR.focused_on(depth_m, 15.0, 10.0).focus_distance_m == 2.0
    assert NIKKOR.focused_on(depth_m, 22.0, 10.0, radius_px=6.0).focus_distance_m == 2.0, "most of what has a depth"
    assert NIKKOR.focused_on(depth_m, 3.0, 10.0, radius_px=3.0).focus_distance_m == 1.0, "background has no say"
    assert NIKKOR.focused_on(depth_m, 15.0, 10.0, radius_px=4.0).focus_distance_m == 1.0, "half and half: the nearer, not the air between"
    depth_m[10, 10] = -1.0
    with pytest.raises(InputError, match="no depth is known"):
        NIKKOR.focused_on(depth_m, 10.5, 10.5)


@pytest.mark.parametrize(("tilt_rad", "radius_mm"), [((0.02, -0.03), np.inf), ((0.0, 0.0), 500.0), ((0.01, 0.02), -800.0)])
def test_autofocus_through_a_tilted_or_curved_field_makes_that_very_pixel_sharp(tilt_rad: tuple[float, float], radius_mm: float) -> None:
    depth_m = two_planes()
    lens = replace(NIKKOR, tilt_rad=tilt_rad, petzval_radius_mm=float(radius_mm)).focused_on(depth_m, 22.5, 6.5)
    assert lens.coc_px(depth_m.astype(np.float64), 30)[6, 22] == pytest.approx(0.0, abs=1e-9)
    assert lens.focus_distance_m != 2.0


def test_a_near_focus_says_from_where_it_counts() -> None:
    """A camera's scale counts from the sensor: 1 / 50 mm = 1 / 360 mm + 1 / 58 mm, and 360 + 58 = 418."""
    assert Lens(50.0, 2.0, 0.36, 36.0).focus_described == "0.36 m from the lens (0.418 m from the sensor)"
    assert Lens(50.0, 2.0, 2.0, 36.0).focus_described == "2 m" and Lens(50.0, 2.0).focus_described == "infinity"


def test_stated_facts_keep_the_shape_of_the_sensor() -> None:
    upright = Lens(50.0, 2.0, 1.0, 24.0, sensor_height_mm=36.0)
    small, dark = upright.stating({"sensor_width_mm": 12.0}), upright.stating({"f_number": 4.0})
    assert (small.sensor_width_mm, small.sensor_height_mm) == (12.0, 18.0)
    assert (dark.f_number, dark.sensor_width_mm, dark.sensor_height_mm) == (4.0, 24.0, 36.0)

"""Light and ground of a photograph for what is put into it: the ground has the irradiance that is told, and slopes as its depth says."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mrbokeh.compositing.ground import ground_under
from mrbokeh.compositing.open_plate import open_plate
from mrbokeh.compositing.plate import Plate, plate_of
from mrbokeh.compositing.plate_light import Surroundings, is_sunlit, picture_light, white_at
from mrbokeh.demo.plan import DATA
from mrbokeh.images.color import luminance
from mrbokeh.images.image_io import write_image
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.scene.changed_light import LightChange
from mrbokeh.scene.light import directions, solid_angles_sr
from mrbokeh.scene.light_change import light_left
from mrbokeh.scene.staging.filming import FilmedLayers, Filming
from mrbokeh.scene.staging.scene_description import Lighting, OneObject, looking_down
from mrbokeh.stacks.photograph import Photograph
from mrbokeh.tracking.world_axes import upright_camera

HEIGHT, WIDTH = 36, 48
LENS = Lens(focal_length_mm=30.0, f_number=4.0, focus_distance_m=2.0)
DOWN_RAD, ROLL_RAD = 0.5, 0.05


def photograph(tint: tuple[float, float, float] = (1.0, 1.0, 1.0), size_px: tuple[int, int] = (HEIGHT, WIDTH)) -> Plate:
    """Grey noise of 0.05 to 0.45, brighter to the right."""
    grey = 0.05 + 0.2 * np.random.default_rng(2).random((*size_px, 1)) + np.linspace(0.0, 0.2, size_px[1])[:, None]
    return plate_of((grey * tint).astype(np.float32), LENS)


def floors_down() -> np.ndarray:
    """Return where the world's down is for a camera that looks down and is rolled a little."""
    cosine, sine = np.cos(ROLL_RAD), np.sin(ROLL_RAD)
    return (looking_down(DOWN_RAD) @ np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]))[1]


def floor_m(plate: Plate) -> np.ndarray:
    """Return the depth of a floor 1 m below that camera."""
    rays = (plate.camera.pixel_centres_px() - plate.camera.principal_px) / plate.camera.focal_px
    along = rays @ floors_down()[:2] + floors_down()[2]
    return np.where(along > 0.01, 1.0 / np.maximum(along, 0.01), np.inf).astype(np.float32)


def test_the_ground_gets_the_irradiance_of_a_white_surface() -> None:
    plate = photograph((1.3, 1.0, 0.6))
    environment, lights = picture_light(plate, (24.0, 28.0), np.eye(3))
    upwards = np.maximum(-directions(32, 64)[..., 1], 0.0) * solid_angles_sr(32, 64)
    white = (environment.radiance * upwards[..., None]).sum(axis=(0, 1)) / np.pi
    np.testing.assert_allclose(white, white_at(plate.rgb, 0.5, 28 / HEIGHT), rtol=0.02)
    assert not lights
    assert white[0] > 1.05 * white[1] > 1.05**2 * white[2], "warm light in a warm picture"
    ahead = environment.radiance[18:21, 31:33].mean(axis=(0, 1))  # just below the middle of the picture, where nothing is added
    np.testing.assert_allclose(ahead, plate.rgb[20:28, 18:30].mean(axis=(0, 1)), rtol=0.15)


def test_what_is_out_of_sight_is_an_overcast_sky() -> None:
    """Walls under a sky of radiance 1 + 2 sin(height) have (pi / 2 + 4 / 3) / (7 pi / 3) = 0.396 of the irradiance of the ground."""
    environment, _ = Surroundings(np.zeros((32, 64, 3)), np.ones(3)).light()
    towards, solid = directions(32, 64), solid_angles_sr(32, 64)
    wall, ground = ((np.maximum(towards @ normal, 0.0) * solid * environment.radiance[..., 0]).sum() for normal in ([0, 0, 1], [0, -1, 0]))
    assert wall / ground == pytest.approx(0.396, abs=0.004)


@pytest.mark.parametrize("above_deg", [25.0, 60.0])
def test_a_sun_that_only_the_exposure_tells_is_wide_and_as_high_as_the_file_says(above_deg: float) -> None:
    """It comes from behind at the left, and is half as bright acos(0.5 ** (1 / 24)) = 13.7 degrees beside its middle."""
    environment, lights = Surroundings(np.zeros((32, 64, 3)), np.ones(3), above_deg).light()
    light, towards = (
        environment.radiance[..., 1] - Surroundings(np.zeros((32, 64, 3)), np.zeros(3)).light()[0].radiance[..., 1],
        directions(32, 64),
    )
    x, y, z = towards[np.unravel_index(light.argmax(), light.shape)]
    assert not lights and np.degrees(np.arcsin(-y)) == pytest.approx(above_deg, abs=4.0) and x < 0.0 and z < 0.0
    assert (solid_angles_sr(32, 64) * (light > light.max() / 2)).sum() == pytest.approx(2 * np.pi * (1 - np.cos(np.radians(13.7))), rel=0.3)


def test_shadows_in_what_a_camera_developed_are_deeper(tmp_path: Path) -> None:
    """A JPEG has the tones of a camera, a PNG of one's own has not: half the light is shown as 0.5 ** 1.3 there."""
    picture = np.full((24, 32, 3), 0.4, np.float32)
    facts = {"focal_length_mm": 30.0, "f_number": 4.0, "sensor_width_mm": 36.0}
    contrasts = []
    for name in ("a.jpg", "a.png"):
        write_image(tmp_path / name, picture)
        contrasts.append(open_plate(tmp_path / name, facts=facts, focus_m=2.0).shadow_contrast)
    assert contrasts == [1.3, 1.0]
    ratio = np.full((2, 2, 3), 0.5, np.float32)
    change = LightChange(ratio, np.zeros_like(ratio), np.ones((2, 2), np.float32), np.ones((2, 2), np.float32))
    assert change.deepened(1.3).ratio == pytest.approx(0.406, abs=1e-3) and change.deepened(1.0) is change


def test_a_main_light_takes_its_share_of_the_light() -> None:
    """The sun from the right and 30 degrees above the horizon travels left and down, and the ground keeps its irradiance.

    On a clear day the sky then gives 11.8 of 53.7 klx (Illuminating Engineering Society, RP-21), and is bluer than the sun.
    """
    plate = photograph()
    environment, (main,) = picture_light(plate, (24.0, 28.0), np.eye(3), (90.0, 30.0))
    np.testing.assert_allclose(main.direction, (-np.cos(np.pi / 6), 0.5, 0.0), atol=1e-9)
    upwards = np.maximum(-directions(32, 64)[..., 1], 0.0) * solid_angles_sr(32, 64)
    irradiance = (environment.radiance * upwards[..., None]).sum(axis=(0, 1)) + 0.5 * np.array(main.rgb)
    np.testing.assert_allclose(irradiance / np.pi, white_at(plate.rgb, 0.5, 28 / HEIGHT), rtol=0.03)
    shade = 1.0 - 0.5 * np.array(main.rgb) / irradiance
    assert float(luminance(shade[None].astype(np.float32))[0]) == pytest.approx(11.8 / 53.7, rel=0.05)
    # As measured in shadows of three sunny photographs.
    assert 1.4 < shade[2] / shade[0] < 2.7 and shade[0] < shade[1] < shade[2]


def test_sunshine_shows_in_the_exposure() -> None:
    """By the rule of f/16 at 1 / ISO s a white surface in full sun, about 100 klx, is just white; five stops more are needed at 3 klx.

    The light then comes from a spot behind the camera, and the ground keeps its irradiance.
    """
    sunny, dull = (Photograph(np.zeros((3, 4, 3), np.float32), 50.0, 16.0, exposure_time_s=time_s, iso=100.0) for time_s in (0.01, 0.32))
    assert sunny.white_lux == pytest.approx(100_000.0, rel=0.05)
    assert dull.white_lux == pytest.approx(100_000.0 / 32, rel=0.05)
    plate = photograph()
    assert not is_sunlit(plate, (24.0, 28.0)) and not is_sunlit(replace(plate, white_lux=dull.white_lux), (24.0, 28.0))
    bright = replace(plate, white_lux=sunny.white_lux)
    assert is_sunlit(bright, (24.0, 28.0))
    shaded = bright.rgb.copy()
    shaded[20:, :20] *= 0.1
    assert not is_sunlit(replace(bright, rgb=shaded), (8.0, 30.0)), "in the shade"
    radiance = picture_light(bright, (24.0, 28.0), np.eye(3))[0].radiance[..., 1]
    towards, weights = directions(32, 64), solid_angles_sr(32, 64)
    from_behind = towards[..., 2] < 0.0
    upwards = np.maximum(-towards[..., 1], 0.0) * weights
    assert (radiance * upwards)[from_behind].sum() > 0.7 * (radiance * upwards).sum()
    assert (radiance * upwards).sum() / np.pi == pytest.approx(white_at(plate.rgb, 0.5, 28 / HEIGHT)[1], rel=0.03)


@pytest.mark.parametrize("factor", [0.01, 40.0])
def test_a_picture_twice_as_bright_tells_of_light_twice_as_bright(factor: float) -> None:
    """Whatever the exposure: of a night, and of light far above the white of a screen."""
    plate = photograph((1.3, 1.0, 0.6))
    brighter = replace(plate, rgb=plate.rgb * np.float32(factor))
    environment, (main,) = picture_light(plate, (24.0, 28.0), np.eye(3), (90.0, 30.0))
    other, (brighter_main,) = picture_light(brighter, (24.0, 28.0), np.eye(3), (90.0, 30.0))
    np.testing.assert_allclose(other.radiance, factor * environment.radiance, rtol=1e-3)
    np.testing.assert_allclose(brighter_main.rgb, factor * np.array(main.rgb), rtol=1e-3)


def test_a_street_under_sodium_lamps_makes_no_red_object() -> None:
    """What faces the camera there, and what lies flat, is lit by two channels at least: red is no more than 2.2 times green."""
    plate = photograph((0.1, 0.03, 0.003))
    environment, _ = picture_light(plate, (24.0, 28.0), np.eye(3))
    weights = solid_angles_sr(32, 64)[..., None]
    for faces in ((0.0, -1.0, 0.0), (0.0, 0.0, -1.0)):
        red, green, blue = (environment.radiance * weights * np.maximum(directions(32, 64) @ np.array(faces), 0.0)[..., None]).sum((0, 1))
        assert green < red < 2.2 * green and blue > 0.2 * green
    lamp = plate.rgb.copy()
    lamp[2:5, 2:5] = (500.0, 150.0, 15.0)
    np.testing.assert_allclose(white_at(lamp, 0.5, 0.8), white_at(plate.rgb, 0.5, 0.8), rtol=0.05, err_msg="a lamp is no white wall")


@pytest.mark.parametrize("noise", [0.0, 0.004])
def test_the_ground_slopes_as_its_depth_says(noise: float) -> None:
    plate = photograph(size_px=(90, 120))
    depth_m = floor_m(plate) * (1 + noise * np.random.default_rng(3).standard_normal((90, 120))).astype(np.float32)
    found = ground_under(replace(plate, depth_m=depth_m), (50.0, 60.0))
    assert found is not None
    np.testing.assert_allclose(found, looking_down(DOWN_RAD), atol=0.002 if noise == 0 else 0.04)


def test_a_wall_and_noise_are_no_ground() -> None:
    plate = photograph(size_px=(90, 120))
    wall = np.full((90, 120), 2.0, np.float32)
    rough = (2.0 + np.random.default_rng(4).random((90, 120))).astype(np.float32)
    assert [ground_under(replace(plate, depth_m=each), (50.0, 60.0)) for each in (wall, rough, None)] == [None, None, None]


@pytest.mark.parametrize("sun_degrees", [pytest.param(None, marks=pytest.mark.slow), (40.0, 35.0)])
def test_light_in_few_pixels_is_that_of_all_pixels(sun_degrees: tuple[float, float] | None) -> None:
    """A cake of 0.3 m; where lights throw sharp shadows the truth has four rays a pixel. Under the cake, where nobody sees it, it is as
    light as beside it: the dark there would show as dashes through the rim."""
    camera = Camera(300, 225, (450.0, 450.0), (150.0, 112.5))
    made = picture_light(photograph(), (60.0, 60.0), looking_down(0.5), sun_degrees)
    one = OneObject(
        DATA / "objects" / "cakeBirthday.glb",
        (0.0, 0.1, 2.0),
        height_m=0.3,
        world_from_camera=looking_down(0.5),
        light=Lighting(made=made),
        shadow=1.0,
    )
    filmed = FilmedLayers(Filming("embree", samples=128, catches="light"), one.described(), threads=1)
    objects, shadow = filmed.at(lambda _: one.seen_by(camera))
    scene, catcher = filmed._staged.scene_at(0.0), filmed._staged.catcher
    assert catcher is not None
    fine = upright_camera(one.seen_by(camera), filmed._staged.description.up).resized(600, 450)
    lost = 1.0 - luminance(light_left(scene, fine, catcher, np.arange(600 * 450), samples=24))
    whole = cv2.resize(lost.reshape(450, 600), (300, 225), interpolation=cv2.INTER_AREA)
    seen, apart = objects.alpha == 0.0, np.abs(shadow.alpha - whole)
    assert whole[seen].max() > 0.5
    assert np.percentile(apart[seen & (whole > 0.01)], 95) < 0.04
    assert np.percentile(apart[seen & (whole > 0.01)], 99.9) < 0.15
    assert abs(float((shadow.alpha - whole)[seen].mean())) < 0.003
    assert whole[~seen].max() > 0.99 > 0.95 > shadow.alpha.max()


@pytest.mark.parametrize(("told_mm", "focal_mm", "width_mm"), [(None, 28.0, 36.0), (85.0, 85.0, 36.0), (4.2, 4.2, 5.4)])
def test_a_guessed_sensor_fits_the_focal_length(told_mm: float | None, focal_mm: float, width_mm: float) -> None:
    """4.2 mm in a phone are 28 mm on full frame: its sensor is 36 * 4.2 / 28 mm wide."""
    guessed, _ = Photograph(np.zeros((30, 40, 3), np.float32), focal_length_mm=told_mm).guessing()
    assert (guessed.focal_length_mm, guessed.sensor_width_mm) == pytest.approx((focal_mm, width_mm))

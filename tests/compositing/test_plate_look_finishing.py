"""The finished picture: identity where nothing virtual is, grain that cannot be told from the plate's, and the order of the steps."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from mrbokeh.compositing.over import OverPhotograph, behind
from mrbokeh.compositing.plate import Inserted, Plate, plate_of
from mrbokeh.compositing.plate_look.colour_match import ColourMatch
from mrbokeh.compositing.plate_look.finishing import Finishing, JpegCompression, LightWrap, LookOptions, finished, matched_finishing
from mrbokeh.compositing.plate_look.grain import Grain, GrainDraw, add_grain_to, measured_grain
from mrbokeh.compositing.plate_look.noise_measurement import NoiseLevel
from mrbokeh.compositing.plate_look.vignetting import RadialFalloff
from mrbokeh.images.color import linear_to_srgb, srgb_codes
from mrbokeh.images.exif import as_stored, upright
from mrbokeh.images.image_io import read_image
from mrbokeh.images.layer import Layer
from mrbokeh.layering.pixel_box import lit_box
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.system.errors import InputError
from tests.compositing.test_plate_look_grain import READ, SHOT, smooth_scene, unit_noise
from tests.support.refusals import refused

SIZE = (256, 384)
NO_FILE = Path("no_file.png")
LENS = Lens(50.0, 2.0, 1.0, 36.0)
GRAIN = Grain(NoiseLevel((4e-4, 2e-4, 6e-4), (2e-5, 1e-5, 4e-5)))
ALL = Finishing(ColourMatch((1.2, 1.0, 0.8), (0.01, 0.02, 0.03)), RadialFalloff(-0.4), GRAIN, LightWrap(0.5, 4.0))


def noisy(scene: np.ndarray, seed: int, sigma_px: float = 0.6) -> Plate:
    noise = unit_noise(seed, sigma_px, scene.shape[:2]) * np.sqrt(SHOT * scene + READ)
    return plate_of((scene + noise).astype(np.float32), LENS)


def soft_disc(colour: tuple[float, float, float] = (0.3, 0.3, 0.3)) -> Layer:
    """A blurred disc: alpha falls from 1 to 0 between 50 and 80 pixels from its middle."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    alpha = np.clip((80.0 - np.hypot(y - 128, x - 160)) / 30.0, 0.0, 1.0).astype(np.float32)
    depth_m = np.where(alpha > 0, 2.0, np.inf).astype(np.float32)
    return Layer(alpha[..., None] * np.float32(colour), alpha, depth_m, {"id": alpha[..., None].copy()})


def red_card() -> Layer:
    card = np.zeros((48, 64), np.float32)
    card[12:36, 20:44] = 1.0
    return Layer(card[..., None] * np.float32([0.8, 0.1, 0.1]), card, np.where(card > 0, 1.3, np.inf).astype(np.float32))


def put_in(plate: Plate, layer: Layer) -> Inserted:
    return Inserted(behind(plate.rgb, layer), layer)


scene_plate = cache(lambda: noisy(smooth_scene(), 0))


STEPS = {
    "colour": replace(Finishing(), colour=ALL.colour),
    "vignetting": replace(Finishing(), vignetting=ALL.vignetting),
    "grain": replace(Finishing(), grain=GRAIN),
    "light wrap": replace(Finishing(), light_wrap=ALL.light_wrap),
    "all": ALL,
}


@pytest.mark.parametrize("name", STEPS)
def test_pixels_without_virtual_light_and_what_came_in_stay_bit_for_bit(name: str) -> None:
    plate = scene_plate()
    inserted = put_in(plate, soft_disc())
    before = [each.copy() for each in (inserted.virtual.rgb, inserted.photo_rgb, plate.rgb)]
    found = finished(inserted, plate, STEPS[name], frame=3)
    for after, each in zip((inserted.virtual.rgb, inserted.photo_rgb, plate.rgb), before, strict=True):
        np.testing.assert_array_equal(after, each)
    untouched = inserted.virtual.alpha == 0
    np.testing.assert_array_equal(found.rgb[untouched], plate.rgb[untouched])
    assert untouched.mean() > 0.5 and (found.rgb[~untouched] != inserted.rgb[~untouched]).mean() > 0.2
    np.testing.assert_array_equal(found.photo_rgb, inserted.photo_rgb)
    np.testing.assert_array_equal(found.virtual.alpha, inserted.virtual.alpha)
    np.testing.assert_array_equal(found.virtual.extra["id"], inserted.virtual.extra["id"])


def test_a_finishing_or_a_layer_that_is_nothing_gives_back_what_came() -> None:
    """An empty finishing is no copy even."""
    plate = scene_plate()
    inserted, silent = put_in(plate, soft_disc()), Grain(NoiseLevel((0.0,) * 3, (0.0,) * 3))
    for finishing in (Finishing(), Finishing(ColourMatch(), None, silent, LightWrap(0.0))):
        assert finished(inserted, plate, finishing) is inserted
    nothing = soft_disc()
    empty = Layer(0 * nothing.rgb, 0 * nothing.alpha, np.full(SIZE, np.inf, np.float32))
    np.testing.assert_array_equal(finished(put_in(plate, empty), plate, ALL).rgb, plate.rgb)
    plate = scene_plate()
    with pytest.raises(InputError, match="expected the plate that was inserted into"):
        finished(put_in(plate, soft_disc()), plate_of(np.zeros((8, 8, 3), np.float32), LENS), ALL)
    refused("strength 0 to 1", LightWrap, 1.5)
    refused("radius above 0", LightWrap, 0.5, 0.0)


def test_behind_an_insertion_untouched_pixels_are_those_of_the_plate() -> None:
    """The same through a true insertion, blurred by the lens."""
    layer = red_card()
    plate = plate_of(np.random.default_rng(0).uniform(0, 1, (48, 64, 3)).astype(np.float32), LENS)
    inserted = OverPhotograph().insert(plate, [layer], ScatterReference())
    found = finished(inserted, plate, ALL)
    untouched = inserted.virtual.alpha == 0
    assert 0.2 < untouched.mean() < 0.9
    np.testing.assert_array_equal(found.rgb[untouched], plate.rgb[untouched])


@pytest.mark.parametrize("alpha", [0.1, 0.5, 1.0])
def test_the_picture_has_the_noise_that_the_sensor_gives_its_final_level(alpha: float) -> None:
    """98304 white values: their variance is good to 0.45 %, asked to four times that. P = 0.4, V = alpha * 0.2, M = (1 - alpha) P + V."""
    plate = noisy(np.full((*SIZE, 3), 0.4), 5, sigma_px=0.0)
    coverage = np.full(SIZE, alpha, np.float32)
    layer = Layer(np.full((*SIZE, 3), 0.2 * alpha, np.float32), coverage, np.ones(SIZE, np.float32))
    picture = finished(put_in(plate, layer), plate, Finishing(grain=GRAIN)).rgb
    level = (1 - alpha) * 0.4 + alpha * 0.2
    np.testing.assert_allclose(picture.var(axis=(0, 1)), SHOT * level + READ, rtol=0.018)
    np.testing.assert_allclose(picture.mean(axis=(0, 1)), level, rtol=1e-3)


def test_shadows_get_the_noise_of_their_darker_level_and_glow_its_own_shot_noise() -> None:
    """A shadow of 0.6 on 0.4 leaves 0.16; light of 0.3 without coverage adds to 0.2. Without grain a patch would be found out."""
    everywhere = np.ones(SIZE, np.float32)
    shadow = Layer(np.zeros((*SIZE, 3), np.float32), 0.6 * everywhere, everywhere)
    glow = Layer(np.full((*SIZE, 3), 0.3, np.float32), 0 * everywhere, np.inf * everywhere)
    for layer, level, seed, final in ((shadow, 0.4, 6, 0.16), (glow, 0.2, 7, 0.5)):
        plate = noisy(np.full((*SIZE, 3), level), seed, sigma_px=0.0)
        picture = finished(put_in(plate, layer), plate, Finishing(grain=GRAIN)).rgb
        np.testing.assert_allclose(picture.var(axis=(0, 1)), SHOT * final + READ, rtol=0.018)
    picture = put_in(noisy(np.full((*SIZE, 3), 0.3), 8), soft_disc()).rgb
    assert picture[100:150, 140:180].var() < 0.01 * picture[:, 300:].var()


def autocorrelation(patch: np.ndarray, lag: int) -> np.ndarray:
    centred = patch - patch.mean(axis=(0, 1))
    return (centred[:, lag:] * centred[:, : centred.shape[1] - lag]).mean(axis=(0, 1)) / centred.var(axis=(0, 1))


@pytest.mark.parametrize("seed", [20, 21, 22])
def test_a_grey_patch_with_grain_cannot_be_told_from_the_plate(seed: int) -> None:
    """Grain measured in one frame, put on a patch of the plate's grey in another. Noise filtered with 0.6 px has
    sum(rho^2) = 2.3, so 128 x 384 values make the ratio of two variances uncertain by 2 sqrt(2.3 / 49152) = 1.4 %, and the
    measurement adds 1.1 %: three sigma are 5.3 %. Correlations at a lag: 1 / sqrt(49152 / 2.3) and the measurement's 0.01."""
    grain = measured_grain(noisy(smooth_scene(), seed).rgb)
    plate = noisy(np.full((*SIZE, 3), 0.3), seed + 100)
    alpha = np.zeros(SIZE, np.float32)
    alpha[:128] = 1.0
    grey = Layer(alpha[..., None] * np.float32([0.3] * 3), alpha, np.where(alpha > 0, 2.0, np.inf).astype(np.float32))
    picture = finished(put_in(plate, grey), plate, Finishing(grain=grain), frame=seed).rgb.astype(np.float64)
    virtual, real = picture[:128], picture[128:]
    np.testing.assert_allclose(virtual.var(axis=(0, 1)), real.var(axis=(0, 1)), rtol=0.053)
    for lag in (1, 2, 3):
        np.testing.assert_allclose(autocorrelation(virtual, lag), autocorrelation(real, lag), atol=0.04)
    between = [np.corrcoef(part.reshape(-1, 3).T) for part in (virtual, real)]
    np.testing.assert_allclose(between[0], between[1], atol=0.04)
    np.testing.assert_allclose(virtual.mean(axis=(0, 1)), real.mean(axis=(0, 1)), atol=0.001)


def test_a_patch_in_a_real_photograph_has_its_grain(shared_data: Path) -> None:
    """Plain paper (Nikon D70 JPEG): a smoothed copy of a part of it, with the grain measured in the whole picture, has the standard
    deviation of what it replaces within a quarter, and its correlation; smoothed alone it has a tenth."""
    rgb = np.ascontiguousarray(read_image(shared_data / "exif" / "nikon_d70_0.45m.jpg")[1300:1940, :1600])
    part = np.s_[480:560, 740:820]
    alpha = np.zeros(rgb.shape[:2], np.float32)
    alpha[part] = 1.0
    copy = Layer(alpha[..., None] * gaussian_filter(rgb, (20, 20, 0)), alpha, np.where(alpha > 0, 2.0, np.inf).astype(np.float32))
    plate = plate_of(rgb, LENS)
    picture = finished(put_in(plate, copy), plate, Finishing(grain=measured_grain(rgb))).rgb
    fine = [each[part] - gaussian_filter(each, (6, 6, 0))[part] for each in (rgb, picture, put_in(plate, copy).rgb)]
    real, ours, smooth = (each.std(axis=(0, 1)) for each in fine)
    np.testing.assert_allclose(ours, real, rtol=0.25)
    assert (smooth < 0.12 * real).all()
    np.testing.assert_allclose(autocorrelation(fine[1], 1), autocorrelation(fine[0], 1), atol=0.15)


def test_frames_differ_and_repeat_and_grain_stands_in_the_frame() -> None:
    plate = scene_plate()
    inserted = put_in(plate, soft_disc())
    first, again, second = (finished(inserted, plate, Finishing(grain=GRAIN), frame).virtual.rgb for frame in (4, 4, 5))
    np.testing.assert_array_equal(first, again)
    inner = inserted.virtual.alpha == 1
    noise = [each[inner] - inserted.virtual.rgb[inner] for each in (first, second)]
    assert abs(np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1]) < 0.02  # 23000 values
    other_seed = finished(inserted, plate, Finishing(grain=replace(GRAIN, seed=1)), 4).virtual.rgb
    assert (other_seed[inner] != first[inner]).mean() > 0.99
    # A speck far away makes the box larger; the grain on the disc stays the same.
    plate = scene_plate()
    disc = soft_disc()
    alpha, rgb = disc.alpha.copy(), disc.rgb.copy()
    alpha[2, 380], rgb[2, 380] = 1.0, 0.5
    larger = replace(disc, alpha=alpha, rgb=rgb)
    assert lit_box(larger) != lit_box(disc)
    found = [finished(put_in(plate, each), plate, ALL, 2).virtual.rgb for each in (disc, larger)]
    np.testing.assert_array_equal(found[0][20:, :350], found[1][20:, :350])


def added_variance_reference(virtual: Layer, photo_rgb: np.ndarray, plate_rgb: np.ndarray, level: NoiseLevel) -> np.ndarray:
    """Return the variance that grain adds to each value; 0 where nothing virtual is."""
    kept = (1.0 - virtual.alpha[..., None]) ** 2
    missing = level.variance(photo_rgb + virtual.rgb) - kept * level.variance(plate_rgb)
    touched = (virtual.alpha != 0.0) | (virtual.rgb != 0.0).any(axis=2)
    return np.where(touched[..., None], np.maximum(missing, 0.0), 0.0).astype(np.float32)


def values_reference(draw: GrainDraw, size_px: tuple[int, int]) -> np.ndarray:
    """Return (h, w, 3) of variance 1: the part of the texture that a frame takes."""
    side = draw.grain.texture.shape[0]
    rows, columns = ((np.arange(length) + start) % side for length, start in zip(size_px, draw.start, strict=True))
    return draw.sign * draw.grain.texture[np.ix_(rows, columns)]


def test_added_variance_is_the_formula_and_the_compiled_loop_its_twin() -> None:
    plate = scene_plate()
    inserted = put_in(plate, soft_disc((0.9, 0.2, 0.05)))
    draw = GrainDraw(GRAIN, 7)
    light = inserted.virtual.rgb.copy()
    add_grain_to(light, inserted.virtual.alpha, inserted.photo_rgb, plate.rgb, draw)
    variance = added_variance_reference(inserted.virtual, inserted.photo_rgb, plate.rgb, GRAIN.level)
    expected = np.sqrt(variance) * values_reference(draw, SIZE)
    np.testing.assert_allclose(light - inserted.virtual.rgb, expected, atol=2e-6)
    # shot (V + a (1 - a) P) + read a (2 - a) for a photograph that keeps 1 - a of itself.
    plate = plate_of(np.full((*SIZE, 3), 0.4, np.float32), LENS)
    layer = soft_disc()
    a, v = layer.alpha[..., None], layer.rgb
    expected = SHOT * (v + a * (1 - a) * 0.4) + READ * a * (2 - a)
    found = added_variance_reference(layer, behind(plate.rgb, layer), plate.rgb, GRAIN.level)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert (found >= 0).all() and (found[layer.alpha == 0] == 0).all()


def test_colour_and_falloff_are_linear_and_may_come_before_the_blur_or_after_it() -> None:
    plate = scene_plate()
    steps = Finishing(ColourMatch((1.2, 1.0, 0.8)), RadialFalloff(-0.4))
    once, twice = (finished(put_in(plate, soft_disc((f * 0.3,) * 3)), plate, steps).virtual.rgb for f in (1.0, 2.0))
    np.testing.assert_allclose(twice, 2 * once, rtol=1e-5)
    # Blur is linear in light and its weights sum to 1.
    match, renderer, layer = ColourMatch((1.7, 0.8, 0.4), (0.02, 0.01, 0.03)), ScatterReference(), red_card()
    first, last = match.applied(renderer.render([layer], LENS)), renderer.render([match.applied(layer)], LENS)
    np.testing.assert_allclose(first.rgb, last.rgb, atol=1e-6)
    # An opaque white everywhere: gain * falloff + black.
    plate = plate_of(np.full((64, 96, 3), 0.2, np.float32), LENS)
    white = Layer(np.ones((64, 96, 3), np.float32), np.ones((64, 96), np.float32), np.ones((64, 96), np.float32))
    steps = Finishing(ColourMatch((0.5, 0.5, 0.5), (0.1, 0.1, 0.1)), RadialFalloff(-0.6))
    picture = finished(put_in(plate, white), plate, steps).rgb
    assert picture[32, 48, 0] == pytest.approx(0.6, abs=1e-3) and picture[0, 0, 0] == pytest.approx(0.5 * 0.4 + 0.1, abs=0.01)


def test_light_wrap_adds_the_light_beside_the_edge_that_it_says() -> None:
    """Before an even photograph B is its level: strength * a (1 - a) * B, nothing where a is 0 or 1, and linear in the photograph."""
    plate = plate_of(np.full((*SIZE, 3), 0.4, np.float32), LENS)
    inserted = put_in(plate, soft_disc())
    a = inserted.virtual.alpha[..., None]
    wrapped = finished(inserted, plate, Finishing(light_wrap=LightWrap(0.5, 4.0)))
    added = wrapped.virtual.rgb - inserted.virtual.rgb
    np.testing.assert_allclose(added, np.broadcast_to(0.5 * a * (1 - a) * 0.4, added.shape), atol=1e-6)
    assert (added[inserted.virtual.alpha == 1] == 0).all() and added.max() <= 0.25 * 0.5 * 0.4 + 1e-6
    # Left of the disc the photograph is red, right of it blue.
    rgb = np.zeros((*SIZE, 3), np.float32)
    rgb[:, :160, 0], rgb[:, 160:, 2] = 1.0, 1.0
    plate = plate_of(rgb, LENS)
    inserted = put_in(plate, soft_disc((0.0, 0.0, 0.0)))
    added = finished(inserted, plate, Finishing(light_wrap=LightWrap(1.0, 4.0))).virtual.rgb
    assert added[128, 95, 0] > 0.2 and added[128, 95, 2] < 1e-6 and added[128, 225, 2] > 0.2
    plate = scene_plate()
    inserted = put_in(plate, soft_disc())
    cut = finished(inserted, plate, Finishing(light_wrap=LightWrap(0.7, 4.0))).virtual.rgb
    whole = LightWrap(0.7, 4.0).wrapped(inserted.virtual, inserted.photo_rgb).rgb
    np.testing.assert_allclose(cut, whole, atol=1e-6)


def test_black_and_grain_are_matched_as_far_as_a_photograph_surely_has_them() -> None:
    """Grain of a deviation of 0.003 on a black of 0.01 is found; sand of 0.04 on 0.3 is no grain so strong, and not black."""
    rng = np.random.default_rng(8)
    level = np.linspace(0.01, 0.4, 256)[:, None, None] * np.ones((1, 320, 3))
    noisy = (level + 0.003 * rng.standard_normal(level.shape)).astype(np.float32)
    found, matched = matched_finishing(LookOptions(), noisy, NO_FILE)
    assert matched == ["--match-black", "--grain"]
    assert found.grain is not None and found.colour is not None
    assert np.sqrt(found.grain.level.variance(np.full(3, 0.18))) == pytest.approx(np.full(3, 0.003), rel=0.15)
    assert found.colour.black == pytest.approx((0.01, 0.01, 0.01), abs=0.005)
    sand = (0.3 + 0.04 * rng.standard_normal(level.shape)).clip(0.1).astype(np.float32)
    found, matched = matched_finishing(LookOptions(), sand, NO_FILE)
    assert matched == ["--grain"] and found.grain is not None
    levels = np.linspace(0.01, 0.6, 60)
    shown = linear_to_srgb((levels + np.sqrt(found.grain.level.variance(levels[:, None] * np.ones(3)).max(axis=1))).astype(np.float32))
    assert 0.012 < (shown - linear_to_srgb(levels.astype(np.float32))).max() < 0.022
    assert matched_finishing(LookOptions(match_black="off", grain="off"), noisy, NO_FILE)[0].is_nothing
    assert not matched_finishing(LookOptions(), np.full((8, 8, 3), 0.001, np.float32), NO_FILE)[1], "too small to tell"


@pytest.mark.parametrize("orientation", [1, 6])
@pytest.mark.parametrize("subsampling", [0, 2])
def test_what_is_put_into_a_jpeg_is_compressed_as_it_is(tmp_path: Path, orientation: int, subsampling: int) -> None:
    """Against the whole picture, saved by Pillow as the photograph was: the same pixels where something was put in, others untouched."""
    stored = np.asarray(np.random.default_rng(3).uniform(60, 160, (80, 112, 3)), np.uint8)
    exif = Image.Exif()
    exif[0x0112] = orientation
    quality = {"quality": 30, "subsampling": subsampling}
    Image.fromarray(stored).save(tmp_path / "photo.jpg", exif=exif, **quality)
    photo_rgb = read_image(tmp_path / "photo.jpg") if orientation == 1 else upright(read_image(tmp_path / "photo.jpg"), orientation)
    alpha = np.zeros(photo_rgb.shape[:2], np.float32)
    alpha[20:61, 33:70] = 1.0
    layer = Layer(alpha[..., None] * np.float32((0.6, 0.1, 0.05)), alpha, np.where(alpha > 0, 2.0, np.inf).astype(np.float32))
    compression = JpegCompression.of(tmp_path / "photo.jpg")
    assert compression is not None
    plate = plate_of(photo_rgb, LENS)
    done = finished(Inserted(behind(photo_rgb, layer), layer), plate, Finishing(compression=compression)).rgb
    whole = as_stored(behind(photo_rgb, layer) + layer.rgb, orientation)
    Image.fromarray(srgb_codes(whole, np.uint8)).save(tmp_path / "whole.jpg", **quality)
    expected = upright(read_image(tmp_path / "whole.jpg"), orientation)
    np.testing.assert_allclose(done[alpha > 0], expected[alpha > 0], atol=1e-6)
    np.testing.assert_array_equal(done[alpha == 0], photo_rgb[alpha == 0])
    assert np.ptp(done[alpha > 0][:, 0]) > 0.05, "it rings"
    assert JpegCompression.of(NO_FILE) is None

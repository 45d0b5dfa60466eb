"""RAW to linear light: known mosaics come back within their quantisation."""

from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float

import capture
from capture.photos.developing import develop
from capture.photos.raw import DecodedPhoto, camera_white_balance, decode_raw, read_raw_metadata
from datasets_scripts.made_sets.simulated_camera import SensorModel, ShotMetadata, write_dng
from mrbokeh.images.color import convert, rec709_from_XYZ
from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError
from tests.scenes.made_photographs import set_exif

QUIET = {"full_well_electrons": 0.0, "read_noise_electrons": 0.0}


SHOT = ShotMetadata(Lens(35.0, 2.8, 1.0, 23.5))


PATCH_PX = 32


# Demosaicing reaches a few pixels beyond the border between two patches.
INSIDE = slice(10, PATCH_PX - 10)


def patches(colours: list[tuple[float, float, float]]) -> Float[np.ndarray, "height width 3"]:
    """A row of flat squares."""
    return np.concatenate([np.broadcast_to(np.float32(colour), (PATCH_PX, PATCH_PX, 3)) for colour in colours], axis=1)


def patch_means(rgb: Float[np.ndarray, "height width 3"]) -> Float[np.ndarray, "patches 3"]:
    count = rgb.shape[1] // PATCH_PX
    return np.array([rgb[INSIDE, index * PATCH_PX :][:, INSIDE].mean(axis=(0, 1)) for index in range(count)])


def rec709(decoded: DecodedPhoto) -> Float[np.ndarray, "height width 3"]:
    return convert(decoded.rgb, np.array(decoded.rec709_from_camera))


def photograph(path: Path, rgb: Float[np.ndarray, "height width 3"], sensor: SensorModel) -> Path:
    write_dng(path, sensor.quantise(np.minimum(sensor.linear_mosaic(rgb), 1.0)), sensor, SHOT)
    return path


def quantisation_error(sensor: SensorModel) -> float:
    """Half a step of the raw number and a step of LibRaw's 16 bit, through white balance and colour matrix."""
    multipliers = 1.0 / sensor.as_shot_neutral
    rec709_from_balanced = np.linalg.inv(multipliers[:, None] * sensor.camera_from_rec709)
    raw_step = 0.5 * multipliers / (sensor.white_level - sensor.black_level) + multipliers.max() / 65535.0
    # The matrix itself is stored in steps of 1e-4 (0.5e-4 at most, relative to entries around 1, colours up to 1).
    return float((np.abs(rec709_from_balanced) @ raw_step).max()) + 1e-4


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
@pytest.mark.parametrize(("bits", "black_level"), [(12, 64), (14, 1008), (16, 0)])
def test_flat_patches_come_back_within_their_quantisation(tmp_path: Path, pattern: str, bits: int, black_level: int) -> None:
    sensor = SensorModel(bits=bits, black_level=black_level, pattern=pattern, **QUIET)
    colours = [(0.2, 0.2, 0.2), (0.8, 0.8, 0.8), (0.4, 0.1, 0.05), (0.02, 0.3, 0.5)]
    decoded = decode_raw(photograph(tmp_path / "patches.dng", patches(colours), sensor))
    assert np.abs(patch_means(rec709(decoded)) - colours).max() < quantisation_error(sensor)
    assert not decoded.saturated.any()


def test_exposure_does_not_follow_the_brightest_pixel(tmp_path: Path) -> None:
    """With LibRaw's default (adjust_maximum_thr 0.75) the patch of 0.200 reads 0.25 when the frame's maximum is 0.80 of white."""
    sensor = SensorModel(**QUIET)
    for brightest in (0.70, 0.80, 0.90, 0.99):
        scene = patches([(0.2, 0.2, 0.2), (brightest,) * 3])
        decoded = decode_raw(photograph(tmp_path / "scene.dng", scene, sensor))
        assert patch_means(rec709(decoded))[0] == pytest.approx([0.2] * 3, abs=quantisation_error(sensor))


def test_highlights_above_white_are_kept(tmp_path: Path) -> None:
    """Raw red of 0.6, 0.8 and 0.95 of its range times the white balance's 2 is 1.2, 1.6 and 1.9 (camera primaries = Rec.709)."""
    camera_from_xyz = np.diag([0.5, 1.0, 0.625]) @ rec709_from_XYZ
    sensor = SensorModel(camera_from_xyz=tuple(map(tuple, np.round(camera_from_xyz, 4).tolist())), **QUIET)
    decoded = decode_raw(photograph(tmp_path / "red.dng", patches([(1.2, 0.5, 0.5), (1.6, 0.5, 0.5), (1.9, 0.5, 0.5)]), sensor))
    assert patch_means(rec709(decoded))[:, 0] == pytest.approx([1.2, 1.6, 1.9], abs=quantisation_error(sensor))
    assert not decoded.saturated.any()


def test_saturated_photosites_are_counted(tmp_path: Path) -> None:
    """White of 3 fills all channels (red has 0.5 of green's sensitivity: 1.5), grey of 0.5 none: two of four patches are full."""
    decoded = decode_raw(photograph(tmp_path / "full.dng", patches([(0.5,) * 3, (3.0,) * 3, (0.1,) * 3, (3.0,) * 3]), SensorModel(**QUIET)))
    assert decoded.photosites.full_fraction == pytest.approx(0.5)
    # A full photosite says "1.0 of white" in green, and camera white balance on top in red and blue.
    assert decoded.saturation_level == 1.0


def test_white_balance_given_from_outside_scales_the_channels(tmp_path: Path) -> None:
    path = photograph(tmp_path / "grey.dng", patches([(0.3,) * 3, (0.1, 0.2, 0.3)]), SensorModel(**QUIET))
    red, green, blue = camera_white_balance(path)
    assert (red, green, blue) == pytest.approx((2.0, 1.0, 1.6), abs=1e-3)
    same = decode_raw(path, (2 * red, 2 * green, 2 * blue))
    assert np.array_equal(same.rgb, decode_raw(path).rgb)
    warmer = patch_means(rec709(decode_raw(path, (1.1 * red, green, blue))))[0]
    assert warmer[0] > 1.1 * 0.3 > warmer[2]
    with pytest.raises(InputError, match="positive multipliers"):
        decode_raw(path, (0.0, 1.0, 1.0))


def test_orientation_is_left_alone(tmp_path: Path) -> None:
    path = photograph(tmp_path / "upright.dng", patches([(0.1,) * 3, (0.4,) * 3]), SensorModel(**QUIET))
    as_stored = decode_raw(path).rgb
    set_exif(path, Orientation="6")
    assert np.array_equal(decode_raw(path).rgb, as_stored)


def test_half_size_keeps_the_light(tmp_path: Path) -> None:
    sensor = SensorModel(**QUIET)
    path = photograph(tmp_path / "patches.dng", patches([(0.2, 0.3, 0.4), (0.5, 0.2, 0.1)]), sensor)
    half = decode_raw(path, half_size=True)
    assert half.rgb.shape == (PATCH_PX // 2, PATCH_PX, 3)
    assert rec709(half)[6:10, 6:10].mean(axis=(0, 1)) == pytest.approx([0.2, 0.3, 0.4], abs=quantisation_error(sensor))


def test_what_is_not_raw_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "text.dng"
    path.write_text("no photograph\n" * 50)
    with pytest.raises(InputError, match="cannot be decoded"):
        decode_raw(path)
    with pytest.raises(InputError, match="no such file"):
        decode_raw(tmp_path / "absent.dng")
    assert read_raw_metadata(path).focal_length_mm is None


def test_what_is_stored_is_camera_rgb(tmp_path: Path) -> None:
    """Balanced camera RGB is the sensor's answer to the colour times the white balance, before any mixing of channels."""
    sensor = SensorModel(**QUIET)
    colours = np.array([(0.4, 0.1, 0.05), (0.02, 0.3, 0.5)])
    decoded = decode_raw(photograph(tmp_path / "colours.dng", patches([tuple(each) for each in colours.tolist()]), sensor))
    expected = colours @ sensor.camera_from_rec709.T / sensor.as_shot_neutral
    assert np.abs(patch_means(decoded.rgb) - expected).max() < quantisation_error(sensor)


def test_saturation_spreads_as_far_as_demosaicing(tmp_path: Path) -> None:
    """A light of one photosite, at (40, 60): with 2 px on each side 25 pixels are marked, also in reduced pictures."""
    rgb = np.full((96, 128, 3), 0.1, np.float32)
    sensor = SensorModel(**QUIET)
    mosaic = sensor.linear_mosaic(rgb)
    mosaic[40, 60] = 1.0
    write_dng(tmp_path / "light.dng", sensor.quantise(mosaic), sensor, SHOT)
    full = develop(tmp_path / "light.dng", None)
    assert (full.photosites.width, full.photosites.height, full.photosites.full) == (128, 96, 1)
    marked = np.zeros((96, 128), np.float32)
    marked[38:43, 58:63] = 1.0
    np.testing.assert_array_equal(full.saturated, marked)
    reduced = develop(tmp_path / "light.dng", None, max_width=32)
    np.testing.assert_allclose(reduced.saturated, marked.reshape(24, 4, 32, 4).mean(axis=(1, 3)), atol=1e-6)
    half = develop(tmp_path / "light.dng", None, half_size=True)
    np.testing.assert_allclose(half.saturated, marked.reshape(48, 2, 64, 2).mean(axis=(1, 3)), atol=1e-6)


def test_decoding_works_in_a_spawned_process(tmp_path: Path) -> None:
    """Forked, LibRaw's OpenMP may hang; nothing of this project forks."""
    import multiprocessing

    path = photograph(tmp_path / "grey.dng", patches([(0.3,) * 3]), SensorModel(**QUIET))
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.apply(camera_white_balance, (path,)) == camera_white_balance(path)
    code = "\n".join(each.read_text() for each in Path(capture.__file__).parent.rglob("*.py"))
    assert "os.fork" not in code and "ProcessPoolExecutor" not in code and "multiprocessing.Pool" not in code

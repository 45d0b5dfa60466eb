"""RAW to linear light: known mosaics come back within their quantisation, real files agree with LibRaw's own conversion."""

from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float

from capture.photos.raw import camera_white_balance, decode_raw, read_raw_metadata
from datasets_scripts.dng_writer import ShotMetadata, write_dng
from datasets_scripts.sensor_model import SensorModel
from mrbokeh.errors import InputError
from mrbokeh.lens import Lens

REAL_FILES = {
    # name: (height, width) that LibRaw calls visible; the Kodak's 848 columns of pixels 1.535 wide make 1301 square ones
    "bmpcc_cup.dng": (1112, 1952),
    "canon_6d_lossy_linear.dng": (816, 1224),
    "canon_g2_0304.crw": (1720, 2312),
    "canon_g2_0313.crw": (1720, 2312),
    "canon_s40_0117.crw": (1720, 2312),
    "kodak_dc120.kdc": (976, 1301),
}
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
    assert np.abs(patch_means(decoded.rgb) - colours).max() < quantisation_error(sensor)
    assert not decoded.saturated.any()


def test_exposure_does_not_follow_the_brightest_pixel(tmp_path: Path) -> None:
    """With LibRaw's default (adjust_maximum_thr 0.75) the patch of 0.200 reads 0.25 when the frame's maximum is 0.80 of white."""
    sensor = SensorModel(**QUIET)
    for brightest in (0.70, 0.80, 0.90, 0.99):
        scene = patches([(0.2, 0.2, 0.2), (brightest,) * 3])
        decoded = decode_raw(photograph(tmp_path / "scene.dng", scene, sensor))
        assert patch_means(decoded.rgb)[0] == pytest.approx([0.2] * 3, abs=quantisation_error(sensor))


def test_highlights_above_white_are_kept(tmp_path: Path) -> None:
    """Raw red of 0.6, 0.8 and 0.95 of its range times the white balance's 2 is 1.2, 1.6 and 1.9 (camera primaries = Rec.709)."""
    from mrbokeh.color import rec709_from_XYZ

    camera_from_xyz = np.diag([0.5, 1.0, 0.625]) @ rec709_from_XYZ
    sensor = SensorModel(camera_from_xyz=tuple(map(tuple, np.round(camera_from_xyz, 4).tolist())), **QUIET)
    decoded = decode_raw(photograph(tmp_path / "red.dng", patches([(1.2, 0.5, 0.5), (1.6, 0.5, 0.5), (1.9, 0.5, 0.5)]), sensor))
    assert patch_means(decoded.rgb)[:, 0] == pytest.approx([1.2, 1.6, 1.9], abs=quantisation_error(sensor))
    assert not decoded.saturated.any()


def test_saturated_photosites_are_counted(tmp_path: Path) -> None:
    """White of 3 fills all channels (red has 0.5 of green's sensitivity: 1.5), grey of 0.5 none: two of four patches are full."""
    decoded = decode_raw(photograph(tmp_path / "full.dng", patches([(0.5,) * 3, (3.0,) * 3, (0.1,) * 3, (3.0,) * 3]), SensorModel(**QUIET)))
    assert decoded.saturated.mean() == pytest.approx(0.5)
    # A full photosite says "1.0 of white" in green, and camera white balance on top in red and blue.
    assert decoded.saturation_level == 1.0


def test_white_balance_given_from_outside_scales_the_channels(tmp_path: Path) -> None:
    path = photograph(tmp_path / "grey.dng", patches([(0.3,) * 3, (0.1, 0.2, 0.3)]), SensorModel(**QUIET))
    red, green, blue = camera_white_balance(path)
    assert (red, green, blue) == pytest.approx((2.0, 1.0, 1.6), abs=1e-3)
    same = decode_raw(path, (2 * red, 2 * green, 2 * blue))
    assert np.array_equal(same.rgb, decode_raw(path).rgb)
    warmer = patch_means(decode_raw(path, (1.1 * red, green, blue)).rgb)[0]
    assert warmer[0] > 1.1 * 0.3 > warmer[2]
    with pytest.raises(InputError, match="positive multipliers"):
        decode_raw(path, (0.0, 1.0, 1.0))


def test_orientation_is_left_alone(tmp_path: Path) -> None:
    import pyexiv2

    path = photograph(tmp_path / "upright.dng", patches([(0.1,) * 3, (0.4,) * 3]), SensorModel(**QUIET))
    as_stored = decode_raw(path).rgb
    with pyexiv2.Image(str(path)) as image:
        image.modify_exif({"Exif.Image.Orientation": "6"})
    assert np.array_equal(decode_raw(path).rgb, as_stored)


def test_half_size_keeps_the_light(tmp_path: Path) -> None:
    sensor = SensorModel(**QUIET)
    path = photograph(tmp_path / "patches.dng", patches([(0.2, 0.3, 0.4), (0.5, 0.2, 0.1)]), sensor)
    half = decode_raw(path, half_size=True)
    assert half.rgb.shape == (PATCH_PX // 2, PATCH_PX, 3)
    assert half.rgb[6:10, 6:10].mean(axis=(0, 1)) == pytest.approx([0.2, 0.3, 0.4], abs=quantisation_error(sensor))


@pytest.mark.parametrize("name", REAL_FILES)
def test_real_files_agree_with_libraws_own_colours(shared_data: Path, name: str) -> None:
    """LibRaw converts to sRGB primaries too, clipping at 0 and white: between, both agree to a step or two of its 16 bit.

    Nearly full channels (from 95 %) are left out: `neutral_where_full` changes them on purpose.
    """
    import rawpy

    path = shared_data / "raw" / name
    decoded = decode_raw(path, half_size=True)
    assert decoded.white_balance is not None
    red, green, blue = decoded.white_balance
    largest = max(decoded.white_balance)
    converted = {}
    for space in (rawpy.ColorSpace.raw, rawpy.ColorSpace.sRGB):
        with rawpy.imread(str(path)) as raw:
            pixels = raw.postprocess(
                user_wb=[red, green, blue, green], output_color=space, gamma=(1, 1), output_bps=16, no_auto_bright=True,
                adjust_maximum_thr=0.0, highlight_mode=rawpy.HighlightMode.Ignore, user_flip=0, half_size=True,
            )  # fmt: skip
        converted[space] = pixels.astype(np.float32) / 65535.0 * largest
    theirs = converted[rawpy.ColorSpace.sRGB]
    unclipped = np.all((theirs > 0.001) & (theirs < 0.999 * largest), axis=-1)
    unclipped &= np.all(converted[rawpy.ColorSpace.raw] < 0.949 * np.array(decoded.white_balance), axis=-1)
    assert np.count_nonzero(unclipped) > 20000
    assert np.abs(decoded.rgb - theirs)[unclipped].max() < 2.5 * largest / 65535.0


@pytest.mark.parametrize(("name", "size"), REAL_FILES.items())
def test_real_files_decode_whole(shared_data: Path, name: str, size: tuple[int, int]) -> None:
    decoded = decode_raw(shared_data / "raw" / name)
    assert decoded.rgb.shape == (*size, 3)
    assert np.isfinite(decoded.rgb).all()
    # Nothing is clipped at 1, and nothing exceeds what the raw range, white balance and matrix allow.
    assert 0.3 < decoded.rgb.max() < 5.0
    if name == "canon_s40_0117.crw":
        assert np.count_nonzero(decoded.saturated) == 2  # photosites at 1023 of 1023 in the mosaic
    if name == "bmpcc_cup.dng":
        assert not decoded.saturated.any()  # 22473 is its largest number, 51080 white


def test_odd_files_say_what_is_odd(shared_data: Path) -> None:
    assert any("without a mosaic" in remark for remark in decode_raw(shared_data / "raw" / "canon_6d_lossy_linear.dng").remarks)
    kodak = decode_raw(shared_data / "raw" / "kodak_dc120.kdc")
    assert any("square pixels" in remark for remark in kodak.remarks)
    assert any("no white balance" in remark for remark in kodak.remarks)
    # The DC120's picture is 4:3.
    assert kodak.rgb.shape[1] / kodak.rgb.shape[0] == pytest.approx(4 / 3, abs=0.002)


def test_greys_of_a_colour_chart_stay_grey(shared_data: Path) -> None:
    """White balance from the chart's fourth patch (N6.5): it must be exactly neutral, N8 and N5 beside it nearly.

    Centres were read off the picture. The chart's maker states |a*|, |b*| up to 0.73 for these patches, which is up to
    1.6 % in R/G or B/G, and lets a chart be off by a colour difference of 1 (about 2 %).
    """
    import rawpy

    path = shared_data / "raw" / "canon_g2_0304.crw"
    areas = [np.s_[1236:1356, x - 60 : x + 60] for x in (656, 988, 1328)]
    with rawpy.imread(str(path)) as raw:
        share = (raw.raw_image_visible[areas[1]] - 32.0) / (1023.0 - 32.0)
        colours = raw.raw_colors_visible[areas[1]]
    red, green, blue = (share[np.isin(colours, channel)].mean() for channel in ([0], [1, 3], [2]))
    rgb = decode_raw(path, (green / red, 1.0, green / blue)).rgb
    n8, n65, n5 = (rgb[area].mean(axis=(0, 1)) for area in areas)
    assert n65 == pytest.approx([green] * 3, rel=0.002)
    for patch in (n8, n5):
        assert patch / patch[1] == pytest.approx([1.0] * 3, abs=0.03)


@pytest.mark.parametrize(("name", "share"), [("canon_g2_0304.crw", 0.5), ("kodak_dc120.kdc", 0.9), ("bmpcc_cup.dng", 0.95)])
def test_truncated_files_are_refused(shared_data: Path, tmp_path: Path, name: str, share: float) -> None:
    data = (shared_data / "raw" / name).read_bytes()
    path = tmp_path / name
    path.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(InputError, match=r"cannot be decoded|cut short"):
        decode_raw(path)


def test_missing_tiles_that_libraw_passes_over_are_refused(shared_data: Path, tmp_path: Path) -> None:
    """Without its last percent LibRaw decodes this file with 3 % of its pixels wrong and says nothing."""
    data = (shared_data / "raw" / "canon_6d_lossy_linear.dng").read_bytes()
    path = tmp_path / "short.dng"
    path.write_bytes(data[: int(len(data) * 0.99)])
    with pytest.raises(InputError, match="cut short"):
        decode_raw(path)


def test_what_is_not_raw_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "text.dng"
    path.write_text("no photograph\n" * 50)
    with pytest.raises(InputError, match="cannot be decoded"):
        decode_raw(path)
    with pytest.raises(InputError, match="no such file"):
        decode_raw(tmp_path / "absent.dng")
    assert read_raw_metadata(path).focal_length_mm is None

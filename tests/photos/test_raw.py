"""RAW to linear light: known mosaics come back within their quantisation, files of cameras agree with LibRaw's own conversion."""

from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float

import capture
from capture.photos.developing import develop
from capture.photos.raw import DecodedPhoto, camera_white_balance, decode_in_one_thread, decode_raw, read_raw_metadata
from datasets_scripts.made_sets.simulated_camera import SensorModel, ShotMetadata, write_dng
from mrbokeh.images.color import convert, rec709_from_XYZ
from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError
from tests.support.made_photographs import set_exif
from tests.support.refusals import refused

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
    refused("positive multipliers", decode_raw, path, (0.0, 1.0, 1.0))


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
    refused("cannot be decoded", decode_raw, path)
    refused("no such file", decode_raw, tmp_path / "absent.dng")
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


X_TRANS = np.array([[1, 1, 0, 1, 1, 2], [1, 1, 2, 1, 1, 0], [2, 0, 1, 0, 2, 1], [1, 1, 2, 1, 1, 0], [1, 1, 0, 1, 1, 2], [0, 2, 1, 2, 0, 1]])


def write_tiff_raw(path: Path, values: np.ndarray, photometric: int, cfa: np.ndarray | None = None, compression: int | None = None) -> None:
    """A bare DNG of 14 bits without black level, whose camera sees Rec.709 as it is, white balance 1.

    compression: a number to write into the finished file's tag, whatever the pixels are."""
    import tifffile

    tags = [
        (50706, "B", 4, bytes([1, 4, 0, 0]), True),
        (50707, "B", 4, bytes([1, 1, 0, 0]), True),
        (50708, "s", 0, "mrbokeh test", True),
        (50717, "I", 1 if cfa is not None else 3, 16383 if cfa is not None else (16383,) * 3, True),
        (50721, "2i", 9, [part for each in rec709_from_XYZ.ravel() for part in (round(each * 10000), 10000)], True),
        (50728, "2I", 3, [1, 1, 1, 1, 1, 1], True),
        (50778, "H", 1, 21, True),
    ]
    if cfa is not None:
        tags += [(33421, "H", 2, cfa.shape, True), (33422, "B", cfa.size, cfa.astype(np.uint8).tobytes(), True)]
    tifffile.imwrite(path, values, photometric=photometric, metadata=None, extratags=tags, subfiletype=0, rowsperstrip=len(values))
    if compression is not None:
        with tifffile.TiffFile(path, mode="r+") as file:
            file.pages[0].tags["Compression"].overwrite(compression)


def test_x_trans_comes_out_the_same_every_time(tmp_path: Path) -> None:
    """Two halves of known colour and noise between; LibRaw needs at least 512 px. In this process, with two threads or more,
    about a thousand samples of such a picture differ from run to run."""
    rng = np.random.default_rng(3)
    rgb = np.empty((516, 540, 3))
    rgb[:, :200], rgb[:, 200:340], rgb[:, 340:] = (0.2, 0.4, 0.3), rng.random((516, 140, 3)), (0.5, 0.1, 0.2)
    colours = np.tile(X_TRANS, (86, 90))
    mosaic = np.take_along_axis(rgb, colours[..., None], axis=2)[..., 0]
    path = tmp_path / "x_trans.dng"
    write_tiff_raw(path, np.round(mosaic * 16383).astype(np.uint16), 32803, X_TRANS)
    first, second = decode_raw(path), decode_raw(path)
    assert np.array_equal(first.rgb, second.rgb)
    assert np.abs(first.rgb[10:-10, 10:180] - (0.2, 0.4, 0.3)).max() < 0.5 / 16383 + 1.0 / 65535
    assert np.abs(first.rgb[10:-10, 360:-10] - (0.5, 0.1, 0.2)).max() < 0.5 / 16383 + 1.0 / 65535
    path.write_bytes(path.read_bytes()[:300000])
    refused("cut short", decode_raw, path)


def test_errors_of_the_process_for_x_trans_come_back(tmp_path: Path) -> None:
    (tmp_path / "text.raf").write_text("no photograph\n" * 50)
    refused(r"text\.raf cannot be decoded as RAW", decode_in_one_thread, tmp_path / "text.raf", None, False)


def test_rgb_without_a_mosaic_is_taken_as_it_is(tmp_path: Path) -> None:
    """LinearRaw, as in sRAW and reduced DNG, unfiltered even where it is noise: half a step of 14 bit and a step of LibRaw's 16 bit."""
    rgb = np.random.default_rng(1).random((48, 64, 3)) * 0.9
    rgb[20, 30] = 1.0
    write_tiff_raw(tmp_path / "linear.dng", np.round(rgb * 16383).astype(np.uint16), 34892)
    decoded = decode_raw(tmp_path / "linear.dng")
    assert np.abs(decoded.rgb[:15] - rgb[:15]).max() < 0.5 / 16383 + 1.0 / 65535
    assert decoded.photosites.full == 1
    assert decoded.saturated[18:23, 28:33].all() and decoded.saturated.sum() == 25
    assert any("without a mosaic" in remark for remark in decoded.remarks)


def test_gopro_files_get_a_clear_line(tmp_path: Path) -> None:
    """GPR is a DNG in VC-5 (TIFF compression 9), whose decoder LibRaw does not bring."""
    bayer = np.array([[0, 1], [1, 2]])
    write_tiff_raw(tmp_path / "hero.gpr", np.full((64, 96), 5000, np.uint16), 32803, bayer, compression=9)
    with pytest.raises(InputError, match=r"hero\.gpr cannot be decoded as RAW: GoPro's GPR needs .* convert it with Adobe DNG Converter"):
        decode_raw(tmp_path / "hero.gpr")


REAL_FILES = {
    # name: (height, width) that LibRaw calls visible; the Kodak's 848 columns of pixels 1.535 wide make 1301 square ones
    "bmpcc_cup.dng": (1112, 1952),
    "canon_6d_lossy_linear.dng": (816, 1224),
    "canon_g2_0304.crw": (1720, 2312),
    "canon_g2_0313.crw": (1720, 2312),
    "canon_s40_0117.crw": (1720, 2312),
    "kodak_dc120.kdc": (976, 1301),
}


@pytest.mark.parametrize("name", REAL_FILES)
def test_real_files_agree_with_libraws_own_colours(shared_data: Path, name: str) -> None:
    """LibRaw converts to sRGB primaries too, clipping at 0 and white: between, both agree to a step or two of its 16 bit.

    Nearly full channels (from 95 %) are left out: `neutral_where_full` changes them on purpose.
    """
    import rawpy

    path = shared_data / "raw" / name
    decoded = decode_raw(path, half_size=True)
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
    assert np.abs(rec709(decoded) - theirs)[unclipped].max() < 2.5 * largest / 65535.0


@pytest.mark.slow
@pytest.mark.parametrize(("name", "size"), REAL_FILES.items(), ids=REAL_FILES)
def test_real_files_decode_whole(shared_data: Path, name: str, size: tuple[int, int]) -> None:
    decoded = decode_raw(shared_data / "raw" / name)
    assert decoded.rgb.shape == (*size, 3)
    assert np.isfinite(decoded.rgb).all()
    # Nothing is clipped at 1, and nothing exceeds what the raw range, white balance and matrix allow.
    assert 0.3 < decoded.rgb.max() < 5.0
    if name == "canon_s40_0117.crw":
        assert decoded.photosites.full == 2  # photosites at 1023 of 1023 in the mosaic
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
    rgb = rec709(decode_raw(path, (green / red, 1.0, green / blue), half_size=True))  # of areas; demosaicking takes 2 s and tells no more
    n8, n65, n5 = (rgb[rows.start // 2 : rows.stop // 2, at.start // 2 : at.stop // 2].mean(axis=(0, 1)) for rows, at in areas)
    assert n65 == pytest.approx([green] * 3, rel=0.002)
    for patch in (n8, n5):
        assert patch / patch[1] == pytest.approx([1.0] * 3, abs=0.03)


@pytest.mark.parametrize(
    ("name", "share", "said"),
    [
        ("canon_g2_0304.crw", 0.5, "cannot be decoded|cut short"),
        ("kodak_dc120.kdc", 0.9, "cannot be decoded|cut short"),
        ("bmpcc_cup.dng", 0.95, "cannot be decoded|cut short"),
        # Without its last percent LibRaw decodes this file with 3 % of its pixels wrong and says nothing.
        ("canon_6d_lossy_linear.dng", 0.99, "cut short"),
    ],
)
def test_truncated_files_are_refused(shared_data: Path, tmp_path: Path, name: str, share: float, said: str) -> None:
    data = (shared_data / "raw" / name).read_bytes()
    (tmp_path / name).write_bytes(data[: int(len(data) * share)])
    refused(said, decode_raw, tmp_path / name)

"""Real RAW files: they agree with LibRaw's own conversion, odd ones say what is odd, damaged ones are refused."""

from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float

from capture.photos.raw import DecodedPhoto, decode_raw
from mrbokeh.images.color import convert
from mrbokeh.system.errors import InputError

REAL_FILES = {
    # name: (height, width) that LibRaw calls visible; the Kodak's 848 columns of pixels 1.535 wide make 1301 square ones
    "bmpcc_cup.dng": (1112, 1952),
    "canon_6d_lossy_linear.dng": (816, 1224),
    "canon_g2_0304.crw": (1720, 2312),
    "canon_g2_0313.crw": (1720, 2312),
    "canon_s40_0117.crw": (1720, 2312),
    "kodak_dc120.kdc": (976, 1301),
}


def rec709(decoded: DecodedPhoto) -> Float[np.ndarray, "height width 3"]:
    return convert(decoded.rgb, np.array(decoded.rec709_from_camera))


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


@pytest.mark.parametrize(
    ("name", "size"),
    [pytest.param(*each, marks=pytest.mark.slow if each[0].startswith("canon_g2") else ()) for each in REAL_FILES.items()],
    ids=REAL_FILES,
)
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
    rgb = rec709(decode_raw(path, (green / red, 1.0, green / blue)))
    n8, n65, n5 = (rgb[area].mean(axis=(0, 1)) for area in areas)
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
    with pytest.raises(InputError, match=said):
        decode_raw(tmp_path / name)

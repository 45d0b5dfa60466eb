"""TIFF gives what its file stores: not turned, and colour that is not multiplied by alpha."""

from pathlib import Path

import numpy as np
import pytest
import tifffile

from mrbokeh.images.exif import stored_orientation, tiff_tags
from mrbokeh.images.picture_codec import stored_pixels, stored_rgb, write_stored

SHADES = (np.uint8, np.uint16, np.float32)


def written(path: Path, rgba: np.ndarray, extra: str | None, orientation: int = 1) -> Path:
    """By tifffile, whose TIFFs have the tags that one asks for."""
    kinds = {} if extra is None else {"extrasamples": [extra]}
    tifffile.imwrite(path, rgba, photometric="rgb", extratags=[(274, 3, 1, orientation, True)], **kinds)
    return path


def shade(dtype: type) -> np.ndarray:
    top = 1 if dtype is np.float32 else np.iinfo(dtype).max
    return (np.random.default_rng(3).uniform(0.1, 1.0, (2, 3, 4)) * top).astype(dtype)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("dtype", SHADES)
def test_it_is_not_turned(tmp_path: Path, dtype: type, orientation: int) -> None:
    """OpenCV turns TIFFs by itself, whatever it is asked."""
    rgb = shade(dtype)[..., :3]
    path = written(tmp_path / "a.tif", rgb, None, orientation)
    np.testing.assert_array_equal(stored_pixels(path)[..., ::-1], rgb)
    assert stored_orientation(path) == orientation


@pytest.mark.parametrize("orientation", [1, 6])
@pytest.mark.parametrize("dtype", SHADES)
@pytest.mark.parametrize("extra", ["unassalpha", "unspecified"])
def test_straight_colour_stays_straight(tmp_path: Path, dtype: type, extra: str, orientation: int) -> None:
    """libtiff's reader of RGBA multiplies 8 bits by alpha: half covered 200 came as 100."""
    rgba = shade(dtype)
    stored = stored_pixels(written(tmp_path / "a.tif", rgba, extra, orientation))
    np.testing.assert_array_equal(stored[..., [2, 1, 0, 3]], rgba)


@pytest.mark.parametrize("dtype", SHADES)
def test_colour_that_is_multiplied_is_divided(tmp_path: Path, dtype: type) -> None:
    rgba = shade(dtype)
    rgba[0, 0] = 0
    top = 1.0 if dtype is np.float32 else float(np.iinfo(dtype).max)
    rgba[..., :3] = rgba[..., :3] * (rgba[..., 3:] / top)
    stored = stored_pixels(written(tmp_path / "a.tif", rgba, "assocalpha"))[..., [2, 1, 0, 3]]
    assert not stored[0, 0].any()
    np.testing.assert_array_equal(stored[..., 3], rgba[..., 3])
    # Half a code of what is stored, and half a one of the quotient.
    np.testing.assert_allclose(stored[..., :3] * (stored[..., 3:] / top), rgba[..., :3], atol=1e-6 * top if dtype is np.float32 else 1.0)


@pytest.mark.parametrize("size", [(2, 3), (5, 7), (61, 33)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_what_is_written_says_that_its_alpha_is_straight(tmp_path: Path, dtype: type, size: tuple[int, int]) -> None:
    """As tifffile reads it, whose parser is its own; without the tag other programs guess, and some multiply."""
    rgba = np.random.default_rng(5).integers(0, np.iinfo(dtype).max, (*size, 4)).astype(dtype)
    write_stored(tmp_path / "a.tif", rgba)
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        assert [int(each) for each in file.pages[0].extrasamples] == [2] and len(file.pages) == 1
        codes = [tag.code for tag in file.pages[0].tags]
        assert codes == sorted(codes)
    np.testing.assert_array_equal(stored_rgb(tmp_path / "a.tif"), rgba)
    write_stored(tmp_path / "b.tif", rgba[..., :3])
    assert 338 not in tiff_tags(tmp_path / "b.tif")


def test_tags_of_any_tiff_and_of_none(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, shade(np.float32), photometric="rgb", bigtiff=True, extratags=[(274, 3, 1, 5, True)])
    assert tiff_tags(path)[274] == 5
    (tmp_path / "cut.tif").write_bytes(path.read_bytes()[:20])
    (tmp_path / "other.tif").write_bytes(b"no picture at all")
    assert tiff_tags(tmp_path / "cut.tif") == tiff_tags(tmp_path / "other.tif") == tiff_tags(tmp_path / "absent.tif") == {}

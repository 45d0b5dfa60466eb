"""RAW that is no Bayer mosaic: X-Trans, pictures without a mosaic, GoPro's."""

from pathlib import Path

import numpy as np
import pytest

from capture.photos.raw import decode_in_one_thread, decode_raw
from mrbokeh.images.color import rec709_from_XYZ
from mrbokeh.system.errors import InputError

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
    with pytest.raises(InputError, match="cut short"):
        decode_raw(path)


def test_errors_of_the_process_for_x_trans_come_back(tmp_path: Path) -> None:
    (tmp_path / "text.raf").write_text("no photograph\n" * 50)
    with pytest.raises(InputError, match=r"text\.raf cannot be decoded as RAW"):
        decode_in_one_thread(tmp_path / "text.raf", None, False)


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

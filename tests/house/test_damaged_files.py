"""Damaged and too new files end in our one sentence: with the whole path, and without the words of the libraries below."""

import re
import struct
import zlib
from contextlib import ExitStack
from pathlib import Path

import cv2
import numpy as np
import pytest

from mrbokeh.images.image_io import read_image, write_image
from mrbokeh.images.picture_codec import quiet_opencv, without_chatter
from mrbokeh.renderers.onnx_sessions import open_session
from mrbokeh.scene.gltf.gltf_loader import load_glb
from mrbokeh.system.errors import InputError
from tests.scenes.command_line import mrbokeh

RNG = np.random.default_rng(0)
SIGNATURE_AND_HEADER = 8 + 25


def chunk(kind: bytes, data: bytes, wrong: int = 0) -> bytes:
    """PNG specification, section 5.3: length, type, data, CRC of type and data."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data) ^ wrong)


@pytest.fixture
def stored(tmp_path: Path) -> bytes:
    write_image(tmp_path / "whole.png", RNG.random((24, 32, 3)).astype(np.float32))
    return (tmp_path / "whole.png").read_bytes()


def test_libpng_says_nothing_beside_us(stored: bytes, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Cut off, without its end, with a flipped bit amid it or a wrong head; capfd sees what C writes to the file descriptor."""
    half = len(stored) // 2
    flipped = stored[:half] + bytes([stored[half] ^ 255]) + stored[half + 1 :]
    for damaged in (stored[:half], stored[:-12], flipped, stored[:20] + b"\xff" + stored[21:]):
        (tmp_path / "odd.png").write_bytes(damaged)
        with pytest.raises(InputError, match=r"odd\.png cannot be read as a picture: it is damaged"):
            read_image(tmp_path / "odd.png")
        assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("suffix", [".tif", ".jpg", ".webp", ".hdr"])
def test_neither_do_opencv_and_the_other_libraries(suffix: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    codes = RNG.integers(0, 256, (48, 64, 3), np.uint8)
    whole = cv2.imencode(suffix, codes.astype(np.float32) if suffix == ".hdr" else codes)[1].tobytes()
    (tmp_path / f"odd{suffix}").write_bytes(whole[: len(whole) // 2])
    before = cv2.utils.logging.getLogLevel()
    with pytest.raises(InputError, match="it is damaged"):
        read_image(tmp_path / f"odd{suffix}")
    assert capfd.readouterr() == ("", "") and cv2.utils.logging.getLogLevel() == before


def test_opencv_is_quiet_until_the_last_thread_is_done() -> None:
    before, level, first = cv2.utils.logging.getLogLevel(), cv2.utils.logging.getLogLevel, ExitStack()
    first.enter_context(quiet_opencv())
    with quiet_opencv():
        first.close()
        assert before != 0 and level() == cv2.utils.logging.LOG_LEVEL_SILENT
    assert level() == before


def test_chunks_that_libpng_warns_of_change_no_pixel(stored: bytes, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A broken colour profile and a comment with a wrong CRC, as some programs write them."""
    odd = chunk(b"iCCP", b"sRGB\0\0" + zlib.compress(b"no profile")) + chunk(b"tEXt", b"x", wrong=1)
    (tmp_path / "odd.png").write_bytes(stored[:SIGNATURE_AND_HEADER] + odd + stored[SIGNATURE_AND_HEADER:])
    np.testing.assert_array_equal(read_image(tmp_path / "odd.png"), read_image(tmp_path / "whole.png"))
    assert capfd.readouterr() == ("", "")


def test_palettes_and_their_transparency_stay(tmp_path: Path) -> None:
    """PLTE and tRNS say what the pixels are; a picture without anything to leave out is passed on as it is."""
    from PIL import Image

    picture = Image.fromarray(np.array([[0, 1], [1, 2]], np.uint8), "P")
    picture.putpalette([255, 0, 0, 0, 255, 0, 0, 0, 255])
    picture.save(tmp_path / "palette.png", transparency=bytes([0, 255, 255]))
    np.testing.assert_allclose(read_image(tmp_path / "palette.png")[0], [[1, 0, 0], [0, 1, 0]])
    data = np.fromfile(tmp_path / "palette.png", np.uint8)
    assert without_chatter(data) is data
    no_png = np.frombuffer(b"\xff\xd8\xff", np.uint8)
    assert without_chatter(no_png) is no_png, "what is no PNG is none of its business"


@pytest.mark.parametrize(("ir_version", "opset", "words"), [(99, 17, "IR version 99"), (8, 99, "opset 99")])
def test_a_network_newer_than_the_runtime(ir_version: int, opset: int, words: str, tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    helper, one = onnx.helper, onnx.TensorProto.FLOAT
    ends = [helper.make_tensor_value_info(name, one, [1]) for name in "xy"]
    graph = helper.make_graph([helper.make_node("Relu", ["x"], ["y"])], "graph", ends[:1], ends[1:])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)])
    model.ir_version = ir_version
    (tmp_path / "new.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(InputError) as told:
        open_session(tmp_path / "new.onnx")
    said = str(told.value)
    assert str(tmp_path / "new.onnx") in said and words in said and "reads up to" in said and "export it again" in said
    assert "onnxruntime_src" not in said and "FAIL" not in said


def test_a_damaged_glb_is_named_by_its_whole_path(tmp_path: Path) -> None:
    path = tmp_path / "cake.glb"
    for damaged_glb in (b"not a model at all, but long enough", b"glTF\x02\0\0\0"):
        path.write_bytes(damaged_glb)
        with pytest.raises(InputError, match=f"{re.escape(str(path))}.*not a readable glTF"):
            load_glb(path)


def test_nothing_is_said_by_a_command_but_our_line(stored: bytes, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "odd.png").write_bytes(stored[:-40])
    done = mrbokeh("check", tmp_path / "odd.png")
    assert "odd.png" in done.stderr + done.stdout and capfd.readouterr() == ("", "")

"""What users get wrong on any day, damaged and too new files: one sentence says what was expected, with the whole path and without the
words of libraries, the code is 2, and nothing that they have is lost."""

import io
import os
import re
import signal
import struct
import sys
import zlib
from contextlib import ExitStack
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest

from mrbokeh import cli
from mrbokeh.checks.checked_picture import open_shot
from mrbokeh.checks.picture_checks import CheckReport, check_numbers
from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.images.image_io import read_image, read_layer, write_image, write_layer
from mrbokeh.images.layer import Layer
from mrbokeh.images.picture_codec import quiet_opencv, without_chatter
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import read_lens, write_lens
from mrbokeh.renderers.onnx_sessions import open_session
from mrbokeh.scene.gltf.gltf_loader import load_glb
from mrbokeh.system.errors import InputError, mistake_in
from mrbokeh.video.writer import VideoWriter
from tests.support.command_line import mrbokeh, printed_by
from tests.support.refusals import refused
from viewfinder.cli import board_command

RNG = np.random.default_rng(0)


def said(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *arguments: object) -> tuple[int, str]:
    """(exit code, what was said) of a command in this process."""
    monkeypatch.setattr(sys, "argv", ["mrbokeh", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    told = capsys.readouterr()
    return int(stop.value.code or 0), " ".join((told.out + told.err).split())


def refusal(*arguments: object) -> str:
    """What a command says that ends with code 2."""
    done = mrbokeh(*arguments)
    assert done.returncode == 2
    return " ".join((done.stdout + done.stderr).split())


@pytest.fixture
def card(tmp_path: Path) -> Path:
    """A white card of 16 x 12 px, 2 m away, in 32 x 24 px; lens.json beside it."""
    write_lens(tmp_path / "lens.json", Lens(50.0, 1.8, 1.0, 36.0))
    alpha = np.zeros((24, 32), np.float32)
    alpha[6:18, 8:24] = 1.0
    depth_m = np.where(alpha > 0, 2.0, np.inf).astype(np.float32)
    write_layer(tmp_path / "card.exr", Layer(np.repeat(alpha[..., None], 3, 2), alpha, depth_m))
    return tmp_path / "card.exr"


def test_an_empty_picture_is_said_to_be_empty_and_a_cut_off_exr_is_not_called_deep(tmp_path: Path) -> None:
    for name in ("empty.png", "empty.jpg", "empty.tif", "empty.hdr"):
        (tmp_path / name).touch()
        refused(f"{name} is empty", read_image, tmp_path / name)
    write_exr(tmp_path / "whole.exr", ExrPart({name: RNG.random((64, 64)).astype(np.float32) for name in "RGB"}))
    stored = (tmp_path / "whole.exr").read_bytes()
    (tmp_path / "cut.exr").write_bytes(stored[: len(stored) // 2])
    refused("missing or damaged", read_layer, tmp_path / "cut.exr")


def test_what_is_read_is_never_written_over(card: Path) -> None:
    """Neither under its name nor through a link, with --overwrite or without."""
    link, plate, lens = card.with_name("link.exr"), card.with_name("plate.png"), card.with_name("lens.json")
    link.symlink_to(card)
    write_image(plate, RNG.random((24, 32, 3)).astype(np.float32))
    before = {path: path.read_bytes() for path in (card, plate, lens)}
    plan = ("capture", "plan", lens, "--near", 0.5, "--far", 3, "--image-width", 600, "--out", lens, "--overwrite")
    renders = (("render", "--layer", card, "--lens", lens, "--out", out, "--overwrite") for out in (card, link))
    for words in (*renders, ("check", plate, "--against", plate, "--leaks", plate), plan):
        assert "is read and would be written over" in refusal(*words)
    assert "--leaks: expected a name that ends in .png" in refusal("check", card, "--against", card, "--leaks", card)
    assert "--log" in refusal("lens", "coc", lens, 1, "--log", lens)
    assert {path: path.read_bytes() for path in before} == before


def test_numbers_that_say_nothing_are_refused(card: Path) -> None:
    photo, out = card.with_name("photo.png"), card.with_name("out.png")
    write_image(photo, RNG.random((24, 32, 3)).astype(np.float32))
    alone = refusal("composite", photo, "--layer", card, "--lens", card.with_name("lens.json"), "--disparity", "1:9", "--out", out)
    assert "--disparity 1:9 says what the numbers of a --depth file mean" in alone
    assert "--far" in printed_by(board_command, "--far", 0, "--out", card.with_name("board.pdf"), exit_code=2)


def test_f_numbers_are_taken_as_they_are_written_on_lenses(tmp_path: Path) -> None:
    for text in ("f/1.4", "F1.4", "f1.4", "1.4"):
        words = ("--focal-length", 50, "--f-number", text, "--focus", 2, "--overwrite")
        assert mrbokeh("lens", "new", tmp_path / "lens.json", *words).returncode == 0
        assert read_lens(tmp_path / "lens.json").f_number == 1.4
    assert "expected a number, got 'fast'" in refusal("lens", "new", tmp_path / "no.json", "--f-number", "fast")


def test_a_name_with_spaces_wants_quotes() -> None:
    assert "(iPhone 6.jpg); a name with spaces needs quotes" in refusal("composite", "My", "iPhone", "6.jpg", "--out", "out.png")


def test_two_results_need_two_names(card: Path) -> None:
    photo, out = card.with_name("photo.png"), card.with_name("out.png")
    write_image(photo, RNG.random((24, 32, 3)).astype(np.float32))
    told = refusal("transfer", photo, "--depth", card, "--lens", card.with_name("lens.json"), "--out", out, "--sheet", out)
    assert "named for two results" in told and not out.exists()


@pytest.mark.parametrize(("channel", "value", "words"), [("R", np.nan, "colour is NaN in 1 place:"), ("Z", -2.0, "turn the sign")])
def test_layers_that_cannot_be_meant(card: Path, channel: str, value: float, words: str) -> None:
    """One pixel that is no number; distances along -z, as cameras of Maya and Houdini count them."""
    layer = read_layer(card)
    planes = {name: layer.rgb[..., i].copy() for i, name in enumerate("RGB")} | {"A": layer.alpha, "Z": np.zeros_like(layer.alpha)}
    planes[channel][layer.alpha > 0 if channel == "Z" else (3, 4)] = value
    odd, out = card.with_name("odd.exr"), card.with_name("out.exr")
    write_exr(odd, ExrPart(planes))
    assert words in refusal("render", "--layer", odd, "--lens", card.with_name("lens.json"), "--out", out) and not out.exists()


def test_the_system_s_refusals_are_sentences(card: Path) -> None:
    """A folder where a file should be, and a file where a folder should be."""
    assert "it is a folder" in refusal("render", "--layer", card, "--lens", card.parent, "--out", card.with_name("out.exr"))
    told = refusal("lens", "new", card / "lens.json", "--focal-length", 50, "--f-number", 2, "--focus", 1)
    assert "Traceback" not in told and str(card) in told
    refused = PermissionError(13, "Permission denied", str(card.with_name(".out.77.part.exr")))
    assert mistake_in(refused).startswith(f"{card.parent}: permission denied")


def test_an_interrupt_that_became_another_error_is_still_an_interrupt(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """As numba's compiler turns it into one of its own; without an interrupt it is a fault, and said to be one."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))

    def interrupted(**_: object) -> None:
        try:
            os.kill(os.getpid(), signal.SIGINT)
            signal.pause()
        except KeyboardInterrupt:
            raise RuntimeError("no compiled object yet") from None

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        monkeypatch.setattr(cli, "app", interrupted)
        assert mrbokeh().returncode == 130
        monkeypatch.setattr(cli, "app", Mock(side_effect=RuntimeError("a mistake of ours")))
        done = mrbokeh()
        assert done.returncode == 1 and "a mistake of ours" in done.stderr
    finally:
        signal.signal(signal.SIGINT, before)


def test_an_untouched_clip_has_no_negative_light(tmp_path: Path) -> None:
    """Saturated colours on black in H.264: rounding of chroma brings channels below 0 where nothing is wrong."""
    rng, path = np.random.default_rng(3), tmp_path / "clip.mp4"
    picture = np.zeros((64, 96, 3), np.float32)
    for _ in range(40):
        y, x = rng.integers(0, 56), rng.integers(0, 88)
        picture[y : y + 8, x : x + 8] = np.eye(3)[rng.integers(3)] * rng.uniform(0.05, 1.0)
    with VideoWriter(path, 96, 64) as writer:
        for index in range(3):
            writer.write(picture, index / 25)
    report, lowest = CheckReport(), 0.0
    for each in open_shot(path).pictures():
        assert not isinstance(each, str)
        lowest = min(lowest, float(each.rgb.min()))
        check_numbers(report, each, None)
    assert lowest < -1e-4 and not report.findings


def test_strong_colours_of_a_camera_are_not_negative_light(tmp_path: Path) -> None:
    """BT.2020's green is (-0.59, 1.13, -0.10) in Rec.709 (ITU-R BT.2087); what no colour of BT.2020 has is found."""
    for colour, findings in (((-0.58, 1.12, -0.09), 0), ((-0.02, 0.001, 0.001), 1), ((-0.9, 0.6, 0.3), 1)):
        picture = np.full((8, 8, 3), 0.2, np.float32)
        picture[3, 4] = colour
        write_image(tmp_path / "out.exr", picture, half=False)
        report = CheckReport()
        check_numbers(report, next(iter(open_shot(tmp_path / "out.exr").pictures())), None)
        assert len(report.findings) == findings, colour


def test_training_is_not_poured_into_a_folder_of_other_things(card: Path) -> None:
    """Such as the data set itself, or a folder of photographs. A network goes into an .onnx file."""
    folder, run = card.parent, card.parent / "run"
    before = sorted(folder.iterdir())
    assert "holds no training run" in refusal("train", "fit", folder, "--out", folder)
    told = refusal("train", "fit", folder / "nix", "--out", run)
    assert "there is no folder" in told and "reading" not in told
    told = refusal("train", "export", folder, "--out", folder / "checkpoint.pt", "--overwrite")
    assert "--out: expected a name that ends in .onnx" in told
    for name, value in (("batch", "-3"), ("learning_rate", "nan"), ("learning_rate", "-1"), ("crops_per_picture", "0")):
        assert f"{name} must be" in refusal("train", "fit", folder, "--out", run, "--set", f"{name}={value}")
    assert sorted(folder.iterdir()) == before


def test_a_board_that_cannot_be_meant_is_told_before_hours_of_work(card: Path) -> None:
    for option, value in (("--board", "8by6"), ("--distance", "a,b,0.2,3")):
        told = refusal("capture", "process", card.parent, "--out", card.parent / "scene", option, value)
        assert option in told and not (card.parent / "scene").exists()


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
        refused(r"odd\.png cannot be read as a picture: it is damaged", read_image, tmp_path / "odd.png")
        assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("suffix", [".tif", ".jpg", ".webp", ".hdr"])
def test_neither_do_opencv_and_the_other_libraries(suffix: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    codes = RNG.integers(0, 256, (48, 64, 3), np.uint8)
    whole = cv2.imencode(suffix, codes.astype(np.float32) if suffix == ".hdr" else codes)[1].tobytes()
    (tmp_path / f"odd{suffix}").write_bytes(whole[: len(whole) // 2])
    before = cv2.utils.logging.getLogLevel()
    refused("it is damaged", read_image, tmp_path / f"odd{suffix}")
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
        refused(f"{re.escape(str(path))}.*not a readable glTF", load_glb, path)
    words = ("composite", "none.png", "--object", path, "--at", "0,0,1", "--out", tmp_path / "out.png")
    assert "not a readable glTF" in refusal(*words), "before the photograph is opened"


def test_nothing_is_said_by_a_command_but_our_line(stored: bytes, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "odd.png").write_bytes(stored[:-40])
    done = mrbokeh("check", tmp_path / "odd.png")
    assert "odd.png" in done.stderr + done.stdout and capfd.readouterr() == ("", "")


def test_words_between_colons_are_no_pictures() -> None:
    printed = io.StringIO()
    cli._complain("expected TOP:FOOT:TIP and [red]X[/red]", printed, stopped=False)
    assert printed.getvalue() == "error: expected TOP:FOOT:TIP and [red]X[/red]\n"

"""What users get wrong on any day: one sentence says what was expected, the code is 2, and nothing that they have is lost."""

import os
import signal
import sys
from pathlib import Path

import numpy as np
import pytest

from mrbokeh import cli
from mrbokeh.checks.checked_picture import open_shot
from mrbokeh.checks.picture_checks import CheckReport, check_numbers
from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.images.image_io import read_image, read_layer, write_image, write_layer
from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.system.errors import InputError
from mrbokeh.video.writer import VideoWriter

RNG = np.random.default_rng(0)


def said(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *arguments: object) -> tuple[int, str]:
    """(exit code, what was said) of a command in this process."""
    monkeypatch.setattr(sys, "argv", ["mrbokeh", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    told = capsys.readouterr()
    return int(stop.value.code or 0), " ".join((told.out + told.err).split())


@pytest.fixture
def card(tmp_path: Path) -> Path:
    """A white card of 16 x 12 px, 2 m away, in 32 x 24 px; lens.json beside it."""
    write_lens(tmp_path / "lens.json", Lens(50.0, 1.8, 1.0, 36.0))
    alpha = np.zeros((24, 32), np.float32)
    alpha[6:18, 8:24] = 1.0
    depth_m = np.where(alpha > 0, 2.0, np.inf).astype(np.float32)
    write_layer(tmp_path / "card.exr", Layer(np.repeat(alpha[..., None], 3, 2), alpha, depth_m))
    return tmp_path / "card.exr"


@pytest.mark.parametrize("name", ["empty.png", "empty.jpg", "empty.tif", "empty.hdr"])
def test_an_empty_picture_is_said_to_be_empty(tmp_path: Path, name: str) -> None:
    (tmp_path / name).touch()
    with pytest.raises(InputError, match=f"{name} is empty"):
        read_image(tmp_path / name)


def test_a_cut_off_exr_is_not_called_deep(tmp_path: Path) -> None:
    write_exr(tmp_path / "whole.exr", ExrPart({name: RNG.random((64, 64)).astype(np.float32) for name in "RGB"}))
    stored = (tmp_path / "whole.exr").read_bytes()
    (tmp_path / "cut.exr").write_bytes(stored[: len(stored) // 2])
    with pytest.raises(InputError, match="missing or damaged"):
        read_layer(tmp_path / "cut.exr")


def test_what_is_read_is_never_written_over(card: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither under its name nor through a link, with --overwrite or without."""
    before, link = card.read_bytes(), card.with_name("link.exr")
    link.symlink_to(card)
    for out in (card, link):
        code, told = said(
            capsys, monkeypatch, "render", "--layer", card, "--lens", card.with_name("lens.json"), "--out", out, "--overwrite"
        )
        assert code == 2 and "is read and would be written over" in told
    code, told = said(capsys, monkeypatch, "check", card, "--against", card, "--map", card.with_suffix(".png"), "--json", card)
    assert code == 2 and "--json: expected a name that ends in .json" in told
    assert card.read_bytes() == before


def test_a_plate_is_not_replaced_by_the_report_on_it(
    card: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    plate = card.with_name("plate.png")
    write_image(plate, RNG.random((24, 32, 3)).astype(np.float32))
    before = plate.read_bytes()
    code, told = said(capsys, monkeypatch, "check", plate, "--against", plate, "--map", plate)
    assert code == 2 and "is read and would be written over" in told and plate.read_bytes() == before


def test_two_results_need_two_names(card: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    photo, out = card.with_name("photo.png"), card.with_name("out.png")
    write_image(photo, RNG.random((24, 32, 3)).astype(np.float32))
    told_by = ("transfer", photo, "--depth", card, "--lens", card.with_name("lens.json"), "--out", out, "--sheet", out)
    code, told = said(capsys, monkeypatch, *told_by)
    assert code == 2 and "named for two results" in told and not out.exists()


@pytest.mark.parametrize(("channel", "value", "words"), [("R", np.nan, "colour is NaN in 1 place:"), ("Z", -2.0, "turn the sign")])
def test_layers_that_cannot_be_meant(
    card: Path, channel: str, value: float, words: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One pixel that is no number; distances along -z, as cameras of Maya and Houdini count them."""
    layer = read_layer(card)
    planes = {name: layer.rgb[..., i].copy() for i, name in enumerate("RGB")} | {"A": layer.alpha, "Z": np.zeros_like(layer.alpha)}
    if channel == "Z":
        planes["Z"][layer.alpha > 0] = value
    else:
        planes[channel][3, 4] = value
    write_exr(card.with_name("odd.exr"), ExrPart(planes))
    out = card.with_name("out.exr")
    code, told = said(
        capsys, monkeypatch, "render", "--layer", card.with_name("odd.exr"), "--lens", card.with_name("lens.json"), "--out", out
    )
    assert code == 2 and words in told and not out.exists()


def test_the_system_s_refusals_are_sentences(card: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder where a file should be, and a file where a folder should be."""
    code, told = said(capsys, monkeypatch, "render", "--layer", card, "--lens", card.parent, "--out", card.with_name("out.exr"))
    assert code == 2 and "is a directory" in told
    code, told = said(capsys, monkeypatch, "lens", "new", card / "lens.json", "--focal-length", 50, "--f-number", 2, "--focus", 1)
    assert code == 2 and "Traceback" not in told and str(card) in told
    refused = PermissionError(13, "Permission denied", str(card.with_name(".out.77.part.exr")))
    assert cli._refused(refused).startswith(f"{card.parent}: permission denied")


def test_an_interrupt_that_became_another_error_is_still_an_interrupt(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As numba's compiler turns it into one of its own; without an interrupt it is a fault, and said to be one."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))

    def interrupted() -> None:
        try:
            os.kill(os.getpid(), signal.SIGINT)
            signal.pause()
        except KeyboardInterrupt:
            raise RuntimeError("no compiled object yet") from None

    def broken() -> None:
        raise RuntimeError("a mistake of ours")

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        monkeypatch.setattr(cli, "app", interrupted)
        with pytest.raises(SystemExit) as stop:
            cli.main()
        assert stop.value.code == 130
        signal.signal(signal.SIGINT, signal.default_int_handler)
        monkeypatch.setattr(cli, "app", broken)
        with pytest.raises(SystemExit) as stop:
            cli.main()
        assert stop.value.code == 1 and "a mistake of ours" in capsys.readouterr().err
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


def test_training_is_not_poured_into_a_folder_of_other_things(
    card: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as the data set itself, or a folder of photographs."""
    before = sorted(card.parent.iterdir())
    code, told = said(capsys, monkeypatch, "train", "fit", card.parent, "--out", card.parent)
    assert code == 2 and "holds no training run" in told and sorted(card.parent.iterdir()) == before


@pytest.mark.parametrize(
    ("name", "value"), [("batch", "-3"), ("learning_rate", "nan"), ("learning_rate", "-1"), ("crops_per_picture", "0")]
)
def test_settings_that_cannot_train_are_refused(
    card: Path, name: str, value: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = card.parent / "run"
    code, told = said(capsys, monkeypatch, "train", "fit", card.parent, "--out", run, "--set", f"{name}={value}")
    assert code == 2 and f"{name} must be" in told and not run.exists()


def test_a_network_goes_into_an_onnx_file(card: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    code, told = said(capsys, monkeypatch, "train", "export", card.parent, "--out", card.parent / "checkpoint.pt", "--overwrite")
    assert code == 2 and "--out: expected a name that ends in .onnx" in told


def test_a_plan_does_not_replace_the_lens(card: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    lens = card.with_name("lens.json")
    before = lens.read_bytes()
    asked = ("capture", "plan", lens, "--near", 0.5, "--far", 3, "--image-width", 600, "--out", lens, "--overwrite")
    code, told = said(capsys, monkeypatch, *asked)
    assert code == 2 and "is read and would be written over" in told and lens.read_bytes() == before


def test_a_board_that_cannot_be_meant_is_told_before_hours_of_work(
    card: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for option, value in (("--board", "8by6"), ("--distance", "a,b,0.2,3")):
        code, told = said(capsys, monkeypatch, "capture", "process", card.parent, "--out", card.parent / "scene", option, value)
        assert code == 2 and option in told and not (card.parent / "scene").exists()

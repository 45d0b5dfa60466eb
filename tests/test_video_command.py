"""`mrbokeh video` from end to end: a real command line, real codecs, and numbers from the compositing it stands on."""

import os
import signal
import subprocess
import sys
import time
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from mrbokeh.commands.video import app, parse_frames
from mrbokeh.compositing.over import OverPhotograph
from mrbokeh.errors import InputError
from mrbokeh.image_io import read_layer, write_layer
from mrbokeh.layer import Layer
from mrbokeh.lens import Lens
from mrbokeh.lens_file import write_lens
from mrbokeh.plate import plate_of
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.video_io import VideoWriter, read_frames

LENS = Lens(focal_length_mm=50.0, f_number=2.0, focus_distance_m=2.0, sensor_width_mm=6.0)
# One 16-bit step of BT.709 codes, in linear light at white, where the curve is steepest: 1 / 65535 * 1 / 0.495.
STEP = 2.1 / 65535


def square(width_px: int, height_px: int, depth_m: float = 1.0) -> Layer:
    """A half-transparent bright square in the middle, in front of the focus plane."""
    alpha = np.zeros((height_px, width_px), np.float32)
    alpha[height_px // 3 : height_px // 2, width_px // 3 : width_px // 2] = 0.75
    rgb = alpha[..., None] * np.array([0.9, 0.4, 0.2], np.float32)
    return Layer(rgb, alpha, np.where(alpha > 0, np.float32(depth_m), np.float32(np.inf)))


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    """Twelve lossless frames of noise with uneven times, in milliseconds as Matroska keeps them."""
    rng = np.random.default_rng(3)
    path = tmp_path / "clip.mkv"
    with VideoWriter(path, 96, 64, Fraction(25), Fraction(1, 1000)) as writer:
        for i in range(12):
            writer.write(rng.random((64, 96, 3), np.float32), (40 * i + i % 3 * 7) / 1000)
    return path


@pytest.fixture
def settings(tmp_path: Path) -> list[str]:
    write_layer(tmp_path / "layer.exr", square(96, 64), half=False)
    write_lens(tmp_path / "lens.json", LENS)
    return ["--layer", str(tmp_path / "layer.exr"), "--lens", str(tmp_path / "lens.json")]


def run(*arguments: object) -> str:
    """What the command prints; its errors are raised here."""
    result = CliRunner().invoke(app, [*map(str, arguments)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def test_every_frame_is_the_composite_of_the_library(clip: Path, settings: list[str], tmp_path: Path) -> None:
    out = tmp_path / "out.mkv"
    assert "12 frames, no audio" in run(clip, *settings, "--renderer", "scatter", "--out", out)
    layer = read_layer(tmp_path / "layer.exr")
    frames = list(zip(read_frames(clip), read_frames(out), strict=True))
    assert len(frames) == 12
    for before, after in frames:
        assert after.time_s == before.time_s
        inserted = OverPhotograph().insert(plate_of(before.rgb, LENS), [layer], ScatterReference())
        np.testing.assert_allclose(after.rgb, inserted.rgb, atol=STEP)
    # 25 mm of aperture, 51.3 mm to the sensor of 16 px per mm and half a dioptre make a blur of 10.3 px, which reaches half as far.
    reach = 25 * 51.282 * 16 * 0.5 / 1000 / 2
    rows = np.flatnonzero((inserted.virtual.alpha > 0).any(axis=1))
    assert (21 - rows[0], rows[-1] - 31) == pytest.approx((reach, reach), abs=1.0)
    far = np.ones((64, 96), bool)
    far[rows[0] : rows[-1] + 1] = False
    np.testing.assert_array_equal(after.rgb[far], before.rgb[far])


def test_a_range_of_frames_begins_at_time_zero(clip: Path, settings: list[str], tmp_path: Path) -> None:
    out = tmp_path / "out.mkv"
    run(clip, *settings, "--out", out, "--frames", "4:9")
    times_s = [frame.time_s for frame in read_frames(clip)]
    assert [frame.time_s for frame in read_frames(out)] == pytest.approx([time_s - times_s[4] for time_s in times_s[4:9]], abs=1e-9)


def test_frames_are_parsed() -> None:
    assert [parse_frames(text) for text in (":", "0:50", "10:", ":7")] == [(0, None), (0, 50), (10, None), (0, 7)]
    for text in ("", "5", "7:7", "9:2", "-1:4", "a:b"):
        with pytest.raises(InputError, match="START:STOP"):
            parse_frames(text)


def test_mistakes_end_in_a_sentence(clip: Path, settings: list[str], tmp_path: Path) -> None:
    write_layer(tmp_path / "small.exr", square(48, 32))
    with pytest.raises(InputError, match=r"small\.exr is 48x32 px but .*clip\.mkv is 96x64 px"):
        run(clip, "--layer", tmp_path / "small.exr", "--lens", tmp_path / "lens.json", "--out", tmp_path / "out.mov")
    with pytest.raises(InputError, match="leaves nothing of"):
        run(clip, *settings, "--out", tmp_path / "out.mov", "--frames", "40:50")
    with pytest.raises(InputError, match="exists already"):
        run(clip, *settings, "--out", clip)
    with pytest.raises(InputError, match="expected a renderer"):
        run(clip, *settings, "--out", tmp_path / "out.mov", "--renderer", "magic")
    assert not (tmp_path / "out.mov").exists()


def test_help_shows_an_example() -> None:
    assert "Example: mrbokeh video" in run("--help")


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGINT for another process")
def test_ctrl_c_leaves_no_half_file(tmp_path: Path, shared_data: Path) -> None:
    write_layer(tmp_path / "layer.exr", square(1280, 720))
    write_lens(tmp_path / "lens.json", LENS)
    out = tmp_path / "results" / "out.mov"
    clip = shared_data / "video" / "ducks_720p.mp4"
    command = [sys.executable, "-m", "mrbokeh.cli", "video", clip, "--layer", tmp_path / "layer.exr", "--lens", tmp_path / "lens.json"]
    process = subprocess.Popen(
        [*map(str, command), "--out", str(out)],
        cwd=Path(__file__).parent.parent,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline_s = time.monotonic() + 40
    # A few frames are in the file under its temporary name: the command is in the middle of its work.
    while not any(file.stat().st_size > 500_000 for file in out.parent.glob(".*")):
        assert process.poll() is None
        assert time.monotonic() < deadline_s
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=20)
    assert process.returncode != 0, errors
    assert "Traceback" not in errors
    assert list(out.parent.iterdir()) == []

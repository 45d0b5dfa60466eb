"""`mrbokeh video` from end to end: a real command line, real codecs, and numbers from the compositing it stands on."""

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.commands.video import segment_frames
from mrbokeh.compositing.over import OverPhotograph
from mrbokeh.compositing.plate import plate_of
from mrbokeh.images.exr_io import ExrPart, read_exr, write_exr
from mrbokeh.images.image_io import read_image, read_layer, write_image, write_layer
from mrbokeh.images.image_metrics import psnr
from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import camera_to_json
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.renderers.onnx_network import OnnxNetwork
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.system.atomic_files import write_json, writing_alone
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.focus_pull import parse_focus_keys
from mrbokeh.video.clip import read_frames
from mrbokeh.video.picture_source import parse_frames
from mrbokeh.video.writer import VideoWriter
from tests.compositing.test_plate_look_options import photo_with_exif
from tests.stacks.test_exr_layers_cryptomatte import beauty, crypto_channels, header
from tests.support.command_line import mrbokeh
from tests.support.refusals import refused
from tests.support.renderer_banks import bank_folder
from tests.support.shot_makers import wait_for
from tests.support.stage_scenes import HEIGHT, ONE_CARD, WIDTH, camera, scene_file
from tests.support.video_files import filmed
from tests.support.video_files import video as run

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
    rng, path = np.random.default_rng(3), tmp_path / "clip.mkv"
    with VideoWriter(path, 96, 64, Fraction(25), Fraction(1, 1000)) as writer:
        for i in range(12):
            writer.write(rng.random((64, 96, 3), np.float32), (40 * i + i % 3 * 7) / 1000)
    return path


@pytest.fixture
def settings(tmp_path: Path) -> list[str]:
    write_layer(tmp_path / "layer.exr", square(96, 64), half=False)
    write_lens(tmp_path / "lens.json", LENS)
    return ["--layer", str(tmp_path / "layer.exr"), "--lens", str(tmp_path / "lens.json")]


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
    run(clip, *settings, "--out", tmp_path / "out.mkv", "--frames", "4-8")
    times_s = [frame.time_s for frame in read_frames(clip)]
    found_s = [frame.time_s for frame in read_frames(tmp_path / "out.mkv")]
    assert found_s == pytest.approx([time_s - times_s[4] for time_s in times_s[4:9]], abs=1e-9)
    with pytest.raises(InputError, match=r"1001-1050, 1001-1050x2 or 1001-1010,1020, got '4:9' \(START:STOP, counted from 0, is no longer"):
        run(clip, *settings, "--out", tmp_path / "no.mkv", "--frames", "4:9")


def test_frames_go_by_the_numbers_of_the_files(clip: Path, settings: list[str], tmp_path: Path) -> None:
    """As studios count: the last is included, x2 takes every second; what is between is neither read nor written."""
    taken = {text: [list(each) for each in parse_frames(text)] for text in ("1001-1003", "1001-1006x2", "1001-1002, 1007", "-2--1")}
    assert list(taken.values()) == [[[1001, 1002, 1003]], [[1001, 1003, 1005]], [[1001, 1002], [1007]], [[-2, -1]]]
    refused("which runs backwards: give 5-7", parse_frames, "7-5")
    for text in ("", "1-4x0", "a-b", "1-", "1,,2", "10-20x"):
        refused("numbers as the files have them, the last included", parse_frames, text)
    pictures = [frame.rgb for frame in read_frames(clip)]
    for i, rgb in enumerate(pictures[:7]):
        write_image(tmp_path / f"in.{1001 + i}.exr", rgb, half=False)
    (tmp_path / "in.1002.exr").write_bytes(b"not EXR")
    options = (tmp_path / "in.%04d.exr", "--rate", "24", *settings, "--focus-pull", "1001:2,1007:1", "--renderer", "scatter")
    run(*options, "--segment", 0.05, "--frames", "1003-1007x2,1004,1003", "--out", tmp_path / "out.%04d.exr")
    assert sorted(each.name for each in tmp_path.glob("out.*")) == [f"out.{number}.exr" for number in (1003, 1004, 1005, 1007)]
    layer, lens = read_layer(tmp_path / "layer.exr"), LENS.focused_at(parse_focus_keys("1001:2,1007:1", "smooth").at(1005))
    inserted = OverPhotograph().insert(plate_of(pictures[4], lens), [layer], ScatterReference())
    np.testing.assert_allclose(read_image(tmp_path / "out.1005.exr"), inserted.rgb, atol=2**-11)
    # A video shows the frames at their own times, those of a video are numbered from --first-number.
    run(clip, *settings, "--first-number", "1001", "--frames", "1003-1007x2", "--out", tmp_path / "out.mkv")
    times_s, shown = [frame.time_s for frame in read_frames(clip)], list(read_frames(tmp_path / "out.mkv"))
    assert [each.time_s for each in shown] == pytest.approx([times_s[i] - times_s[2] for i in (2, 4, 6)], abs=1e-9)
    for i, each in zip((2, 4, 6), shown, strict=True):
        np.testing.assert_allclose(each.rgb[0], pictures[i][0], atol=STEP)
    refused(r"--frames 1003-1013: \S+ has the frames 1001-1012", run, clip, *settings, "--first-number", 1001, "--frames", "1003-1013",
            "--out", tmp_path / "no.mkv")  # fmt: skip
    refused("keys from frame 0 to 9, but the frames taken are 1001-1007", run, *options[:3], *settings, "--focus-pull", "0:2,9:1",
            "--out", tmp_path / "no.mkv")  # fmt: skip


in_this_process_and_slowly_in_workers = pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])


@in_this_process_and_slowly_in_workers
def test_a_bank_is_a_lens(clip: Path, settings: list[str], tmp_path: Path, workers: int) -> None:
    """The same film as by the lens file, in workers too, which read the bank themselves."""
    bank = bank_folder(tmp_path / "bank", LENS)
    run(clip, *settings, "--frames", "0-5", "--out", tmp_path / "by_file.mkv")
    words = ("--frames", "0-5", "--workers", workers, "--segment", "0.12", "--out", tmp_path / "by_bank.mkv")
    run(clip, *settings[:2], "--lens", bank, *words)
    by_file, by_bank = (list(read_frames(tmp_path / f"by_{way}.mkv")) for way in ("file", "bank"))
    assert len(by_bank) == 6 and all(psnr(a.rgb, b.rgb) > 40.0 for a, b in zip(by_file, by_bank, strict=True))


def test_mistakes_end_in_a_sentence(clip: Path, settings: list[str], tmp_path: Path) -> None:
    write_layer(tmp_path / "small.exr", square(48, 32))
    (tmp_path / "there.mkv").touch()
    lens, out = ("--lens", tmp_path / "lens.json"), ("--out", tmp_path / "out.mov")
    for words, sentence in (
        (("--layer", tmp_path / "small.exr", *lens, *out), r"small\.exr is 48x32 px but the clip is 96x64 px"),
        ((*settings, *out, "--frames", "40-50"), r"has the frames 0-11"), ((*settings, "--out", clip), "is read and would be written over"),
        ((*settings, "--out", tmp_path / "there.mkv"), "exists already"), ((*settings, *out, "--renderer", "magic"), "expected a renderer"),
        ((*lens, *out), "nothing to put into the clip"), ((*settings, *out, "--mode", "infront"), "mode: expected one of front"),
    ):  # fmt: skip
        refused(sentence, run, clip, *words)
    assert not list(tmp_path.glob("out.mov*"))


HELD_COMMAND = """
from mrbokeh.shots import executors
from mrbokeh.shots.composite_recipe import CompositeRecipe

class Held(CompositeRecipe):
    def build(self, threads):
        maker = super().build(threads)
        make = maker.make

        def held(index, *frame):
            assert index < 6 or executors._stopping.wait(60)
            return make(index, *frame)

        maker.make = held
        return maker

if __name__ == "__main__":
    from mrbokeh import cli
    from mrbokeh.commands import video

    video.CompositeRecipe = Held
    cli.main()
"""
"""The command, but that its workers make no frame of the third segment, of three frames each, before they are told to stop."""


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGINT for another process")
@pytest.mark.slow
def test_ctrl_c_keeps_finished_segments_and_the_same_command_goes_on(clip: Path, settings: list[str], tmp_path: Path) -> None:
    out, program, root = tmp_path / "results" / "out.mp4", tmp_path / "held.py", Path(__file__).parents[2]
    program.write_text(HELD_COMMAND)
    options = [*settings, "--renderer", "scatter", "--segment", "0.12"]
    command = [sys.executable, program, "video", clip, *options, "--workers", "2", "--out", out]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    process = subprocess.Popen([*map(str, command)], cwd=root, env=environment, stderr=subprocess.PIPE, text=True)
    parts = out.with_name("out.mp4.parts")
    wait_for(lambda: len(list(parts.glob("0*.nut"))) == 2 or process.poll() is not None)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors and "the same command goes on from there" in " ".join(errors.split())
    assert [file.name for file in out.parent.iterdir()] == ["out.mp4.parts"]
    assert sorted(file.name for file in parts.iterdir()) == ["00000.nut", "00001.nut", "manifest.json"], "no half files"
    assert "12 frames, no audio" in run(clip, *options, "--out", out)
    assert [file.name for file in out.parent.iterdir()] == ["out.mp4"] and len(list(read_frames(out))) == 12


def test_facts_of_the_lens_may_stand_in_options(
    clip: Path, settings: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """All of them in place of a file; the focus also by a pixel, on depth that is even in 1/distance."""
    facts = ["--focal-length", "50", "--f-number", "2", "--sensor-width", "6", "--layer", tmp_path / "layer.exr", "--renderer", "scatter"]
    write_image(tmp_path / "near.png", np.full((64, 96, 3), 0.5, np.float32), "linear")  # 2 m
    near = ["--depth", tmp_path / "near.png", "--disparity", "1:inf", "--mode", "front"]
    run(clip, *settings, "--renderer", "scatter", "--mode", "front", "--out", tmp_path / "by_file.mkv")
    run(clip, *facts, "--focus", "2", "--mode", "front", "--out", tmp_path / "by_options.mkv")
    told = run(clip, *facts, *near, "--focus-at", "48,32", "--out", tmp_path / "by_pixel.mkv")
    assert "50 mm f/2 focused at 2 m" in " ".join(told.split())
    told = run(clip, *facts, "--frames", "0", "--out", tmp_path / "far.mkv") + capfd.readouterr().err
    assert "nothing tells the focus: it is taken to be at infinity" in " ".join(told.split())
    by_file, by_options, by_pixel = (list(read_frames(tmp_path / f"by_{way}.mkv")) for way in ("file", "options", "pixel"))
    np.testing.assert_array_equal(by_file[5].rgb, by_options[5].rgb)
    np.testing.assert_allclose(by_pixel[5].rgb, by_file[5].rgb, atol=2e-3)  # the picture of disparity has 65536 steps
    refused("not both", run, clip, *facts, "--focus", "2", "--focus-pull", "0:1", "--out", tmp_path / "no.mkv")
    refused("--disparity 1:9 says what the numbers", run, clip, *facts, "--disparity", "1:9", "--out", tmp_path / "no.mkv")
    refused("there is no depth", run, clip, *facts, "--focus-at", "1,1", "--out", tmp_path / "no.mkv")
    monkeypatch.setattr("mrbokeh.renderers.choose.make_renderer", lambda _, **__: object.__new__(OnnxNetwork))
    refused("a network blurs as the lens", run, clip, *facts, "--renderer", "my.onnx", "--out", tmp_path / "no.mkv")


def test_several_runs_may_write_one_result(clip: Path, settings: list[str], tmp_path: Path) -> None:
    """Other commands keep one another out by this lock; those of a clip share its segments (tests/shots)."""
    with writing_alone(tmp_path / "out.mkv"):
        done = mrbokeh("video", clip, *settings, "--workers", 1, "--frames", "0-1", "--out", tmp_path / "out.mkv")
    assert done.returncode == 0, done.stderr


def test_a_lens_of_the_library_says_where_it_is_focused(clip: Path, settings: list[str], capfd: pytest.CaptureFixture[str]) -> None:
    """Which no file of the clip does; and layers without primaries say as what they are taken."""
    part = read_exr(settings[1])[0]
    write_exr(settings[1], replace(part, attributes={}))
    given = (clip, "--layer", settings[1], "--lens", "fast-50", "--frames", "0", "--output-space", "ACEScg")
    told = run(*given, "--out", clip.with_name("out.%04d.exr")) + capfd.readouterr().err
    assert "fast-50 is focused at 2 m" in told and "layer.exr states no primaries" in told


@pytest.mark.parametrize(
    ("frames", "most", "expected"), [(150, 50, 38), (100, 50, 50), (12, 3, 3), (12, 50, 12), (600, 50, 50), (1, 50, 1)]
)
def test_segments_are_even_for_two_and_for_four_workers(frames: int, most: int, expected: int) -> None:
    assert segment_frames(frames, most) == expected


def test_the_focus_is_pulled(clip: Path, settings: list[str], tmp_path: Path) -> None:
    """Each frame is blurred as by the lens at its own focus; between keys focus goes smoothly in dioptres (tracking.camera_track)."""
    out = tmp_path / "out.mkv"
    run(clip, *settings, "--focus-pull", "0:2.0,11:1.0", "--renderer", "scatter", "--out", out)
    pull, layer = parse_focus_keys("0:2.0,11:1.0", "smooth"), read_layer(tmp_path / "layer.exr")
    for index, (before, after) in enumerate(zip(read_frames(clip), read_frames(out), strict=True)):
        plate = plate_of(before.rgb, LENS.focused_at(pull.at(index)))
        np.testing.assert_allclose(after.rgb, OverPhotograph().insert(plate, [layer], ScatterReference()).rgb, atol=STEP)
    (tmp_path / "pull.csv").write_text("frame,focus_distance_m\n" + "".join(f"{i},{2 - i / 11}\n" for i in range(12)))
    run(clip, *settings, "--focus-pull", tmp_path / "pull.csv", "--out", tmp_path / "of_csv.mkv")
    first, *_, last = read_frames(tmp_path / "of_csv.mkv")
    # At 1 m the square of 1 m is in focus: its rim is sharp, and the frame beside it untouched; at 2 m it spreads by 5 px.
    assert (last.rgb[21:32, 30] == list(read_frames(clip))[11].rgb[21:32, 30]).all()
    assert (first.rgb[21:32, 30] != next(read_frames(clip)).rgb[21:32, 30]).any()


@pytest.mark.usefixtures("settings")
def test_layers_and_depth_of_each_frame(clip: Path, tmp_path: Path) -> None:
    """A square that moves by 4 px a frame; from frame 6 on the filmed scene stands before it and hides all of it."""
    for i in range(12):
        layer = square(96, 64)
        moved = Layer(*(np.roll(plane, 4 * i, axis=1) for plane in (layer.rgb, layer.alpha, layer.depth_m)))
        write_layer(tmp_path / f"moving.{1001 + i}.exr", moved, half=False)
        depth_m = np.full((64, 96), 5.0 if i < 6 else 0.5, np.float32)
        write_exr(tmp_path / f"depth.{1001 + i}.exr", ExrPart({"Z": depth_m}))
    options = ["--lens", tmp_path / "lens.json", "--layer", tmp_path / "moving.%04d.exr", "--first-number", "1001"]
    out = tmp_path / "out.mkv"
    assert "; between; " in run(clip, *options, "--depth", tmp_path / "depth.%04d.exr", "--renderer", "scatter", "--out", out)
    for index, (before, after) in enumerate(zip(read_frames(clip), read_frames(out), strict=True)):
        layers = [read_layer(tmp_path / f"moving.{1001 + index}.exr")] if index < 6 else []
        np.testing.assert_allclose(
            after.rgb, OverPhotograph().insert(plate_of(before.rgb, LENS), layers, ScatterReference()).rgb, atol=STEP
        )
    run(clip, *options, "--depth", tmp_path / "depth.%04d.exr", "--mode", "front", "--out", tmp_path / "front.mkv", "--frames", "1007-1008")
    assert (next(read_frames(tmp_path / "front.mkv")).rgb != list(read_frames(clip))[6].rgb).any()
    with pytest.raises(InputError, match=r"has the frames 1001-1012, none of those taken \(0-11\): say --first-number"):
        run(clip, "--lens", tmp_path / "lens.json", "--layer", tmp_path / "moving.%04d.exr", "--out", tmp_path / "no.mkv")


def test_a_scene_is_rendered_per_frame(tmp_path: Path) -> None:
    """A card of light 0.2 m high stands 1 m before a fixed camera: it covers 0.2 * 150 = 30 px; of a shut lens, exactly."""
    clip = filmed(tmp_path / "grey.mkv", [np.full((HEIGHT, WIDTH, 3), 0.25, np.float32)] * 3)
    scene = scene_file(tmp_path, ONE_CARD)
    write_json(tmp_path / "camera.json", camera_to_json(camera()))
    write_lens(tmp_path / "pinhole.json", Lens(50.0, 5000.0, 1.0, 36.0))
    options = ["--scene", scene, "--scene-renderer", "embree", "--lens", tmp_path / "pinhole.json", "--out", tmp_path / "out.mkv"]
    run(clip, *options, "--camera", tmp_path / "camera.json")
    for frame in read_frames(tmp_path / "out.mkv"):
        lit = (np.abs(frame.rgb - [1.0, 0.5, 0.25]) < 0.01).all(axis=2)
        rows, columns = np.flatnonzero(lit.any(axis=1)), np.flatnonzero(lit.any(axis=0))
        assert (len(rows), len(columns)) == pytest.approx((30, 30), abs=1)
        np.testing.assert_array_equal(frame.rgb[0], next(read_frames(clip)).rgb[0])
    refused("give --camera", run, clip, *options, "--overwrite")


@in_this_process_and_slowly_in_workers
def test_the_virtual_layer_alone_and_pictures_out(clip: Path, settings: list[str], tmp_path: Path, workers: int) -> None:
    run(clip, *settings, "--virtual-only", "--out", tmp_path / "virtual.%03d.exr", "--frames", "2-4")
    run(clip, *settings, "--virtual-only", "--out", tmp_path / "virtual.mov", "--frames", "2-4")
    options = ("--out", tmp_path / "whole.%03d.png", "--frames", "2-4", "--segment", 0.04, "--workers", workers)
    told = json.loads(mrbokeh("video", clip, *settings, *options, "--json").stdout)
    assert told["outputs"] == [str(tmp_path / f"whole.{i:03d}.png") for i in (2, 3, 4)]
    assert sorted(file.name for file in tmp_path.glob("virtual.*")) == [*(f"virtual.{i:03d}.exr" for i in (2, 3, 4)), "virtual.mov"]
    virtual, frame = read_layer(tmp_path / "virtual.002.exr"), list(read_frames(clip))[2]
    whole = read_image(tmp_path / "whole.002.png")
    # Half has 11 bits; 16-bit sRGB has 1/65535.
    np.testing.assert_allclose(whole, np.clip((1 - virtual.alpha[..., None]) * frame.rgb + virtual.rgb, 0, 1), atol=2**-10)
    assert 0.5 < virtual.alpha.max() < 0.76
    # And numbered pictures in: the same composite of the same light.
    for i, picture in enumerate(read_frames(clip)):
        write_image(tmp_path / f"in.{i:03d}.exr", picture.rgb, half=False)
    run(tmp_path / "in.%03d.exr", "--rate", "24", *settings, "--out", tmp_path / "again.%03d.png", "--frames", "2-4")
    np.testing.assert_allclose(read_image(tmp_path / "again.004.png"), read_image(tmp_path / "whole.004.png"), atol=2.5 / 65535)
    refused("give --rate", run, tmp_path / "in.%03d.exr", *settings, "--out", tmp_path / "no.mov")
    refused("is for videos", run, clip, *settings, "--encoding", "h264", "--out", tmp_path / "no.%03d.exr")


@pytest.mark.usefixtures("settings")
def test_exposures_that_pictures_state_are_matched_frame_by_frame(clip: Path, tmp_path: Path) -> None:
    """A panorama of 1/100 s; frames of 1/25, 1/50 and 1/100 s at the same ISO and f-number show its light 4, 2 and 1 times as bright."""
    alpha = np.ones((32, 48), np.float32)
    write_layer(tmp_path / "grey.exr", Layer(np.full((32, 48, 3), 0.1, np.float32), alpha, 2 * alpha), half=False)
    panorama = photo_with_exif(tmp_path / "panorama.jpg", 0.01)
    for i, exposure_time_s in enumerate((0.04, 0.02, 0.01)):
        photo_with_exif(tmp_path / f"taken.{i}.jpg", exposure_time_s)
        stated = {"expTime": exposure_time_s, "isoSpeed": 200.0, "aperture": 2.8}
        write_exr(tmp_path / f"taken.{i}.exr", ExrPart(dict.fromkeys("RGB", 0.5 * alpha), attributes=stated))
    for suffix in ("jpg", "exr"):
        options = ["--rate", "25", "--lens", tmp_path / "lens.json", "--layer", tmp_path / "grey.exr", "--match-exposure", panorama]
        run(tmp_path / f"taken.%d.{suffix}", *options, "--out", tmp_path / f"{suffix}.%d.exr")
        found = [float(read_image(tmp_path / f"{suffix}.{i}.exr")[16, 24, 0]) for i in range(3)]
        assert found == pytest.approx([0.4, 0.2, 0.1], rel=2e-3)
        run(tmp_path / f"taken.%d.{suffix}", *options, "--frames", "1-2", "--out", tmp_path / f"{suffix}.later.%d.exr")
        assert float(read_image(tmp_path / f"{suffix}.later.2.exr")[16, 24, 0]) == pytest.approx(0.1, rel=2e-3)
    with pytest.raises(InputError, match=r"--match-exposure needs a photograph that states how it was taken .* give --plate-exposure"):
        run(clip, *options[2:], "--out", tmp_path / "no.mkv")


@pytest.mark.usefixtures("settings")
def test_the_exposure_of_a_video_is_stated_by_the_user(clip: Path, tmp_path: Path) -> None:
    """A panorama of 1/100 s, ISO 200, f/2.8; a clip of 1/50 s at ISO 400 shows its light 4 times as bright, in every frame."""
    alpha = np.ones((64, 96), np.float32)
    write_layer(tmp_path / "grey.exr", Layer(np.full((64, 96, 3), 0.1, np.float32), alpha, 2 * alpha), half=False)
    panorama, lens = photo_with_exif(tmp_path / "panorama.jpg", 0.01), tmp_path / "lens.json"
    options = ["--lens", lens, "--layer", tmp_path / "grey.exr", "--match-exposure", panorama, "--plate-exposure"]
    run(clip, *options, "1/50,400,2.8", "--frames", "0-2", "--out", tmp_path / "out.%d.exr")
    assert [float(read_image(tmp_path / f"out.{i}.exr")[32, 48, 0]) for i in range(3)] == pytest.approx([0.4] * 3, rel=2e-3)
    with pytest.raises(InputError, match=r"expected an exposure as SECONDS,ISO,F-NUMBER, .* got '1/50,400'"):
        run(clip, *options, "1/50,400", "--out", tmp_path / "no.mkv")
    refused("give both", run, clip, *options[:4], *options[-1:], "1/50,400,2.8", "--out", tmp_path / "no.mkv")


@pytest.mark.usefixtures("settings")
def test_objects_are_taken_out_of_a_render_by_their_cryptomatte(tmp_path: Path) -> None:
    """Red "near" covers columns 0 to 5 of 9, green "far" 6 to 8; both are in focus, and only one is wanted."""
    height, width = beauty()["R"].shape
    for i in range(2):
        planes = beauty() | {"Z": np.full((height, width), 2.0, np.float32)}
        write_exr(tmp_path / f"render.{i}.exr", ExrPart(planes | crypto_channels(), attributes=header()))
        write_image(tmp_path / f"plate.{i}.exr", np.zeros((height, width, 3), np.float32))
    options = ["--rate", "25", "--lens", tmp_path / "lens.json", "--layer", tmp_path / "render.%d.exr"]
    run(tmp_path / "plate.%d.exr", *options, "--objects", "far", "--out", tmp_path / "far.%d.exr")
    made, render = read_image(tmp_path / "far.1.exr"), beauty()
    np.testing.assert_allclose(made[:, 6:8, 1], render["G"][:, 6:8], atol=2e-3)
    assert made[:, :5].max() == 0.0
    run(tmp_path / "plate.%d.exr", *options, "--objects", "near,far", "--out", tmp_path / "both.%d.exr")
    np.testing.assert_allclose(read_image(tmp_path / "both.0.exr")[..., 0], render["R"], atol=2e-3)
    with pytest.raises(InputError, match="give --layer"):
        run(tmp_path / "plate.%d.exr", *options[:4], "--scene", "s.toml", "--objects", "far", "--out", tmp_path / "no.%d.exr")


def test_parts_of_another_lens_are_refused(clip: Path, settings: list[str], tmp_path: Path) -> None:
    out = tmp_path / "out.mkv"
    (tmp_path / "out.mkv.parts").mkdir()
    run(clip, *settings, "--out", out, "--segment", "0.1")
    out.unlink()
    write_json(tmp_path / "out.mkv.parts" / "manifest.json", {"settings": {"lens": "another"}, "segments": []})
    (tmp_path / "out.mkv.parts" / "00000.mkv").touch()
    refused(r"other settings \(.*lens.*\): run with the same to go on, or --overwrite", run, clip, *settings, "--out", out)
    run(clip, *settings, "--out", out, "--overwrite")
    assert not (tmp_path / "out.mkv.parts").exists()

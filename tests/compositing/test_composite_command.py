"""`mrbokeh composite` as a user meets it: a layer or an object into a photograph or a slice, and what it refuses."""

import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mrbokeh.compositing.open_plate import open_plate
from mrbokeh.demo.plan import DATA
from mrbokeh.images.image_io import read_image, read_layer, write_image, write_layer
from mrbokeh.images.image_metrics import psnr
from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.stacks.focal_stack import FocalStack, Slice, write_focal_stack, write_merged
from tests.project.test_user_mistakes import said
from tests.support.renderer_banks import bank_folder

HEIGHT, WIDTH = 96, 144
LENS = Lens(35.0, 2.0, 1.0, 23.5)
CAKE = DATA / "objects" / "cakeBirthday.glb"


Composite = Callable[..., tuple[int, str]]


@pytest.fixture
def composite(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Composite:
    """`mrbokeh composite` with these arguments: (exit code, what was said)."""
    return lambda *arguments: said(capsys, monkeypatch, "composite", *arguments)


def plate_rgb() -> np.ndarray:
    return np.random.default_rng(0).uniform(0.1, 0.5, (HEIGHT, WIDTH, 3)).astype(np.float32)


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """A photograph of a wall 2 m away with a post at 0.8 m in its left third, its depth, a lens and a card at 1.3 m."""
    write_image(tmp_path / "photo.exr", plate_rgb(), half=False)
    depth_m = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    depth_m[:, : WIDTH // 3] = 0.8
    write_layer(tmp_path / "depth.exr", Layer(plate_rgb(), np.ones_like(depth_m), depth_m))
    write_lens(tmp_path / "lens.json", LENS)
    alpha = np.zeros((HEIGHT, WIDTH), np.float32)
    alpha[30:70, 30:90] = 1.0
    card = Layer(alpha[..., None] * np.float32([0.9, 0.2, 0.1]), alpha, np.where(alpha > 0, 1.3, np.inf).astype(np.float32))
    write_layer(tmp_path / "card.exr", card, half=False)
    return tmp_path


def test_a_layer_goes_behind_the_post_and_before_the_wall(files: Path, composite: Composite) -> None:
    out, layer = files / "out.exr", files / "blurred.exr"
    arguments = ("--layer", files / "card.exr", "--lens", files / "lens.json", "--depth", files / "depth.exr")
    code, told = composite(files / "photo.exr", *arguments, "--out", out, "--save-layer", layer)
    assert code == 0, told
    picture, blurred = read_image(out), read_layer(layer)
    # The blur reaches half a circle of confusion beyond the visible part of the card, which begins at the post's edge.
    reach_px = int(np.ceil(float(LENS.coc_px(1.3, WIDTH)) / 2)) + 1
    assert blurred.alpha[:, : WIDTH // 3 - reach_px].max() == 0.0
    np.testing.assert_allclose(picture[50, 70], [0.9, 0.2, 0.1], rtol=2e-3)  # half float
    untouched = blurred.alpha == 0
    np.testing.assert_allclose(picture[untouched], plate_rgb()[untouched], rtol=2**-11)


def test_a_bank_is_a_lens_that_says_what_it_was_made_for_or_lets_the_photograph_say_it(files: Path, composite: Composite) -> None:
    """As --lens with its facts, as --renderer beside a lens file, and with facts in options where neither bank nor photograph has them."""
    said_by, silent = bank_folder(files / "bank", LENS), bank_folder(files / "silent", LENS, says_lens=False)
    facts = ("--focal-length", 35, "--f-number", 2, "--sensor-width", 23.5, "--focus", 1)
    ways = [("--lens", files / "lens.json"), ("--lens", said_by), ("--lens", files / "lens.json", "--renderer", silent)]
    ways += [("--lens", silent, *facts), ("--lens", said_by, "--renderer", "laplacian")]
    found = []
    for number, way in enumerate(ways):
        out = files / f"{number}.exr"
        code, told = composite(files / "photo.exr", "--layer", files / "card.exr", "--depth", files / "depth.exr", *way, "--out", out)
        assert code == 0 and "35 mm f/2 focused at 1 m" in told, told
        found.append(read_image(out))
    assert all(psnr(each, found[0]) > 45.0 for each in found[1:])
    code, told = composite(files / "photo.exr", "--layer", files / "card.exr", "--lens", silent, "--out", files / "no.exr")
    assert code == 2 and "does not tell its lens" in told


def test_an_object_stands_on_the_pixel_it_was_put_on(files: Path, composite: Composite) -> None:
    out, layer = files / "out.png", files / "cake.exr"
    arguments = ("--object", CAKE, "--at-pixel", "100,70", "--height", 0.1, "--shadow", 0)
    code, told = composite(
        *(files / "photo.exr", "--lens", files / "lens.json", "--focus", 2.0, "--depth", files / "depth.exr"),
        *(*arguments, "--out", out, "--save-layer", layer),
    )
    assert code == 0, told
    rows, columns = np.nonzero(read_layer(layer).alpha > 0.5)
    # 0.1 m at 2 m through 35 mm on 23.5 mm is 10.9 px of 144; it stands on row 70 and is wider than high.
    assert 68 <= rows.max() <= 76 and 8 <= 70 - rows.min() <= 16
    assert abs(columns.mean() - 100) < 4
    assert read_image(out).shape == (HEIGHT, WIDTH, 3)


def test_without_depth_an_object_stands_on_level_ground(files: Path, composite: Composite) -> None:
    """Row 70 of 96 is 22 px below the horizon of a level camera, whose focal length is 214 px: 1.5 m of height are 14.6 m away."""
    layer = files / "cake.exr"
    words = (files / "photo.exr", "--object", CAKE, "--out", files / "out.png", "--overwrite", "--save-layer", layer)
    lens = ("--focal-length", 35, "--sensor-width", 23.5, "--f-number", 4)
    code, told = composite(*words, *lens, "--at-pixel", "100,70", "--camera-height", 1.5, "--pitch", 0, "--height", "20px")
    assert code == 0 and "the focus to be on the object, 14.6 m away" in told, told
    rows, columns = np.nonzero(read_layer(layer).alpha > 0.5)
    assert 66 <= rows.max() <= 74 and 16 <= np.ptp(rows) <= 30 and abs(columns.mean() - 100) < 4
    code, told = composite(*words, *lens, "--focus", 3, "--at-pixel", "100,70")
    assert code == 0 and "where the lens is focused, 3 m away" in told and "24px high" in told, told
    assert read_layer(layer).depth_m[68, 100] == pytest.approx(3.0, abs=0.5)
    code, told = composite(*words, "--at-pixel", "100,40")
    assert code == 0 and "28 mm on 36 mm of sensor" in told and "f/8" in told and "to look down by" in told


def test_a_preview_is_small_and_tells_the_size_in_pixels_of_the_photograph(tmp_path: Path, composite: Composite) -> None:
    """24 px of 144 are 240 of 1440; the picture is 1000 px wide and has the grid's colour beside the object, not on it."""
    photo, out = tmp_path / "large.exr", tmp_path / "preview.png"
    write_image(photo, np.repeat(np.repeat(plate_rgb(), 10, axis=0), 10, axis=1))
    words = (photo, "--object", CAKE, "--at-pixel", "1000,700", "--height", "240px", "--preview", "--out", out)
    code, told = composite(*words, "--focal-length", 35, "--sensor-width", 23.5, "--f-number", 4, "--focus", 3)
    assert code == 0, told
    height_px = int(re.search(r"x(\d+) px, ", told).group(1))  # type: ignore[union-attr]
    assert 220 < height_px < 290 and "cells of 0.2 m" in told, told
    shown = cv2.imread(str(out))[..., ::-1].astype(int)
    assert shown.shape == (667, 1000, 3)
    yellow = np.abs(shown - (255, 225, 40)).max(axis=2) < 60
    assert yellow[500:640].sum() > 500 and not yellow[430:480, 660:730].any()
    code, told = composite(*words[:-1], tmp_path / "preview.exr")
    assert code == 2 and "expected a name that ends in .png" in told
    code, told = composite(*words, "--save-layer", tmp_path / "layer.exr", "--overwrite")
    assert code == 2 and "--preview shows where an --object stands" in told


def test_a_slice_of_a_stack_brings_lens_focus_and_depth(files: Path, composite: Composite) -> None:
    stack_folder = files / "stack"
    for i in range(3):
        write_image(stack_folder / f"{i}.exr", plate_rgb())
    camera = Camera(WIDTH, HEIGHT, (LENS.focal_px(WIDTH),) * 2, (WIDTH / 2, HEIGHT / 2))
    stack = FocalStack(stack_folder, tuple(Slice(f"{i}.exr", d) for i, d in enumerate((0.6, 1.3, 3.0))), LENS, camera, registered=True)
    plane = np.ones((HEIGHT, WIDTH), np.float32)
    write_merged(stack_folder, plate_rgb(), plane, plane, 2 * plane)
    write_focal_stack(replace(stack, merged=True))
    spread = []
    for index in range(3):
        layer = files / f"layer_{index}.exr"
        words = stack_folder, "--slice", index, "--layer", files / "card.exr", "--out", files / f"{index}.png", "--save-layer", layer
        code, told = composite(*words)
        assert code == 0, told
        spread.append(int((read_layer(layer).alpha > 0).sum()))
    assert spread[1] == 40 * 60, "slice 1 is focused on the card"
    assert spread[0] > spread[1] < spread[2]


def test_objects_are_placed_in_camera_axes_wherever_the_camera_stood(tmp_path: Path) -> None:
    """Depth 2 m under the middle of the picture is (0, 0, 2), also for a camera that stands 5 m to the side."""
    write_image(tmp_path / "0.exr", plate_rgb())
    pose = np.eye(4)
    pose[0, 3] = -5.0
    camera = Camera(WIDTH, HEIGHT, (LENS.focal_px(WIDTH),) * 2, (WIDTH / 2, HEIGHT / 2), pose)
    plane = np.ones((HEIGHT, WIDTH), np.float32)
    write_merged(tmp_path, plate_rgb(), plane, plane, 2 * plane)
    write_focal_stack(FocalStack(tmp_path, (Slice("0.exr", 1.3),), LENS, camera, registered=True, merged=True))
    plate = open_plate(tmp_path, 0)
    assert plate.point_under_pixel_m(WIDTH / 2, HEIGHT / 2) == pytest.approx((0.0, 0.0, 2.0), abs=1e-9)


@pytest.mark.parametrize(("change", "message"), [
    ({}, "nothing to put into the photograph"),
    ({"--lens": None}, "nothing to put into the photograph"),
    ({"--layer": "card.exr", "--lens": None}, "does not tell its lens"),
    ({"--layer": "card.exr", "--lens": None, "--mode": "infront"}, "mode: expected one of front, over"),
    ({"--layer": "none.exr"}, "none.exr"),
    ({"--object": "cake"}, "where does the object stand"),
    ({"--object": "cake", "--at-pixel": "10,10", "--pitch": "0"}, "above the horizon"),
    ({"--object": "cake", "--at-pixel": "10,60", "--camera": "lens.json"}, "expected a camera of `mrbokeh capture solve`"),
    ({"--object": "cake", "--at": "1,2"}, "--at expects 3 numbers"),
    ({"--object": "cake", "--at": "0,0,1", "--at-pixel": "10,80"}, "--at and --at-pixel both say where the object stands"),
    ({"--object": "cake", "--at-pixel": "10,80", "--sun": "0,40", "--environment": "sky.hdr"}, "a panorama has its own sun"),
    ({"--object": "cake", "--at-pixel": "10,80", "--sun": "0,40", "--plain": True}, "needs the light that --plain leaves out"),
    ({"--object": "cake", "--at-pixel": "10,80", "--sun": "0,95"}, "elevation above 0 and up to 90 over the horizon"),
    ({"--object": "cake", "--at-pixel": "10,80", "--pitch": "95"}, "--pitch: expected how far the camera looks down, between -90"),
    ({"--object": "cake", "--at-pixel": "10,80", "--roll": "180"}, "--roll: expected how far the camera is turned clockwise, between -90"),
    ({"--object": "cake", "--at-pixel": "10,80", "--height": "high"}, "--height: expected metres above 0"),
    ({"--object": "cake", "--at-pixel": "10,80", "--catch": "shadow"}, "the photograph tells of none"),
    ({"--object": "cake", "--at-pixel": "10,80", "--camera-height": "0"}, "--camera-height: expected metres above 0, got 0"),
    ({"--object": "cake", "--at": "0,0,1", "--camera-height": "1.2"}, "leave it out with depth, a stack, --plain or --at"),
    ({"--object": "cake", "--at-pixel": "10,80", "--depth": "depth.exr", "--camera-height": "1.2"}, "leave it out with depth"),
    ({"--layer": "card.exr", "--renderer": "magic"}, "expected a renderer"),
    ({"--layer": "card.exr", "--out": "photo.exr"}, "is read and would be written over"),
    ({"--layer": "card.exr", "--out": "depth.exr"}, "exists already: give another name, or --overwrite"),
    ({"--layer": "card.exr", "--slice": "1"}, "not a folder"),
    ({"--layer": "card.exr", "--out": "out.gif"}, "expected a name that ends in .exr or .png"),
])  # fmt: skip
def test_mistakes_end_in_one_sentence(files: Path, composite: Composite, change: dict[str, Any], message: str) -> None:
    """And none of them comes after a line that says what was guessed."""
    options = {"--lens": "lens.json", "--out": "out.exr"} | change
    words: list[object] = []
    for option, value in options.items():
        if value is not None:
            path = CAKE if value == "cake" else files / value if str(value).endswith((".exr", ".json", ".gif", ".hdr")) else value
            words += [option] if value is True else [option, path]
    code, told = composite(files / "photo.exr", *words)
    assert code == 2
    assert message in told and "Traceback" not in told and "guessed" not in told and "there is no depth: mrbokeh" not in told
    assert not (files / "out.exr").exists() and not (files / "out.gif").exists()


def test_a_shell_gets_the_code_and_the_sentence(files: Path) -> None:
    """A process of its own, as a user starts it."""
    command = [sys.executable, "-m", "mrbokeh.cli", "composite", files / "photo.exr"]
    command += ["--lens", files / "lens.json", "--out", files / "out.exr"]
    done = subprocess.run([*map(str, command)], capture_output=True, text=True)
    assert done.returncode == 2 and not done.stdout
    assert "nothing to put into the photograph" in " ".join(done.stderr.split()) and "Traceback" not in done.stderr
    assert not (files / "out.exr").exists()

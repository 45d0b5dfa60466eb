"""A proxy is the picture of the full size, shrunk; what was read of plate, layers, depth, mattes and cameras is shrunk alike."""

from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest

from mrbokeh.images.exr_io import ExrPart, header_of, read_exr, write_exr
from mrbokeh.images.image_io import read_image, write_image, write_layer
from mrbokeh.images.image_metrics import psnr
from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import camera_to_json
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.shots.proxies import shrunk_layer
from mrbokeh.system.atomic_files import write_json
from mrbokeh.video.clip import read_frames
from mrbokeh.video.proxy_source import parse_proxy
from tests.stacks.test_exr_layers_cryptomatte import header, id_bits
from tests.support.refusals import refused
from tests.support.stage_scenes import HEIGHT, ONE_CARD, WIDTH, camera, scene_file
from tests.support.video_files import filmed
from tests.support.video_files import video as run

SIZE = (96, 160)


def half(rgb: np.ndarray) -> np.ndarray:
    return cv2.resize(rgb, (rgb.shape[1] // 2, rgb.shape[0] // 2), interpolation=cv2.INTER_AREA)


@pytest.fixture
def words(tmp_path: Path) -> list[object]:
    """A soft plate, two discs before and behind the focus, depth that hides a part, a matte, and a lens with 9 px of blur."""
    rng, (height, width) = np.random.default_rng(6), SIZE
    y, x = np.mgrid[:height, :width] + 0.5
    for number in (7, 8):
        write_image(tmp_path / f"plate.{number}.exr", cv2.GaussianBlur(rng.random((*SIZE, 3), np.float32), (0, 0), 2.0))
        alpha = np.clip(22 - np.hypot(x - 60 - number, y - 46), 0, 1).astype(np.float32)
        depth_m = np.where(alpha > 0, np.float32(1.2), np.float32(np.inf))
        layer = Layer(alpha[..., None] * np.float32([0.9, 0.4, 0.1]), alpha, depth_m)
        write_layer(tmp_path / f"cg.{number}.exr", layer)
        write_exr(tmp_path / f"z.{number}.exr", ExrPart({"Z": np.where(x > 64, 1.0, 5.0).astype(np.float32)}))
    write_image(tmp_path / "matte.png", np.repeat((np.clip(y - 60, 0, 1)[..., None]).astype(np.float32), 3, axis=2), "linear")
    write_lens(tmp_path / "lens.json", Lens(50.0, 2.0, 2.0, 12.0))
    return [tmp_path / "plate.%d.exr", "--rate", 24, "--lens", tmp_path / "lens.json", "--layer", tmp_path / "cg.%d.exr"]


@pytest.mark.parametrize("given", ["nothing", "depth", "matte", "between"])
def test_it_is_the_full_size_shrunk(tmp_path: Path, words: list[object], given: str) -> None:
    """PSNR on the light, 0 to 1, found: 60 dB (depth) to 64; by a lens with half the blur, as if it counted in pixels, below 45."""
    depth = ("--depth", tmp_path / "z.%d.exr", "--exact-depth")
    more = {"nothing": (), "depth": depth, "matte": ("--matte", tmp_path / "matte.png"), "between": (*depth, "--mode", "between")}[given]
    run(*words, *more, "--out", tmp_path / "whole.%d.exr")
    run(*words, *more, "--proxy", "1/2", "--out", tmp_path / "proxy.%d.exr")
    for number in (7, 8):
        made, whole = (read_image(tmp_path / f"{name}.{number}.exr") for name in ("proxy", "whole"))
        assert made.shape == (48, 80, 3)
        assert psnr(made, half(whole)) > 57.0
    run(*words, *more, "--proxy", "1/2", "--f-number", 4, "--frames", 8, "--out", tmp_path / "sharper.%d.exr")
    assert psnr(read_image(tmp_path / "sharper.8.exr"), half(whole)) < 47.0


def test_a_scene_is_rendered_in_its_size(tmp_path: Path) -> None:
    clip = filmed(tmp_path / "grey.mkv", [np.full((HEIGHT, WIDTH, 3), 0.25, np.float32)])
    write_json(tmp_path / "camera.json", camera_to_json(camera()))
    write_lens(tmp_path / "lens.json", Lens(50.0, 4.0, 1.5, 36.0))
    options = ["--scene", scene_file(tmp_path, ONE_CARD), "--camera", tmp_path / "camera.json", "--scene-renderer", "embree"]
    for name, more in (("whole", ()), ("proxy", ("--proxy", 0.5))):
        run(clip, *options, *more, "--lens", tmp_path / "lens.json", "--out", tmp_path / f"{name}.mkv")
    (whole,), (made,) = (list(read_frames(tmp_path / f"{name}.mkv")) for name in ("whole", "proxy"))
    assert psnr(made.rgb, half(whole.rgb)) > 40.0


def test_headers_and_mattes_follow(tmp_path: Path, words: list[object]) -> None:
    """IDs are picked, not averaged; the windows are those of the small picture."""
    alpha = np.zeros(SIZE, np.float32)
    alpha[20:60, 30:90] = 1.0
    planes = dict.fromkeys("RGB", 0.5 * alpha) | {"A": alpha, "Z": np.where(alpha > 0, 2.0, np.inf).astype(np.float32)}
    ids = {"CryptoObject00.R": np.where(alpha > 0, np.uint32(id_bits("near")).view(np.float32), np.float32(0)), "CryptoObject00.G": alpha}
    write_exr(tmp_path / "named.exr", ExrPart(planes | ids, attributes=header()))
    run(*words[:-1], tmp_path / "named.exr", "--proxy", "1/2", "--frames", 7, "--out", tmp_path / "out.%d.exr")
    (part,) = read_exr(tmp_path / "out.7.exr")
    assert set(np.unique(part.channels["CryptoObject00.R"].view(np.uint32))) == {0, id_bits("near")}
    assert part.channels["CryptoObject00.R"].shape == (48, 80) and part.channels["CryptoObject00.G"].sum() == 20 * 30
    assert header_of(tmp_path / "out.7.exr")["displayWindow"][1].tolist() == [79, 47]


def test_depth_of_a_covered_half_is_its_own() -> None:
    """Of two pixels, one at 2 m and one empty, comes a pixel at 2 m that is half covered; of 2 m and 4 m one at 2 / (1/2 + 1/4) m."""
    depth_m = np.array([[2.0, np.inf, 2.0, 4.0]] * 2, np.float32)
    alpha = np.isfinite(depth_m).astype(np.float32)
    small = shrunk_layer(Layer(np.repeat(alpha[..., None], 3, 2), alpha, depth_m), (2, 1))
    np.testing.assert_allclose(small.depth_m, [[2.0, 8 / 3]], rtol=1e-6)
    np.testing.assert_allclose(small.alpha, [[0.5, 1.0]])


def test_scales_are_understood() -> None:
    assert [parse_proxy(text) for text in (None, "1/2", "0.25", "1")] == [1, Fraction(1, 2), Fraction(1, 4), 1]
    for text in ("2", "0", "half", "1/0", "-1/2"):
        refused("--proxy: expected a part of the plate's width and height", parse_proxy, text)

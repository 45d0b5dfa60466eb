"""`mrbokeh transfer`: blur of any lens on a sharp photograph, from every kind of depth to every kind of output."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from mrbokeh.commands.transfer import app
from mrbokeh.images.color import linear_to_srgb
from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.images.image_io import read_depth, read_image, write_image
from mrbokeh.images.image_metrics import psnr
from mrbokeh.images.layer import opaque
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.refocus import seen_like, with_recovered_highlights
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.stacks.focal_stack import read_focal_stack
from mrbokeh.stacks.photograph import Photograph
from mrbokeh.video.clip import read_frames
from tests.support.refusals import refused
from tests.support.renderer_banks import bank_folder

LENS = Lens(50.0, 2.0, 1.0, 9.0)
SIZE = (48, 72)


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    rng = np.random.default_rng(0)
    rgb = np.kron(rng.uniform(0.02, 0.7, (12, 18, 3)), np.ones((4, 4, 1))).astype(np.float32)
    rgb[10, 50] = 1.0
    depth_m = np.full(SIZE, 2.0, np.float32)
    depth_m[:, :30] = 1.0
    write_image(tmp_path / "photo.exr", rgb, half=False)
    write_image(tmp_path / "photo.png", rgb)
    write_exr(tmp_path / "depth.exr", ExrPart({"Z": depth_m}))
    # 1 m is 1 dioptre, white; 2 m is half a dioptre, black.
    cv2.imencode(".png", np.where(depth_m < 1.5, 65535, 0).astype(np.uint16))[1].tofile(tmp_path / "disparity.png")
    write_lens(tmp_path / "lens.json", LENS)
    return {name: tmp_path / name for name in ("photo.exr", "photo.png", "depth.exr", "disparity.png", "lens.json")} | {"folder": tmp_path}


def run(files: dict[str, Path], out: str, *more: object, photo: str = "photo.exr", depth: str | None = "depth.exr") -> Path:
    path = files["folder"] / out
    known = [] if depth is None else ["--depth", str(files[depth])]
    arguments = [str(files[photo]), "--lens", str(files["lens.json"]), "--renderer", "scatter", "--out", str(path), *known, *map(str, more)]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return path


def expected(files: dict[str, Path], focus_m: float, lens: Lens = LENS) -> np.ndarray:
    sharp = opaque(read_image(files["photo.exr"]), read_depth(files["depth.exr"]))
    return ScatterReference().render([sharp], lens.focused_at(focus_m)).rgb


def test_the_picture_is_that_of_the_lens(files: dict[str, Path]) -> None:
    half_step = 2.0**-11
    np.testing.assert_allclose(read_image(run(files, "a.exr")), expected(files, 1.0), rtol=half_step, atol=1e-6)
    np.testing.assert_allclose(read_image(run(files, "b.exr", "--focus", 2.0)), expected(files, 2.0), rtol=half_step, atol=1e-6)
    np.testing.assert_allclose(read_image(run(files, "c.exr", "--focus-at", "60,20")), expected(files, 2.0), rtol=half_step, atol=1e-6)
    assert np.abs(expected(files, 1.0) - expected(files, 2.0)).max() > 0.1


def test_a_bank_is_a_lens(files: dict[str, Path]) -> None:
    """It blurs as the lens that it was made for, in its place or focused elsewhere."""
    bank = bank_folder(files["folder"] / "bank", LENS, 40.0)
    found = read_image(run(files, "a.exr", "--lens", bank, "--focus", 2.0))
    assert psnr(found, expected(files, 2.0)) > 38.0 > psnr(expected(files, 1.0), expected(files, 2.0))


def test_disparity_of_sixteen_bit_means_the_same(files: dict[str, Path]) -> None:
    found = read_image(run(files, "a.exr", "--disparity", "1:2", "--no-refine", depth="disparity.png"))
    np.testing.assert_allclose(found, expected(files, 1.0), rtol=2e-3, atol=1e-4)
    farther = read_image(run(files, "b.exr", "--disparity", "1:8", "--no-refine", depth="disparity.png"))
    assert np.abs(farther - found).max() > 0.02
    metres = read_image(run(files, "c.exr", "--depth-scale", 2.0 / 65535, "--no-refine", depth="disparity.png"))
    assert np.abs(metres - found).max() > 0.02


def test_several_distances_become_a_focal_stack_with_a_sheet(files: dict[str, Path]) -> None:
    folder = run(files, "stack", "--focus", "1,1.4,2", "--sheet", files["folder"] / "sheet.png", "--save-depth", files["folder"] / "z.exr")
    stack = read_focal_stack(folder)
    assert stack.focus_distances_m == (1.0, 1.4, 2.0) and stack.merged
    np.testing.assert_allclose(stack.slice_rgb(2), expected(files, 2.0), atol=1e-6)
    np.testing.assert_array_equal(stack.depth_m(), read_depth(files["depth.exr"]))
    np.testing.assert_array_equal(read_depth(files["folder"] / "z.exr"), stack.depth_m())
    # 1 m is sharpest in slice 0, 2 m in slice 2.
    assert stack.focus_index()[5, 5] == 0 and stack.focus_index()[5, 60] == 2
    assert (files["folder"] / "sheet.png").stat().st_size > 500
    refused("exists already", run, files, "stack", "--focus", "1,2")
    assert len(read_focal_stack(run(files, "stack", "--focus", "1,2", "--overwrite"))) == 2


def test_a_focus_pull_is_a_film(files: dict[str, Path]) -> None:
    film = run(files, "pull.mkv", "--focus", "1:2:5", "--rate", 10)
    frames = list(read_frames(film))
    assert [each.time_s for each in frames] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4], abs=1e-3)
    for index, focus_m in ((0, 1.0), (4, 2.0)):
        assert psnr(frames[index].rgb, np.clip(expected(files, focus_m), 0, 1)) > 70
    refused("5 distances", run, files, "one.png", "--focus", "1:2:5")


def test_clipped_light_is_boosted_only_when_asked_and_smoothly(files: dict[str, Path]) -> None:
    """The lamp at 2 m is one pixel of white 5 px out of focus; three stops more are eight times its light, and of nothing else."""
    plain = read_image(run(files, "a.exr", photo="photo.png"))
    boosted = read_image(run(files, "b.exr", "--highlights", 3, photo="photo.png"))
    np.testing.assert_allclose(plain, expected(files, 1.0), rtol=2e-3, atol=1e-4)
    gained = (boosted.astype(np.float64) - plain).sum(axis=(0, 1))
    np.testing.assert_allclose(gained, 7.0, rtol=0.01)
    grey = np.repeat(np.linspace(0, 1, 400, dtype=np.float32)[None, :, None], 3, axis=2)
    found = with_recovered_highlights(grey, 2.0)
    untouched = linear_to_srgb(grey[0, :, 0]) < 0.97
    np.testing.assert_array_equal(found[0, untouched], grey[0, untouched])
    assert found[0, -1, 0] == pytest.approx(4.0) and (np.diff(found[0, :, 0]) >= 0).all()


def test_the_same_view_is_a_lens_of_another_length_and_asks_the_photograph(files: dict[str, Path]) -> None:
    """A phone of 4.2 mm on 5.6 mm sees what 27 mm sees on 36 mm."""
    phone = Photograph(np.zeros((4, 4, 3), np.float32), focal_length_mm=4.2, sensor_width_mm=5.6)
    found = seen_like(replace(LENS, sensor_width_mm=36.0), phone, Path("phone.jpg"))
    assert found.focal_length_mm == pytest.approx(27.0) and found.f_number == LENS.f_number
    refused("--same-view", seen_like, LENS, Photograph(np.zeros((4, 4, 3), np.float32)), Path("phone.jpg"))
    refused("does not tell its focal length", run, files, "a.exr", "--same-view")


def test_what_is_missing_or_odd_is_one_sentence(files: dict[str, Path]) -> None:
    for more, words in (
        (["--focus", "1", "--focus-at", "3,3"], "give one of them"),
        (["--focus", "soon"], "--focus"),
        (["--focus-at", "900,3"], "900"),
        (["--disparity", "3"], "NEAR:FAR"),
        (["--depth-model-gives", "depth"], "'inverse' or 'metric'"),
    ):
        refused(words, run, files, "a.exr", *more)
    refused("holds no depth of its own", run, files, "a.exr", depth=None)
    (files["folder"] / "other").mkdir()
    refused("not made by transfer", run, files, "other", "--overwrite")


def test_a_phones_photograph_brings_its_depth_its_original_and_its_focus(files: dict[str, Path], shared_data: Path) -> None:
    """The face of the file is blurred by the phone; what is blurred here is the sharp original, small enough for a quick test."""
    from mrbokeh.depth.phone_depth import read_phone_photo

    path = shared_data / "rgbd" / "phone_lens_blur_gdepth.jpg"
    phone = read_phone_photo(path)
    assert phone is not None and phone.original_rgb is not None
    lens = files["folder"] / "tiny.json"
    write_lens(lens, Lens(50.0, 500.0, 1.0, 36.0))
    out = files["folder"] / "phone.exr"
    arguments = [str(path), "--lens", str(lens), "--out", str(out), "--no-refine"]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    # An opening of 0.1 mm, 50 mm, 21.3 px/mm: 0.1 px per dioptre, so that the original comes out.
    assert result.exit_code == 0 and "GDepth of the phone" in result.output
    assert psnr(linear_to_srgb(read_image(out)), linear_to_srgb(phone.original_rgb)) > 45
    assert psnr(linear_to_srgb(read_image(out)), linear_to_srgb(read_image(path))) < 25

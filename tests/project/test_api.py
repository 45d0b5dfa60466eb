"""The verbs on arrays do what the commands do, take files and arrays alike, refuse what cannot be meant; the examples run."""

import runpy
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mrbokeh as mb
from mrbokeh.commands.on_arrays import focus_in_numbers
from mrbokeh.images.image_io import write_layer
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.system.errors import InputError
from tests.support.command_line import mrbokeh
from tests.support.shipped_photographs import few_small_photographs

ROOT = Path(__file__).resolve().parents[2]
LENS = mb.Lens(focal_length_mm=50, f_number=2.0, focus_distance_m=2.0)


def picture_and_depth() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    depth_m = np.full((40, 60), 2.0, np.float32)
    depth_m[:, 36:] = 0.8
    return rng.uniform(0.0, 1.0, (40, 60, 3)).astype(np.float32), depth_m


def ball(depth_m: float = 1.2) -> mb.Layer:
    y, x = np.mgrid[:40, :60]
    alpha = (np.hypot(x - 34, y - 20) < 10).astype(np.float32)
    return mb.Layer(alpha[..., None] * np.full(3, 0.7, np.float32), alpha, np.where(alpha > 0, depth_m, np.inf).astype(np.float32))


def test_a_lens_is_by_default_focused_at_infinity_on_full_frame() -> None:
    lens = mb.Lens(focal_length_mm=50, f_number=1.8)
    assert (lens.focus_distance_m, lens.sensor_width_mm) == (np.inf, 36.0)


def test_render_is_the_renderer_of_that_name_with_the_focus_asked_for() -> None:
    picture, depth_m = picture_and_depth()
    layer = mb.Layer(picture, np.ones((40, 60), np.float32), depth_m)
    on_the_post = ScatterReference().render([layer], LENS.focused_at(0.8)).rgb
    np.testing.assert_array_equal(mb.render(picture, depth_m, LENS, focus=(50, 20), renderer="scatter"), on_the_post)
    np.testing.assert_array_equal(mb.render(picture, depth_m, LENS, focus=0.8, renderer=ScatterReference()), on_the_post)
    for wrong in ("near", ("a", "b"), (1.0, 2.0, 3.0)):
        with pytest.raises(InputError, match="expected metres, or the pixel to focus on"):
            focus_in_numbers(wrong)
    np.testing.assert_array_equal(mb.render(picture, depth_m, LENS, renderer="scatter"), ScatterReference().render([layer], LENS).rgb)


def test_render_and_composite_make_the_pictures_of_their_commands(tmp_path: Path) -> None:
    picture, depth_m = picture_and_depth()
    files = {name: tmp_path / name for name in ("sharp.exr", "photo.exr", "ball.exr", "lens.json", "blurred.exr", "with_ball.exr")}
    write_layer(files["sharp.exr"], mb.Layer(picture, np.ones((40, 60), np.float32), depth_m), half=False)
    write_layer(files["ball.exr"], ball(), half=False)
    write_lens(files["lens.json"], LENS)
    sharp, lens = files["sharp.exr"], files["lens.json"]
    assert mrbokeh("render", "--rgb", sharp, "--depth", sharp, "--lens", lens, "--out", files["blurred.exr"]).returncode == 0
    photo = mb.render(sharp, sharp, lens)
    np.testing.assert_array_equal(photo, mb.render(picture, depth_m, LENS))
    np.testing.assert_array_equal(photo.astype(np.float16), mb.read_picture(files["blurred.exr"]).astype(np.float16))

    mb.write_image(files["photo.exr"], photo, half=False)
    words = (files["photo.exr"], "--layer", files["ball.exr"], "--depth", sharp, "--lens", lens, "--out", files["with_ball.exr"])
    assert mrbokeh("composite", *words).returncode == 0
    with_ball = mb.composite(photo, ball(), LENS, depth_m=depth_m)
    np.testing.assert_array_equal(with_ball, mb.composite(files["photo.exr"], files["ball.exr"], lens, depth_m=sharp))
    np.testing.assert_allclose(with_ball, mb.read_picture(files["with_ball.exr"]), atol=2e-3)  # half floats
    assert np.abs(with_ball - photo).max() > 0.1


def test_composite_knows_the_best_mode_and_where_layers_stand() -> None:
    picture, depth_m = picture_and_depth()
    photo = mb.render(picture, depth_m, LENS)
    known = {"depth_m": depth_m, "all_in_focus": picture}
    between = mb.composite(photo, ball(), LENS, **known)
    np.testing.assert_array_equal(between, mb.composite(photo, [ball()], LENS, mode="between", **known))
    # At the pixel (30, 20) the photograph shows the wall at 2 m: the ball is brought there from any depth.
    standing = mb.composite(photo, ball(0.3), LENS, at_pixel=(30, 20), **known)
    np.testing.assert_allclose(standing, mb.composite(photo, ball(2.0), LENS, **known), atol=1e-5)
    assert not np.array_equal(mb.composite(photo, ball(), LENS, focus=(50, 20), **known), between)


def test_an_object_stands_on_a_photograph_without_depth_as_by_the_command(tmp_path: Path) -> None:
    photo = tmp_path / "photo.exr"
    mb.write_image(photo, picture_and_depth()[0])
    cake = ROOT / "mrbokeh/demo_data/objects/cakeBirthday.glb"
    picture = mb.composite(photo, cake, at_pixel=(30, 32), height="20px")
    words = ("--object", cake, "--at-pixel", "30,32", "--height", "20px", "--out", tmp_path / "command.exr")
    assert "there is no depth: mrbokeh takes the camera" in mrbokeh("composite", photo, *words).stdout
    np.testing.assert_allclose(mb.read_picture(tmp_path / "command.exr"), picture, rtol=2e-3, atol=1e-3)


def test_an_object_in_a_grey_photograph_is_grey_as_by_the_command(tmp_path: Path) -> None:
    photo, cake = tmp_path / "grey.exr", ROOT / "mrbokeh/demo_data/objects/cakeBirthday.glb"
    mb.write_image(photo, np.repeat(picture_and_depth()[0].mean(axis=2, keepdims=True), 3, axis=2))
    assert np.ptp(mb.composite(photo, cake, at_pixel=(30, 32), height="20px"), axis=2).max() < 1e-6


def test_the_focus_that_is_given_stays_where_the_photograph_tells_none(tmp_path: Path) -> None:
    """The object stands at 2 m; the lens that is guessed blurs it by a fraction of a pixel where it is focused at 0.8 m."""
    photo, (picture, depth_m) = tmp_path / "photo.exr", picture_and_depth()
    mb.write_image(photo, picture)
    cake = ROOT / "mrbokeh/demo_data/objects/cakeBirthday.glb"
    seen = [mb.composite(photo, cake, depth_m=depth_m, at_pixel=(20, 32), height="20px", focus=each) for each in ((50, 20), 0.8, (20, 32))]
    np.testing.assert_allclose(seen[0], seen[1], atol=1e-5)
    assert np.abs(seen[0] - seen[2]).max() > 1e-3


@pytest.mark.parametrize(("factor", "told"), [(1.0, False), (1000.0, True)])
def test_depth_in_millimetres_is_doubted(factor: float, told: bool, capsys: pytest.CaptureFixture[str]) -> None:
    picture, depth_m = picture_and_depth()
    mb.render(picture, factor * depth_m, LENS)
    assert ("is its depth in metres?" in capsys.readouterr().err) == told


def test_merge_takes_arrays_and_keeps_the_stack_where_asked(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    near, far = (np.repeat(np.repeat(rng.uniform(0.05, 0.6, (48, 64, 3)), 2, 0), 2, 1).astype(np.float32) for _ in range(2))
    truth = np.where(np.arange(128)[None, :, None] < 64, near, far)
    depth_m = np.where(np.arange(128)[None, :] < 64, 0.6, 2.0).astype(np.float32) * np.ones((96, 1), np.float32)
    lens = mb.Lens(focal_length_mm=50, f_number=4.0)
    slices = [mb.render(truth, depth_m, lens, focus=focus_m) for focus_m in (0.6, 1.0, 2.0)]
    merged = mb.merge(slices, tmp_path / "scene")
    left, right = merged.all_in_focus[8:-8, 8:50], merged.all_in_focus[8:-8, 78:-8]
    # Each half is that of the slice focused on it; slices differ from the truth in the other half by 0.1 and more.
    assert np.abs(left - truth[8:-8, 8:50]).mean() < 0.01 and np.abs(right - truth[8:-8, 78:-8]).mean() < 0.01
    assert merged.folder is not None and len(mb.read_focal_stack(merged.folder)) == 3 and not merged.metres_known
    with pytest.raises(mb.InputError, match=r"expected a new folder, but .* is a stack"):
        mb.merge(slices[:2], tmp_path / "scene")
    with pytest.raises(mb.InputError, match="is a file"):
        mb.merge(slices[:2], __file__)
    again = mb.merge(slices)
    assert again.folder is None
    np.testing.assert_array_equal(again.all_in_focus, merged.all_in_focus)
    assert merged.depth_m.shape == merged.confidence.shape == merged.focus_index.shape == (96, 128)


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda rgb, z: mb.render(rgb[:30], z, LENS), "of one size"),
        (lambda rgb, z: mb.render((255 * rgb).astype(np.uint8), z, LENS), "read_picture"),
        (lambda rgb, z: mb.render(rgb * np.nan, z, LENS), "NaN"),
        (lambda rgb, z: mb.render(rgb, z[None], LENS), "height, width"),
        (lambda rgb, z: mb.render(rgb, z, LENS, renderer="bokeh"), "expected a renderer"),
        (lambda rgb, z: mb.render(rgb, z, "no_such_lens.json"), "no_such_lens.json"),
        (lambda rgb, _: mb.composite(rgb, ball()), "does not tell its lens"),
        (lambda rgb, _: mb.composite(rgb, ball(), LENS, focus=(3, 3)), "needs depth"),
        (lambda rgb, _: mb.composite(rgb, ball(), LENS, at_pixel=(3, 3)), "onto a pixel the photograph needs depth: give depth_m"),
        (lambda *_: mb.write_layer("layer.png", ball()), "a name that ends in .exr, got layer.png"),
        (lambda rgb, _: mb.composite(rgb[:30], ball(), LENS), "60x30"),
        (lambda rgb, z: mb.render(rgb, np.nan * z, LENS), "no pixel has any"),
        (lambda rgb, z: mb.render(rgb, 1e-4 * z, LENS), "times the picture"),
        (lambda rgb, _: mb.composite(rgb, [], LENS), "expected a GLB file, a layer"),
        (lambda rgb, _: mb.composite(rgb, replace(ball(), alpha=255 * ball().alpha), LENS), "expected alpha from 0 to 1"),
        (lambda rgb, _: mb.composite(rgb, replace(ball(), alpha=np.nan * ball().alpha), LENS), "expected alpha from 0 to 1"),
        (lambda rgb, _: mb.composite(rgb, replace(ball(), rgb=np.nan * ball().rgb), LENS), "rgb of a layer is NaN"),
        (lambda rgb, _: mb.composite(rgb, ball(), LENS, slice_index=7), "got an array and slice 7"),
        (lambda rgb, _: mb.composite(rgb, ball(), LENS, height=3), "only a GLB takes one"),
        (lambda rgb, _: mb.composite(rgb, ball(), LENS, at_pixel=[(3, 3), (4, 4)]), "at_pixel: expected one for all layers, got 2"),
        (lambda rgb, _: mb.composite(rgb, "cake.glb", LENS, at_pixel=(3, 3), height=[1, 2]), "height: expected one for all GLB files"),
        (lambda *_: mb.read_picture("none.jpg"), "expected a photograph at none.jpg"),
        (lambda rgb, _: mb.composite(rgb, Path(__file__).parents[2] / "README.md", LENS), "first bytes are of another kind"),
        (lambda rgb, _: mb.composite(rgb, ball(), LENS, mode="infront"), "mode: expected one of front, over"),
        (lambda rgb, _: mb.composite(rgb, "cake.glb", LENS), "at_pixel: on which pixel"),
        (lambda rgb, z: mb.render(rgb, z, LENS, renderer=Path("none.onnx")), "none.onnx"),
        (lambda *_: mb.merge(["none.jpg"]), "two or more of one scene at several focus distances, or a folder, got 1"),
        (lambda *_: mb.merge([Path(__file__).parent]), "but found none"),
        (lambda rgb, _: mb.merge([rgb]), "two or more"),
        (lambda rgb, _: mb.merge([rgb, (255 * rgb).astype(np.uint8)]), "got uint8"),
    ],
)
def test_what_cannot_be_meant_is_refused_in_one_sentence(call: object, told: str) -> None:
    with pytest.raises(mb.InputError, match=told):
        call(*picture_and_depth())  # type: ignore[operator]


OF_WRONG_TYPE = """
import numpy as np
import mrbokeh as mb
rgb, depth_m, lens = np.full((4, 6, 3), 0.5), np.full((4, 6), 2.0), mb.Lens(50, 2)
for call in (
    lambda: mb.composite(rgb, 5, lens), lambda: mb.composite(rgb, np.array(5), lens), lambda: mb.merge(5),
    lambda: mb.render(rgb, {}, lens), lambda: mb.render(rgb, depth_m, lens, renderer=5),
    lambda: mb.write_image("w.png", np.zeros((4, 6, 3), np.uint8)), lambda: mb.write_image("w.png", rgb[..., 0]),
):
    try:
        call()
    except mb.InputError as error:
        print(str(error).partition(" expected")[0])
"""


def test_arguments_of_a_wrong_type_are_refused_in_one_sentence_too() -> None:
    """In a process of its own: in this one the annotations refuse them first."""
    told = subprocess.run([sys.executable, "-c", OF_WRONG_TYPE], capture_output=True, text=True, cwd=ROOT)
    assert told.stdout.split() == ["inserted:", "inserted:", "photographs:", "depth_m:", "renderer:", "w.png:", "w.png:"], told.stderr


def test_the_public_names_are_listed_and_say_what_they_are() -> None:
    assert set(mb.__all__) <= set(dir(mb))
    assert all((getattr(mb, name).__doc__ or "").strip() for name in mb.__all__)


@pytest.mark.parametrize("script", sorted((ROOT / "examples").glob("*.py")), ids=lambda path: path.stem)
def test_examples_run(script: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = [str(tmp_path / "out")]
    if "PHOTOGRAPHS_FOLDER" in script.read_text(encoding="utf-8"):
        arguments.append(str(few_small_photographs(tmp_path / "few")))
    monkeypatch.setattr(sys, "argv", [str(script), *arguments])
    runpy.run_path(str(script), run_name="__main__")
    assert len(list((tmp_path / "out").glob("*.png"))) == 2

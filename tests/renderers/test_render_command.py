"""`mrbokeh render` as a user meets it: pictures with depth, layers, focus, and one clear sentence for every mistake."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from mrbokeh.cli import app as everything
from mrbokeh.commands.composite import app as composite
from mrbokeh.commands.render import app
from mrbokeh.images.exr_io import ExrPart, read_exr, write_exr
from mrbokeh.images.image_io import read_image, read_layer, write_image, write_layer
from mrbokeh.images.image_metrics import psnr
from mrbokeh.images.layer import Layer, opaque
from mrbokeh.optics.lens_file import read_lens
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.system.errors import InputError
from tests.support.command_line import printed_by

WIDTH, HEIGHT = 48, 32
LENS = {"focal_length_mm": 50, "f_number": 1.8, "focus_distance_m": 2.0, "sensor_width_mm": 12}
LENS["aperture"] = {"shape": "polygon", "blades": 7, "curvature": 0.3, "rotation_deg": 10}


@pytest.fixture(name="folder")
def fixture_folder(tmp_path: Path) -> Path:
    """A picture whose left half lies at 2 m and whose right half at infinity, a near card, and a lens."""
    rng = np.random.default_rng(0)
    rgb = rng.uniform(0.0, 1.0, (HEIGHT, WIDTH, 3)).astype(np.float32)
    depth_m = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    depth_m[:, WIDTH // 2 :] = 0.0  # background
    write_exr(tmp_path / "aif.exr", ExrPart({name: rgb[..., i] for i, name in enumerate("RGB")}))
    write_exr(tmp_path / "z.exr", ExrPart({"Z": depth_m}))
    alpha = np.zeros((HEIGHT, WIDTH), np.float32)
    alpha[8:20, 10:30] = 1.0
    card = Layer(np.repeat(alpha[..., None], 3, 2), alpha, np.where(alpha > 0, 0.7, np.inf).astype(np.float32), {"matte": alpha[..., None]})
    write_layer(tmp_path / "card.exr", card, half=False)
    (tmp_path / "lens.json").write_text(json.dumps(LENS))
    return tmp_path


def run(folder: Path, *arguments: str, out: str = "out.exr") -> Path:
    """Names of files are those in the folder; raises what the command line would print."""
    words = [str(folder / word) if word.rsplit(".", 1)[-1] in ("exr", "json", "png", "hdr") else word for word in arguments]
    result = CliRunner().invoke(app, [*words, "--out", str(folder / out)])
    if isinstance(result.exception, InputError):
        raise result.exception
    assert result.exit_code == 0, result.output
    return folder / out


PICTURE = ("--rgb", "aif.exr", "--depth", "z.exr", "--lens", "lens.json", "--renderer", "scatter")


def test_a_lens_can_be_told_in_options_instead_of_a_file(folder: Path) -> None:
    """Options go before the file's facts; without a file the lens is 50 mm f/1.8 on 36 mm, with a round opening."""
    picture = ("--rgb", "aif.exr", "--depth", "z.exr", "--renderer", "scatter", "--focus", "2")
    (folder / "round.json").write_text(json.dumps(LENS | {"focal_length_mm": 40, "aperture": {"shape": "disc"}}))
    by_file = read_image(run(folder, *picture, "--lens", "round.json", "--focal-length", "50"))
    by_options = read_image(run(folder, *picture, "--sensor-width", "12", out="options.exr"))
    assert np.array_equal(by_file, by_options)
    wide = read_image(run(folder, *picture, "--sensor-width", "12", "--f-number", "16", out="wide.exr"))
    assert psnr(wide, by_options) < 40.0, "the f-number is heard"


def test_terms_and_passes_of_low_rank_filters_can_be_told(folder: Path) -> None:
    """The more terms, the nearer to exact kernels: with the focus at 0.3 m circles are 19 and 22 px wide."""
    picture = ("--rgb", "aif.exr", "--depth", "z.exr", "--lens", "lens.json", "--focus", "0.3")
    exact = read_image(run(folder, *picture, "--renderer", "scatter"))

    def error(*words: str) -> float:
        return float(
            np.abs(read_image(run(folder, *picture, "--renderer", "low-rank", *words, "--overwrite", out="low.exr")) - exact).mean()
        )

    assert error("--rank", "1") > 2.0 * error("--rank", "3") > 2.0 * error("--rank", "12")
    assert error("--two-passes") != error()
    for words, told in (
        (("--rank", "3"), "--rank and --two-passes are of --renderer low-rank"),
        (("--renderer", "lrdm", "--slices", "4"), "--slices is for renderers that cut"),
    ):
        with pytest.raises(InputError, match=told):
            run(folder, *picture, *words, out="none.exr")
    assert not (folder / "none.exr").exists()


def test_depth_may_be_even_in_dioptres(folder: Path) -> None:
    """White is 1 m, black infinity: half of it is 2 m."""
    levels = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
    levels[:, WIDTH // 2 :] = 0.0
    write_image(folder / "levels.png", levels, "linear")
    words = ("--rgb", "aif.exr", "--depth", "levels.png", "--disparity", "1:inf", "--lens", "lens.json", "--renderer", "scatter")
    np.testing.assert_allclose(read_image(run(folder, *words)), read_image(run(folder, *PICTURE, out="metres.exr")), atol=2e-3)


def test_a_picture_with_depth_is_what_the_library_renders(folder: Path) -> None:
    done = read_exr(run(folder, *PICTURE))[0]
    assert sorted(done.channels) == ["B", "G", "R"]
    rgb, lens = read_image(folder / "aif.exr"), read_lens(folder / "lens.json")
    depth_m = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    depth_m[:, WIDTH // 2 :] = np.inf
    expected = ScatterReference().render([opaque(rgb, depth_m)], lens)
    np.testing.assert_allclose(done.stacked("RGB"), expected.rgb, atol=1e-3)  # stored as half
    np.testing.assert_allclose(done.stacked("RGB")[:, :10], rgb[:, :10], atol=1e-3)  # in focus


@pytest.mark.parametrize("channel", ["depth.Z", "Y"])
def test_depth_may_have_other_names(folder: Path, channel: str) -> None:
    usual = read_image(run(folder, *PICTURE))
    write_exr(folder / "z.exr", ExrPart({channel: read_exr(folder / "z.exr")[0].channels["Z"]}))
    np.testing.assert_array_equal(read_image(run(folder, *PICTURE, out="other.exr")), usual)


def test_focus_on_a_pixel_and_at_its_distance_are_the_same(folder: Path) -> None:
    write_exr(folder / "z.exr", ExrPart({"Z": np.broadcast_to(np.linspace(1.0, 4.0, WIDTH, dtype=np.float32), (HEIGHT, WIDTH)).copy()}))
    distance_m = read_exr(folder / "z.exr")[0].channels["Z"][5, 20]
    at_pixel = read_image(run(folder, *PICTURE, "--focus-at", "20,5", out="a.exr"))
    at_distance = read_image(run(folder, *PICTURE, "--focus", repr(float(distance_m)), out="b.exr"))
    np.testing.assert_array_equal(at_pixel, at_distance)
    assert np.abs(at_pixel - read_image(run(folder, *PICTURE))).max() > 0.05


def test_layers_lie_over_the_picture_and_alone_keep_their_alpha_and_channels(folder: Path) -> None:
    done = read_layer(run(folder, *PICTURE, "--layer", "card.exr", "--alpha-out"), extra=True)
    assert done.alpha.min() == 1.0
    matte = done.extra["matte"][..., 0]
    assert 0.2 < matte[8, 20] < 0.8 and matte[14, 20] == pytest.approx(1.0, abs=1e-3), "a blurred card of 20 x 12 px with a soft edge"
    np.testing.assert_array_equal(done.depth_m[14, 20], np.float32(0.7))
    done = read_layer(run(folder, "--layer", "card.exr", "--lens", "lens.json", "--renderer", "scatter", "--alpha-out", out="alone.exr"))
    np.testing.assert_allclose(done.rgb[..., 1], done.alpha, atol=1e-3)
    assert done.alpha.max() > 0.99 and done.alpha[0, 40] == 0.0


def test_holes_of_a_picture_are_told(folder: Path) -> None:
    words = [str(folder / word) if word.endswith((".exr", ".json")) else word for word in PICTURE]
    for picture, has_holes in (("card.exr", True), ("aif.exr", False)):
        printed = printed_by(app, *(word.replace("aif.exr", picture) for word in words), "--out", folder / "out.png", "--overwrite")
        assert ("has holes (alpha below 1)" in printed) == has_holes


def test_threads_change_nothing_and_srgb_is_read_when_it_is_said(folder: Path) -> None:
    one, two = (read_image(run(folder, *PICTURE, "--threads", n, out=f"{n}.exr")) for n in "12")
    np.testing.assert_array_equal(one, two)
    cv2.imwrite(str(folder / "aif.png"), np.full((HEIGHT, WIDTH, 3), 188, np.uint8))
    done = read_image(run(folder, "--srgb", *(word.replace("aif.exr", "aif.png") for word in PICTURE)))
    np.testing.assert_allclose(done, 0.5029, atol=1e-3)  # 188 of 255 in sRGB


def spoil_lens(folder: Path, **changed: object) -> None:
    (folder / "lens.json").write_text(json.dumps(LENS | changed))


def write_depth(folder: Path, depth_m: np.ndarray, name: str = "Z") -> None:
    write_exr(folder / "z.exr", ExrPart({name: depth_m.astype(np.float32)}))


MISTAKES = {
    "no such channel": (lambda f: write_depth(f, np.ones((HEIGHT, WIDTH)), "U"), (), "expected depth in a channel Z"),
    "another size": (lambda f: write_depth(f, np.ones((HEIGHT, WIDTH + 2))), (), "must be of one size"),
    "NaN in depth": (lambda f: write_depth(f, np.full((HEIGHT, WIDTH), np.nan)), (), "are NaN"),
    "NaN in colour": (
        lambda f: write_exr(f / "aif.exr", ExrPart({name: np.full((HEIGHT, WIDTH), np.nan, np.float32) for name in "RGB"})),
        (),
        "NaN or infinite",
    ),
    "8 bits given as linear": (
        lambda f: cv2.imwrite(str(f / "aif.png"), np.zeros((HEIGHT, WIDTH, 3), np.uint8)),
        ("--rgb", "aif.png"),
        "expected scene-linear values",
    ),
    "negative f-number": (lambda f: spoil_lens(f, f_number=-1.8), (), "f_number"),
    "focus nearer than the focal length": (lambda f: spoil_lens(f, focus_distance_m=0.04), (), "cannot focus"),
    "focus by option nearer than the focal length": (lambda _: None, ("--focus", "0.01"), "cannot focus"),
    "focus outside": (lambda _: None, ("--focus-at", "480,10"), "cannot focus at"),
    "focus on the background": (lambda _: None, ("--focus-at", "40,10"), "finite|background"),
    "focus in words": (lambda _: None, ("--focus-at", "middle"), "expected X,Y"),
    "focus twice": (lambda _: None, ("--focus-at", "4,4", "--focus", "1"), "not both"),
    "no lens": (lambda f: (f / "lens.json").unlink(), (), "lens"),
    "an unknown method": (lambda _: None, ("--renderer", "magic"), "expected a renderer"),
    "a missing picture": (lambda f: (f / "aif.exr").unlink(), (), "aif.exr"),
    "not an EXR": (lambda f: (f / "z.exr").write_text("no"), (), "cannot be read as EXR"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_gets_one_sentence_and_writes_nothing(folder: Path, mistake: str) -> None:
    spoil, options, said = MISTAKES[mistake]
    spoil(folder)
    with pytest.raises(InputError, match=said) as caught:
        run(folder, *PICTURE, *options)
    assert "\n" not in str(caught.value)
    assert not (folder / "out.exr").exists()


@pytest.mark.parametrize("method", ["laplacian", "polygon", "low-rank", "scatter"])
def test_a_bank_of_kernels_takes_the_place_of_the_opening(folder: Path, method: str) -> None:
    """A bank of discs gives what the disc of a lens file gives, as near as its cells are fine."""
    bank = folder / "bank"
    spoil_lens(folder, aperture={"shape": "disc"})
    words = ["--diameter", "24", "--counts", "24", "--lens", str(folder / "lens.json"), "--out", str(bank)]
    made = CliRunner().invoke(everything, ["lens", "psf", "simple", *words])
    assert made.exit_code == 0, made.output
    by_lens, by_bank = (
        read_image(run(folder, *PICTURE[:-1], method, *lens, out=f"{len(lens)}.exr")) for lens in ((), ("--lens", str(bank)))
    )
    assert psnr(by_bank, by_lens) > 40.0
    by_renderer = read_image(run(folder, *PICTURE[:-1], str(bank), out="renderer.exr"))
    assert psnr(by_renderer, by_lens) > 40.0
    with pytest.raises(InputError, match="laplacian"):
        run(folder, *PICTURE[:-1], "lrdm", "--lens", str(bank), out="other.exr")


@pytest.mark.parametrize("method", ["lrdm", "laplacian"])
def test_noisy_samples_become_a_clean_picture(tmp_path: Path, method: str) -> None:
    """8 samples a pixel of a fence before moving boards, against 1024: 26.1 dB as they are."""
    scene = Path(__file__).parents[1] / "data" / "samples" / "fence_1"
    words = ["--samples", str(scene / "samples.npz"), "--lens", str(scene / "lens.json"), "--renderer", method]
    result = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "clean.exr")])
    assert result.exit_code == 0, result.output
    clean, truth = (np.clip(read_image(path), 0.0, 1.0) for path in (tmp_path / "clean.exr", scene / "reference.exr"))
    assert psnr(clean, truth) > 26.1 + (5.0 if method == "lrdm" else 2.0)


def test_samples_do_not_go_with_pictures_or_other_methods(folder: Path) -> None:
    scene = Path(__file__).parents[1] / "data" / "samples" / "fence_1"
    with pytest.raises(InputError, match="leave out"):
        run(folder, *PICTURE, "--samples", str(scene / "samples.npz"))
    with pytest.raises(InputError, match="lrdm or laplacian"):
        run(folder, "--samples", str(scene / "samples.npz"), "--lens", str(scene / "lens.json"), "--renderer", "polygon")


@pytest.mark.parametrize("method", ["laplacian", "lrdm"])
def test_a_device_gives_the_same_picture_or_one_sentence(folder: Path, method: str) -> None:
    """torch on the CPU stands for any device: it sums in another order than the compiled loops."""
    pytest.importorskip("torch")
    words = (*PICTURE[:-1], method)
    plain, on_device = (read_image(run(folder, *words, *more, out=f"{i}.exr")) for i, more in enumerate([(), ("--device", "cpu")]))
    assert psnr(on_device, plain) > 80.0
    for wrong, said in (((*words, "--device", "abacus"), "got 'abacus'"), ((*PICTURE, "--device", "cpu"), "--device is for --renderer")):
        with pytest.raises(InputError, match=said):
            run(folder, *wrong, out="none.exr")
    assert not (folder / "none.exr").exists()


def test_half_a_picture_alpha_in_a_png_and_existing_files_are_refused(folder: Path) -> None:
    (folder / "out.exr").write_text("mine")
    for words, out, said in (
        (("--rgb", "aif.exr", "--lens", "lens.json"), "new.exr", "belong together"),
        (("--lens", "lens.json"), "new.exr", "nothing to blur"),
        (("--rgb", "aif.exr", "--depth", "-2", "--lens", "lens.json"), "new.exr", "metres above 0 such as 4, got -2"),
        (("--rgb", "aif.exr", "--depth", "2", "--disparity", "1:9", "--lens", "lens.json"), "new.exr", "--disparity 1:9 says"),
        ((*PICTURE, "--shutter", "0.5"), "new.exr", "for 0.5 of it give 180"),
        ((*PICTURE, "--alpha-out"), "out.png", "needs an \\.exr"),
        (PICTURE, "out.exr", "--overwrite"),
    ):
        with pytest.raises(InputError, match=said):
            run(folder, *words, out=out)
    assert (folder / "out.exr").read_text() == "mine"


def test_colours_are_stated(folder: Path) -> None:
    """Linear Rec.709, with the primaries of ITU-R BT.709."""
    for more, out in (((), "picture.exr"), (("--alpha-out",), "layer.exr")):
        (part,) = read_exr(run(folder, *PICTURE, *more, out=out))
        assert part.attributes["chromaticities"] == pytest.approx((0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329))
        assert (part.attributes["oiio:ColorSpace"], part.attributes["colorInteropID"]) == ("lin_rec709", "lin_rec709_scene")


def test_a_layer_without_depth_is_refused_as_composite_does(tmp_path: Path) -> None:
    """Its blur would be that of infinity, which nobody asked for."""
    write_exr(tmp_path / "flat.exr", ExrPart(dict.fromkeys("RGBA", np.full((8, 8), 0.5, np.float32))))
    write_exr(tmp_path / "plate.exr", ExrPart(dict.fromkeys("RGB", np.zeros((8, 8), np.float32))))
    layer = ("--layer", tmp_path / "flat.exr", "--focal-length", 50, "--f-number", 2, "--out", tmp_path / "out.exr")
    for command, words in ((app, ()), (composite, (tmp_path / "plate.exr", "--focus", "1", "--sensor-width", "36"))):
        with pytest.raises(InputError, match=r"flat\.exr: expected depth in a channel Z, .* but it has A, B, G, R: render with depth"):
            printed_by(command, *words, *layer)

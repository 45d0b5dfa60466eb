"""`mrbokeh lens`: options become the lens, the sheet becomes a picture."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from mrbokeh.commands.lens import app
from mrbokeh.figures.psf_bank_drawing import draw_lens, kernel_rgb
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import read_lens, write_lens
from mrbokeh.system.errors import InputError

BODY = ["--focal-length", "50", "--f-number", "1.8", "--focus", "2"]


def new(path: Path, *options: object) -> Lens:
    CliRunner().invoke(app, ["new", str(path), *BODY, *map(str, options)], catch_exceptions=False)
    return read_lens(path)


@pytest.mark.parametrize(("options", "expected"), [
    ([], Aperture.disc()), (["--blades", 7, "--rotation", 30], Aperture.blades(7, np.pi / 6)),
    (["--blades", 5, "--curvature", 0.5], Aperture.blades(5, 0.0, 0.5)), (["--shape", "ring", "--inner", 0.6], Aperture.ring(0.6)),
    (["--shape", "star", "--blades", 6, "--inner", 0.5], Aperture.star(6, 0.5)),
    (["--shape", "heart", "--squeeze", 2], Aperture.heart().squeezed(2.0)),
    (["--shape", "outline", "--path", "M0 0H1V1Z"], Aperture.from_outline("M0 0H1V1Z")),
])  # fmt: skip
def test_shapes(tmp_path: Path, options: list[object], expected: Aperture) -> None:
    made = new(tmp_path / "lens.json", *options).aperture
    assert made.weights == expected.weights
    np.testing.assert_allclose(made.outlines[0], expected.outlines[0], atol=1e-9)


def test_an_image_and_its_levels(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "ramp.png"), np.repeat(np.linspace(0, 255, 64).astype(np.uint8)[None], 32, axis=0))
    made = new(tmp_path / "lens.json", "--shape", "image", "--image", tmp_path / "ramp.png", "--levels", 3)
    assert made.aperture.weights == pytest.approx((1 / 3,) * 3)


def test_modifiers_tilt_and_curvature(tmp_path: Path) -> None:
    lens = new(
        tmp_path / "lens.json",
        *("--cat-eye", 0.5, "--spherical-aberration", -0.5, "--axial-chromatic", 0.1, 0, -0.1, "--lateral-chromatic", 0, 0.1, 0.2),
        *("--tilt", 1, -2, "--petzval-radius", 75),
    )
    opening = lens.aperture
    assert (opening.cat_eye, opening.spherical_aberration) == (0.5, -0.5)
    assert (opening.axial_chromatic, opening.lateral_chromatic) == ((0.1, 0.0, -0.1), (0.0, 0.1, 0.2))
    assert lens.tilt_rad == pytest.approx(tuple(np.radians([1, -2]))) and lens.petzval_radius_mm == 75.0


@pytest.mark.parametrize(("options", "message"), [
    (["--inner", 0.5], "--inner does nothing for the shape disc"),
    (["--shape", "heart", "--blades", 5], "--blades does nothing for the shape heart"),
    (["--shape", "blob"], "expected --shape out of"), (["--shape", "ring"], "inner missing"), (["--cat-eye", 3], "cat_eye"),
])  # fmt: skip
def test_options_wired_to_nothing_are_refused(tmp_path: Path, options: list[object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        new(tmp_path / "lens.json", *options)
    assert not (tmp_path / "lens.json").exists()


COLOURED = Aperture(
    Aperture.blades(7).outlines, (1.0,), 0.7, 0.5, axial_chromatic=(0.1, 0.0, -0.1), lateral_chromatic=(0.05, 0.0, -0.05)
)  # fmt: skip


def test_kernels_in_colour_and_the_sheet_shows_what_the_lens_has() -> None:
    """The blur of red is 1.1, of blue 0.9 times as wide; each colour keeps its light."""
    kernel = kernel_rgb(COLOURED, 30.0)
    np.testing.assert_allclose(kernel.sum((0, 1)), 1.0, rtol=1e-12)
    widths = [(kernel[..., channel].sum(0) > 1e-6).sum() for channel in range(3)]
    assert widths[0] > widths[1] > widths[2]
    grey = kernel_rgb(Aperture.disc(), 30.0)
    np.testing.assert_array_equal(grey[..., 0], grey[..., 2])

    def titles(lens: Lens) -> str:
        return " ".join(axes.get_title() for axes in draw_lens(lens, 960).axes)

    plain = titles(Lens(50.0, 1.8, 2.0, 36.0))
    assert all(words in plain for words in ("-24 px in front", "+24 px behind", "opening", "low-rank", "circle of confusion"))
    assert "over the frame" not in plain and "in focus" not in plain
    full = titles(Lens(50.0, 1.8, 2.0, 36.0, COLOURED, (0.05, 0.0)))
    assert "over the frame, -40 px in front" in full and "in focus" in full


def test_coc_wants_a_width_and_a_lens_file(tmp_path: Path) -> None:
    (tmp_path / "bank.json").touch()
    for words in (["coc", str(tmp_path), "1", "--image-width", "0"], ["psf", "physical", "--out", str(tmp_path), "--image-width", "-5"]):
        refused = CliRunner().invoke(app, words, env={"COLUMNS": "200"})
        assert refused.exit_code == 2 and "greater than or equal to 1" in refused.output
    with pytest.raises(InputError, match="it is a bank of PSFs: give the lens file that it was made of"):
        CliRunner().invoke(app, ["coc", str(tmp_path), "1"], catch_exceptions=False)


def test_show_writes_a_picture(tmp_path: Path) -> None:
    few = replace(COLOURED, outlines=Aperture.blades(3).outlines)
    write_lens(tmp_path / "lens.json", Lens(50.0, 1.8, float("inf"), 36.0, few, petzval_radius_mm=80.0))
    arguments = ["show", str(tmp_path / "lens.json"), "--out"]
    CliRunner().invoke(app, [*arguments, str(tmp_path / "sheet.png")], catch_exceptions=False)
    assert cv2.imread(str(tmp_path / "sheet.png")).shape[1] == 13 * 150
    with pytest.raises(InputError, match=r"expected \.png"):
        CliRunner().invoke(app, [*arguments, str(tmp_path / "sheet.txt")], catch_exceptions=False)

"""Blur pairs: kernels out of a sharp picture, its diameters and a blurred picture that lies apart and was lit otherwise."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from mrbokeh.commands import lens_fit
from mrbokeh.commands.lens_fit import fit as fit_command
from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.lens_measuring.fitting.blur_pairs import (
    BLURRED,
    COC,
    SHARP,
    BlurPair,
    Match,
    blurred_by_disc,
    even_light,
    find_blur_pairs,
    match,
    read_blur_pair,
)
from mrbokeh.lens_measuring.fitting.lens_fit import FitSettings, fit_lens
from mrbokeh.lens_measuring.fitting.stack_equations import usable_pixels
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.psf_bank_file import read_bank
from mrbokeh.renderers.scatter_reference import scatter
from mrbokeh.system.errors import InputError
from tests.lens_measuring.test_lens_fitting import kernels_are_like
from tests.support.blur_pair_files import write_blur_pair
from tests.support.refusals import refused

SIZE = (110, 150)
DIAMETER_PX = 12.0
GAIN, BLACK = 0.45, 0.02
APART = Match(np.array([[1.006, 0.001, 1.6], [-0.001, 1.004, -2.3]]))
"""How far breathing moves and enlarges a picture of this size, about as in photographs of a telephone: up to 3 px."""
RING = Aperture.ring(0.5)


def texture(seed: int = 0) -> np.ndarray:
    """Squares of 6 px and of one."""
    rng = np.random.default_rng(seed)
    height, width = SIZE
    coarse = np.kron(rng.random((height // 6 + 1, width // 6 + 1, 3)), np.ones((6, 6, 1)))[:height, :width]
    return (0.05 + 0.6 * coarse + 0.2 * rng.random((height, width, 3))).astype(np.float32)


def lit() -> np.ndarray:
    """Light that changes by a quarter over the frame, as where a shiny box mirrors something else."""
    y, x = np.indices(SIZE) / max(SIZE)
    return (1.0 + 0.25 * np.sin(2.0 * x + 1.0) * np.cos(3.0 * y))[..., None].astype(np.float32)


def pair(folder: Path, aperture: Aperture = RING) -> BlurPair:
    """A wall behind the focus, photographed through an aperture; the photograph lies apart, is darker, and was lit otherwise."""
    sharp, coc_px = texture(), np.full(SIZE, DIAMETER_PX, np.float32)
    spread = scatter(np.concatenate([sharp, np.ones((*SIZE, 1))], axis=2).astype(np.float64), coc_px, aperture)
    blurred = APART.registered((spread[..., :3] / spread[..., 3:]).astype(np.float32))
    coc_px[:25, :30] = np.nan
    return BlurPair(folder, sharp, (GAIN * lit() * blurred + BLACK).astype(np.float32), coc_px)


def apart_px(found: Match) -> float:
    """How far two maps lead apart, at most, over the frame."""
    corners = np.array([[x, y, 1.0] for x in (0.0, SIZE[1]) for y in (0.0, SIZE[0])])
    return float(np.abs(corners @ (found.sharp_from_blurred - APART.sharp_from_blurred).T).max())


def test_pictures_are_registered_through_their_blur() -> None:
    """Found to a tenth of a pixel where nothing but a disc was between them, whatever the light; gain and black come out as well."""
    sharp, coc_px = texture(), np.full(SIZE, DIAMETER_PX, np.float32)
    usable = np.zeros(SIZE, bool)
    usable[12:-12, 12:-12] = True
    seen = (GAIN * APART.registered(blurred_by_disc(sharp, coc_px)) + BLACK).astype(np.float32)
    found = match(sharp, coc_px, seen, usable)
    assert apart_px(found) < 0.1
    assert (found.gain, found.black) == (pytest.approx(GAIN, rel=0.01), pytest.approx(BLACK, abs=0.005))
    assert apart_px(match(sharp, coc_px, seen * lit(), usable)) < 0.3


def test_pictures_without_texture_stay_as_they_lie() -> None:
    flat, coc_px = np.full((*SIZE, 3), 0.5, np.float32), np.full(SIZE, DIAMETER_PX, np.float32)
    np.testing.assert_allclose(match(flat, coc_px, flat, np.ones(SIZE, bool)).sharp_from_blurred, np.eye(2, 3), atol=1e-6)
    np.testing.assert_array_equal(match(texture(), coc_px, flat, np.zeros(SIZE, bool)).sharp_from_blurred, np.eye(2, 3))


def test_light_that_changes_slowly_is_found() -> None:
    """Within 3 % a window away from the frame; where nothing is known it is left alone."""
    picture, known = blurred_by_disc(texture(), np.full(SIZE, DIAMETER_PX, np.float32)), np.ones(SIZE, bool)
    found = even_light(picture * lit(), picture, known, 20.0)
    np.testing.assert_allclose(found[20:-20, 20:-20], lit()[20:-20, 20:-20, 0], rtol=0.03)
    np.testing.assert_array_equal(even_light(picture, picture, ~known, 20.0), 1.0)


def test_a_pair_tells_the_kernel(tmp_path: Path) -> None:
    """The aperture comes out as it is. Pixels of unknown diameter, and those that their light reaches, are not used."""
    given = pair(tmp_path)
    usable = usable_pixels(given.view)
    assert usable.any()
    assert not usable[:30, :35].any()
    assert apart_px(given.match) < 0.3
    fitted = fit_lens([given], [], FitSettings(diameters_px=(DIAMETER_PX,), regions=(1, 1), pixels=4000))
    assert min(kernels_are_like(fitted, RING, DIAMETER_PX)) > 0.95


def test_pairs_are_read_as_they_were_written(tmp_path: Path) -> None:
    given = pair(tmp_path / "scenes" / "wall")
    write_blur_pair(given)
    (found,) = find_blur_pairs(tmp_path / "scenes")
    for name in ("sharp", "blurred", "coc_px"):
        np.testing.assert_array_equal(getattr(found, name), getattr(given, name))
    with pytest.raises(InputError, match="NaN means unknown"):
        replace(given, coc_px=np.full_like(given.coc_px, np.nan))
    write_exr(given.folder / BLURRED, ExrPart(dict.fromkeys("RGB", given.coc_px[1:])))
    with pytest.raises(InputError, match="one size"):
        read_blur_pair(given.folder)
    write_exr(given.folder / SHARP, ExrPart(dict.fromkeys("RGB", given.coc_px)))
    with pytest.raises(InputError, match=COC):
        read_blur_pair(given.folder)


def test_the_command_takes_folders_of_pairs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_blur_pair(pair(tmp_path / "scenes" / "wall"))
    app = typer.Typer()
    app.command()(fit_command)

    def run(*arguments: object) -> str:
        return CliRunner().invoke(app, [str(each) for each in arguments], catch_exceptions=False).output

    monkeypatch.setattr(lens_fit, "_draw", lambda *_: None)  # a second, and looked at where a stack is fitted
    out = tmp_path / "lens"
    settings = ("--regions", "1x1", "--pixels", 1500, "--diameters", "12")
    assert "error on slices" in run(tmp_path / "scenes", "--out", out, *settings)
    assert read_bank(out).settings["slices"][0]["stack"] == "wall"
    (tmp_path / "scenes" / "wall" / BLURRED).unlink()
    refused("stack.json", run, tmp_path / "scenes", "--out", tmp_path / "other", *settings)

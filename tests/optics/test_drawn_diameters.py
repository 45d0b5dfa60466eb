"""Drawn kernels blur as much as a lens does, so that slices whose focus is right are not called wrong."""

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.report.examination import STEP_PX
from capture.report.slice_fit import Prediction, SliceFit, fit_slice
from capture.report.stack_view import Reblur
from mrbokeh.images.image_metrics import psnr
from mrbokeh.optics import drawn_diameters
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.drawn_diameters import drawn_diameters_px
from mrbokeh.renderers.choose import make_renderer
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.system import compiled

FINER = 5
HEIGHT_PX, WIDTH_PX = 64, 96
INNER = np.s_[6:-6, 6:-6]
EXACT = ScatterReference(threads=1)


APERTURES = [Aperture.disc(), Aperture.ring(0.5), Aperture.blades(6), Aperture.heart()]


@pytest.mark.parametrize("aperture", APERTURES[:3])
@pytest.mark.parametrize("coc_px", [-1.6, 2.3, 3.0, 7.7, -15.7, 16.3, 30.0])
def test_what_is_drawn_passes_detail_as_blur_does(aperture: Aperture, coc_px: float) -> None:
    """Along x, from waves of 50 px down to those of 3: what a kernel drawn 40 times as large (whose pixels are fine) leaves of them."""
    frequencies = np.array([0.02, 0.05, 0.1, 0.2, 0.3])
    drawn = float(drawn_diameters_px(np.full((1, 1), coc_px, np.float32), aperture)[0, 0])
    assert np.sign(drawn) == np.sign(coc_px)
    meant = left_of_waves(aperture, 40.0 * coc_px, frequencies / 40.0)
    off, plainly_off = (np.abs(left_of_waves(aperture, each, frequencies) - meant).max() for each in (drawn, coc_px))
    assert off < 0.07 and off <= plainly_off + 0.01
    if coc_px == 2.3:
        assert off < 0.6 * plainly_off


def left_of_waves(aperture: Aperture, diameter_px: float, frequencies: np.ndarray) -> np.ndarray:
    row = aperture.rasterize(diameter_px).kernel.sum(axis=0)
    along = np.arange(len(row)) - len(row) // 2
    return np.abs(np.exp(2j * np.pi * frequencies[:, None] * along) @ row)


def test_far_beyond_a_pixel_variances_add() -> None:
    """What is drawn differs from the blur by the same in squares, whatever the diameter; 4 / 3 px^2 for a disc's variance alone."""
    coc_px = np.array([[20.0, 40.0, 100.0]], np.float32)
    less = coc_px[0] ** 2 - drawn_diameters_px(coc_px, Aperture.disc())[0] ** 2
    np.testing.assert_allclose(less, less[0], rtol=0.02)
    assert 0.5 < less[0] < 4.0 / 3.0


@pytest.mark.parametrize("aperture", APERTURES)
def test_the_order_of_diameters_stays(aperture: Aperture) -> None:
    coc_px = np.linspace(-20.0, 20.0, 4001, dtype=np.float32)[None]
    drawn = drawn_diameters_px(coc_px, aperture)[0]
    steps = np.diff(drawn)
    assert (steps > 0.0).all() and steps.max() < 0.04, "no jump where 0.01 px follow on each other"
    assert (np.abs(drawn) <= np.abs(coc_px[0]) + 1e-5).all(), "no light beyond the circle of confusion"
    focused = np.abs(coc_px[0]) <= 1.0
    np.testing.assert_allclose(drawn[focused], coc_px[0, focused], atol=1e-6)
    np.testing.assert_allclose(drawn, -drawn[::-1], atol=1e-6)


def picture(finer: int) -> np.ndarray:
    noise = np.random.default_rng(3).random((HEIGHT_PX * FINER, WIDTH_PX * FINER, 3)).astype(np.float32)
    texture = np.clip(0.5 + 2.0 * FINER * (cv2.GaussianBlur(noise, (0, 0), 0.5 * FINER) - 0.5), 0.0, 1.0).astype(np.float32)
    return reduced(texture, FINER // finer)


def reduced(rgb: np.ndarray, factor: int) -> np.ndarray:
    height, width = rgb.shape[0] // factor, rgb.shape[1] // factor
    return np.ascontiguousarray(rgb.reshape(height, factor, width, factor, -1).mean(axis=(1, 3)), np.float32)


def fine_and_coarse(aperture: Aperture) -> tuple[np.ndarray, np.ndarray]:
    """0.3 to 9 px of blur (H, W), and the picture that pixels of 5 x 5 finer ones catch of it."""
    coc_px = np.broadcast_to(-np.linspace(0.3, 9.0, WIDTH_PX, dtype=np.float32), (HEIGHT_PX, WIDTH_PX)).copy()
    fine_px = FINER * np.repeat(np.repeat(coc_px, FINER, axis=0), FINER, axis=1)
    return coc_px, reduced(Reblur(EXACT)(picture(FINER), fine_px, aperture), FINER)


def fitted(aperture: Aperture) -> SliceFit:
    """Fit a slice that is focused behind everything."""
    coc_px, photographed = fine_and_coarse(aperture)
    predicted = (Reblur(EXACT)(picture(1), coc_px + np.float32(step), aperture) for step in (0.0, -STEP_PX, STEP_PX))
    counted = np.zeros(coc_px.shape, bool)
    counted[INNER] = True
    return fit_slice(photographed, Prediction(*predicted, coc_px, STEP_PX), counted)[0]


@pytest.mark.parametrize("aperture", APERTURES[:3])
@pytest.mark.slow
def test_a_slice_at_its_focus_is_found_there(aperture: Aperture, monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawn without regard to the pixels, the very same slice seems to be focused elsewhere, and blurred by another lens."""
    right = fitted(aperture)
    monkeypatch.setattr("mrbokeh.layering.psf_over_field.drawn_diameters_px", lambda coc_px, _: coc_px)
    wrong = fitted(aperture)
    assert abs(right.focus_px.value) < 0.1 and abs(right.blur_gain.value) < 0.015
    assert abs(wrong.focus_px.value) > 0.2 and abs(wrong.blur_gain.value) > 0.03


@cache
def through_a_disc() -> tuple[np.ndarray, np.ndarray]:
    return fine_and_coarse(Aperture.disc())


@pytest.mark.parametrize("name", ["scatter", "polygon", "low-rank", "laplacian", pytest.param("lrdm", marks=pytest.mark.slow)])
def test_every_renderer_blurs_a_picture_of_pixels_as_the_lens_does(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    coc_px, photographed = through_a_disc()
    reblur = Reblur(make_renderer(name))
    right = psnr(reblur(picture(1), coc_px, Aperture.disc())[INNER], photographed[INNER])
    for module in ("mrbokeh.layering.psf_over_field", "mrbokeh.renderers.layered_reconstruction._samples"):
        monkeypatch.setattr(f"{module}.drawn_diameters_px", lambda coc_px, _: coc_px)
    wrong = psnr(reblur(picture(1), coc_px, Aperture.disc())[INNER], photographed[INNER])
    assert right > wrong + 2.0


def test_a_kept_table_is_the_one_that_was_made_and_a_damaged_one_is_made_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "folder_of", lambda _file, _module: tmp_path)
    apertures = (Aperture.disc(), Aperture.blades(6), Aperture.blades(7))
    made = [drawn_diameters.drawn_table.__wrapped__(each) for each in apertures]
    assert len(list(tmp_path.iterdir())) == len(apertures), "one for each opening"
    monkeypatch.setattr(drawn_diameters, "_made_table", None)
    for each, table in zip(apertures, made, strict=True):
        np.testing.assert_array_equal(drawn_diameters.drawn_table.__wrapped__(each), table)
    monkeypatch.undo()
    monkeypatch.setattr(compiled, "folder_of", lambda _file, _module: tmp_path)
    for path in tmp_path.iterdir():
        path.write_bytes(b"x")
    np.testing.assert_array_equal(drawn_diameters.drawn_table.__wrapped__(apertures[0]), made[0])

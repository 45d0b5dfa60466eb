"""Layers as sheets: channels side by side, continued beyond the frame."""

import numpy as np
import pytest

from mrbokeh.images.layer import Layer, clear, opaque
from mrbokeh.layering.padded_layers import PaddedLayer, Pixels, coc_px_of, pad_layer
from mrbokeh.optics.lens import Lens
from mrbokeh.system.resources import CallingThread
from tests.support.refusals import refused

LENS = Lens(focal_length_mm=50.0, f_number=2.0, focus_distance_m=2.0, sensor_width_mm=36.0)
SIZE = (12, 17)


def layer(alpha: float | np.ndarray, extra: int = 0) -> Layer:
    rng = np.random.default_rng(3)
    covered = np.broadcast_to(np.asarray(alpha, np.float32), SIZE).copy()
    channels = {"id": rng.uniform(0.0, 1.0, (*SIZE, extra)).astype(np.float32)} if extra else {}
    rgb = rng.uniform(0.3, 1.0, (*SIZE, 3)).astype(np.float32) * covered[..., None]
    return Layer(rgb, covered, rng.uniform(1.0, 9.0, SIZE).astype(np.float32), channels)


@pytest.mark.parametrize("margin", [0, 1, 5, 30])
@pytest.mark.parametrize("extra", [0, 2])
def test_an_opaque_layer_goes_on_as_its_border_and_one_with_holes_as_nothing(margin: int, extra: int) -> None:
    """Against numpy's padding of all channels put side by side."""
    around = ((margin, margin), (margin, margin))
    for alpha, mode in ((1.0, "edge"), (0.5, "constant")):
        source = layer(alpha, extra)
        coc_px = coc_px_of(source, LENS)
        sheet = pad_layer(source, coc_px, margin, CallingThread())
        values = np.concatenate([source.rgb, source.alpha[..., None], *source.extra.values()], axis=2)
        np.testing.assert_array_equal(sheet.values, np.pad(values, (*around, (0, 0)), mode=mode))
        np.testing.assert_array_equal(sheet.coc_px, np.pad(coc_px, around, mode=mode))
        assert sheet.is_opaque == (alpha == 1.0)


def test_a_lamp_on_the_border_does_not_go_on_as_a_bar() -> None:
    rgb = np.full((*SIZE, 3), 0.5, np.float32)
    rgb[0, 8] = rgb[11, 0] = 100.0
    source = opaque(rgb, np.full(SIZE, 4.0, np.float32))
    sheet = pad_layer(source, coc_px_of(source, LENS), 4, CallingThread())
    np.testing.assert_array_equal(sheet.values[4:16, 4:21, :3], rgb)
    outside = np.ones(sheet.coc_px.shape, bool)
    outside[4:16, 4:21] = False
    np.testing.assert_array_equal(sheet.values[outside, 0], 0.5)


def test_pixels_that_cover_nothing_have_no_circle_of_confusion_and_sheets_know_those_that_do() -> None:
    alpha = np.zeros(SIZE, np.float32)
    alpha[3, 4:7] = 0.5
    source = layer(alpha)
    source.depth_m[alpha == 0] = 0.0
    coc_px = coc_px_of(source, LENS)
    np.testing.assert_array_equal(coc_px == 0, alpha == 0)
    np.testing.assert_array_equal(coc_px[3, 4:7], LENS.coc_px(source.depth_m[3, 4:7], SIZE[1]))
    assert coc_px_of(clear(*SIZE), LENS).max() == 0.0
    source.depth_m[3, 5] = np.nan
    refused("finite circle of confusion", coc_px_of, source, LENS)
    values = np.zeros((3, 4, 5), np.float32)
    values[1, 2], values[2, 0] = 0.5, 0.25
    sheet = PaddedLayer(values, np.arange(12, dtype=np.float32).reshape(3, 4), False)
    pixels = Pixels.covered(sheet)
    np.testing.assert_array_equal(pixels.places, [6, 8])
    np.testing.assert_array_equal(pixels.coc_px, [6.0, 8.0])
    np.testing.assert_array_equal(pixels.values, values.reshape(12, 5)[[6, 8]])
    np.testing.assert_array_equal(Pixels.covered(sheet, sheet.coc_px > 7.0).places, [8])
    assert len(Pixels.of(sheet).places) == 12

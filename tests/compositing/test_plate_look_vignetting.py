"""Falloff of light towards the corners, by coefficients, by a flat field and by lensfun."""

import sys
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.compositing.plate_look.vignetting import (
    CameraAndLens,
    FlatField,
    RadialFalloff,
    Vignetting,
    darkened,
    falloff_at,
    flat_field_of,
    lensfun_falloff,
    read_flat_field,
)
from mrbokeh.images.image_io import write_image
from mrbokeh.images.layer import Layer
from mrbokeh.layering.pixel_box import Box
from mrbokeh.system.errors import InputError, MissingExtraError
from tests.support.refusals import refused

FRAME = (112, 160)
WHOLE = Box(0, 112, 0, 160)
MACRO = CameraAndLens("Canon", "Canon EOS 450D", "Canon EF 100mm f/2.8L Macro IS USM")


def tilted_field() -> FlatField:
    """Brighter on the right, and of different colours."""
    coefficients = np.zeros((7, 7, 3))
    coefficients[0, 0], coefficients[0, 1], coefficients[2, 0] = 1.0, (0.3, 0.2, 0.1), (-0.3, -0.2, -0.1)
    return FlatField(coefficients)


def test_the_polynomial_at_known_radii_on_both_sensors() -> None:
    """In the middle 1; in the corner of the frame 1 + k1 + k2 + k3; half way out 1 + k1/4 + k2/16 + k3/64."""
    falloff = RadialFalloff(-0.5, 0.2, -0.1)
    assert falloff_at(falloff, 80, 56, FRAME)[0] == pytest.approx(1.0, abs=1e-3)
    assert falloff_at(falloff, 0, 0, FRAME)[0] == pytest.approx(0.6, abs=0.01)
    assert falloff_at(falloff, 40, 28, FRAME)[0] == pytest.approx(1 - 0.125 + 0.0125 - 0.1 / 64, abs=0.005)
    whole, cropped = RadialFalloff(-0.4), RadialFalloff(-0.4, reach=0.5)
    assert 1 - falloff_at(cropped, 0, 0, FRAME)[0] == pytest.approx((1 - falloff_at(whole, 0, 0, FRAME)[0]) / 4, rel=1e-4)
    layer = Layer(np.ones((*FRAME, 3), np.float32), np.ones(FRAME, np.float32), np.ones(FRAME, np.float32))
    found = darkened(layer, RadialFalloff(-0.5).gain(WHOLE, FRAME))
    assert found.rgb[0, 0, 0] == pytest.approx(0.5, abs=0.02) and (found.alpha == 1).all()


@pytest.mark.parametrize("vignetting", [RadialFalloff(-0.5, 0.2), tilted_field()])
def test_a_part_of_the_frame_is_cut_out_of_the_whole(vignetting: Vignetting) -> None:
    part = Box(30, 70, 90, 150)
    np.testing.assert_allclose(vignetting.gain(part, FRAME), vignetting.gain(WHOLE, FRAME)[30:70, 90:150], atol=1e-6)


def test_a_photographed_flat_field_of_any_size_gives_the_falloff_back() -> None:
    """Grain of 2 % in 17920 pixels, 28 coefficients: 0.1 % on average, several times that in the very corner, which has few neighbours."""
    truth = RadialFalloff(-0.45, 0.1).gain(WHOLE, FRAME)
    grain = np.random.default_rng(1).normal(1.0, 0.02, (*FRAME, 3))
    found = flat_field_of((0.6 * np.array([1.0, 0.8, 0.7]) * truth * grain).astype(np.float32))
    error = found.gain(WHOLE, FRAME) / truth - 1.0
    assert np.sqrt((error**2).mean()) < 0.002 and np.abs(error).max() < 0.02
    small, large = (
        flat_field_of(np.repeat(RadialFalloff(-0.4).gain(Box(0, h, 0, w), (h, w)), 3, axis=2)) for h, w in ((56, 80), (224, 320))
    )
    np.testing.assert_allclose(small.gain(WHOLE, FRAME), large.gain(WHOLE, FRAME), rtol=0.01)


def test_text_and_files(tmp_path: Path) -> None:
    assert RadialFalloff.parse("-0.4,0.1,0") == RadialFalloff(-0.4, 0.1, 0.0) and RadialFalloff.parse("-0.4") == RadialFalloff(-0.4)
    write_image(tmp_path / "flat.exr", np.repeat(RadialFalloff(-0.4).gain(WHOLE, FRAME), 3, axis=2))
    found = read_flat_field(tmp_path / "flat.exr").gain(WHOLE, FRAME)
    np.testing.assert_allclose(found[..., :1], RadialFalloff(-0.4).gain(WHOLE, FRAME), rtol=0.02)


def test_falloffs_that_cannot_be_are_refused() -> None:
    for text in ("", "a", "1,2,3,4", "nan"):
        refused("--vignetting: expected K1,K2,K3", RadialFalloff.parse, text)
    refused("leaves light in the corners", RadialFalloff, -1.2)
    refused("bright in the middle", flat_field_of, np.zeros((*FRAME, 3), np.float32))


@pytest.mark.parametrize("camera", ["Canon EOS 450D", "Canon EOS 5D Mark II"])
def test_lensfun_measurements_darken_as_lensfun_says(camera: str) -> None:
    """lensfun's own Modifier undoes the falloff: what it makes of an even white is one over ours (sensors of crop 1.62 and 1)."""
    lensfunpy = pytest.importorskip("lensfunpy")
    falloff = lensfun_falloff(CameraAndLens("Canon", camera, MACRO.lens_model), 100.0, 2.8, 10.0)
    database = lensfunpy.Database()
    body = database.find_cameras("Canon", camera)[0]
    lens = next(each for each in database.find_lenses(body, None, MACRO.lens_model) if each.calib_vignetting)
    height, width = 960, 1440
    modifier = lensfunpy.Modifier(lens, body.crop_factor, width, height)
    modifier.initialize(100.0, 2.8, 10.0, pixel_format=np.float32)
    white = np.ones((height, width, 3), np.float32)
    assert modifier.apply_color_modification(white)
    np.testing.assert_allclose(falloff.gain(Box(0, height, 0, width), (height, width)) * white, 1.0, atol=0.003)
    assert falloff_at(falloff, 0, 0, FRAME)[0] < 0.9


def test_what_lensfun_does_not_know_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("lensfunpy")
    refused("does not know the camera Nobody None", lensfun_falloff, CameraAndLens("Nobody", "None", "x"), 50.0, 2.0)
    with pytest.raises(InputError, match="has no vignetting of Noctilux of nowhere"):
        lensfun_falloff(CameraAndLens("Canon", "Canon EOS 450D", "Noctilux of nowhere"), 50.0, 2.0)
    monkeypatch.setitem(sys.modules, "lensfunpy", None)
    with pytest.raises(MissingExtraError, match=r"pip install .*\[capture\]"):
        lensfun_falloff(MACRO, 100.0, 2.8)

"""Exposure, white balance and blacks of the photograph on virtual light."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.compositing.plate_look.colour_match import ColourMatch, PixelBox, darkest_black, grey_card_match, patch_colour
from mrbokeh.compositing.plate_look.exposure_match import (
    Exposure,
    exposure_of_metadata,
    exposure_of_photo,
    matched_exposure,
    white_balance_gain,
    white_of_kelvin,
)
from mrbokeh.images.color import rec709_from_XYZ
from mrbokeh.images.image_io import read_image
from mrbokeh.images.layer import Layer
from tests.support.refusals import refused

CAST, BLACK = (1.6, 0.9, 0.5), (0.012, 0.015, 0.021)


def reflectances(seed: int = 0) -> np.ndarray:
    """A scene of squares with a hole (0), a grey card (0.18) and a white wall."""
    squares = np.random.default_rng(seed).uniform(0.02, 0.8, (14, 20, 3))
    scene = np.kron(squares, np.ones((8, 8, 1)))
    scene[8:32, 8:40], scene[56:80, 64:96], scene[0:8] = 0.0, 0.18, 0.55
    return scene.astype(np.float32)


def photographed(scene: np.ndarray, noise: float = 0.004) -> np.ndarray:
    grain = np.random.default_rng(1).normal(0.0, noise, scene.shape)
    return (scene * np.array(CAST) + np.array(BLACK) + grain).astype(np.float32)


def a_layer(seed: int = 2) -> Layer:
    rng = np.random.default_rng(seed)
    alpha = rng.uniform(0, 1, (12, 16)).astype(np.float32)
    alpha[:4] = 0.0
    colour = rng.uniform(0, 1, (12, 16, 3)).astype(np.float32)
    return Layer(alpha[..., None] * colour, alpha, np.where(alpha > 0, 2.0, np.inf).astype(np.float32))


def test_a_grey_card_under_a_cast_gives_the_gain_back_in_a_dark_corner_as_well() -> None:
    """Twelve thousand values of noise 0.004 on 0.18: the mean of 21x21 is good to about 0.3 % of the weakest channel's 0.09."""
    plate = photographed(reflectances())
    found = grey_card_match(plate, PixelBox(80, 68, 10), black=BLACK)
    np.testing.assert_allclose(found.gain, CAST, rtol=0.01)
    assert found.black == BLACK
    plate = photographed(reflectances())
    found = grey_card_match(plate, PixelBox(80, 68, 10), rendered=(0.36, 0.18, 0.09), black=BLACK)
    np.testing.assert_allclose(found.gain, np.array(CAST) / (2.0, 1.0, 0.5), rtol=0.01)
    plate = (0.7 * reflectances()).astype(np.float32)
    np.testing.assert_allclose(grey_card_match(plate, PixelBox(80, 68, 10), falloff=(0.7, 0.7, 0.7)).gain, 1.0, rtol=1e-5)
    plate = photographed(reflectances(), noise=0.0)
    clean = patch_colour(plate, PixelBox(80, 68, 10))
    plate[66:72, 78:84] = 3.0
    np.testing.assert_allclose(patch_colour(plate, PixelBox(80, 68, 10)), clean, rtol=1e-5)


def test_the_darkest_places_give_the_black_with_which_the_scene_becomes_the_photograph() -> None:
    """The hole is 768 pixels; a single pixel's noise is 0.004, a block's of 16 pixels 0.001."""
    found = darkest_black(photographed(reflectances()))
    np.testing.assert_allclose(found, BLACK, atol=0.003)
    bright = (reflectances() * 0 + 0.3).astype(np.float32)
    np.testing.assert_allclose(darkest_black(bright), 0.3, rtol=1e-6)
    assert darkest_black(bright - np.float32(0.4)) == (0.0, 0.0, 0.0)
    scene = reflectances()
    plate = photographed(scene)
    black = patch_colour(plate, PixelBox(24, 20, 8))
    match = grey_card_match(plate, PixelBox(80, 68, 10), black=black)
    rendered = Layer(scene, np.ones(scene.shape[:2], np.float32), np.ones(scene.shape[:2], np.float32))
    np.testing.assert_allclose(match.applied(rendered).rgb, photographed(scene, noise=0.0), atol=0.01)


def test_of_the_black_a_pixel_gets_what_it_covers_and_gain_is_linear() -> None:
    """gain * light + black * alpha: over the lifted plate, (1 - a)(P + black) + that, the black is whole at every coverage."""
    layer = a_layer()
    found = ColourMatch((2.0, 1.0, 0.5), BLACK).applied(layer)
    expected = layer.rgb * np.float32([2.0, 1.0, 0.5]) + layer.alpha[..., None] * np.float32(BLACK)
    np.testing.assert_allclose(found.rgb, expected, rtol=1e-6)
    assert (found.rgb[layer.alpha == 0] == 0).all()
    scene = np.float32(0.2)
    through = (1 - layer.alpha[..., None]) * (scene + np.float32(BLACK)) + ColourMatch(black=BLACK).applied(layer).rgb
    np.testing.assert_allclose(through, (1 - layer.alpha[..., None]) * scene + layer.rgb + np.float32(BLACK), atol=1e-6)
    layer = a_layer()
    assert ColourMatch().applied(layer) is layer and ColourMatch().is_nothing
    layer, match = a_layer(), ColourMatch((1.3, 0.8, 2.0))
    doubled = match.applied(replace(layer, rgb=2 * layer.rgb)).rgb
    np.testing.assert_allclose(doubled, 2 * match.applied(layer).rgb, rtol=1e-6)


def test_exposure_is_that_of_the_sunny_sixteen_in_stops_of_two() -> None:
    """ISO 100, 1/100 s, f/16: EV 14.64, so 1.2 * 2^14.64 = 30720 cd/m^2 fill the sensor (ISO 12232: 78 N^2 / (0.65 t S))."""
    full_cd_m2 = 1.0 / matched_exposure(Exposure(0.01, 100.0, 16.0)).gain[0]
    assert full_cd_m2 == pytest.approx(78.0 * 16.0**2 / (0.65 * 0.01 * 100.0), rel=1e-6)
    assert full_cd_m2 == pytest.approx(1.2 * 2 ** np.log2(16.0**2 / 0.01), rel=1e-6)
    panorama = Exposure(0.01, 200.0, 4.0)
    for plate in (Exposure(0.02, 200.0, 4.0), Exposure(0.01, 400.0, 4.0), Exposure(0.01, 200.0, 8**0.5), Exposure(0.01, 200.0, 4.0, 2.0)):
        np.testing.assert_allclose(matched_exposure(plate, panorama).gain, 2.0)
    metadata = {"exposure_time_s": 0.1, "iso": 200.0, "f_number": 2.0, "exposure_gain": 0.25}
    assert exposure_of_metadata(metadata) == Exposure(0.1, 200.0, 2.0, 0.25)
    refused("f_number is missing", exposure_of_metadata, metadata | {"f_number": None})


def test_exposure_and_card_of_real_photographs(shared_data: Path) -> None:
    """The numbers are those that exiftool prints; the D70 states no ISO."""
    assert exposure_of_photo(shared_data / "exif" / "canon_450d_4.6m.jpg") == Exposure(0.001, 100.0, 4.5)
    assert exposure_of_photo(shared_data / "exif" / "nikon_d60_0.45m.jpg") == Exposure(0.008, 100.0, 4.5)
    refused(r"iso is missing: pick a grey card", exposure_of_photo, shared_data / "exif" / "nikon_d70_0.45m.jpg")
    # Two patches of plain paper in a photograph (Nikon D70), far apart: one says what colour the other has, up to its own brightness.
    plate = read_image(shared_data / "exif" / "nikon_d70_0.45m.jpg")
    near, far = (np.array(grey_card_match(plate, PixelBox(*at, 20), rendered=0.8).gain) for at in ((780, 1820), (2220, 1500)))
    np.testing.assert_allclose(near / near[1], far / far[1], rtol=0.02)
    assert near[1] > 1.05 * far[1]


def test_white_of_known_illuminants_and_lamps() -> None:
    """D65 is the white of Rec.709 (0.3127, 0.3290). Illuminant A is XYZ 1.0985, 1, 0.3558 (CIE 15): through the matrix of Rec.709."""

    np.testing.assert_allclose(white_of_kelvin(6504.0), 1.0, atol=0.003)
    of_a = rec709_from_XYZ @ (1.0985, 1.0, 0.3558)
    np.testing.assert_allclose(white_of_kelvin(2856.0), of_a / of_a[1], rtol=0.02)
    of_d50 = rec709_from_XYZ @ (0.9642, 1.0, 0.8251)
    np.testing.assert_allclose(white_of_kelvin(5003.0), of_d50 / of_d50[1], rtol=0.01)
    red, green, blue = white_balance_gain(2856.0)
    assert red < 0.5 and green == 1.0 and blue > 3.0
    np.testing.assert_allclose(white_balance_gain(4300.0, 4300.0), 1.0)
    kelvins = np.arange(2000.0, 12000.0, 50.0)
    steps = np.diff(np.log([white_of_kelvin(each) for each in kelvins]), axis=0)
    assert (steps[:, 0] < 0).all() and (steps[:, 2] > 0).all()
    np.testing.assert_allclose(white_of_kelvin(7000.0), white_of_kelvin(7000.5), rtol=1e-3)


def test_patches_by_text_and_what_cannot_be_a_grey_card() -> None:
    plate = photographed(reflectances())
    refused("within the photograph of 160x112 px", grey_card_match, plate, PixelBox(155, 60, 8))
    refused("brighter than the photograph's black", grey_card_match, plate, PixelBox(24, 20, 8), black=(0.02, 0.02, 0.03))
    burnt = plate.copy()
    burnt[60:76, 70:90] = 1.7
    refused("clipped in 100%", grey_card_match, np.minimum(burnt, np.float32(1.0)), PixelBox(80, 68, 5))
    for text in ("", "5", "1,2,3,4", "a,b", "-1,2", "1.5,2"):
        refused("--match-grey: expected X,Y", PixelBox.parse, text)
    refused("expected gains above 0", ColourMatch, (0.0, 1.0, 1.0))
    assert PixelBox.parse("3,4") == PixelBox(3, 4, 8) and PixelBox.parse("3,4,5") == PixelBox(3, 4, 5)

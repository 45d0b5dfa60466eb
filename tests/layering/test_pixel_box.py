"""layering.pixel_box: what is cut out of a picture, beyond its border too, comes back to its place; its camera and lens see the same."""

from dataclasses import replace

import numpy as np
import pytest

from mrbokeh.images.layer import Layer, clear
from mrbokeh.layering.pixel_box import NOWHERE, Box, is_same_everywhere, lit_box
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens

FRAME = (6, 8)
PICTURE = np.arange(48, dtype=np.float32).reshape(FRAME)
LENS = Lens(50.0, 2.0, 2.0, 36.0)


def layer_with(*pixels: tuple[int, int]) -> Layer:
    layer = clear(*FRAME)
    for row, column in pixels:
        layer.alpha[row, column] = 0.5
    return layer


@pytest.mark.parametrize("box", [Box(1, 4, 2, 7), Box(-2, 3, -1, 9), Box(0, 6, 0, 8)])
def test_what_is_cut_comes_back_to_its_place(box: Box) -> None:
    whole = np.zeros(FRAME, np.float32)
    box.paste(box.cut(PICTURE, "edge"), whole)
    inside = box.within(FRAME)
    np.testing.assert_array_equal(inside.of(whole), inside.of(PICTURE))
    assert np.count_nonzero(whole) == np.count_nonzero(inside.of(PICTURE))


def test_beyond_the_border_it_goes_on_or_is_a_value_and_boxes_have_sizes() -> None:
    box = Box(-1, 2, 6, 10)
    np.testing.assert_array_equal(box.cut(PICTURE, "edge"), [[6, 7, 7, 7], [6, 7, 7, 7], [14, 15, 15, 15]])
    np.testing.assert_array_equal(box.cut(PICTURE, "constant", -1.0), [[-1, -1, -1, -1], [6, 7, -1, -1], [14, 15, -1, -1]])
    box = Box(1, 4, 2, 7)
    assert box.size_px == (3, 5) and box.origin_px == (1, 2) and not box.is_empty and NOWHERE.is_empty
    assert box.grown(3) == Box(-2, 7, -1, 10) and box.grown(3).within(FRAME) == Box(0, 6, 0, 8)


def test_a_layer_comes_back_among_nothing() -> None:
    rng = np.random.default_rng(0)
    rgb, alpha, depth_m = (rng.random((*FRAME, *rest), np.float32) for rest in ((3,), (), ()))
    layer, box = Layer(rgb, alpha, depth_m, {"id": rgb[..., :1]}), Box(2, 9, -3, 4)
    back = box.placed(box.cut_layer(layer), FRAME)
    inside = np.zeros(FRAME, bool)
    inside[2:, :4] = True
    np.testing.assert_array_equal(back.rgb, np.where(inside[..., None], rgb, 0.0))
    np.testing.assert_array_equal(back.alpha, np.where(inside, alpha, 0.0))
    np.testing.assert_array_equal(back.depth_m, np.where(inside, depth_m, np.inf))
    np.testing.assert_array_equal(back.extra["id"], np.where(inside[..., None], rgb[..., :1], 0.0))


def test_the_smallest_box_with_light() -> None:
    assert lit_box(layer_with((2, 5))) == Box(2, 3, 5, 6) and lit_box(layer_with((0, 7), (5, 3), (4, 4))) == Box(0, 6, 3, 8)
    assert lit_box(clear(*FRAME)) == NOWHERE
    glow, matte = clear(*FRAME), np.zeros((*FRAME, 2), np.float32)
    glow.rgb[3, 1, 2] = -1e-20
    matte[4, 6, 1] = 1.0
    assert lit_box(glow) == Box(3, 4, 1, 2) and lit_box(replace(glow, extra={"matte": matte})) == Box(3, 5, 1, 7)


def test_the_part_is_seen_and_blurred_as_in_the_whole_where_lenses_blur_alike() -> None:
    camera, box = Camera(8, 6, (9.0, 8.0), (4.2, 2.9)), Box(1, 4, 2, 7)
    part = box.camera_of(camera)
    np.testing.assert_allclose(part.project(np.array([[0.1, 0.2, 1.5]]))[0] + (2, 1), camera.project(np.array([[0.1, 0.2, 1.5]]))[0])
    assert (part.width_px, part.height_px) == (5, 3)
    assert float(box.lens_of(LENS, 8).coc_px(1.3, 5)) == pytest.approx(float(LENS.coc_px(1.3, 8)))
    coloured = replace(LENS.aperture, lateral_chromatic=(0.01, 0.0, -0.01))
    others = [
        replace(LENS, tilt_rad=(0.05, 0.0)),
        *(replace(LENS, aperture=each) for each in (replace(LENS.aperture, cat_eye=0.5), coloured)),
    ]
    assert is_same_everywhere(LENS) and not any(map(is_same_everywhere, others))

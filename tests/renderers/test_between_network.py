"""Objects between the blurred layers of a photograph, blurred by a network in place of polygons.

The network is the gated form as it starts, its kernels discs, exported and run by ONNX Runtime as any trained one: so what it has to give
is known from the exact renderer.
"""

from dataclasses import replace

import numpy as np
import pytest

from mrbokeh.compositing.choose import insertion_of
from mrbokeh.compositing.plate import Plate, plate_of
from mrbokeh.images.image_metrics import psnr
from mrbokeh.images.layer import Layer, opaque
from mrbokeh.renderers.onnx_network import OnnxNetwork
from mrbokeh.renderers.scatter_reference import ScatterReference
from tests.renderers.test_onnx_network import LENS, SIZE, depth_for, exported
from training.fitting.settings import demo_settings

POST = np.s_[:, 40:56]


@pytest.fixture
def network() -> OnnxNetwork:
    return exported(demo_settings().network)


def plate() -> tuple[Plate, np.ndarray]:
    """A yellow post 6 px out of focus before a wall in focus; and where the post is."""
    near = np.zeros(SIZE, bool)
    near[POST] = True
    noise = 1.0 + 0.05 * np.random.default_rng(6).standard_normal((*SIZE, 1))
    rgb = (np.where(near[..., None], [0.6, 0.5, 0.1], [0.1, 0.2, 0.5]) * noise).astype(np.float32)
    depth_m = np.where(near, depth_for(-6.0), LENS.focus_distance_m).astype(np.float32)
    photo = ScatterReference().render([opaque(rgb, depth_m)], LENS).rgb
    return replace(plate_of(photo, LENS, depth_m), sharp_rgb=rgb), near


def card() -> Layer:
    """White, 3 px out of focus, behind the post and on both sides of it."""
    alpha = np.zeros(SIZE, np.float32)
    alpha[16:48, 24:72] = 1.0
    return Layer(np.repeat(0.9 * alpha[..., None], 3, axis=2), alpha, np.where(alpha > 0, depth_for(-3.0), np.inf).astype(np.float32))


@pytest.mark.slow
def test_the_network_puts_it_behind_the_post_as_the_exact_renderer_does(network: OnnxNetwork) -> None:
    photo, _ = plate()
    exact, found = (insertion_of("between").insert(photo, [card()], renderer) for renderer in (ScatterReference(), network))
    assert psnr(found.rgb, exact.rgb) > 35.0
    over = insertion_of("front").insert(photo, [card()], ScatterReference())
    assert psnr(found.rgb, exact.rgb) > psnr(over.rgb, exact.rgb) + 10.0
    np.testing.assert_allclose(found.rgb[32, 46:50], photo.rgb[32, 46:50], atol=0.02)  # the middle of the post hides it
    assert found.rgb[32, 30:34].min() > 0.85  # beside the post it is seen
    across = found.virtual.alpha[32, 33:40]
    assert (np.diff(across) < 0.01).all() and across[0] > 0.99 and 0.3 < across[6] < 0.9  # the post's soft rim


@pytest.mark.slow
def test_pixels_that_no_virtual_light_reaches_stay_bit_for_bit(network: OnnxNetwork) -> None:
    photo, _ = plate()
    found = insertion_of("between").insert(photo, [card()], network)
    untouched = found.virtual.alpha == 0
    assert untouched.mean() > 0.3
    np.testing.assert_array_equal(found.rgb[untouched], photo.rgb[untouched])


@pytest.mark.slow
def test_rims_that_are_a_pixel_off_are_found_by_the_network_too(network: OnnxNetwork) -> None:
    photo, near = plate()
    fat = np.zeros_like(near)
    fat[:, 39:57] = True
    wrong = replace(photo, depth_m=np.where(fat, depth_for(-6.0), LENS.focus_distance_m).astype(np.float32))
    exact, kept, mended = (
        insertion_of("between", exact_depth=exact).insert(which, [card()], network).rgb
        for which, exact in ((photo, True), (wrong, True), (wrong, False))
    )
    assert np.abs(mended - exact).mean() < 0.3 * np.abs(kept - exact).mean()

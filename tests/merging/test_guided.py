"""The second-pass all-in-focus picture: two layers whose blur is known exactly, lights, masks, noise."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.merging.restored_lights import restored_lights, with_restored_lights
from capture.merging.second_pass import SliceOptics, all_in_focus_from_depth, foreground_occlusion
from mrbokeh.images.image_metrics import psnr
from mrbokeh.images.layer import Layer, opaque
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.scatter_reference import blur_layer
from mrbokeh.stacks.focal_stack import FocalStack, Slice
from tests.support.refusals import refused

SIZE = (96, 128)
FOCUS = (2.0, 1.5, 1.0)
PX_PER_DIOPTRE = 12.0
NEAR, FAR = 2.0, 1.0
EDGE = 64
BORDER = 16


def texture(seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(0, 1, (*SIZE, 3)).astype(np.float32)
    return np.clip(0.4 + 2.0 * (cv2.GaussianBlur(noise, (0, 0), 0.8) - 0.5), 0.02, 0.9)


def optics(aperture: Aperture | None = None) -> SliceOptics:
    return SliceOptics.of_slices(FOCUS, [PX_PER_DIOPTRE] * 3, aperture)


def near_layer() -> Layer:
    """The left half of the picture, 0.5 m away; premultiplied."""
    alpha = np.zeros(SIZE, np.float32)
    alpha[:, :EDGE] = 1.0
    return Layer(texture(1) * alpha[..., None], alpha, np.full(SIZE, 1.0 / NEAR, np.float32))


def dioptres() -> np.ndarray:
    return np.where(near_layer().alpha > 0, np.float32(NEAR), np.float32(FAR)).astype(np.float32)


def truth() -> np.ndarray:
    near = near_layer()
    return near.rgb + (1.0 - near.alpha[..., None]) * texture(2)


def photographs(aperture: Aperture) -> list[np.ndarray]:
    """Each slice: the far wall as blurred there, and over it the near layer as blurred there."""
    slices = []
    for focus in FOCUS:
        coc_px = {depth: np.full(SIZE, PX_PER_DIOPTRE * (focus - depth), np.float32) for depth in (NEAR, FAR)}
        far = blur_layer(opaque(texture(2), np.ones(SIZE, np.float32)), coc_px[FAR], aperture)
        near = blur_layer(near_layer(), coc_px[NEAR], aperture)
        slices.append(near.rgb + (1.0 - near.alpha[..., None]) * far.rgb / far.alpha[..., None])
    return slices


@pytest.mark.parametrize("aperture", [Aperture.disc(), Aperture.star(5, 0.5, 0.4)])
def test_the_blur_of_nearer_surfaces_is_that_of_the_scatter_reference(aperture: Aperture) -> None:
    """Gathered over circles of confusion here, spread pixel by pixel there; a star tells whether it is mirrored as it must be."""
    found = foreground_occlusion(2, dioptres(), truth(), optics(aperture), np.ones(SIZE, bool))
    expected = blur_layer(near_layer(), np.full(SIZE, PX_PER_DIOPTRE * (FAR - NEAR), np.float32), aperture)
    beside = np.s_[BORDER:-BORDER, EDGE : EDGE + 20]
    np.testing.assert_allclose(found.share[beside], expected.alpha[beside], atol=1e-4)
    np.testing.assert_allclose(found.light[beside], expected.rgb[beside], atol=1e-4)
    assert found.share[:, :EDGE].max() == 0.0, "nothing is nearer than the near layer"
    assert found.share[:, EDGE + 8 :].max() == 0.0, "its blur, 12 px wide, ends 6 px beside the edge"


def test_large_blur_is_gathered_on_a_coarser_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    import capture.merging.second_pass as module

    fine = foreground_occlusion(2, dioptres(), truth(), optics(), np.ones(SIZE, bool))
    monkeypatch.setattr(module, "LARGEST_GATHERED_PX", 6.0)
    coarse = foreground_occlusion(2, dioptres(), truth(), optics(), np.ones(SIZE, bool))
    beside = np.s_[BORDER:-BORDER, EDGE + 1 : EDGE + 20]
    # Half the resolution: the ramp of the share over 6 px is read at most a pixel off, 1/6 of its height.
    assert 1e-4 < np.abs(coarse.share[beside] - fine.share[beside]).max() < 0.17
    assert np.abs(coarse.share[beside] - fine.share[beside]).mean() < 0.02


def test_a_far_wall_is_had_back_from_under_the_blur_of_a_near_edge() -> None:
    slices = photographs(Aperture.disc())
    result = all_in_focus_from_depth(lambda: slices, 1.0 / dioptres(), optics(), truth())
    inner = np.zeros(SIZE, bool)
    inner[BORDER:-BORDER, BORDER:-BORDER] = True
    beside = inner & (np.abs(np.arange(SIZE[1]) - EDGE) < 8)
    nearest = np.where(near_layer().alpha[..., None] > 0, slices[0], slices[2])
    assert psnr(nearest, truth(), mask=beside) < 30.0, "taking the slice in focus leaves a halo"
    # The model is exact but for the smoothing of half steps of diameter, so what is left is far below noise.
    assert psnr(result, truth(), mask=beside) > 40.0
    assert psnr(result, truth(), mask=inner) > 45.0


def test_without_a_sharp_near_picture_the_slice_with_least_halo_is_better_than_none() -> None:
    """A first pass that knows the near surface by its mean colour only still takes most of the halo off."""
    slices = photographs(Aperture.disc())
    flat = np.broadcast_to(texture(1).mean(axis=(0, 1)), (*SIZE, 3)).astype(np.float32)
    result = all_in_focus_from_depth(lambda: slices, 1.0 / dioptres(), optics(), flat)
    beside = np.s_[BORDER:-BORDER, EDGE : EDGE + 8]
    assert psnr(result[beside], truth()[beside]) > psnr(slices[2][beside], truth()[beside]) + 3.0


def test_slices_without_data_are_not_used() -> None:
    slices = photographs(Aperture.disc())
    slices[2][:, 100:] = 7.0

    def valid(index: int) -> np.ndarray:
        return np.broadcast_to((np.arange(SIZE[1]) < 100) | (index != 2), SIZE).copy()

    result = all_in_focus_from_depth(lambda: slices, 1.0 / dioptres(), optics(), truth(), valid)
    np.testing.assert_allclose(result[BORDER:-BORDER, 104:-BORDER], slices[1][BORDER:-BORDER, 104:-BORDER], atol=1e-6)


def test_slices_that_are_equally_sharp_share_their_noise() -> None:
    """Focus 0.6 px of blur to either side: both count half, so the noise falls by the root of 2."""
    rng, flat = np.random.default_rng(0), np.full((*SIZE, 3), 0.5, np.float32)
    slices = [flat + rng.normal(0, 0.01, flat.shape).astype(np.float32) for _ in range(2)]
    between = SliceOptics.of_slices((1.05, 0.95), (12.0, 12.0))
    result = all_in_focus_from_depth(lambda: slices, np.ones(SIZE, np.float32), between, flat)
    assert result.std() == pytest.approx(0.01 / np.sqrt(2), rel=0.05)


def test_a_light_before_a_wall_leaves_no_ring() -> None:
    """The light's disc lies over the wall in the slice where the wall is sharp; with depth its light is known and taken off."""
    from tests.merging.test_restored_lights import LIGHT_AT, RADIANCE, scene
    from tests.merging.test_restored_lights import SIZE as WALL
    from tests.merging.test_restored_lights import slices as photographed

    stack = photographed(scene())
    five = SliceOptics.of_slices((5.0, 4.0, 3.0, 2.0, 1.0), [4.0] * 5, Aperture.blades(6))
    depth = np.full(WALL, 2.0, np.float32)
    depth[LIGHT_AT] = 4.0
    guided = all_in_focus_from_depth(lambda: stack, 1.0 / depth, five, scene())
    guided = with_restored_lights(guided, restored_lights(lambda: stack, guided, guided=True)[1])
    ring = np.s_[LIGHT_AT[0] - 5 : LIGHT_AT[0] + 6, LIGHT_AT[1] + 2 : LIGHT_AT[1] + 7]
    # The wall never exceeds 0.3 and the disc adds 1.8 to it; what is left is the rim of the hexagon drawn in whole pixels.
    assert stack[3][ring].max() > 1.5
    assert np.median(np.abs(guided[ring] - scene()[ring])) < 0.05
    np.testing.assert_allclose(guided[LIGHT_AT], RADIANCE, rtol=0.05)


def test_optics_of_a_stack_are_its_circles_of_confusion() -> None:
    slices = tuple(Slice(f"{i}.exr", distance, scale) for i, (distance, scale) in enumerate(((0.6, 1.0), (1.0, 1.03), (2.0, 1.05))))
    stack = FocalStack(Path("."), slices, Lens(35.0, 2.0, 0.6, 23.5))
    depth_m = np.random.default_rng(0).uniform(0.5, 3.0, (4, 640)).astype(np.float32)
    found = SliceOptics.of_stack(stack, 640)
    for index in range(3):
        np.testing.assert_allclose(found.coc_px(index, 1.0 / depth_m), stack.coc_px(index, depth_m), rtol=1e-4, atol=1e-4)


def test_optics_need_one_of_each_for_every_slice() -> None:
    refused("got 2 and 1 of them", SliceOptics.of_slices, (1.0, 2.0), (12.0,))

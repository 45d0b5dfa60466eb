"""The truth of flat cards against answers that are known without it."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.ndimage import uniform_filter
from scipy.signal import fftconvolve

from datasets_scripts.scenes.textures import fractal_noise
from mrbokeh.images.image_metrics import energy_ratio, psnr
from mrbokeh.images.layer import flatten
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from tests.support import card_scene as cards
from tests.support.card_tracer import lens_samples
from tests.support.cards import Card, Lamp, TexelGrid, disc, everywhere, mirrored_beyond, rectangle, wire

SIZE_PX, MARGIN_PX, DENSITY = 48, 16, 8
GRID = TexelGrid(SIZE_PX, SIZE_PX, MARGIN_PX, DENSITY)
HEART = Aperture.heart()
LENS = Lens(focal_length_mm=50.0, f_number=2.0, focus_distance_m=2.0, sensor_width_mm=36.0)


def dioptres_for_coc(coc_px: float, lens: Lens = LENS) -> float:
    """1/depth at which the lens makes this signed diameter: coc = k (1 / focus - 1 / depth)."""
    return 1.0 / lens.focus_distance_m - coc_px / lens.coc_px_per_dioptre(SIZE_PX)


def flat_card(solid: np.ndarray, colour: np.ndarray | float, coc_px: float) -> Card:
    rgb = np.broadcast_to(colour, (*GRID.shape, 3))
    return Card("card", (dioptres_for_coc(coc_px), 0.0, 0.0), solid, rgb.astype(np.float32))


def noise_texture(seed: int) -> np.ndarray:
    """Detail of three pixels and more, mirrored beyond the frame."""
    rng = np.random.default_rng(seed)
    shades = [0.5 + 0.15 * fractal_noise(*GRID.shape, rng, 3.0 * DENSITY, 40.0 * DENSITY, 0.3) for _ in range(3)]
    return mirrored_beyond(GRID, np.clip(np.stack(shades, axis=-1), 0.01, 1.0))


def truth_of(scene_cards: list[Card], lamps: tuple[Lamp, ...] = (), aperture: Aperture | None = None, positions: int = 1600) -> np.ndarray:
    lens = Lens(focal_length_mm=50.0, f_number=2.0, focus_distance_m=2.0, sensor_width_mm=36.0, aperture=aperture or Aperture.disc())
    return cards.truth(cards.scene_of(tuple(scene_cards), lamps, GRID), lens, positions)


@pytest.mark.parametrize("coc_px", [9.4, -9.4])
def test_a_flat_card_is_its_texture_convolved_with_the_exact_psf(coc_px: float) -> None:
    # At 8 texels a pixel the convolution and the mean over pixels are the integral; a heart tells right from mirrored.
    texture = noise_texture(1)
    kernel = HEART.rasterize(coc_px * DENSITY).kernel
    blurred = np.stack([fftconvolve(texture[..., c], kernel, mode="same") for c in range(3)], axis=-1)
    inside = slice(MARGIN_PX * DENSITY, -MARGIN_PX * DENSITY)
    expected = blurred[inside, inside].reshape(SIZE_PX, DENSITY, SIZE_PX, DENSITY, 3).mean((1, 3)).astype(np.float32)
    result = truth_of([flat_card(everywhere(GRID), texture, coc_px)], aperture=HEART)
    assert psnr(result, expected) > 60.0
    np.testing.assert_allclose(result, expected, atol=0.006)


@pytest.mark.parametrize("coc_px", [-20.0, 14.0])
def test_past_a_straight_edge_shows_the_open_share_of_the_aperture(coc_px: float) -> None:
    # A card left of x = 24 seen out of focus over white: of a disc of radius R the part beyond a chord at distance t is
    # 1/2 - (t sqrt(R^2 - t^2) / R^2 + asin(t / R)) / pi, whichever side of the focus; averaged over the pixel.
    front = flat_card(rectangle(GRID, -100.0, -100.0, 24.0, 200.0), 0.0, coc_px)
    behind = flat_card(everywhere(GRID), 1.0, 16.0)
    result = truth_of([front, behind])
    radius = abs(coc_px) / 2
    t = np.clip((np.arange(SIZE_PX * 64) + 0.5) / 64 - 24.0, -radius, radius)
    open_share = 0.5 + (t * np.sqrt(radius**2 - t**2) / radius**2 + np.arcsin(t / radius)) / np.pi
    expected = np.broadcast_to(open_share.reshape(SIZE_PX, 64).mean(1)[None, :, None], result.shape)
    np.testing.assert_allclose(result, expected, atol=0.005)
    np.testing.assert_allclose(result.mean(0), expected.mean(0), atol=0.001)


def test_a_slanted_card_is_met_where_the_ray_in_space_meets_it() -> None:
    # The thin lens in millimetres: the ray leaves lens point u, passes the point in focus that the pixel images, and cuts
    # the plane in space; the pinhole picture of that point is where the tracer must look.
    from tests.support._card_tracer_numba import sharp_from_film

    lens, size_px = LENS, 200
    dioptres = np.array([0.42, 0.0006, -0.0011])
    plane = lens.coc_px_per_dioptre(size_px) * (np.array([1 / lens.focus_distance_m, 0, 0]) - dioptres)
    focal_px = lens.focal_px(size_px)
    rng = np.random.default_rng(0)
    for _ in range(50):
        film, pupil = rng.uniform(0, size_px, 2), rng.uniform(-0.7, 0.7, 2)
        on_lens = np.append(pupil * lens.aperture_diameter_mm / 2000.0, 0.0)
        in_focus = np.append(film / focal_px, 1.0) * lens.focus_distance_m
        direction = in_focus - on_lens
        # 1 / z = c + a x_px + b y_px with x_px = f x / z:  1 = c z + f (a x + b y).
        normal = np.array([dioptres[1] * focal_px, dioptres[2] * focal_px, dioptres[0]])
        met = on_lens + direction * (1.0 - normal @ on_lens) / (normal @ direction)
        expected = met[:2] / met[2] * focal_px
        np.testing.assert_allclose(sharp_from_film(plane, *film, *pupil), expected, atol=1e-6)


@pytest.mark.parametrize("coc_px", [0.0, 6.5, -13.0])
def test_a_lamp_keeps_its_energy_and_its_place(coc_px: float) -> None:
    lamp = Lamp(0, 23.3, 25.1, 0.8, (90.0, 30.0, 15.0))
    result = truth_of([flat_card(everywhere(GRID), 0.0, coc_px)], (lamp,))
    np.testing.assert_allclose(result.sum((0, 1)), np.pi * 0.8**2 * np.array([90.0, 30.0, 15.0]), rtol=2e-3)
    y, x = np.mgrid[:SIZE_PX, :SIZE_PX] + 0.5
    # A sharp lamp within a few pixels shows its place only as well as these can tell.
    place_px = [(result[..., 0] * axis).sum() / result[..., 0].sum() for axis in (x, y)]
    np.testing.assert_allclose(place_px, [23.3, 25.1], atol=0.05 if coc_px == 0.0 else 0.01)


@pytest.mark.slow
def test_a_lamp_followed_from_its_side_is_the_disc_that_camera_rays_find() -> None:
    # Two independent ways, with a wire of another depth across the view: a lamp, and a card of the same shape and light.
    thin = flat_card(wire(GRID, [(-20.0, 18.0), (70.0, 31.0)], 2.0), 0.02, -8.0)
    behind = flat_card(everywhere(GRID), 0.1, 12.0)
    bright = flat_card(disc(GRID, 24.4, 23.7, 5.0), 3.0, 10.0)
    empty = flat_card(disc(GRID, 24.4, 23.7, -9.0), 0.0, 10.0)
    as_card = truth_of([thin, bright, behind], aperture=HEART, positions=4800)
    as_lamp = truth_of([thin, empty, behind], (Lamp(1, 24.4, 23.7, 5.0, (3.0, 3.0, 3.0)),), HEART, positions=4800)
    np.testing.assert_allclose(as_lamp, as_card, atol=0.04)
    assert psnr(as_lamp, as_card, peak=3.0) > 58.0
    np.testing.assert_allclose(as_lamp.sum(), as_card.sum(), rtol=1e-3)


def test_a_ring_is_weighted_by_its_outlines_and_a_mirrored_picture_keeps_its_energy() -> None:
    samples, starts = lens_samples(Aperture.ring(0.6), 1600, 4)
    assert np.hypot(*samples[:, :2].T).min() > 0.595
    assert len(samples) == starts[-1] and len(samples) / 4 >= 1600
    # Blur of an even mirror image by a symmetric aperture moves light over the border both ways alike.
    sharp, blurred = (truth_of([flat_card(everywhere(GRID), noise_texture(2), coc_px)]) for coc_px in (0.0, 18.0))
    assert energy_ratio(blurred, sharp) == pytest.approx(1.0, abs=2e-4)
    assert blurred.std() < 0.5 * sharp.std()


@pytest.mark.slow
def test_the_scene_is_what_it_says_and_its_layers_over_one_another_are_the_sharp_picture() -> None:
    scene = cards.card_scene(seed=3, width_px=144, height_px=96)
    layers = cards.layers(scene)
    radiances = [max(lamp.radiance_rgb) for lamp in scene.lamps]
    assert len(scene.lamps) == 60 and min(radiances) >= 14.99 and max(radiances) <= 150.01
    coc_px = cards.lens_of_radius(12.0, 144).coc_px(cards.depth_m(scene), 144)
    assert np.abs(coc_px).max() == pytest.approx(24.0, rel=1e-5)
    behind_one_another = list(pairwise(layers))
    for front, back in behind_one_another[:2] + behind_one_another[3:]:
        assert front.depth_m[front.alpha > 0].max() <= back.depth_m[back.alpha > 0].min()
    board = layers[2]
    board_coc_px = cards.lens_of_radius(12.0, 144).coc_px(board.depth_m[board.alpha > 0.5], 144)
    assert board_coc_px.min() < -8.0 and board_coc_px.max() > 3.0
    # Only where two edges share a pixel does "over" differ from the true mean of the pixel.
    flat, sharp = flatten(layers), cards.all_in_focus(scene)
    np.testing.assert_allclose(flat.alpha, 1.0, atol=1e-6)
    one_edge_at_most = sum((layer.alpha > 0.001) & (layer.alpha < 0.999) for layer in layers) <= 1
    assert one_edge_at_most.mean() > 0.9
    assert psnr(flat.rgb[one_edge_at_most], sharp[one_edge_at_most]) > 45.0
    middle_only = uniform_filter(one_edge_at_most.astype(float), 3) == 1.0
    np.testing.assert_array_less(np.abs(flat.rgb - sharp)[middle_only].mean(), 2e-3)

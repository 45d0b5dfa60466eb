"""One list of laws for every renderer (see mrbokeh/renderers/base.py); a new renderer joins RENDERERS and nothing else."""

import numpy as np
import pytest

from mrbokeh.aperture import Aperture
from mrbokeh.layer import Layer, clear, opaque
from mrbokeh.lens import Lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.renderers.scatter_reference import ScatterReference

RENDERERS = {"scatter_reference": ScatterReference()}
SIZE_PX = 65
CENTRE = SIZE_PX // 2
LENS = Lens(focal_length_mm=50.0, f_number=2.0, focus_distance_m=1.0, sensor_width_mm=36.0)


@pytest.fixture(params=RENDERERS, name="renderer")
def fixture_renderer(request: pytest.FixtureRequest) -> Renderer:
    return RENDERERS[request.param]


def depth_for_coc_m(coc_px: float, lens: Lens = LENS) -> float:
    """The depth at which the lens makes this (signed) circle of confusion: coc = k (1 / focus - 1 / depth)."""
    return 1.0 / (1.0 / lens.focus_distance_m - coc_px / lens.coc_px_per_dioptre(SIZE_PX))


def flat_layer(rgb: np.ndarray, alpha: np.ndarray, coc_px: float) -> Layer:
    depth_m = np.where(alpha > 0, depth_for_coc_m(coc_px), np.inf)
    return Layer(rgb.astype(np.float32), alpha.astype(np.float32), depth_m.astype(np.float32))


def point(coc_px: float, colour: tuple[float, float, float] = (4.0, 2.0, 1.0)) -> Layer:
    alpha = np.zeros((SIZE_PX, SIZE_PX))
    alpha[CENTRE, CENTRE] = 1.0
    return flat_layer(alpha[..., None] * colour, alpha, coc_px)


def texture(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.0, 2.0, (SIZE_PX, SIZE_PX, 3))


def test_it_is_a_renderer(renderer: Renderer) -> None:
    assert isinstance(renderer, Renderer)


@pytest.mark.parametrize("coc_px", [-11.0, -2.3, 0.0, 0.7, 3.1, 14.6])
def test_energy_of_a_point_is_conserved(renderer: Renderer, coc_px: float) -> None:
    result = renderer.render([point(coc_px)], LENS)
    np.testing.assert_allclose(result.rgb.sum((0, 1)), (4.0, 2.0, 1.0), rtol=1e-5)
    np.testing.assert_allclose(result.alpha.sum(), 1.0, rtol=1e-5)


@pytest.mark.parametrize("coc_px", [-0.9, 0.0, 0.9])
def test_below_one_pixel_nothing_changes(renderer: Renderer, coc_px: float) -> None:
    layer = flat_layer(texture(), np.ones((SIZE_PX, SIZE_PX)), coc_px)
    result = renderer.render([layer], LENS)
    np.testing.assert_allclose(result.rgb, layer.rgb, atol=1e-6)
    np.testing.assert_allclose(result.alpha, 1.0, atol=1e-6)


@pytest.mark.parametrize("coc_px", [-12.4, 5.5, 20.2])
def test_a_point_stays_within_its_circle_of_confusion(renderer: Renderer, coc_px: float) -> None:
    result = renderer.render([point(coc_px)], LENS)
    y, x = np.nonzero(result.alpha > 1e-7)
    # A pixel is touched where its nearest corner lies inside the circle; the 64-gon reaches 0.08 % beyond the disc.
    nearest_px = np.hypot(np.maximum(abs(x - CENTRE) - 0.5, 0), np.maximum(abs(y - CENTRE) - 0.5, 0))
    assert nearest_px.max() <= abs(coc_px) / 2 * 1.001
    assert nearest_px.max() >= abs(coc_px) / 2 - 1.5


def test_mirrored_picture_gives_mirrored_result(renderer: Renderer) -> None:
    rgb = texture()
    ones = np.ones((SIZE_PX, SIZE_PX))
    result = renderer.render([flat_layer(rgb, ones, 7.3)], LENS)
    mirrored = renderer.render([flat_layer(rgb[:, ::-1], ones, 7.3)], LENS)
    np.testing.assert_allclose(mirrored.rgb, result.rgb[:, ::-1], atol=1e-5)


def test_in_front_of_the_focus_the_aperture_is_seen_mirrored(renderer: Renderer) -> None:
    triangle = Lens(50.0, 2.0, 1.0, 36.0, Aperture.blades(3))
    behind = renderer.render([point(12.0)], triangle).alpha
    in_front = renderer.render([point(-12.0)], triangle).alpha
    np.testing.assert_allclose(in_front, behind[::-1, ::-1], atol=1e-6)
    assert behind[:, CENTRE + 4 :].sum() > 0 and behind[CENTRE, CENTRE + 5] > 0, "the corner at +x shows at +x behind the focus"
    assert in_front[CENTRE, CENTRE - 5] > 0 and behind[CENTRE, CENTRE - 5] == 0


def test_linearity_in_light(renderer: Renderer) -> None:
    ones = np.ones((SIZE_PX, SIZE_PX))
    one = renderer.render([flat_layer(texture(1), ones, 6.0)], LENS).rgb
    doubled = renderer.render([flat_layer(2.0 * texture(1), ones, 6.0)], LENS).rgb
    np.testing.assert_allclose(doubled, 2.0 * one, rtol=1e-5)


def test_premultiplied_white_blurs_like_its_alpha(renderer: Renderer) -> None:
    alpha = np.zeros((SIZE_PX, SIZE_PX))
    alpha[20:40, 25:45] = 1.0
    result = renderer.render([flat_layer(np.repeat(alpha[..., None], 3, 2), alpha, 9.0)], LENS)
    np.testing.assert_allclose(result.rgb, np.repeat(result.alpha[..., None], 3, 2), atol=1e-6)


def test_an_even_field_stays_even_inside(renderer: Renderer) -> None:
    result = renderer.render([flat_layer(np.full((SIZE_PX, SIZE_PX, 3), 0.4), np.ones((SIZE_PX, SIZE_PX)), 10.0)], LENS)
    np.testing.assert_allclose(result.rgb[8:-8, 8:-8], 0.4, rtol=1e-5)


def test_a_straight_edge_blurs_to_the_integral_of_the_disc(renderer: Renderer) -> None:
    """A half plane blurred by a disc of radius R covers 1/2 + (t sqrt(R^2 - t^2) + R^2 asin(t / R)) / (pi R^2) at distance t."""
    alpha = np.zeros((SIZE_PX, SIZE_PX))
    alpha[:, CENTRE:] = 1.0
    profile = renderer.render([flat_layer(np.repeat(alpha[..., None], 3, 2), alpha, 16.0)], LENS).alpha[CENTRE]
    # Area-exact kernels of all pixels right of the edge add up to the exact integral at each pixel's centre.
    radius = 8.0
    t = np.clip(np.arange(SIZE_PX) - CENTRE + 0.5, -radius, radius)
    exact = 0.5 + (t * np.sqrt(radius**2 - t**2) + radius**2 * np.arcsin(t / radius)) / (np.pi * radius**2)
    np.testing.assert_allclose(profile[10:-10], exact[10:-10], atol=5e-4)  # what a 64-gon lacks of a disc


def test_an_opaque_sharp_layer_hides_what_is_behind(renderer: Renderer) -> None:
    ones = np.ones((SIZE_PX, SIZE_PX))
    front = flat_layer(texture(2), ones, 0.0)
    behind = flat_layer(texture(3), ones, 9.0)
    np.testing.assert_allclose(renderer.render([front, behind], LENS).rgb, front.rgb, atol=1e-6)


def test_a_clear_layer_changes_nothing(renderer: Renderer) -> None:
    behind = flat_layer(texture(4), np.ones((SIZE_PX, SIZE_PX)), 5.0)
    alone = renderer.render([behind], LENS)
    with_clear = renderer.render([clear(SIZE_PX, SIZE_PX), behind], LENS)
    np.testing.assert_array_equal(with_clear.rgb, alone.rgb)
    np.testing.assert_array_equal(with_clear.alpha, alone.alpha)


def test_a_blurred_front_layer_lets_the_sharp_background_through(renderer: Renderer) -> None:
    alpha = np.zeros((SIZE_PX, SIZE_PX))
    alpha[:, :CENTRE] = 1.0
    front = flat_layer(0.0 * alpha[..., None] + np.zeros(3), alpha, -14.0)
    behind = opaque(np.ones((SIZE_PX, SIZE_PX, 3), np.float32), np.full((SIZE_PX, SIZE_PX), 1.0, np.float32))
    result = renderer.render([front, behind], LENS)
    np.testing.assert_allclose(result.alpha, 1.0, atol=1e-5)
    front_alone = renderer.render([front], LENS)
    np.testing.assert_allclose(result.rgb[..., 0], 1.0 - front_alone.alpha, atol=1e-5)


def test_changing_the_focus_changes_the_picture(renderer: Renderer) -> None:
    layer = flat_layer(texture(5), np.ones((SIZE_PX, SIZE_PX)), 0.0)
    sharp, blurred = renderer.render([layer], LENS), renderer.render([layer], LENS.focused_at(0.6))
    assert np.abs(sharp.rgb - blurred.rgb).max() > 0.1

"""Layers, slices and field cells: what all spreading renderers share."""

from dataclasses import replace

import numpy as np
import pytest

from mrbokeh.images.layer import Layer, opaque
from mrbokeh.layering.layering import Layering, render_layers
from mrbokeh.layering.psf_over_field import Frame, blur_colours
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.renderers.layered_reconstruction import LayeredReconstruction
from mrbokeh.renderers.scatter_reference import ScatterReference
from tests.support.refusals import refused

SIZE = (72, 96)
LENS = Lens(focal_length_mm=50.0, f_number=0.7, focus_distance_m=0.5, sensor_width_mm=12.0)  # up to 64 px of blur at infinity
SPREAD = ScatterReference().sum_kernels


def depth_m(coc_px: np.ndarray | float) -> np.ndarray:
    per_dioptre = LENS.coc_px_per_dioptre(SIZE[1])
    return np.broadcast_to(1.0 / (1.0 / LENS.focus_distance_m - np.asarray(coc_px) / per_dioptre), SIZE).astype(np.float32)


def picture(rgb: np.ndarray, coc_px: np.ndarray | float) -> Layer:
    return opaque(np.broadcast_to(rgb, (*SIZE, 3)).astype(np.float32), depth_m(coc_px).copy())


def rendered(layers: list[Layer], lens: Lens = LENS, **settings: object) -> Layer:
    return render_layers(layers, lens, SPREAD, Layering(**settings))  # type: ignore[arg-type]


@pytest.mark.parametrize("slices", [1, 4, 16, 64])
def test_a_slanted_surface_has_no_seams_and_no_dip_of_opacity(slices: int) -> None:
    """From 20 px in front through the focus to 20 px behind: a white surface stays white everywhere, however it is cut."""
    slanted = picture(np.ones(3), np.linspace(-20.0, 20.0, SIZE[1]))
    result = rendered([slanted], slices=slices)
    np.testing.assert_allclose(result.rgb, 1.0, atol=2e-6)
    np.testing.assert_array_equal(result.alpha, 1.0)


def test_a_slanted_object_over_nothing_stays_opaque_inside_and_its_slices_hardly_show() -> None:
    alpha = np.zeros(SIZE, np.float32)
    alpha[:, 20:76] = 1.0
    card = Layer(np.repeat(alpha[..., None], 3, axis=2), alpha, depth_m(np.linspace(-9.0, 9.0, SIZE[1])).copy())
    result = rendered([card], slices=8)
    # Where the blur shrinks from pixel to pixel a little less light arrives than leaves: 0.9 %, not the 7 % of slices under "over".
    np.testing.assert_allclose(result.alpha[12:-12, 28:68], 1.0, atol=0.01)
    np.testing.assert_allclose(result.rgb[..., 0], result.alpha, atol=1e-6)
    # One surface, textured: the reference without any slice is a plain scatter, divided by its weights.
    rng = np.random.default_rng(1)
    slanted = picture(rng.uniform(0.0, 1.0, (*SIZE, 3)), np.linspace(-10.0, 10.0, SIZE[1]))
    one, many = rendered([slanted], slices=1, fill=False), rendered([slanted], slices=12, fill=False)
    assert np.abs(one.rgb - many.rgb).mean() < 0.01


def test_what_hides_is_interpolated_from_both_sides_and_real_layers_go_before_it() -> None:
    """A wire of 3 px, blurred by 20 px, over a ramp in focus: where it was the ramp goes on, darkened by the wire's share of the
    disc, which on the wire's axis is the strip of 3 px through the middle of a disc of 20 px: 3 * 20 / (100 pi) to 1 %."""
    ramp = np.linspace(0.2, 1.0, SIZE[1])[None, :, None] * np.ones(3)
    rgb, coc_px = np.broadcast_to(ramp, (*SIZE, 3)).copy(), np.zeros(SIZE)
    rgb[:, 47:50], coc_px[:, 47:50] = 0.0, -20.0
    result = rendered([picture(rgb, coc_px)])
    # 1.5 %: the formula's own, and what the weights of 8 directions make of a ramp.
    np.testing.assert_allclose(result.rgb[30:40, 47:50, 0] / ramp[0, 47:50, 0], 1.0 - 60.0 / (100.0 * np.pi), atol=0.015)
    # Behind a near card lies a second picture, green. Where the lens looks past the card's edge it is seen, not the red beside it.
    rgb, coc_px = np.tile([1.0, 0.0, 0.0], (*SIZE, 1)), np.zeros(SIZE)
    rgb[:, :40], coc_px[:, :40] = 0.0, -24.0
    clean = np.tile([1.0, 0.0, 0.0], (*SIZE, 1))
    clean[:, :40] = [0.0, 1.0, 0.0]
    alone, with_plate = rendered([picture(rgb, coc_px)]), rendered([picture(rgb, coc_px), picture(clean, 0.0)])
    assert alone.rgb[36, 36, 1] == 0.0 and alone.rgb[36, 36, 0] > 0.2
    assert with_plate.rgb[36, 36, 1] > 0.2 and with_plate.rgb[36, 36, 0] < 1e-6


def test_across_the_focus_the_pupil_beside_an_edge_looks_behind_it() -> None:
    """A black card blurred by -20 px left of x = 48, behind it a wall blurred by +20 px, red where the picture shows it, green behind
    the card. d px right of the edge the card takes the part A of the pupil with u < -d/10, and as its kernel is mirrored the part
    with u > d/10, A too, sees green; red is between. A = (acos(s) - s sqrt(1 - s^2)) / pi at s = d/10."""
    rgb, coc_px, clean = np.tile([1.0, 0.0, 0.0], (*SIZE, 1)), np.full(SIZE, 20.0), np.tile([1.0, 0.0, 0.0], (*SIZE, 1))
    rgb[:, :48], coc_px[:, :48], clean[:, :48] = 0.0, -20.0, [0.0, 1.0, 0.0]
    result = rendered([picture(rgb, coc_px), picture(clean, 20.0)]).rgb[36, 48:58]
    s = (np.arange(10) + 0.5) / 10.0
    part = (np.arccos(s) - s * np.sqrt(1.0 - s**2)) / np.pi
    np.testing.assert_allclose(result[:, 1], part, atol=0.005)
    np.testing.assert_allclose(result[:, 0], 1.0 - 2.0 * part, atol=0.01)


def test_layers_that_interleave_are_sorted_by_depth() -> None:
    """Two crossing cards listed in the wrong order for the left half: on both sides the nearer one is seen."""
    alpha = np.ones(SIZE, np.float32) * 0.999999  # not opaque, so that only the depth can group them
    rising = Layer(alpha[..., None] * np.float32([1, 0, 0]), alpha, depth_m(np.linspace(8, -8, SIZE[1])).copy())
    falling = Layer(alpha[..., None] * np.float32([0, 0, 1]), alpha, depth_m(np.linspace(-8, 8, SIZE[1])).copy())
    result = rendered([rising, falling])
    assert result.rgb[36, 12, 2] > 0.95 and result.rgb[36, 12, 0] < 0.01
    assert result.rgb[36, -12, 0] > 0.95 and result.rgb[36, -12, 2] < 0.01


def test_the_antialiased_rim_of_a_blurred_lamp_leaves_no_dot() -> None:
    """A lamp of radiance 100 whose light also fills 30 % of a pixel that is said to be in focus; the background is 0.1."""
    rgb, coc_px = np.full((*SIZE, 3), 0.1), np.zeros(SIZE)
    rgb[36, 48], coc_px[36, 48] = 100.0, -20.0
    rgb[36, 49] = 0.3 * 100.0 + 0.7 * 0.1
    result = rendered([picture(rgb, coc_px)]).rgb[..., 0]
    disc = 130.0 / (100.0 * np.pi)  # the light of 1.3 pixels over the disc
    np.testing.assert_allclose(result[32:41, 44:53], 0.1 + disc, rtol=0.03)
    assert result[36, 49] < 2.0 * disc


def test_field_cells_meet_their_limit_and_those_of_a_part_are_those_of_the_whole_frame() -> None:
    """A cat-eye resolved in ever finer cells: halving them brings the result nearer to the finest, and no light is lost."""
    aperture = replace(Aperture.disc(32), cat_eye=0.8)
    rng = np.random.default_rng(3)
    values = np.zeros((*SIZE, 4), np.float32)
    values[20:52, 20:76] = rng.uniform(0.0, 1.0, (32, 56, 4))
    coc_px = np.full(SIZE, 12.0, np.float32)
    frame = Frame(SIZE[1], SIZE[0])
    coarse, middle, finest = (blur_colours(SPREAD, values, coc_px, aperture, frame, cells) for cells in ((4, 3), (8, 6), (48, 36)))
    for each in (coarse, middle, finest):
        np.testing.assert_allclose(each.sum((0, 1)), values.sum((0, 1)), rtol=1e-5)
    assert np.abs(middle - finest).mean() < 0.6 * np.abs(coarse - finest).mean()
    # Light in a window sees the aperture of its place in the frame, not of its place in the window.
    values = np.zeros((*SIZE, 4), np.float32)
    values[60, 80] = 1.0
    coc_px = np.full(SIZE, 14.0, np.float32)
    whole = blur_colours(SPREAD, values, coc_px, aperture, Frame(SIZE[1], SIZE[0]))
    window = np.s_[44:72, 64:96]
    part = blur_colours(SPREAD, values[window].copy(), coc_px[window].copy(), aperture, Frame(SIZE[1], SIZE[0], 64, 44))
    np.testing.assert_allclose(part, whole[window], atol=1e-7)


@pytest.mark.parametrize(
    ("layers", "said"),
    [
        ([], "at least one layer"),
        ([picture(np.ones(3), 0.0), opaque(np.ones((8, 8, 3), np.float32), np.ones((8, 8), np.float32))], "one size"),
        ([picture(np.ones(3), 0.0), replace(picture(np.ones(3), 3.0), extra={"id": np.ones((*SIZE, 1), np.float32)})], "extra channels"),
        ([opaque(np.ones((*SIZE, 3), np.float32), np.zeros(SIZE, np.float32))], "finite circle of confusion"),
    ],
)
def test_what_cannot_be_rendered_is_said(layers: list[Layer], said: str) -> None:
    refused(said, rendered, layers)


# Layers with holes: nothing shines through what is whole.


Strip = tuple[int, int, float, tuple[float, float, float]]
"""First and last column + 1, depth in metres, colour: an upright strip as high as the picture; EDGE is beyond every ray."""
RED, GREEN, BLUE, EDGE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), 10**6
ARM_AND_BODY: list[Strip] = [(-EDGE, 60, 0.8, RED), (-EDGE, 72, 2.0, GREEN)]
NEAR_PARTS: list[Strip] = [(-EDGE, 60, 0.85, RED), (-EDGE, 72, 1.8, GREEN)]
NEAR_AND_HIDDEN: list[Strip] = [(-EDGE, 60, 0.5, RED), (80, 90, 2.0, BLUE)]
FAR: Strip = (-EDGE, EDGE, 20.0, BLUE)


def of_strips(strips: list[Strip]) -> Layer:
    rgb, depth = np.zeros((64, 160, 3), np.float32), np.full((64, 160), np.inf, np.float32)
    for first, end, strip_m, colour in sorted(strips, key=lambda strip: -strip[2]):
        rgb[:, max(first, 0) : end], depth[:, max(first, 0) : end] = colour, strip_m
    return Layer(rgb, np.isfinite(depth).astype(np.float32), depth)


def by_rays(strips: list[Strip], lens: Lens) -> np.ndarray:
    """Red, green, blue and coverage of each column: which strip each of 2001 rays through the round pupil meets first."""
    across = np.linspace(-1.0, 1.0, 2001)
    chord = np.sqrt(1.0 - across**2)
    seen, free = np.zeros((160, 4)), np.ones((160, len(across)))
    for first, end, strip_m, colour in sorted(strips, key=lambda strip: strip[2]):
        met = np.arange(160)[:, None] + 0.5 - across * 0.5 * float(lens.coc_px(strip_m, 160))
        hit = free * ((met >= first) & (met < end))
        seen += (hit @ (chord / chord.sum()))[:, None] * np.array([*colour, 1.0])
        free -= hit
    return seen


@pytest.mark.parametrize("sensor_width_mm", [6.0, 9.0])
@pytest.mark.parametrize(
    "layers",
    [
        pytest.param([ARM_AND_BODY], id="an arm before a body, within the blur of its outline"),
        pytest.param([NEAR_AND_HIDDEN, [(59, 130, 1.0, GREEN)]], id="two layers one behind the other, each in part"),
        pytest.param([[(20, 140, 5.0, RED)], [*NEAR_PARTS, FAR]], id="an object behind two near parts of a photograph"),
        pytest.param([ARM_AND_BODY, [(24, 30, 0.6, BLUE), FAR]], id="an arm before a body in a photograph with something nearer"),
    ],
)
def test_what_shines_through_layers_with_inner_edges_is_what_rays_meet(layers: list[list[Strip]], sensor_width_mm: float) -> None:
    """Blurs of 6 to 35 px on both sides of the focus. Left of column 48 stands the nearer thing that makes two layers interleave."""
    lens = Lens(50.0, 2.0, 1.0, sensor_width_mm)
    found = ScatterReference().render([of_strips(strips) for strips in layers], lens)
    truth = by_rays([strip for strips in layers for strip in strips], lens)
    np.testing.assert_allclose(np.column_stack([found.rgb[32], found.alpha[32]])[48:], truth[48:], atol=0.01)


def test_a_lamp_beside_an_inner_edge_shines_once() -> None:
    """A lamp one pixel beside the arm: the rays that pass the arm bring its light, 58 % of them; what continues behind the arm brings none.

    Its light is claimed with that of its slice, not ray by ray: a quarter too little.
    """
    lens, body = Lens(50.0, 2.0, 1.0, 9.0), of_strips([(-EDGE, 60, 0.6, RED), (-EDGE, 130, 1.6, (0.1, 0.1, 0.1))])
    lit = replace(body, rgb=body.rgb.copy())
    lit.rgb[32, 61] = 200.0
    with_lamp, without = (float(ScatterReference().render([layer], lens).rgb[..., 1].sum()) for layer in (lit, body))
    past_px = (60.0 - 61.5) / (0.5 * float(lens.coc_px(1.6, 160) - lens.coc_px(0.6, 160)))
    across = np.linspace(-1.0, 1.0, 2001)
    passing = float(np.sqrt(1.0 - across**2)[across > past_px].sum() / np.sqrt(1.0 - across**2).sum())
    assert 0.7 * passing < (with_lamp - without) / 200.0 < 1.02 * passing


def test_steps_and_specks_of_depth_leave_no_lines_and_dots_in_a_ball() -> None:
    """Depth in half floats has steps, and a stray pixel; files of renderers hold both. The ball's own colour is the truth."""
    lens, rows_columns = Lens(85.0, 0.5, 2.2, 24.0), np.indices((120, 120)) - 60.0  # blurs of -3.4 to 7 px, 15 of the stray
    radius_px = np.hypot(*rows_columns)
    depth_m = (3.0 - np.sqrt(np.maximum(0.0, 1.0 - (radius_px / 50.0) ** 2))).astype(np.float16).astype(np.float32)
    depth_m[50, 62] = 3.9
    alpha = (radius_px < 50.0).astype(np.float32)
    rgb = np.repeat((alpha * (0.5 + 0.004 * rows_columns[1]).astype(np.float32))[..., None], 3, axis=2)
    found = ScatterReference().render([Layer(rgb, alpha, depth_m)], lens)
    reach_px = 0.5 * float(np.abs(lens.coc_px(depth_m[alpha > 0], 120)).max()) + 2.0
    inside = radius_px < 50.0 - reach_px
    assert inside.sum() > 2000
    np.testing.assert_allclose(found.alpha[inside], 1.0, atol=2e-4)
    np.testing.assert_allclose(found.rgb[inside], rgb[inside], atol=0.02)


@pytest.mark.parametrize("renderer", [ScatterReference(), LayeredReconstruction()])
def test_depth_that_is_hardly_in_metres_is_refused_before_it_takes_all_memory(renderer: Renderer) -> None:
    """The sentence names what is blurred, which need not be what is nearest."""
    near, far = (opaque(np.full((60, 80, 3), 0.5, np.float32), np.full((60, 80), each, np.float32)) for each in (1e-4, np.inf))
    refused("what lies 0.0001 m away", renderer.render, [near], Lens(50.0, 1.8, 1.2, 36.0))
    far.depth_m[:, :40] = 0.34
    refused("what lies inf m away", renderer.render, [far], Lens(200.0, 0.5, 0.34, 22.3))

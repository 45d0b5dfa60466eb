"""Rims as the pupil sees them, against areas of the pupil known by geometry and against plain loops over its points."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from mrbokeh.images.layer import Layer, opaque
from mrbokeh.layering._pupil_views_numba import BEFORE_PX, Window, correlate
from mrbokeh.layering.layering import Layering
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.pupil_points import pupil_points
from mrbokeh.renderers.scatter_reference import ScatterReference

HEIGHT, WIDTH = 24, 96
LENS = replace(Lens(100.0, 1.0, 1.0, 36.0), aperture=Aperture.disc())
SLICES, RIMS = (ScatterReference(Layering(sees_rims=sees)) for sees in (False, True))
EDGE_PX = 48


def depth_of(coc_px: float) -> float:
    """Distance in metres that has this circle of confusion at this width."""
    return 1.0 / (1.0 / LENS.focus_distance_m - coc_px / LENS.coc_px_per_dioptre(WIDTH))


def card(coc_px: float, until_px: int) -> Layer:
    """A black card that covers what is left of a column."""
    alpha = np.zeros((HEIGHT, WIDTH), np.float32)
    alpha[:, :until_px] = 1.0
    return Layer(np.zeros((HEIGHT, WIDTH, 3), np.float32), alpha, np.full((HEIGHT, WIDTH), depth_of(coc_px), np.float32))


def wall(coc_px: float, bright_from_px: int) -> Layer:
    """A black wall, white from a column on."""
    rgb = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    rgb[:, bright_from_px:] = 1.0
    return opaque(rgb, np.full((HEIGHT, WIDTH), depth_of(coc_px), np.float32))


def row_of(renderer: ScatterReference, layers: list[Layer]) -> np.ndarray:
    return renderer.render(layers, LENS).rgb[HEIGHT // 2, :, 1]


@pytest.mark.parametrize(("card_px", "wall_px", "step_px"), [(6.0, 20.0, 44), (6.0, 20.0, 52), (-16.0, 12.0, 48), (-20.0, -6.0, 50)])
def test_a_step_behind_an_edge_is_seen_through_the_part_of_the_pupil_that_is_free(card_px: float, wall_px: float, step_px: int) -> None:
    """Both are straight, so the light is the area of the disc between two chords: counted here on a fine grid, a pixel wide.

    Shares multiplied, as slices do, are off by a tenth.
    """
    layers = [card(card_px, EDGE_PX), wall(wall_px, step_px)]
    u, v = np.meshgrid(*[(np.arange(400) + 0.5) / 200 - 1] * 2)
    u = u[u**2 + v**2 <= 1.0]
    x_px = (np.arange(WIDTH) + 0.5)[:, None]
    over = np.linspace(-0.5, 0.5, 9)[1::2]
    truth = np.mean(
        [((x_px + at - u * card_px / 2 >= EDGE_PX) & (x_px + at - u * wall_px / 2 >= step_px)).mean(axis=1) for at in over], axis=0
    )
    inside = slice(16, WIDTH - 16)
    by_slices, by_pupil = (np.abs(row_of(renderer, layers) - truth)[inside].max() for renderer in (SLICES, RIMS))
    assert by_slices > 0.05 and by_pupil < 0.35 * by_slices, (by_slices, by_pupil)


def test_a_light_is_cut_by_the_card_before_it() -> None:
    """The ray to x through u = 2 (x - lamp) / c meets the card at x - u c_card / 2; the card's edge cuts the disc along a straight line."""
    card_px, wall_px, lamp_px = 8.0, 24.0, EDGE_PX + 1
    scene = wall(wall_px, 0)
    scene.rgb[:] = 0.01
    scene.rgb[HEIGHT // 2, lamp_px] = 500.0
    row = row_of(RIMS, [card(card_px, EDGE_PX), scene])
    centre_px = lamp_px + 0.5
    free = RIMS.render([scene], LENS).rgb[HEIGHT // 2, :, 1]
    x_px = np.arange(WIDTH) + 0.5
    meets_px = x_px - (x_px - centre_px) * card_px / wall_px
    disc = np.abs(x_px - centre_px) < wall_px / 2 - 1.5
    np.testing.assert_allclose(row[disc & (meets_px > EDGE_PX + 1)], free[disc & (meets_px > EDGE_PX + 1)], rtol=0.02)
    assert row[disc & (meets_px < EDGE_PX - 1)].max() < 0.05 * free[lamp_px]
    # Slices dim the whole disc by the card's blurred coverage.
    assert row_of(SLICES, [card(card_px, EDGE_PX), scene])[disc & (meets_px < EDGE_PX - 1)].max() > 0.05 * free[lamp_px]


def test_one_colour_behind_and_one_surface_alone_stay_as_slices_have_them() -> None:
    flat = wall(14.0, 0)
    for layers in ([card(-9.0, EDGE_PX), flat], [wall(14.0, EDGE_PX)]):
        np.testing.assert_allclose(row_of(RIMS, layers), row_of(SLICES, layers), atol=2e-6)


def test_two_panes_dim_one_after_the_other() -> None:
    """Two layers of half coverage let a quarter through: their soft pixels must not be there for the same points of the pupil."""
    panes = [card(coc_px, WIDTH) for coc_px in (-4.0, -1.5)]
    for pane in panes:
        pane.alpha[:] = 0.5
    seen = RIMS.render([*panes, wall(3.0, 0)], LENS).rgb[8:-8, 30:-30]
    np.testing.assert_allclose(seen, 0.25, atol=0.01)


def test_a_layer_between_near_and_far_of_one_picture_is_as_if_all_three_were_given() -> None:
    """A red card listed first, and a picture of a black post before it and an even wall behind it, whose hidden part is no guess."""
    post, behind = card(-14.0, 20), wall(10.0, 0)
    red = card(-5.0, EDGE_PX)
    red.alpha[:, :32] = 0.0
    red.alpha[: HEIGHT // 2, :32] = 0.5  # behind the post: without any overlap nothing interleaves
    red.rgb[..., 0] = 0.8 * red.alpha
    picture = opaque(behind.rgb * (1.0 - post.alpha[..., None]), np.where(post.alpha > 0, post.depth_m, behind.depth_m))
    # The border is left out: a picture goes on beyond it, a layer with holes does not.
    inside = np.s_[8:-8, 12:]
    given = RIMS.render([post, red, behind], LENS).rgb[inside]
    np.testing.assert_allclose(RIMS.render([red, picture], LENS).rgb[inside], given, atol=0.01)
    # Not parted, what the wall lacks behind the post is shared out among what is there.
    assert np.abs(SLICES.render([red, picture], LENS).rgb[inside] - given).max() > 0.03


def test_sums_over_the_pupil_are_those_of_plain_loops() -> None:
    generator = np.random.default_rng(3)
    rows, columns, around, count = 9, 11, 6, 40
    box, surfaces = (rows + 2 * around, columns + 2 * around), 3
    groups, pupil = np.array([0, 0, 1]), pupil_points(Aperture.disc(), count).astype(np.float32)
    pupil[:, 2] = (np.arange(1, count + 1) * 0.618) % 1.0
    alpha = np.where(generator.random((surfaces, *box)) < 0.4, generator.random((surfaces, *box)), 0.0).astype(np.float32)
    alpha[2] = 1.0
    half_px = (generator.random((surfaces, *box)) * 8 - 4 + np.array([-1, 0, 3])[:, None, None]).astype(np.float32)
    half_px = np.clip(half_px, -5.5, 5.5)
    rgb, there = generator.random((surfaces, *box, 3)).astype(np.float32), alpha > 0
    y, x = np.indices(box)
    window = Window(
        x_px=np.concatenate([(x[each] - around + 0.5 + BEFORE_PX).astype(np.float32) for each in there]),
        y_px=np.concatenate([(y[each] - around + 0.5).astype(np.float32) for each in there]),
        half_px=half_px[there],
        alpha=alpha[there],
        rgb=rgb[there],
        starts=_starts(there),
        range_px=np.array([half_px.min(), half_px.max()], np.float32),
        top_px=-around,
    )
    sums = np.zeros((rows, columns, 1, 9), np.float32)
    buffers = np.empty((2, rows, columns), np.float32), np.empty((2, rows, columns), np.int32)
    correlate(sums, window, groups, pupil, np.zeros((rows, columns), np.int64), np.ones((1, count), np.float32), *buffers)
    expected = np.zeros_like(sums[:, :, 0])
    for u, v, threshold in pupil:
        nearest = [{}, {}]
        for s, row, column in np.argwhere(alpha > threshold):
            h = half_px[s, row, column]
            place = int(np.floor(row - around + 0.5 + v * h)), int(np.floor(column - around + 0.5 + u * h))
            seen = nearest[groups[s]]
            if place not in seen or h < seen[place][0]:
                seen[place] = h, rgb[s, row, column], (row, column)
        _close_cracks(nearest[0], rows, columns)
        for place, (_, behind, _) in nearest[1].items():
            if 0 <= place[0] < rows and 0 <= place[1] < columns:
                hidden = float(place in nearest[0])
                expected[place] += np.array([1.0, hidden, *behind, *(hidden * behind), np.square(behind).sum()])
    np.testing.assert_allclose(sums[:, :, 0], expected, rtol=1e-4, atol=1e-4)


def _close_cracks(seen: dict[tuple[int, int], tuple[float, np.ndarray, tuple[int, int]]], rows: int, columns: int) -> None:
    """Between two places that show neighbours of one surface nothing shows through: side by side first, then below one another."""
    for down, right in ((0, 1), (1, 0)):
        for row, column in product(range(down, rows - down), range(right, columns - right)):
            ends = seen.get((row - down, column - right)), seen.get((row + down, column + right))
            if (row, column) not in seen and None not in ends:
                (h, _, source), (other_h, _, other) = ends
                if np.abs(np.subtract(source, other)).max() <= 2 and 2 * abs(h - other_h) < 1:
                    seen[row, column] = ends[0]


@pytest.mark.slow
def test_a_round_thing_in_a_layer_lets_nothing_of_the_picture_through() -> None:
    """Its blur grows from pixel to pixel, so that points of the pupil see it drawn apart; one grey is one grey all the same."""
    y, x = np.indices((96, 208))  # two blocks
    radius_px = np.hypot(x - 150, y - 48)
    lens, alpha = Lens(50.0, 1.4, 1.0, 2.8), (radius_px < 44).astype(np.float32)
    ball_m = np.where(alpha > 0, 1.12 - 0.2 * np.sqrt(np.maximum(0.0, 1.0 - (radius_px / 44.0) ** 2)), np.inf).astype(np.float32)
    squares = np.random.default_rng(0).uniform(0.0, 2.0, (24, 52, 3)).repeat(4, axis=0).repeat(4, axis=1).astype(np.float32)
    picture = opaque(squares, np.full((96, 208), 6.0, np.float32))
    seen = RIMS.render([Layer(0.3 * np.repeat(alpha[..., None], 3, axis=2), alpha, ball_m), picture], lens)
    blur_px = np.abs(lens.coc_px(ball_m[alpha > 0], 208)).max()
    assert 8.0 < blur_px < 15.0
    off = np.abs(seen.rgb[radius_px < 41 - blur_px / 2] - 0.3).max(axis=1)
    assert np.quantile(off, 0.97) < 0.005 and off.max() < 0.02


def _starts(there: np.ndarray) -> np.ndarray:
    """Where the rows of each surface begin among all pixels, and where its last ends."""
    ends = np.concatenate([[0], np.cumsum(there.sum(axis=2))])
    rows = there.shape[1]
    return np.stack([ends[surface * rows : (surface + 1) * rows + 1] for surface in range(len(there))])

"""Layers between the blurred layers of a photograph: half planes and lights whose shares of the pupil are known in closed form."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from mrbokeh.compositing.between import Between, clean_colours, virtual_highlights
from mrbokeh.compositing.choose import insertion_of
from mrbokeh.compositing.near_and_far import NO_HIGHLIGHTS, NearAndFar, cut_in_two, nearer_than
from mrbokeh.compositing.over import OverPhotograph
from mrbokeh.compositing.plate import Plate, plate_of
from mrbokeh.compositing.pupil_shares import Rays
from mrbokeh.images.layer import Layer, opaque
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.pupil_points import pupil_points, transmission
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.system.errors import InputError

LENS = Lens(100.0, 1.0, 4.0, 36.0)  # 28 px of blur for near things, 13 px for virtual ones
HEIGHT, WIDTH, EDGE = 40, 96, 48
NEAR_M, VIRTUAL_M, FAR_M = 0.8, 1.4, 4.0
GREEN, RED, BLUE = np.float32([0.1, 0.5, 0.1]), np.float32([0.8, 0.1, 0.1]), np.float32([0.1, 0.2, 0.9])


def disc_share(t: np.ndarray) -> np.ndarray:
    """Area of the unit disc left of x = t, over its whole: the circular segment in closed form."""
    inside = np.clip(t, -1.0, 1.0)
    return 0.5 + (inside * np.sqrt(1.0 - inside**2) + np.arcsin(inside)) / np.pi


def half_plane(left: bool, depth_m: float, colour: np.ndarray) -> Layer:
    alpha = np.zeros((HEIGHT, WIDTH), np.float32)
    alpha[:, slice(None, EDGE) if left else slice(EDGE, None)] = 1.0
    return Layer(alpha[..., None] * colour, alpha, np.where(alpha > 0, depth_m, np.inf).astype(np.float32))


def photograph(lens: Lens = LENS) -> Plate:
    """Green and near on the left, blue and in focus behind it."""
    near = half_plane(True, NEAR_M, GREEN)
    depth_m = np.where(near.alpha > 0, NEAR_M, FAR_M).astype(np.float32)
    sharp = np.where(near.alpha[..., None] > 0, GREEN, BLUE).astype(np.float32)
    near_share = half_share(lens, NEAR_M)
    row = near_share[:, None] * GREEN + (1.0 - near_share[:, None]) * BLUE
    blurred = np.broadcast_to(row, (HEIGHT, WIDTH, 3)).astype(np.float32)
    return replace(plate_of(blurred, lens, depth_m), sharp_rgb=sharp)


def whole_wall() -> Layer:
    """A red wall that fills the picture."""
    rgb = np.broadcast_to(RED, (HEIGHT, WIDTH, 3)).copy()
    return Layer(rgb, np.ones((HEIGHT, WIDTH), np.float32), np.full((HEIGHT, WIDTH), VIRTUAL_M, np.float32))


def middle_row(plate: Plate, virtual: Layer, between: Between | None = None) -> tuple[np.ndarray, np.ndarray]:
    """(rgb, share of the pupil) along the middle row, away from the borders, and their columns cut alike."""
    found = (between or Between()).insert(plate, [virtual], ScatterReference())
    return found.rgb[HEIGHT // 2, 24:-24], found.virtual.alpha[HEIGHT // 2, 24:-24]


def half_share(lens: Lens, depth_m: float) -> np.ndarray:
    """What a half plane on the left of the edge covers of the pupil, by column; in focus an edge between pixels is sharp."""
    coc_px = max(abs(float(lens.coc_px(depth_m, WIDTH))), 0.5)
    return 1.0 - disc_share(2.0 * (np.arange(WIDTH) + 0.5 - EDGE) / coc_px)


def shares(lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Of near and virtual half planes on the left, along the columns of `middle_row`."""
    return half_share(lens, NEAR_M)[24:-24], half_share(lens, VIRTUAL_M)[24:-24]


def test_an_object_that_fills_the_picture_shows_where_the_near_thing_does_not() -> None:
    """Or the matte of a user in place of sharp picture and depth: near green over blue is solved from the photograph alone."""
    rgb, share = middle_row(photograph(), whole_wall())
    near, _ = shares(LENS)
    expected = near[:, None] * GREEN + (1.0 - near)[:, None] * RED
    np.testing.assert_allclose(rgb, expected, atol=0.012)
    np.testing.assert_allclose(share, 1.0 - near, atol=0.012)
    plate = replace(photograph(), depth_m=None, sharp_rgb=None, near_alpha=half_plane(True, NEAR_M, GREEN).alpha)
    np.testing.assert_allclose(middle_row(plate, whole_wall(), Between(near_depth_m=NEAR_M))[0], expected, atol=0.06)


def test_an_object_hidden_by_the_same_half_of_the_pupil_does_not_show() -> None:
    """Both edges lie in one line: at the edge near and virtual take the same half, so none of the virtual is seen.

    Coverages multiplied would show a quarter of it. Beside the edge the virtual shows by what its share exceeds the near one's.
    """
    rgb, share = middle_row(photograph(), half_plane(True, VIRTUAL_M, RED))
    near, virtual = shares(LENS)
    seen = np.maximum(virtual - near, 0.0)
    np.testing.assert_allclose(share, seen, atol=0.025)
    np.testing.assert_allclose(rgb, near[:, None] * GREEN + seen[:, None] * RED + (1.0 - near - seen)[:, None] * BLUE, atol=0.03)
    assert abs(share[EDGE - 24]) < 0.04 < 0.2 < near[EDGE - 24] * (1.0 - virtual[EDGE - 24])


@pytest.mark.parametrize(("focus_m", "tolerance"), [(LENS.focus_distance_m, 0.025), (0.8, 0.04), (1.4, 0.04)])
def test_an_object_in_the_other_half_of_the_pupil_shows_whole(focus_m: float, tolerance: float) -> None:
    """At the edge each takes its half and nothing is left for what is far; multiplied, a quarter would be left."""
    lens = LENS.focused_at(focus_m)
    rgb, share = middle_row(photograph(lens), half_plane(False, VIRTUAL_M, RED))
    near, left_part = shares(lens)
    seen = np.minimum(1.0 - left_part, 1.0 - near)
    np.testing.assert_allclose(share, seen, atol=tolerance)
    if lens == LENS:
        np.testing.assert_allclose(rgb, near[:, None] * GREEN + seen[:, None] * RED + (1.0 - near - seen)[:, None] * BLUE, atol=0.03)


def test_where_rays_see_one_far_colour_the_pupil_is_shared_as_in_over(monkeypatch: pytest.MonkeyPatch) -> None:
    """The rays themselves, where they are asked, say the same. Depth alone: what is far is as the photograph has it."""
    size = (48, 160)
    depth_m, rgb = np.full(size, FAR_M, np.float32), np.random.default_rng(2).uniform(0.1, 1.0, (*size, 3)).astype(np.float32)
    depth_m[:, :20] = NEAR_M
    alpha = np.zeros(size, np.float32)
    alpha[10:40, 8:140], alpha[10:40, 100:140] = 1.0, 0.4
    virtual = Layer(alpha[..., None] * RED, alpha, np.where(alpha > 0, VIRTUAL_M, np.inf).astype(np.float32))
    plate = plate_of(rgb, Lens(50.0, 2.0, FAR_M, 36.0), depth_m)
    short = Between().insert(plate, [virtual], ScatterReference())
    asked = []
    monkeypatch.setattr(Rays, "one_far_colour", property(lambda rays: asked.append(rays) or np.zeros(size, bool)))
    whole = Between().insert(plate, [virtual], ScatterReference())
    soft = (short.virtual.alpha > 0.01) & (short.virtual.alpha < 0.99)
    assert asked and soft[:, 60:].sum() > 1000
    np.testing.assert_allclose(short.rgb, whole.rgb, atol=1e-5)
    np.testing.assert_allclose(short.virtual.alpha, whole.virtual.alpha, atol=1e-5)


@pytest.mark.parametrize("has_sharp", [False, True])
def test_what_a_matte_with_gaps_tells_counts_in_the_part_of_the_frame_too(has_sharp: bool) -> None:
    """A far wall, whose left part is told to be in front: its light reaches farther than the wall's would, and the part is as large."""
    size, edge = (160, 320), 160
    rgb = np.random.default_rng(4).uniform(0.1, 1.0, (*size, 3)).astype(np.float32)
    told = np.full(size, np.nan, np.float32)
    told[:, :edge] = 1.0
    lens = replace(LENS, f_number=2.0)  # 22 px of blur for virtual things
    plate = replace(plate_of(rgb, lens, np.full(size, FAR_M, np.float32)), near_alpha=told, sharp_rgb=rgb if has_sharp else None)
    alpha = np.zeros(size, np.float32)
    alpha[70:90, edge - 8 : edge + 20] = 1.0
    virtual = Layer(alpha[..., None] * RED, alpha, np.where(alpha > 0, VIRTUAL_M, np.inf).astype(np.float32))
    whole, part = (insertion.insert(plate, [virtual], ScatterReference()) for insertion in (Between(), insertion_of("between")))
    np.testing.assert_allclose(part.rgb, whole.rgb, atol=0.01)
    assert whole.virtual.alpha[80, edge - 8] < 0.2 < whole.virtual.alpha[80, edge + 10]


def test_each_setting_matters_and_what_is_missing_is_asked_for() -> None:
    plate, virtual = photograph(), half_plane(False, VIRTUAL_M, RED)
    usual = Between().insert(plate, [virtual], ScatterReference()).rgb
    assert np.abs(Between(tolerance=0.9).insert(plate, [virtual], ScatterReference()).rgb - usual).max() > 0.1
    assert 1e-5 < np.abs(Between(pupil_points=8).insert(plate, [virtual], ScatterReference()).rgb - usual).max() < 0.2
    matted = replace(plate, near_alpha=1.0 - virtual.alpha)
    nearer, farther = (Between(near_depth_m=d).insert(matted, [virtual], ScatterReference()).rgb for d in (0.8, 1.2))
    assert np.abs(nearer - farther).max() > 0.05
    virtual, bare = half_plane(True, VIRTUAL_M, RED), replace(photograph(), depth_m=None, sharp_rgb=None)
    with pytest.raises(InputError, match=r"needs depth .* or a matte"):
        Between().insert(bare, [virtual], ScatterReference())
    with pytest.raises(InputError, match="all-in-focus picture is needed"):
        Between().cut(replace(bare, near_alpha=virtual.alpha), [virtual], ScatterReference())


def test_a_matte_without_distance_is_as_the_photograph_shows_it() -> None:
    """The green half plane is blurred in the photograph; the matte states that very coverage, and the lens does not blur it again.

    Where no virtual light arrives the photograph stays bit for bit; a part of the frame gives what the whole gives.
    """
    near = np.tile(half_share(LENS, NEAR_M).astype(np.float32), (HEIGHT, 1))
    plate = replace(photograph(), depth_m=None, sharp_rgb=None, near_alpha=near)
    expected = near[0, 24:-24, None] * GREEN + (1.0 - near[0, 24:-24, None]) * RED
    # Means of both colours hold some of one another.
    np.testing.assert_allclose(middle_row(plate, whole_wall(), Between())[0], expected, atol=0.04)
    near = cv2.resize(near, (8 * WIDTH, HEIGHT), interpolation=cv2.INTER_LINEAR)
    rgb = np.random.default_rng(3).uniform(0.1, 1.0, (HEIGHT, 8 * WIDTH, 3)).astype(np.float32)
    plate = replace(plate_of(rgb, LENS.focused_at(VIRTUAL_M)), near_alpha=near)
    alpha = np.zeros_like(near)
    alpha[:, 3 * WIDTH : 5 * WIDTH] = 1.0
    small = Layer(alpha[..., None] * RED, alpha, np.where(alpha > 0, VIRTUAL_M, np.inf).astype(np.float32))
    whole, part = (insertion.insert(plate, [small], ScatterReference()) for insertion in (Between(), insertion_of("between")))
    np.testing.assert_allclose(part.rgb, whole.rgb, atol=2e-6)
    untouched = whole.virtual.alpha == 0.0
    assert untouched.any() and (part.rgb[untouched] == plate.rgb[untouched]).all()


def test_depth_tells_where_a_matte_says_nothing() -> None:
    """NaN everywhere is as no matte; 1 in the upper half hides what depth would show, 0 in the lower shows what depth would hide."""
    plate, virtual = photograph(), whole_wall()
    silent = replace(plate, near_alpha=np.full_like(virtual.alpha, np.nan))
    for insertion in (Between(), OverPhotograph()):
        usual = insertion.insert(plate, [virtual], ScatterReference()).rgb
        assert (insertion.insert(silent, [virtual], ScatterReference()).rgb == usual).all()
        told = silent.near_alpha.copy()
        told[: HEIGHT // 2], told[HEIGHT // 2 :, : EDGE - 12] = 1.0, 0.0
        seen = insertion.insert(replace(plate, near_alpha=told), [virtual], ScatterReference()).virtual.alpha
        assert seen[10, -8] < 0.02 and seen[-8, 24] > 0.9 and seen[-8, -8] > 0.98


def test_the_edge_of_an_object_cuts_the_disc_of_a_light_behind_it() -> None:
    """A far light at the edge of an object half way to it: one half of its disc stays, the other goes."""
    lens = LENS.focused_at(0.9)
    sharp, row, column = np.full((HEIGHT, WIDTH, 3), 0.1, np.float32), HEIGHT // 2, EDGE
    sharp[row, column] = 400.0
    depth_m = np.full((HEIGHT, WIDTH), FAR_M, np.float32)
    plate = replace(plate_of(ScatterReference().render([opaque(sharp, depth_m)], lens).rgb, lens, depth_m), sharp_rgb=sharp)
    left = Between().insert(plate, [half_plane(True, 2.0, 0.1 * np.ones(3, np.float32))], ScatterReference()).photo_rgb[row, :, 0]
    half_px = 0.5 * float(lens.coc_px(FAR_M, WIDTH))
    soft_px = 1 + int(half_px / (half_px - 0.5 * float(lens.coc_px(2.0, WIDTH))))  # how wide a pixel of the edge lies on the disc
    kept, gone = np.s_[column + soft_px : column + int(half_px) - 2], np.s_[column - int(half_px) + 3 : column - soft_px]
    assert half_px > 12 and plate.rgb[row, kept, 0].min() > 0.3
    np.testing.assert_allclose(left[kept], plate.rgb[row, kept, 0], rtol=0.03)
    assert left[gone].max() < 0.15


def test_lights_of_the_object_are_hidden_by_near_edges_alone() -> None:
    """A light on the virtual surface behind a near half plane: where its disc lies past the edge, it is not dimmed."""
    lens = LENS.focused_at(0.8)
    virtual = half_plane(False, VIRTUAL_M, np.float32([0.1, 0.1, 0.1]))
    virtual.rgb[HEIGHT // 2, EDGE + 4] = 300.0
    found = Between().insert(photograph(lens), [virtual], ScatterReference()).virtual.rgb[HEIGHT // 2, :, 0]
    alone = ScatterReference().render([virtual], lens).rgb[HEIGHT // 2, :, 0]
    np.testing.assert_allclose(found[EDGE + 2 : EDGE + 8], alone[EDGE + 2 : EDGE + 8], rtol=0.05)
    assert found[: EDGE - 1].max() < 0.1 < alone[EDGE - 3]


# The steps.


def test_points_of_the_pupil_are_evenly_spread_and_transmission_is_that_of_the_outlines() -> None:
    points = pupil_points(Aperture.disc(), 4096)
    np.testing.assert_allclose(points[:, :2].mean(axis=0), 0.0, atol=5e-3)
    np.testing.assert_allclose((points[:, :2] ** 2).mean(axis=0), 0.25, atol=5e-3)  # of a disc: r^2 / 4
    ring = pupil_points(Aperture.ring(0.5), 4096)
    assert np.hypot(*ring[:, :2].T).min() > 0.49 and np.all(ring[:, 2] == 1.0)
    ring = Aperture.ring(0.5)
    np.testing.assert_allclose(transmission(ring, np.array([[0.0, 0.0], [0.75, 0.0], [0.0, -0.75], [1.2, 0.0]])), [0, 1, 1, 0], atol=1e-9)


def rays_through_flat_layers(focus_m: float = 1.0) -> Rays:
    rng = np.random.default_rng(1)
    near = half_plane(True, NEAR_M, GREEN)
    near, far_rgb = replace(near, depth_m=np.full_like(near.alpha, NEAR_M)), rng.uniform(0, 1, (HEIGHT, WIDTH, 3)).astype(np.float32)
    scene = NearAndFar(near, far_rgb, np.full((HEIGHT, WIDTH), FAR_M, np.float32), NO_HIGHLIGHTS)
    alpha = rng.uniform(0, 1, (HEIGHT, WIDTH)).astype(np.float32)
    virtual = Layer(alpha[..., None] * RED, alpha, np.full((HEIGHT, WIDTH), VIRTUAL_M, np.float32))
    return Rays.of(scene, virtual, virtual.depth_m, LENS.focused_at(focus_m), 32)


@pytest.mark.parametrize("focus_m", [1.0, FAR_M])
def test_compiled_rays_are_those_of_a_plain_loop(focus_m: float) -> None:
    """Focused on what is far, all rays of a pixel end in one point there, which is looked up once."""
    rays = rays_through_flat_layers(focus_m)
    places = np.array([20 * WIDTH + 30, 20 * WIDTH + EDGE, 3 * WIDTH + EDGE + 5])
    found, pupil = rays.means(places), pupil_points(rays.lens.aperture, 32)
    near_px, virtual_px, far_px = (float(plane[0, 0]) for plane in rays.coc_px)
    for index, place in enumerate(places):
        y, x = place // WIDTH + 0.5, place % WIDTH + 0.5

        def met(plane: np.ndarray, coc_px: float, y: float = y, x: float = x) -> np.ndarray:
            at = [y - pupil[:, 1] * coc_px / 2 - 0.5, x - pupil[:, 0] * coc_px / 2 - 0.5]
            return map_coordinates(plane.astype(np.float64), at, order=1, mode="nearest")

        free, covered = 1.0 - met(rays.scene.near.alpha, near_px), met(rays.virtual.alpha, virtual_px)
        red = met(rays.scene.far_rgb[..., 0], far_px)
        plain = [free.mean(), covered.mean(), (free * covered).mean(), (free * red).mean(), (free * (1 - covered) * red).mean()]
        compiled = [found.f[index], found.a[index], found.f_a[index], found.f_far[index, 0], found.past_far[index, 0]]
        np.testing.assert_allclose(compiled, plain, atol=2e-4)


def test_what_hides_behind_near_things_is_filled_in_as_far_as_the_lens_sees_at_their_edges_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A wall 1.6 m away behind a near wing; the hills far to the right have larger circles of confusion, but no near edge."""
    size, lens = (40, 160), Lens(100.0, 1.0, 1.2, 36.0)
    depth_m = np.full(size, 1.6, np.float32)
    depth_m[:, :70], depth_m[:, 130:] = NEAR_M, 40.0
    rgb = np.random.default_rng(3).uniform(0.1, 1.0, (*size, 3)).astype(np.float32)
    plate = replace(plate_of(ScatterReference().render([opaque(rgb, depth_m)], lens).rgb, lens, depth_m), sharp_rgb=rgb)
    alpha = np.zeros(size, np.float32)
    alpha[8:32, 40:100] = 1.0
    virtual = Layer(alpha[..., None] * RED, alpha, np.where(alpha > 0, VIRTUAL_M, np.inf).astype(np.float32))
    found = [(Between().cut(plate, [virtual], ScatterReference()), Between().insert(plate, [virtual], ScatterReference()))]
    coc_px = lens.coc_px(depth_m, size[1])
    for module in ("between", "edge_refinement"):
        monkeypatch.setattr(f"mrbokeh.compositing.{module}.reach_px", lambda *_: 0.5 * float(coc_px.max() - coc_px.min()))
    found.append((Between().cut(plate, [virtual], ScatterReference()), Between().insert(plate, [virtual], ScatterReference())))
    (small, short), (large, whole) = found
    only_large = (small.far_rgb != large.far_rgb).any(axis=(0, 2))
    assert only_large.sum() >= 10 and not only_large[60:].any()
    assert 0.05 < short.virtual.alpha[20, 68] < 0.95
    np.testing.assert_allclose(short.rgb, whole.rgb, atol=1e-6)
    np.testing.assert_allclose(short.virtual.alpha, whole.virtual.alpha, atol=1e-6)


def test_lights_are_followed_where_they_are_wanted_and_arrive_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where light is wanted it is that of all lights."""
    rays, wanted = rays_through_flat_layers(), np.zeros((HEIGHT, WIDTH), bool)
    rays.virtual.rgb[:] = 0.1 * rays.virtual.alpha[..., None]
    rays.virtual.rgb[[20, 6, 30], [70, 20, 50]] = 100.0
    wanted[:, 72:] = True
    few = virtual_highlights(rays, wanted)
    monkeypatch.setattr("mrbokeh.compositing.between._arriving", lambda *given: given[1])
    every = virtual_highlights(rays, wanted)
    assert few.one[wanted].sum() > 10.0 and few.one.sum() < 0.5 * every.one.sum()
    np.testing.assert_array_equal(few.one[wanted], every.one[wanted])
    np.testing.assert_array_equal(few.both[wanted], every.both[wanted])
    rays = rays_through_flat_layers()
    rays.virtual.rgb[:] = 0.1 * rays.virtual.alpha[..., None]
    rays.virtual.rgb[20, 70] = 100.0
    monkeypatch.undo()
    through = virtual_highlights(rays, np.ones_like(rays.virtual.alpha, bool))
    assert through.one.sum() == pytest.approx(300.0, rel=0.02) and through.both.sum() == pytest.approx(through.one.sum(), rel=1e-5)


def test_surfaces_are_cut_hard_and_mixed_pixels_of_a_rim_taken_apart() -> None:
    """A table that recedes: what is near and what is far of it add up to it, hard at the cut."""
    sharp = np.random.default_rng(2).uniform(0, 1, (40, 60, 3)).astype(np.float32)
    depth_m = np.repeat(np.linspace(2.4, 1.6, 40, dtype=np.float32)[:, None], 60, axis=1)
    near = nearer_than(depth_m, np.full_like(depth_m, 2.0), 0.03)
    scene = cut_in_two(sharp, depth_m, near, 8.0, 0.03)
    assert set(np.unique(scene.near.alpha)) == {0.0, 1.0} and 0.3 < near.mean() < 0.6
    np.testing.assert_array_equal(scene.near.rgb[near], sharp[near])
    np.testing.assert_array_equal(scene.far_rgb[~near], sharp[~near])
    # A dark bar over grey whose border pixels are 40 % bar: its coverage there is found again.
    alpha = np.zeros((30, 40), np.float32)
    alpha[:, 10:16], alpha[:, [9, 16]] = 1.0, 0.4
    sharp = (alpha[..., None] * 0.1 + (1.0 - alpha[..., None]) * 0.6).repeat(3, axis=2).astype(np.float32)
    depth_m = np.where(alpha > 0.5, 0.8, 3.0).astype(np.float32)
    scene = cut_in_two(sharp, depth_m, alpha > 0.5, 8.0, 0.03)
    np.testing.assert_allclose(scene.near.alpha, alpha, atol=0.02)
    np.testing.assert_allclose(scene.far_rgb, 0.6, atol=0.02)
    alpha = np.repeat(np.clip((np.arange(120, dtype=np.float32) - 50) / 20, 0, 1)[None], 40, axis=0)
    picture = (alpha[..., None] * GREEN + (1.0 - alpha[..., None]) * BLUE).astype(np.float32)
    front, behind = clean_colours(picture, alpha)
    np.testing.assert_allclose(alpha[..., None] * front + (1.0 - alpha[..., None]) * behind, picture, atol=0.02)
    mixed = (alpha > 0.2) & (alpha < 0.8)
    for found, true in ((front, GREEN), (behind, BLUE)):
        assert np.abs(found[mixed] - true).mean() < 0.2 * np.abs(picture[mixed] - true).mean()


def test_specks_of_wrong_depth_leave_no_holes_in_a_near_surface() -> None:
    """A grey card in focus hides what is behind it; depth that is off at single pixels and at pairs must not let that through."""
    lens = Lens(100.0, 1.0, 2.0, 36.0)
    depth_m = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    depth_m[10, 20] = depth_m[20, 30:32] = depth_m[30:32, 40:42] = 2.3
    depth_m[:, 80:] = 4.0
    grey = np.full((HEIGHT, WIDTH, 3), 0.4, np.float32)
    behind = opaque(np.ones_like(grey), np.full((HEIGHT, WIDTH), 2.6, np.float32))
    plate = replace(plate_of(grey, lens, depth_m), sharp_rgb=grey)
    found = Between().insert(plate, [behind], ScatterReference()).rgb
    np.testing.assert_allclose(found[:, :60], grey[:, :60], atol=0.01)
    assert found[:, 90:].min() > 0.9


def test_print_on_a_near_thing_stays_whole_though_its_sharp_picture_lies_beside_it() -> None:
    """Slices from the hand: the sharp picture of a bumpy post is off by 5 px, and rendering leaves 1 to 3 % of the pupil free there."""
    lens = Lens(focal_length_mm=35.0, f_number=2.0, focus_distance_m=2.0, sensor_width_mm=3.5)
    rows, columns = np.mgrid[:90, :120].astype(np.float32)
    post = columns >= 50
    depth_m = np.where(post, 1.0 + 0.08 * np.sin(columns / 6) * np.cos(rows / 7), 3.0).astype(np.float32)
    print_ = np.where((np.floor(columns / 8) + np.floor(rows / 8)) % 2 < 1, 0.6, 0.1)
    sharp = np.repeat(np.where(post, print_, 0.3)[..., None], 3, axis=2).astype(np.float32)
    renderer = PolygonDifferences(threads=1)
    photo = renderer.render([opaque(sharp, depth_m)], lens).rgb
    plate = replace(plate_of(photo, lens, depth_m), sharp_rgb=np.where(post[..., None], np.roll(sharp, 5, axis=1), sharp))
    alpha = (columns > 20).astype(np.float32)
    card = Layer(0.8 * np.repeat(alpha[..., None], 3, axis=2), alpha, np.where(alpha > 0, 2.0, np.inf).astype(np.float32))
    left = Between(refine_edges=False).insert(plate, [card], renderer).photo_rgb
    assert np.abs(left - photo)[15:-15, 75:-15].max() < 1e-3

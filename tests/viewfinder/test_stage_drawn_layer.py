"""Drawings of the stage: the box shows what the whole frame would show, shadows darken, real things hide, and drawings move rightly. What
lies under a point, the pictures that the page can switch between, and the cheaper settings of the live stage."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from mrbokeh.compositing.overlay import Overlay, code_tables
from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.images.image_io import read_linear
from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import Camera, camera_to_json, level_plane_dioptres
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.choose import make_renderer
from mrbokeh.scene import split_sun
from mrbokeh.scene.embree.embree_raycaster import EmbreeRaycaster
from mrbokeh.scene.light import Environment
from mrbokeh.scene.mesh import rigid_motion
from mrbokeh.scene.staging.picture_box import box_around, drawn_points_m
from mrbokeh.scene.staging.scene_description import Lighting, RealThings, Sun
from mrbokeh.scene.staging.staged_scene import Assets
from mrbokeh.tracking.world_axes import UPRIGHT_FROM_WORLD, turned, turned_back, upright_camera
from tests.support.refusals import refused
from tests.support.stage_scenes import FOCAL_PX, HEIGHT, LENS, ONE_CARD, SHADOW, WIDTH, camera, centroid, render_setup, scene_file, staged
from viewfinder.stage.drawing import Drawing, DrawRequest, draw, is_outdated, moved_px, sharp_layers
from viewfinder.stage.occlusion import Mask, Occlusion, RealDepth, read_occlusion
from viewfinder.stage.reprojection import LayerDepth
from viewfinder.stage.shown_scene import VIEWS, ShownScene, depth_at_m, object_at, view_picture
from viewfinder.stage.stage_setup import SetupLoader, live_backend

BLACK = np.zeros((HEIGHT, WIDTH, 3), np.float32)


def shown(drawing: Drawing, view: Camera) -> Overlay:
    return drawing.layer.moved_to(upright_camera(view, "-z"))


def whole_frame(folder: Path, view: Camera, lens: Lens = LENS) -> Layer:
    """The same scene without any box: raycast and blurred as one picture."""
    tools = render_setup()
    sharp = tools.backend.render(staged(folder).scene_at(0.0), upright_camera(view, "-z"))
    return tools.renderer.render([sharp], lens)


TILTED, CAT_EYED = replace(LENS, tilt_rad=(0.0, 0.1)), replace(LENS, aperture=replace(LENS.aperture, cat_eye=0.5))


@pytest.mark.parametrize("lens", [LENS.focused_at(0.5), LENS, LENS.focused_at(3.0), TILTED.focused_at(0.6), CAT_EYED.focused_at(0.6)])
def test_the_box_shows_what_the_whole_frame_would(tmp_path: Path, lens: Lens) -> None:
    # The reference renderer sums exact kernels: cutting changes nothing but what is too weak to be seen (1e-4). A blur that depends on the
    # place is drawn in the whole frame.
    drawing = drawn(tmp_path, lens)
    assert np.abs(shown(drawing, camera()).over(BLACK) - whole_frame(tmp_path, camera(), lens).rgb).max() < 2e-4
    varies = lens.tilt_rad != LENS.tilt_rad or lens.aperture != LENS.aperture
    assert drawing.layer is not None and (varies or drawing.layer.rgba.shape[1] < WIDTH)


def test_only_the_box_is_drawn_and_it_holds_the_blur(tmp_path: Path) -> None:
    # The card of 0.2 m at 1 m is 30 px wide; focused at 0.5 m its blur is 2.9 * 1 px wide: 34 px and 2 px for pixel edges, in 16s.
    points = staged(tmp_path).scene_at(0.0).meshes[0].positions_m
    box = box_around(points, upright_camera(camera(), "-z"), LENS.focused_at(0.5))
    assert box is not None and box.width_px == 48 and box.left_px <= 80 - 17 and box.left_px + 48 >= 80 + 17


def aside(right_m: float) -> Camera:
    """The camera, moved to the right."""
    return camera((right_m, 1.0, -0.1), (right_m, 0.0, -0.1))


def drawn(folder: Path, lens: Lens = LENS, view: Camera | None = None, resolution: float = 1.0) -> Drawing:
    return draw(staged(folder), DrawRequest(view or camera(), lens, 0.0, resolution), render_setup())


def test_a_camera_that_looks_away_sees_nothing_and_one_within_the_object_is_no_mistake(tmp_path: Path) -> None:
    for at_m in ((0.0, 2.0, -0.1), (1.5, 0.0, -0.1)):
        assert drawn(tmp_path, view=camera((0.0, 1.0, -0.1), at_m)).layer is None
    hidden = staged(tmp_path).with_object("card", visible=False)
    assert draw(hidden, DrawRequest(camera(), LENS), render_setup()).layer is None
    inside = camera((0.05, 0.004, -0.1), (0.0, -1.0, -0.1))
    draw(staged(tmp_path), DrawRequest(inside, LENS), render_setup("polygon"))


@pytest.mark.parametrize("resolution", [0.75, 0.5])
def test_reduced_resolution_keeps_light_and_place(tmp_path: Path, resolution: float) -> None:
    full, less = (shown(drawn(tmp_path, LENS.focused_at(0.5), None, each), camera()).over(BLACK)[..., 0] for each in (1.0, resolution))
    assert less.sum() == pytest.approx(full.sum(), rel=0.01) and centroid(less) == pytest.approx(centroid(full), abs=0.05)


def test_a_bokeh_disc_moves_as_its_point_does(tmp_path: Path) -> None:
    # A lamp of 1 cm at 3 m, blurred over 3.27 * (3 - 1 / 3) = 8.7 px by a lens focused at 1/3 m (58.8 mm to the sensor), and the camera
    # moves by 4 cm to the right:
    # every part of the disc moves by f t / z = 2 px, though half of it lies where the sharp picture shows nothing.
    text = ONE_CARD.replace("0.2", "0.01") + "position_m = [0, -2, -0.1]\n"
    drawing = draw(staged(tmp_path, text), DrawRequest(camera(), LENS.focused_at(1 / 3)), render_setup())
    before, after = (shown(drawing, view).over(BLACK)[..., 0] for view in (camera(), aside(0.04)))
    assert np.count_nonzero(before > 0.5 * before.max()) == pytest.approx(np.pi / 4 * 8.7**2, rel=0.1)
    assert centroid(after)[0] - centroid(before)[0] == pytest.approx(-FOCAL_PX * 0.04 / 3.0, abs=0.02)
    assert np.abs(after[:, :-2] - before[:, 2:]).max() < 1e-3 * before.max()


def test_a_moved_drawing_is_near_a_fresh_one(tmp_path: Path) -> None:
    # 2 cm to the side and 1 cm forward with a turn of half a degree: 3 px of parallax. Resampling softens the card's edges.
    drawing, view = drawn(tmp_path, LENS.focused_at(0.5)), camera((0.02, 0.99, -0.1), (0.01, 0.0, -0.105))
    fresh = shown(drawn(tmp_path, LENS.focused_at(0.5), view), view).over(BLACK)
    late, stale = (shown(drawing, each).over(BLACK) for each in (view, camera()))
    errors = [float(np.sqrt(np.mean((each - fresh) ** 2))) for each in (late, stale)]
    assert errors[0] < 0.1 * errors[1] and errors[0] < 0.01


class TestShadow:
    # The sun stands 45 degrees high in front of the card: light goes away from the viewer and down. The card of 0.2 m throws 0.2 m of
    # shadow behind it, 0.2 m wide. Seen from high above, its middle lies clear of the card.
    VIEW = camera((0.0, 0.3, -1.2), (0.0, -0.1, 0.0))
    GREY = np.full((HEIGHT, WIDTH, 3), 0.8, np.float32)

    def drawing(self, folder: Path, text: str = SHADOW) -> Drawing:
        return draw(staged(folder, text), DrawRequest(self.VIEW, replace(LENS, f_number=32.0, focus_distance_m=1.25)), render_setup())

    def light_at(self, folder: Path, text: str, x_m: float, y_m: float, view: Camera = VIEW) -> np.ndarray:
        """On a grey table."""
        column, row = view.project(np.array([x_m, y_m, 0.0]))[0]
        return shown(self.drawing(folder, text), view).over(self.GREY)[int(row), int(column)]

    def test_it_darkens_the_plate_by_its_strength_where_the_light_is_blocked(self, tmp_path: Path) -> None:
        for x_m, y_m, light in ((0.0, -0.1, 0.2), (0.07, -0.17, 0.2), (0.15, -0.1, 0.8), (0.0, -0.26, 0.8), (0.0, 0.1, 0.8)):
            assert np.allclose(self.light_at(tmp_path, SHADOW, x_m, y_m), light, atol=1e-3)

    def test_without_a_plane_there_is_none_and_it_ends_where_the_plane_ends(self, tmp_path: Path) -> None:
        assert np.allclose(self.light_at(tmp_path, SHADOW.partition("[shadow]")[0], 0.0, -0.1), 0.8)
        assert np.allclose(self.light_at(tmp_path, SHADOW + "size_m = 0.2\n", 0.0, -0.17), 0.8, atol=1e-3)

    def test_it_moves_with_the_table(self, tmp_path: Path) -> None:
        # From a camera 5 cm to the right, the shadow's middle is where that camera sees it.
        view = camera((0.05, 0.3, -1.2), (0.05, -0.1, 0.0))
        for x_m, light in ((0.08, 0.2), (0.12, 0.8)):
            assert self.light_at(tmp_path, SHADOW, x_m, -0.15, view)[1] == pytest.approx(light, abs=0.02)


class TestOcclusion:
    def drawn_behind(self, folder: Path, occlusion: Occlusion | None) -> np.ndarray:
        tools = replace(render_setup(), occlusion=occlusion)
        drawing = draw(staged(folder), DrawRequest(camera(), LENS), tools)
        return BLACK if drawing.layer is None else shown(drawing, camera()).over(BLACK)

    def test_a_real_wall_hides_what_is_behind_it_only(self, tmp_path: Path) -> None:
        # The card stands at 1 m; depths are told apart from 4 % on (mrbokeh.compositing).
        view, open_air = upright_camera(camera(), "-z"), self.drawn_behind(tmp_path, None)
        for wall_m, hides in ((0.9, True), (1.1, False), (1.01, False)):
            seen = self.drawn_behind(tmp_path, RealDepth(np.full((HEIGHT, WIDTH), wall_m, np.float32), view))
            assert np.array_equal(seen, BLACK if hides else open_air)

    def test_half_a_wall_seen_from_elsewhere(self, tmp_path: Path) -> None:
        # A wall 0.5 m before the camera covers all that is left of x = 0 there: from a camera 10 cm to the left of ours its
        # border is at column 80 + 0.1 / 0.5 * 150 = 110; ours sees it at 80, in the middle of the card.
        elsewhere = upright_camera(aside(-0.1), "-z")
        depth_m = np.full((HEIGHT, WIDTH), np.inf, np.float32)
        depth_m[:, :110] = 0.5
        seen, open_air = self.drawn_behind(tmp_path, RealDepth(depth_m, elsewhere)), self.drawn_behind(tmp_path, None)
        assert not seen[:, :79].any() and open_air[:, 70].any() and np.array_equal(seen[:, 81:], open_air[:, 81:])

    def test_a_mask_hides_where_it_is_white(self, tmp_path: Path) -> None:
        # The mask has half the frame's pixels: its column 39 is white, 40 is not; the border is at column 80, soft by its own pixel.
        hides = np.zeros((HEIGHT // 2, WIDTH // 2), np.float32)
        hides[:, :40] = 1.0
        seen, open_air = self.drawn_behind(tmp_path, Mask(hides)), self.drawn_behind(tmp_path, None)
        assert not seen[:, :78].any() and np.allclose(seen[:, 82:], open_air[:, 82:])
        # Bilinear between the mask's pixels: a quarter and three quarters of the light on both sides of the border.
        assert np.allclose(seen[50, 79:81] / open_air[50, 79:81], [[0.25], [0.75]], atol=1e-3)

    def test_files(self, tmp_path: Path) -> None:
        view = camera()
        write_exr(tmp_path / "depth.exr", ExrPart({"Z": np.full((HEIGHT, WIDTH), 0.9, np.float32)}))
        (tmp_path / "camera.json").write_text(str(camera_to_json(view)).replace("'", '"'))
        cv2.imwrite(str(tmp_path / "mask.png"), np.full((HEIGHT, WIDTH), 255, np.uint8))
        by_depth = read_occlusion(RealThings(tmp_path / "depth.exr", tmp_path / "camera.json"), "-z")
        by_mask = read_occlusion(RealThings(mask=tmp_path / "mask.png"), "-z")
        assert read_occlusion(None, "-z") is None
        for occlusion in (by_depth, by_mask):
            assert not self.drawn_behind(tmp_path, occlusion).any()
        write_exr(tmp_path / "depth.exr", ExrPart({"Z": np.full((HEIGHT, HEIGHT), 0.9, np.float32)}))
        refused("expected the same picture", read_occlusion, RealThings(tmp_path / "depth.exr", tmp_path / "camera.json"), "-z")


class TestRedraw:
    def test_it_goes_by_pixels_of_movement_and_of_blur(self, tmp_path: Path) -> None:
        drawing = drawn(tmp_path)
        request = drawing.request
        assert not is_outdated(drawing, request, is_animated=False)
        # 5 mm to the side at 1 m are 0.75 px; 8 mm are 1.2 px.
        for aside_m, outdated in ((0.005, False), (0.008, True)):
            view = aside(aside_m)
            assert moved_px(drawing, view) == pytest.approx(FOCAL_PX * aside_m, rel=1e-3)
            assert is_outdated(drawing, replace(request, camera=view), is_animated=False) == outdated
        # 2.9 px per dioptre: a focus at 1.05 m instead of 1 m changes the blur by 0.14 px, one at 1.2 m by 0.48 px.
        for focus_m, outdated in ((1.05, False), (1.2, True)):
            assert is_outdated(drawing, replace(request, lens=LENS.focused_at(focus_m)), is_animated=False) == outdated
        other_shape = replace(LENS, aperture=LENS.aperture.obstructed(0.5))
        for change in ({"lens": other_shape}, {"camera": camera().resized(80, 56)}):
            assert is_outdated(drawing, replace(request, **change), is_animated=False)
        for is_animated in (False, True):
            assert is_outdated(drawing, replace(request, time_s=1.0), is_animated=is_animated) == is_animated

    def test_an_empty_drawing_holds_for_its_own_view_only(self, tmp_path: Path) -> None:
        away = camera((0.0, 1.0, -0.1), (0.0, 2.0, -0.1))
        drawing = drawn(tmp_path, view=away)
        assert not is_outdated(drawing, DrawRequest(away, LENS), is_animated=False)
        assert is_outdated(drawing, DrawRequest(camera(), LENS), is_animated=False)


def test_the_depth_of_a_blurred_pixel_is_that_of_what_it_shows() -> None:
    # Two lamps at 1 and 4 m on dark ground, both blurred: within each disc it is the lamp's own 1 / depth, also outside the sharp lamp.
    alpha = np.zeros((HEIGHT, WIDTH), np.float32)
    alpha[52:60, 36:44] = alpha[52:60, 116:124] = 1.0
    depth_m = np.where(alpha > 0, np.where(np.arange(WIDTH) < 80, np.float32(1.0), np.float32(4.0)), np.float32(np.inf))
    lens = replace(LENS, focus_distance_m=2.0, f_number=0.5)
    # 23 px per dioptre: 11.7 px of blur for the near, 5.9 px for the far.
    layer = Layer(np.repeat(alpha[..., None], 3, axis=2), alpha, depth_m)
    blurred = make_renderer("scatter", threads=1).render([layer], lens)
    grid = np.kron(LayerDepth().seen_dioptres([layer], lens), np.ones((4, 4), np.float32))
    for columns, dioptres in ((np.s_[:, :80], 1.0), (np.s_[:, 80:], 0.25)):
        seen = blurred.alpha[columns] > 0.02
        assert np.count_nonzero(seen) > 80 and np.allclose(grid[columns][seen], dioptres, rtol=0.01)


def test_real_object_box_and_whole_agree(shared_data: Path, tmp_path: Path) -> None:
    # A real textured object in front of a lens with 3 px of blur, drawn by the renderer that the viewfinder uses.
    text = f'[[object]]\nname = "alien"\nglb = "{shared_data}/objects/alien.glb"\nheight_m = 0.2\n'
    scene, lens, tools = staged(tmp_path, text), LENS.focused_at(0.5), render_setup("polygon")
    drawing = draw(scene, DrawRequest(camera(), lens), tools)
    sharp = tools.backend.render(scene.scene_at(0.0), upright_camera(camera(), "-z"))
    expected = tools.renderer.render([sharp], lens).rgb
    assert expected.max() > 0.1
    assert np.abs(shown(drawing, camera()).over(BLACK) - expected).max() < 0.003 * expected.max()


TWO_CARDS = ONE_CARD + ONE_CARD.replace('"card"', '"far"') + "position_m = [0.3, -0.5, 0]\n"
TABLES = code_tables("srgb")
PLATE = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
ABOVE = camera((0.0, 0.5, -1.0), (0.0, 0.0, 0.0))


def seen(
    folder: Path, text: str = TWO_CARDS, pose: Camera | None = None, occlusion: Occlusion | None = None, lens: Lens = LENS
) -> ShownScene:
    scene, pose = staged(folder, text), pose or camera()
    drawing, upright = draw(scene, DrawRequest(pose, lens), render_setup()), upright_camera(pose, "-z")
    return ShownScene(drawing.layer.moved_to(upright), upright, drawing, scene, occlusion)


def test_worlds_turn_without_mirroring_and_back() -> None:
    for up, matrix in UPRIGHT_FROM_WORLD.items():
        assert np.linalg.det(matrix) == pytest.approx(1.0)
        towards = {"x": (1.0, 0, 0), "y": (0, 1.0, 0), "z": (0, 0, 1.0)}[up[1]]
        sign = 1.0 if up[0] == "+" else -1.0
        # Up is -y in the upright world.
        assert turned((sign * towards[0], sign * towards[1], sign * towards[2]), up) == (0.0, -1.0, 0.0)
        assert turned_back(turned((1.0, 2.0, 3.0), up), up) == (1.0, 2.0, 3.0)


def test_the_table_as_the_camera_sees_it() -> None:
    upright = upright_camera(ABOVE, "-z")
    dioptres = level_plane_dioptres(upright)
    for x_m, y_m in ((0.0, 0.0), (0.2, -0.3)):
        (x_px, y_px), depth_m = ABOVE.project(np.array([x_m, y_m, 0.0]))
        assert 1.0 / dioptres[int(y_px), int(x_px)] == pytest.approx(depth_m, rel=0.01)
    # Level along the table, the upper half of the picture sees none of it.
    level = level_plane_dioptres(upright_camera(camera(), "-z"))
    assert not level[: HEIGHT // 2].any() and (level[HEIGHT // 2 + 1 :] > 0).all()


def test_objects_are_picked_with_their_depth(tmp_path: Path) -> None:
    scene = seen(tmp_path)
    assert object_at(scene, 80.0, 56.0) == ("card", pytest.approx(1.0))
    # (0.3, -0.5) is seen from 1.5 m, 30 px to the right.
    assert object_at(scene, 110.0, 56.0) == ("far", pytest.approx(1.5)) and object_at(scene, 96.0, 56.0) is None
    assert object_at(scene, 80.0, 110.0) is None


def test_the_nearer_of_two_is_picked_and_what_a_wall_hides_is_not(tmp_path: Path) -> None:
    behind = ONE_CARD + ONE_CARD.replace('"card"', '"far"') + "position_m = [0, -0.5, 0]\n"
    assert object_at(seen(tmp_path, behind), 80.0, 56.0) == ("card", pytest.approx(1.0))
    wall = RealDepth(np.full((HEIGHT, WIDTH), 1.2, np.float32), upright_camera(camera(), "-z"))
    scene = seen(tmp_path, TWO_CARDS, occlusion=wall)
    assert object_at(scene, 80.0, 56.0) is not None and object_at(scene, 110.0, 56.0) is None
    assert depth_at_m(scene, 110.0, 56.0) == pytest.approx(1.2)


def test_a_tap_focuses_on_the_object_or_else_on_the_table(tmp_path: Path) -> None:
    scene = seen(tmp_path)
    assert depth_at_m(scene, 80.0, 56.0) == pytest.approx(1.0)
    # 0.1 m above the table, 40 px below the horizon: f h / y = 150 * 0.1 / 40.
    assert depth_at_m(scene, 10.0, 96.0) == pytest.approx(0.375)
    refused("point in the picture", depth_at_m, scene, -3.0, 0.0)
    refused("cannot focus at", depth_at_m, scene, 10.0, 10.0)


def test_views(tmp_path: Path) -> None:
    scene = seen(tmp_path)
    pictures = {view: view_picture(view, PLATE, scene, TABLES) for view in VIEWS}
    assert all(picture.shape == PLATE.shape and picture.dtype == np.uint8 for picture in pictures.values())
    assert set(VIEWS) == {"final", "plate", "virtual", "matte", "depth", "coc"}
    centre, beside = (56, 80), (56, 10)
    # The card shines with 1, 0.5, 0.25 (red first): sRGB codes 255, 188, 137. It is opaque.
    assert pictures["final"][centre].tolist() == [137, 188, 255] == pictures["virtual"][centre].tolist()
    assert (pictures["final"][beside] == 90).all() and not pictures["virtual"][beside].any()
    assert (pictures["matte"][centre] == 255).all() and not pictures["matte"][beside].any()
    assert np.array_equal(pictures["plate"], PLATE)
    # The near card is red (blue first: the last), the far one blue.
    near, far = pictures["depth"][centre].astype(int), pictures["depth"][56, 110].astype(int)
    assert near[2] > near[0] and far[0] > far[2] and not pictures["depth"][beside].any()
    refused("expected a view", view_picture, "heat", PLATE, scene, TABLES)


@pytest.mark.parametrize(("focus_m", "colour"), [(1.0, (255, 255, 255)), (0.5, (0, 0, 255)), (3.0, (255, 0, 0))])
def test_the_circle_of_confusion_has_its_colour(tmp_path: Path, focus_m: float, colour: tuple[int, int, int]) -> None:
    # Everything is at 1 m. In focus white, behind the focus red, in front of it blue (blue first here).
    scene = seen(tmp_path, ONE_CARD, lens=LENS.focused_at(focus_m))
    assert view_picture("coc", PLATE, scene, TABLES)[56, 80] == pytest.approx(colour, abs=1)


def test_before_anything_is_drawn_and_where_nothing_is_seen(tmp_path: Path) -> None:
    away = camera((0.0, 1.0, -0.1), (0.0, 2.0, -0.1))
    drawing = draw(staged(tmp_path), DrawRequest(away, LENS), render_setup())
    empty = replace(seen(tmp_path).overlay, rgb=np.zeros((0, 0, 3), np.float32), shines_through=np.zeros((0, 0), np.float32))
    for nothing in (None, ShownScene(empty, upright_camera(away, "-z"), drawing, staged(tmp_path))):
        for view in VIEWS:
            expected = PLATE if view in ("plate", "final") else np.zeros_like(PLATE)
            assert np.array_equal(view_picture(view, PLATE, nothing, TABLES), expected)


def test_drawings_are_live_and_captures_are_not(tmp_path: Path) -> None:
    setup = SetupLoader(scene_file(tmp_path, SHADOW), EmbreeRaycaster(threads=1)).load()
    scene, upright = setup.staged.scene_at(0.0), upright_camera(camera((0.05, 0.3, -1.2), (0.0, -0.1, 0.0)), "-z")
    live = setup.render_setup.live.render(scene, upright)
    assert set(np.unique(live.alpha)) <= {0.0, 0.25, 0.5, 0.75, 1.0}
    card, shadow = sharp_layers(setup.staged, 0.0, upright, setup.render_setup)
    assert np.array_equal(card.alpha, EmbreeRaycaster().render(scene, upright).alpha)
    assert len(np.unique(card.alpha)) > 5 >= len(np.unique(live_backend(EmbreeRaycaster()).render(scene, upright).alpha))
    mask = EmbreeRaycaster().render_shadow_mask(scene, upright, setup.staged.catcher)
    assert np.allclose(shadow.alpha, 0.75 * (1 - mask))


def test_any_other_backend_draws_live_pictures_too() -> None:
    other = SimpleNamespace(render=EmbreeRaycaster.render, render_shadow_mask=EmbreeRaycaster.render_shadow_mask)
    assert live_backend(other) is other  # type: ignore[arg-type]


def test_a_live_drawing_is_near_the_best(tmp_path: Path) -> None:
    tools, scene = render_setup(), staged(tmp_path, SHADOW)
    live = replace(tools, live=live_backend(tools.backend))
    request = DrawRequest(camera((0.05, 0.3, -1.2), (0.0, -0.1, 0.0)), LENS)
    best, fast = draw(scene, request, tools).sharp, draw(scene, request, live).sharp
    assert best is not None and fast is not None
    # Only edges differ: of the card by a quarter at most; of the shadow (0.75 dark) by half of it, where two pixels are interpolated.
    assert 0 < np.abs(best.rgba - fast.rgba).max() < 0.75 / 2 + 0.05
    assert fast.rgba.sum((0, 1)) == pytest.approx(best.rgba.sum((0, 1)), rel=0.02)


def test_a_moved_object_shares_what_was_loaded(tmp_path: Path) -> None:
    before = staged(tmp_path)
    after = before.with_object("card", position_m=(0.1, 0.2, 0.0), yaw_rad=0.5)
    motion = rigid_motion(before.scene_at(0.0).meshes, after.scene_at(0.0).meshes)
    # Upright axes: x as the table's, y down, z away: (0.1, 0.2, 0) of a board whose y comes towards the viewer.
    assert (motion @ np.array([0.0, 0.0, 0.0, 1.0]))[:3] == pytest.approx((0.1, 0.0, -0.2), abs=1e-9)
    bigger = before.with_object("card", height_m=0.3)
    assert rigid_motion(before.scene_at(0.0).meshes, bigger.scene_at(0.0).meshes) is None


def test_points_are_those_of_the_scene(tmp_path: Path) -> None:
    scene = staged(tmp_path, SHADOW)
    first = scene.drawn_points_m(0.0)
    assert np.array_equal(first, drawn_points_m(scene.scene_at(0.0), scene.catcher))
    assert scene.drawn_points_m(0.0) is first
    moved = scene.with_object("card", position_m=(0.5, 0.0, 0.0))
    assert np.array_equal(moved.drawn_points_m(0.0), drawn_points_m(moved.scene_at(0.0), moved.catcher))


@pytest.mark.parametrize("exposure", [1.0, 1.7])
def test_a_panorama_is_turned_and_exposed_after_its_sun_was_split_off(tmp_path: Path, exposure: float) -> None:
    rng = np.random.default_rng(0)
    radiance = rng.uniform(0.2, 0.4, (32, 64, 3)).astype(np.float32)
    radiance[8, 40] = 900.0
    path = tmp_path / "sky.hdr"
    assert cv2.imwrite(str(path), radiance[..., ::-1])
    stored, assets = read_linear(path), Assets()
    assets.light(Lighting(path), "-z")
    sky, lights = assets.light(Lighting(path, 0.6, exposure), "-z")
    expected_sky, expected_sun = split_sun(Environment(stored).turned(0.6).brighter(exposure))
    assert sky is not None and len(lights) == 1 and np.allclose(sky.radiance, expected_sky.radiance, rtol=1e-5)
    assert np.allclose(sky.world_from_environment, expected_sky.world_from_environment)
    assert np.allclose(lights[0].rgb, expected_sun.rgb, rtol=1e-5)
    assert np.allclose(lights[0].direction, expected_sun.direction, atol=1e-6)
    whole, suns = assets.light(Lighting(path, 0.6, exposure, (Sun((0.0, 0.0, 1.0), (1.0, 1.0, 1.0)),)), "-z")
    assert whole is not None and len(suns) == 1
    assert np.allclose(whole.radiance, stored * np.float32(exposure), rtol=1e-5)

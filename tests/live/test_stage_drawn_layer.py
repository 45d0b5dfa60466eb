"""Drawings of the stage: the box shows what the whole frame would show, shadows darken, real things hide, and drawings move rightly."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mrbokeh.compositing.overlay import Overlay
from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import Camera, camera_to_json
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.choose import make_renderer
from mrbokeh.scene.staging.picture_box import box_around
from mrbokeh.scene.staging.scene_description import RealThings
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.world_axes import upright_camera
from tests.scenes.stage_scenes import FOCAL_PX, HEIGHT, LENS, ONE_CARD, SHADOW, WIDTH, camera, centroid, render_setup, staged
from viewfinder.stage.drawing import Drawing, DrawRequest, draw, is_outdated, moved_px
from viewfinder.stage.occlusion import Mask, Occlusion, RealDepth, read_occlusion
from viewfinder.stage.reprojection import LayerDepth

BLACK = np.zeros((HEIGHT, WIDTH, 3), np.float32)


def shown(drawing: Drawing, view: Camera) -> Overlay:
    return drawing.layer.moved_to(upright_camera(view, "-z"))


def whole_frame(folder: Path, view: Camera, lens: Lens = LENS) -> Layer:
    """The same scene without any box: raycast and blurred as one picture."""
    tools = render_setup()
    sharp = tools.backend.render(staged(folder).scene_at(0.0), upright_camera(view, "-z"))
    return tools.renderer.render([sharp], lens)


@pytest.mark.parametrize("focus_m", [0.5, 1.0, 3.0])
def test_the_box_shows_what_the_whole_frame_would(tmp_path: Path, focus_m: float) -> None:
    # The reference renderer sums exact kernels: cutting changes nothing but what is too weak to be seen (1e-4).
    lens = LENS.focused_at(focus_m)
    drawing = draw(staged(tmp_path), DrawRequest(camera(), lens), render_setup())
    assert np.abs(shown(drawing, camera()).over(BLACK) - whole_frame(tmp_path, camera(), lens).rgb).max() < 2e-4
    assert drawing.layer is not None and drawing.layer.rgba.shape[1] < WIDTH


def test_only_the_box_is_drawn_and_it_holds_the_blur(tmp_path: Path) -> None:
    # The card of 0.2 m at 1 m is 30 px wide; focused at 0.5 m its blur is 2.9 * 1 px wide: 34 px and 2 px for pixel edges, in 16s.
    points = staged(tmp_path).scene_at(0.0).meshes[0].positions_m
    box = box_around(points, upright_camera(camera(), "-z"), LENS.focused_at(0.5))
    assert box is not None and box.width_px == 48 and box.left_px <= 80 - 17 and box.left_px + 48 >= 80 + 17


def test_a_camera_that_looks_away_sees_nothing(tmp_path: Path) -> None:
    away = camera((0.0, 1.0, -0.1), (0.0, 2.0, -0.1))
    assert draw(staged(tmp_path), DrawRequest(away, LENS), render_setup()).layer is None
    aside = camera((0.0, 1.0, -0.1), (1.5, 0.0, -0.1))
    assert draw(staged(tmp_path), DrawRequest(aside, LENS), render_setup()).layer is None
    hidden = staged(tmp_path).with_object("card", visible=False)
    assert draw(hidden, DrawRequest(camera(), LENS), render_setup()).layer is None


def test_a_camera_within_the_object_is_no_mistake(tmp_path: Path) -> None:
    inside = camera((0.05, 0.004, -0.1), (0.0, -1.0, -0.1))
    draw(staged(tmp_path), DrawRequest(inside, LENS), render_setup("polygon"))


@pytest.mark.parametrize("lens", [replace(LENS, tilt_rad=(0.0, 0.1)), replace(LENS, aperture=replace(LENS.aperture, cat_eye=0.5))])
def test_a_blur_that_depends_on_the_place_is_drawn_in_the_whole_frame(tmp_path: Path, lens: Lens) -> None:
    lens = lens.focused_at(0.6)
    drawing = draw(staged(tmp_path), DrawRequest(camera(), lens), render_setup())
    assert np.abs(shown(drawing, camera()).over(BLACK) - whole_frame(tmp_path, camera(), lens).rgb).max() < 2e-4


@pytest.mark.parametrize("resolution", [0.75, 0.5])
def test_reduced_resolution_keeps_light_and_place(tmp_path: Path, resolution: float) -> None:
    lens = LENS.focused_at(0.5)
    full = shown(draw(staged(tmp_path), DrawRequest(camera(), lens), render_setup()), camera()).over(BLACK)[..., 0]
    less = shown(draw(staged(tmp_path), DrawRequest(camera(), lens, 0.0, resolution), render_setup()), camera()).over(BLACK)[..., 0]
    assert less.sum() == pytest.approx(full.sum(), rel=0.01)
    assert centroid(less) == pytest.approx(centroid(full), abs=0.05)


def test_a_bokeh_disc_moves_as_its_point_does(tmp_path: Path) -> None:
    # A lamp of 1 cm at 3 m, blurred over 3.27 * (3 - 1 / 3) = 8.7 px by a lens focused at 1/3 m (58.8 mm to the sensor), and the camera
    # moves by 4 cm to the right:
    # every part of the disc moves by f t / z = 2 px, though half of it lies where the sharp picture shows nothing.
    text = ONE_CARD.replace("0.2", "0.01") + "position_m = [0, -2, -0.1]\n"
    drawing = draw(staged(tmp_path, text), DrawRequest(camera(), LENS.focused_at(1 / 3)), render_setup())
    aside = camera((0.04, 1.0, -0.1), (0.04, 0.0, -0.1))
    before, after = (shown(drawing, view).over(BLACK)[..., 0] for view in (camera(), aside))
    assert np.count_nonzero(before > 0.5 * before.max()) == pytest.approx(np.pi / 4 * 8.7**2, rel=0.1)
    assert centroid(after)[0] - centroid(before)[0] == pytest.approx(-FOCAL_PX * 0.04 / 3.0, abs=0.02)
    assert np.abs(after[:, :-2] - before[:, 2:]).max() < 1e-3 * before.max()


def test_a_moved_drawing_is_near_a_fresh_one(tmp_path: Path) -> None:
    # 2 cm to the side and 1 cm forward with a turn of half a degree: 3 px of parallax. Resampling softens the card's edges.
    drawing = draw(staged(tmp_path), DrawRequest(camera(), LENS.focused_at(0.5)), render_setup())
    view = camera((0.02, 0.99, -0.1), (0.01, 0.0, -0.105))
    fresh = shown(draw(staged(tmp_path), DrawRequest(view, LENS.focused_at(0.5)), render_setup()), view).over(BLACK)
    late, stale = shown(drawing, view).over(BLACK), shown(drawing, camera()).over(BLACK)
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
        aside = upright_camera(camera((-0.1, 1.0, -0.1), (-0.1, 0.0, -0.1)), "-z")
        depth_m = np.full((HEIGHT, WIDTH), np.inf, np.float32)
        depth_m[:, :110] = 0.5
        seen, open_air = self.drawn_behind(tmp_path, RealDepth(depth_m, aside)), self.drawn_behind(tmp_path, None)
        assert not seen[:, :79].any() and open_air[:, 70].any()
        assert np.array_equal(seen[:, 81:], open_air[:, 81:])

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
        with pytest.raises(InputError, match="expected the same picture"):
            read_occlusion(RealThings(tmp_path / "depth.exr", tmp_path / "camera.json"), "-z")


class TestRedraw:
    def test_it_goes_by_pixels_of_movement_and_of_blur(self, tmp_path: Path) -> None:
        drawing = draw(staged(tmp_path), DrawRequest(camera(), LENS), render_setup())
        request = drawing.request
        assert not is_outdated(drawing, request, is_animated=False)
        # 5 mm to the side at 1 m are 0.75 px; 8 mm are 1.2 px.
        for aside_m, outdated in ((0.005, False), (0.008, True)):
            view = camera((aside_m, 1.0, -0.1), (aside_m, 0.0, -0.1))
            assert moved_px(drawing, view) == pytest.approx(FOCAL_PX * aside_m, rel=1e-3)
            assert is_outdated(drawing, replace(request, camera=view), is_animated=False) == outdated
        # 2.9 px per dioptre: a focus at 1.05 m instead of 1 m changes the blur by 0.14 px, one at 1.2 m by 0.48 px.
        for focus_m, outdated in ((1.05, False), (1.2, True)):
            assert is_outdated(drawing, replace(request, lens=LENS.focused_at(focus_m)), is_animated=False) == outdated
        other_shape = replace(LENS, aperture=LENS.aperture.obstructed(0.5))
        assert is_outdated(drawing, replace(request, lens=other_shape), is_animated=False)
        assert is_outdated(drawing, replace(request, time_s=1.0), is_animated=True)
        assert not is_outdated(drawing, replace(request, time_s=1.0), is_animated=False)
        assert is_outdated(drawing, replace(request, camera=camera().resized(80, 56)), is_animated=False)

    def test_an_empty_drawing_holds_for_its_own_view_only(self, tmp_path: Path) -> None:
        away = camera((0.0, 1.0, -0.1), (0.0, 2.0, -0.1))
        drawing = draw(staged(tmp_path), DrawRequest(away, LENS), render_setup())
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

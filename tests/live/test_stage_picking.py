"""Picking and views: what lies under a point, the pictures that the page can switch between, and the cheaper settings of the live stage."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mrbokeh.compositing.overlay import code_tables
from mrbokeh.images.image_io import read_linear
from mrbokeh.optics.camera import Camera, level_plane_dioptres
from mrbokeh.optics.lens import Lens
from mrbokeh.scene import split_sun
from mrbokeh.scene.embree.embree_raycaster import EmbreeRaycaster
from mrbokeh.scene.light import Environment
from mrbokeh.scene.mesh import rigid_motion
from mrbokeh.scene.staging.picture_box import drawn_points_m
from mrbokeh.scene.staging.scene_description import Lighting, Sun
from mrbokeh.scene.staging.staged_scene import Assets
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.world_axes import UPRIGHT_FROM_WORLD, turned, turned_back, upright_camera
from tests.scenes.stage_scenes import HEIGHT, LENS, ONE_CARD, SHADOW, WIDTH, camera, render_setup, scene_file, staged
from viewfinder.stage.drawing import DrawRequest, draw, sharp_layers
from viewfinder.stage.occlusion import Occlusion, RealDepth
from viewfinder.stage.shown_scene import VIEWS, ShownScene, depth_at_m, object_at, view_picture
from viewfinder.stage.stage_setup import SetupLoader, live_backend

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
    assert object_at(scene, 110.0, 56.0) == ("far", pytest.approx(1.5))
    assert object_at(scene, 96.0, 56.0) is None
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
    with pytest.raises(InputError, match="point in the picture"):
        depth_at_m(scene, -3.0, 0.0)
    with pytest.raises(InputError, match="cannot focus at"):
        depth_at_m(scene, 10.0, 10.0)


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
    with pytest.raises(InputError, match="expected a view"):
        view_picture("heat", PLATE, scene, TABLES)


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
    loader = SetupLoader(scene_file(tmp_path, SHADOW), EmbreeRaycaster(threads=1))
    setup, upright = loader.load(), upright_camera(camera((0.05, 0.3, -1.2), (0.0, -0.1, 0.0)), "-z")
    live = setup.render_setup.live.render(setup.staged.scene_at(0.0), upright)
    assert set(np.unique(live.alpha)) <= {0.0, 0.25, 0.5, 0.75, 1.0}
    card, shadow = sharp_layers(setup.staged, 0.0, upright, setup.render_setup)
    expected = EmbreeRaycaster().render(setup.staged.scene_at(0.0), upright)
    assert np.array_equal(card.alpha, expected.alpha)
    assert (
        len(np.unique(card.alpha)) > 5 >= len(np.unique(live_backend(EmbreeRaycaster()).render(setup.staged.scene_at(0.0), upright).alpha))
    )
    mask = EmbreeRaycaster().render_shadow_mask(setup.staged.scene_at(0.0), upright, setup.staged.catcher)
    assert np.allclose(shadow.alpha, 0.75 * (1 - mask))


def test_any_other_backend_draws_live_pictures_too() -> None:
    class Other:
        render = EmbreeRaycaster.render
        render_shadow_mask = EmbreeRaycaster.render_shadow_mask

    other = Other()
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
    stored = read_linear(path)
    assets = Assets()
    assets.light(Lighting(path), "-z")
    sky, lights = assets.light(Lighting(path, 0.6, exposure), "-z")
    expected_sky, expected_sun = split_sun(Environment(stored).turned(0.6).brighter(exposure))
    assert sky is not None and len(lights) == 1
    assert np.allclose(sky.radiance, expected_sky.radiance, rtol=1e-5)
    assert np.allclose(sky.world_from_environment, expected_sky.world_from_environment)
    assert np.allclose(lights[0].rgb, expected_sun.rgb, rtol=1e-5)
    assert np.allclose(lights[0].direction, expected_sun.direction, atol=1e-6)
    whole, suns = assets.light(Lighting(path, 0.6, exposure, (Sun((0.0, 0.0, 1.0), (1.0, 1.0, 1.0)),)), "-z")
    assert whole is not None and len(suns) == 1
    assert np.allclose(whole.radiance, stored * np.float32(exposure), rtol=1e-5)

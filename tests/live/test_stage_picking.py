"""Picking and views: what lies under a point of the picture, and the pictures that the page can switch between."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.compositing.overlay import code_tables
from mrbokeh.optics.camera import level_plane_dioptres
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.world_axes import UPRIGHT_FROM_WORLD, turned, turned_back, upright_camera
from tests.scenes.stage_scenes import HEIGHT, LENS, ONE_CARD, WIDTH, camera, render_setup, staged
from viewfinder.stage.drawing import DrawRequest, draw
from viewfinder.stage.occlusion import Occlusion, RealDepth
from viewfinder.stage.reprojection import MovableLayer
from viewfinder.stage.shown_scene import VIEWS, ShownScene, depth_at_m, object_at, view_picture

TWO_CARDS = ONE_CARD + ONE_CARD.replace('"card"', '"far"') + "position_m = [0.3, -0.5, 0]\n"
TABLES = code_tables("srgb")
PLATE = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
ABOVE = camera((0.0, 0.5, -1.0), (0.0, 0.0, 0.0))


def seen(folder: Path, text: str = TWO_CARDS, view: object = None, occlusion: Occlusion | None = None, lens: object = LENS) -> ShownScene:
    pose = camera() if view is None else view
    scene = staged(folder, text)
    drawing = draw(scene, DrawRequest(pose, lens), render_setup())  # type: ignore[arg-type]
    upright = upright_camera(pose, "-z")  # type: ignore[arg-type]
    assert isinstance(drawing.layer, MovableLayer)
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

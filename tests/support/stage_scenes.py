"""Small scenes for the tests of viewfinder/stage: cards that shine on a board, cameras that look at it."""

from functools import cache
from pathlib import Path

import numpy as np

from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.renderers.choose import make_renderer
from mrbokeh.scene.embree.embree_raycaster import EmbreeRaycaster
from mrbokeh.scene.staging.scene_description import SceneDescription
from mrbokeh.scene.staging.scene_file import read_scene_file
from mrbokeh.scene.staging.staged_scene import Assets, StagedScene
from tests.scene.test_scene_gltf import GlbWriter
from viewfinder.stage.drawing import RenderSetup
from viewfinder.stage.reprojection import LayerDepth

WIDTH, HEIGHT = 160, 112
FOCAL_PX = 150.0
# In focus at 1 m; 36 mm of sensor on 160 px, 12.5 mm of aperture, 52.6 mm to the sensor: 2.9 px of blur per dioptre.
LENS = Lens(focal_length_mm=50.0, f_number=4.0, focus_distance_m=1.0, sensor_width_mm=36.0)
SHINING = {"emissiveFactor": [1.0, 0.5, 0.25], "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]}, "doubleSided": True}


def looking(eye_m: tuple[float, float, float], at_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """camera_from_world of a camera over a board (x right, y towards the viewer, z into the table), upright in the picture."""
    forward = np.subtract(at_m, eye_m) / np.linalg.norm(np.subtract(at_m, eye_m))
    right = np.cross([0.0, 0.0, 1.0], forward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = [right, np.cross(forward, right), forward]
    pose[:3, 3] = -pose[:3, :3] @ np.asarray(eye_m)
    return pose


def camera(eye_m: tuple[float, float, float] = (0.0, 1.0, -0.1), at_m: tuple[float, float, float] = (0.0, 0.0, -0.1)) -> Camera:
    """By default 1 m before the board's corner, looking level along the table."""
    return Camera(WIDTH, HEIGHT, (FOCAL_PX, FOCAL_PX), (WIDTH / 2, HEIGHT / 2), looking(eye_m, at_m))


def card(folder: Path, name: str = "card.glb", material: dict[str, object] | None = None) -> Path:
    """A square of 2 m at z = 0 of the file, facing the viewer."""
    writer = GlbWriter()
    writer.square(material or SHINING)
    return writer.write(folder / name)


def scene_file(folder: Path, text: str) -> Path:
    """`scene.toml` beside `card.glb`."""
    card(folder)
    path = folder / "scene.toml"
    path.write_text(text, encoding="utf-8")
    return path


ONE_CARD = '[[object]]\nname = "card"\nglb = "card.glb"\nheight_m = 0.2\n'
SHADOW = ONE_CARD + "[[sun]]\ndirection = [0, -1, 1]\nirradiance = 3\n[shadow]\nstrength = 0.75\n"


def centroid(plane: np.ndarray) -> tuple[float, float]:
    columns, rows = np.meshgrid(np.arange(plane.shape[1]) + 0.5, np.arange(plane.shape[0]) + 0.5)
    return float((plane * columns).sum() / plane.sum()), float((plane * rows).sum() / plane.sum())


def staged(folder: Path, text: str = ONE_CARD) -> StagedScene:
    return StagedScene.load(read_scene_file(scene_file(folder, text)), _assets())


@cache
def backend() -> EmbreeRaycaster:
    """One for all tests, because it keeps what it computed for a light."""
    return EmbreeRaycaster(threads=1)


@cache
def _assets() -> Assets:
    return Assets()


def described(folder: Path, text: str) -> SceneDescription:
    return read_scene_file(scene_file(folder, text))


def render_setup(renderer: Renderer | str = "scatter") -> RenderSetup:
    chosen = make_renderer(renderer, threads=1) if isinstance(renderer, str) else renderer
    return RenderSetup(backend(), chosen, LayerDepth())

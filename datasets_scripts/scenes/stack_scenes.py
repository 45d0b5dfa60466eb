"""The scenes that RAW stacks are made of: what stands in them, where cameras stand, which lens photographs them.

The lab is the desk with what measuring needs: a ChArUco board of known size for the scale, places without texture, and a dark card of
point lights, where every focus-stacking tool leaves rings.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from datasets_scripts.scenes.desk import (
    FAR_FOCUS_M,
    NEAR_FOCUS_M,
    VIEWPOINTS,
    Viewpoint,
    camera_at,
    desk_camera,
    desk_furniture,
    desk_scene,
)
from datasets_scripts.scenes.textures import mottled
from datasets_scripts.tracers.baked_lighting import bake_lighting
from datasets_scripts.tracers.traced_scene import DiscLight, Quad, Scene, Texture, Vector, plain_texture
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError

LAB_NEAR_M = 0.62
LAB_FAR_M = 2.05
BOARD_SQUARES = (8, 6)
BOARD_SQUARE_M = 0.03
BOARD_MARKER_M = 0.022
BOARD_DICTIONARY = "DICT_4X4_50"
LAB_VIEWPOINTS = (
    *VIEWPOINTS,
    Viewpoint((-0.03, -0.045, 0.0), float(np.deg2rad(0.5))),
    Viewpoint((0.04, 0.03, -0.01), float(np.deg2rad(-1.0))),
)
_TEXELS_PER_SQUARE = 48
_LIGHTS = 26
_LIGHT_RADIUS_M = (0.5e-3, 1.1e-3)
_LIGHT_RADIANCE = (4.0, 40.0)
_BEFORE_CARD_M = 0.002
_TINTS = ((1.0, 0.9, 0.75), (1.0, 0.75, 0.45), (0.7, 0.85, 1.0), (1.0, 0.55, 0.4), (0.7, 1.0, 0.7))
# A ring on purpose: it is point-symmetric, so that front and back blur look alike to a network fed with |CoC|.
_DESK_LENS = Lens(
    focal_length_mm=35.0, f_number=2.0, focus_distance_m=NEAR_FOCUS_M, sensor_width_mm=23.5, aperture=Aperture.disc().obstructed(0.5)
)


@dataclass(frozen=True)
class _Card:
    """An upright rectangle: its upper left corner, right and down edges in world metres."""

    corner_m: Vector
    right_m: Vector
    down_m: Vector

    def point_m(self, across: float, down: float) -> Float[np.ndarray, "3"]:
        return np.asarray(self.corner_m) + across * np.asarray(self.right_m) + down * np.asarray(self.down_m)

    def quad(self, texture: Texture) -> Quad:
        return Quad(self.corner_m, self.right_m, self.down_m, texture)


def _leaning_board(corner_m: Vector, yaw_rad: float, lean_rad: float) -> _Card:
    """Return the board with its upper left corner there, its right side turned nearer, its lower side leaning towards the camera."""
    columns, rows = BOARD_SQUARES
    right = columns * BOARD_SQUARE_M * np.array([np.cos(yaw_rad), 0.0, -np.sin(yaw_rad)])
    nearer = -np.array([np.sin(yaw_rad), 0.0, np.cos(yaw_rad)])
    down = rows * BOARD_SQUARE_M * (np.cos(lean_rad) * np.array([0.0, 1.0, 0.0]) + np.sin(lean_rad) * nearer)
    return _Card(corner_m, (float(right[0]), 0.0, float(right[2])), (float(down[0]), float(down[1]), float(down[2])))


DARK_CARD = _Card((-0.31, -0.115, 1.28), (0.3, 0.0, 0.05), (0.0, 0.22, 0.0))


GREY_CARD = _Card((0.12, -0.2, 1.62), (0.24, 0.0, -0.04), (0.0, 0.16, 0.0))


BOARD = _leaning_board((-0.05, 0.085, 0.93), np.deg2rad(10.0), np.deg2rad(46.0))


def lab_camera(index: int, width_px: int, height_px: int, lens: Lens) -> Camera:
    """Return one of the viewpoints of the lab."""
    if not 0 <= index < len(LAB_VIEWPOINTS):
        raise InputError(f"the lab has {len(LAB_VIEWPOINTS)} viewpoints, but number {index} was asked for")
    return camera_at(LAB_VIEWPOINTS[index], width_px, height_px, lens)


def lab_facts() -> dict[str, Any]:
    """Return what is known of the board and the dark card, for truth.json."""
    corners_m = [DARK_CARD.point_m(across, down).tolist() for across, down in ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))]
    return {
        "board": {"squares": list(BOARD_SQUARES), "square_m": BOARD_SQUARE_M, "marker_m": BOARD_MARKER_M, "dictionary": BOARD_DICTIONARY},
        "dark_card_corners_m": corners_m,
    }


def lab_scene(seed: int) -> Scene:
    """Build the lab with baked light; the seed changes textures and lights."""
    rng = np.random.default_rng([seed, 1])
    furniture = desk_furniture(rng)
    dark = mottled(512, rng, (0.012, 0.012, 0.014), (0.05, 0.048, 0.045), finest=4.0, slope=0.2)
    cards = (DARK_CARD.quad(dark), GREY_CARD.quad(plain_texture((0.35, 0.35, 0.35))), BOARD.quad(board_texture()))
    scene = bake_lighting(replace(furniture, quads=(*furniture.quads, *cards)), seed=seed)
    return replace(scene, lights=_point_lights(rng))


def board_texture() -> Texture:
    """Return the board's print: paper reflects 0.8, ink 0.03; every square has the same whole number of texels."""
    import cv2

    columns, rows = BOARD_SQUARES
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, BOARD_DICTIONARY))
    board = cv2.aruco.CharucoBoard(BOARD_SQUARES, BOARD_SQUARE_M, BOARD_MARKER_M, dictionary)
    printed = board.generateImage((columns * _TEXELS_PER_SQUARE, rows * _TEXELS_PER_SQUARE), marginSize=0)
    shade = cv2.GaussianBlur(printed.astype(np.float32) / 255.0, (0, 0), 1.0)
    return np.repeat((0.03 + 0.77 * shade)[..., None], 3, axis=2).astype(np.float32)


def _point_lights(rng: np.random.Generator) -> tuple[DiscLight, ...]:
    """Return lights jittered over a grid of the dark card, a little before it."""
    columns, rows = 6, 5
    cells = rng.permutation(columns * rows)[:_LIGHTS]
    lights = []
    for number, cell in enumerate(cells):
        across, down = (cell % columns + rng.uniform(0.25, 0.75)) / columns, (cell // columns + rng.uniform(0.25, 0.75)) / rows
        x, y, z = (DARK_CARD.point_m(across, down) - np.array([0.0, 0.0, _BEFORE_CARD_M])).tolist()
        radiance = np.asarray(_TINTS[number % len(_TINTS)]) * np.exp(rng.uniform(*np.log(_LIGHT_RADIANCE)))
        red, green, blue = radiance.tolist()
        lights.append(DiscLight((x, y, z), float(rng.uniform(*_LIGHT_RADIUS_M)), (red, green, blue)))
    return tuple(lights)


@dataclass(frozen=True)
class StackScene:
    """A scene with its viewpoints, lens and range of focus (metres from the lens); facts go into truth.json."""

    build: Callable[[int], Scene]
    camera: Callable[[int, int, int, Lens], Camera]
    viewpoints: int
    lens: Lens
    near_m: float
    far_m: float
    facts: dict[str, Any] = field(default_factory=dict)


def _desk(seed: int) -> Scene:
    return desk_scene(seed)


STACK_SCENES = {
    "desk": StackScene(
        build=_desk, camera=desk_camera, viewpoints=len(VIEWPOINTS), lens=_DESK_LENS, near_m=NEAR_FOCUS_M, far_m=FAR_FOCUS_M
    ),
    "lab": StackScene(
        build=lab_scene,
        camera=lab_camera,
        viewpoints=len(LAB_VIEWPOINTS),
        lens=Lens(28.0, 2.8, LAB_NEAR_M, 23.5),
        near_m=LAB_NEAR_M,
        far_m=LAB_FAR_M,
        facts=lab_facts(),
    ),
}

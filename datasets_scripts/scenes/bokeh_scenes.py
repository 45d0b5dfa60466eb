"""Scenes for learning blur: small lights at many depths before dim textured things, thin ones among them; closed all around."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np

from datasets_scripts.scenes.truth_scenes import (
    FAR_M,
    GROUND_M,
    HALF_X,
    HALF_Y,
    TINTS,
    any_texture,
    blocks,
    fine,
    slanted_board,
    stage,
    twig,
)
from datasets_scripts.tracers.traced_scene import vector
from datasets_scripts.tracers.truth_scene import Body, Lamp, TruthScene, ball, box, quad, wire
from mrbokeh.system.errors import InputError

NEAREST_M, FARTHEST_LIGHT_M = 0.85, FAR_M - 0.4
# Radii over depth: discs about two pixels wide where the picture is 240 px wide, as bulbs are.
_LIGHT_RADIUS = (1.7e-3, 3.4e-3)
_RADIANCE = (3.0, 16.0)


@lru_cache(maxsize=1)
def bokeh_scene(name: str) -> TruthScene:
    """Build the scene KIND_NUMBER; the number chooses everything that may vary, light included. The last one is kept for its next view."""
    kind, _, number = name.partition("_")
    if kind not in KINDS or not number.isdigit():
        raise InputError(f"expected a scene such as garlands_1 out of the kinds {', '.join(KINDS)}, got {name!r}")
    rng = np.random.default_rng([int(number), *kind.encode()])
    return replace(KINDS[kind](rng), sun=float(rng.uniform(0.05, 0.35)), sky_light=float(rng.uniform(0.12, 0.3)))


def _garlands(rng: np.random.Generator) -> TruthScene:
    """Strings of lights that sag across the view at seven depths."""
    bodies, lights = [*_room(rng), *blocks(rng, 6, (1.5, 6.5))], list(_lights(rng, 8, (2.0, FARTHEST_LIGHT_M)))
    cable = fine(rng, (0.02, 0.03, 0.02), (0.12, 0.12, 0.1))
    for depth_m in _evenly_in_dioptres(7, NEAREST_M, 6.5):
        height, sag, tilt = rng.uniform(-0.85, 0.55) * HALF_Y, rng.uniform(0.02, 0.09), rng.uniform(-0.06, 0.06)
        t = np.linspace(-1.3, 1.3, 60)
        points = depth_m * np.stack([t * HALF_X, height + sag * (1 - t**2) + tilt * t, 1.0 + 0.03 * np.sin(3 * t + depth_m)], axis=1)
        bodies.append(wire(points, 0.0014 * depth_m, cable))
        tint = _tint(rng)
        for index in range(int(rng.integers(2, 6)), 60, int(rng.integers(6, 11))):
            lights.append(_light(rng, points[index] + [0.0, 0.006 * depth_m, 0.0], tint))
    return TruthScene("open", tuple(bodies), tuple(lights))


def _fence(rng: np.random.Generator) -> TruthScene:
    """Crossed wires close to the camera, lights behind and on some of the crossings."""
    metal = fine(rng, (0.12, 0.12, 0.13), (0.5, 0.48, 0.44))
    bodies, near_m = [*_room(rng), *blocks(rng, 7, (1.8, 6.5))], float(rng.uniform(0.88, 1.0))
    lights = list(_lights(rng, 34, (1.3, FARTHEST_LIGHT_M)))
    for slope in (1.0, -1.0):
        for offset in np.arange(-0.75, 0.75, 0.15):
            t = np.linspace(-0.42, 0.42, 50)
            x_m = offset + slope * 0.75 * t + 0.006 * np.sin(30 * t + 7 * offset)
            points = np.stack([x_m, t, near_m + 0.06 * t + 0.006 * slope], axis=1)
            bodies.append(wire(points, 0.0022, metal, 0.03))
            lights.append(_light(rng, points[int(rng.integers(12, 38))] + [0.0, 0.0, -0.012], _tint(rng)))
    return TruthScene("open", tuple(bodies), tuple(lights))


def _leaves(rng: np.random.Generator) -> TruthScene:
    """Twigs with small leaves in front, lights among and behind them."""
    greens = [fine(rng, (0.03, 0.1, 0.02), (0.35, 0.55, 0.12)), fine(rng, (0.16, 0.12, 0.02), (0.75, 0.5, 0.1))]
    bark = fine(rng, (0.05, 0.03, 0.02), (0.35, 0.24, 0.15))
    bodies = [*_room(rng), *blocks(rng, 7, (2.2, 6.5))]
    for _ in range(7):
        bodies += twig(rng, greens, bark)
    return TruthScene("open", tuple(bodies), tuple(_lights(rng, 48, (0.9, FARTHEST_LIGHT_M))))


def _checkers(rng: np.random.Generator) -> TruthScene:
    """Slanted checkerboards, whose blur changes along them, with lights everywhere."""
    bodies = [*_room(rng), *blocks(rng, 4, (2.8, 6.5), dark=0.25)]
    bodies += [slanted_board(rng, depth_m) for depth_m in (1.05, 1.7, 2.7)]
    return TruthScene("open", tuple(bodies), tuple(_lights(rng, 46, (NEAREST_M, FARTHEST_LIGHT_M))))


def _shelves(rng: np.random.Generator) -> TruthScene:
    """Boards that run away from the camera, with things and lights on them."""
    bodies, lights = [*_room(rng)], list(_lights(rng, 14, (NEAREST_M, FARTHEST_LIGHT_M)))
    for side in (-1.0, 1.0):
        for height_m in (-0.16, 0.06, 0.3):
            board = any_texture(rng, 0.12)
            bodies.append(quad((side * 0.62 - 0.26, height_m, 6.4), (0.52, 0.0, 0.0), (0.0, 0.0, -5.2), board, (1.0, 8.0)))
            for depth_m in _evenly_in_dioptres(5, 1.3, 6.0):
                bodies += _thing(rng, np.array([side * rng.uniform(0.45, 0.8), height_m, depth_m]))
                place = np.array([side * rng.uniform(0.4, 0.8), height_m - 0.02 * depth_m, depth_m * rng.uniform(0.86, 0.95)])
                lights.append(_light(rng, place, _tint(rng)))
    return TruthScene("open", tuple(bodies), tuple(lights))


KINDS: dict[str, Callable[[np.random.Generator], TruthScene]] = {
    "garlands": _garlands,
    "fence": _fence,
    "checkers": _checkers,
    "leaves": _leaves,
    "shelves": _shelves,
}


def _room(rng: np.random.Generator) -> list[Body]:
    """Build a room of less contrast than a photograph may have: the noise of blurred detail would hide what is to be measured."""
    return stage(rng, dark=0.2, light=0.5)


def _thing(rng: np.random.Generator, base_m: np.ndarray) -> list[Body]:
    texture, size_m = any_texture(rng, 0.08), float(rng.uniform(0.08, 0.16))
    if rng.integers(2):
        return [ball(base_m - [0.0, 0.5 * size_m, 0.0], 0.5 * size_m, texture)]
    return box(base_m, (size_m, size_m * float(rng.uniform(0.8, 1.2)), size_m), float(rng.uniform(-0.7, 0.7)), texture)


def _lights(rng: np.random.Generator, count: int, depths_m: tuple[float, float]) -> list[Lamp]:
    """Return lights in the air, evenly in dioptres; none stands under the ground."""
    lights = []
    for depth_m in _evenly_in_dioptres(count, *depths_m):
        low = min(0.9 * HALF_Y, 0.95 * GROUND_M / depth_m)
        x, y = rng.uniform(-1.05, 1.05) * HALF_X, rng.uniform(-1.0 * HALF_Y, low)
        lights.append(_light(rng, depth_m * np.array([x, y, 1.0]), _tint(rng)))
    return lights


def _light(rng: np.random.Generator, centre_m: np.ndarray, tint: np.ndarray) -> Lamp:
    radius_m = float(rng.uniform(*_LIGHT_RADIUS) * centre_m[2])
    return Lamp(vector(centre_m), radius_m, vector(np.exp(rng.uniform(*np.log(_RADIANCE))) * tint))


def _tint(rng: np.random.Generator) -> np.ndarray:
    """Return one of the usual colours of bulbs, or white, or any."""
    choice = int(rng.integers(len(TINTS) + 2))
    return np.asarray(TINTS[choice]) if choice < len(TINTS) else rng.uniform(0.3, 1.0, 3) ** (choice - len(TINTS))


def _evenly_in_dioptres(count: int, near_m: float, far_m: float) -> np.ndarray:
    return 1.0 / np.linspace(1.0 / near_m, 1.0 / far_m, count)

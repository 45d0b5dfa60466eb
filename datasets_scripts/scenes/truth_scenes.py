"""Procedural scenes for lens blur, by kind and seed: fence and leaves before far texture (thin), checkers and blocks (open)."""

from collections.abc import Callable

import numpy as np

from datasets_scripts.scenes.textures import bricks, checks, fractal_noise, mottled, page_of_text, spots, wood
from datasets_scripts.tracers.traced_scene import Texture, Vector, vector
from datasets_scripts.tracers.truth_scene import Body, Lamp, TruthScene, ball, box, leaf, quad, wire
from mrbokeh.system.errors import InputError

GROUND_M = 0.62
FAR_M = 9.0
TINTS = ((1.0, 0.7, 0.36), (1.0, 0.86, 0.62), (0.55, 0.75, 1.0), (1.0, 0.42, 0.3), (0.6, 1.0, 0.55))
# Tangents of half the picture's angle of view, for placing things within it.
HALF_X, HALF_Y = 0.36, 0.2025


def make_scene(name: str, seed: int) -> TruthScene:
    """Build a scene of that kind; the seed chooses everything that may vary."""
    if name not in SCENES:
        raise InputError(f"expected a scene out of {', '.join(SCENES)}, got {name!r}")
    return SCENES[name](np.random.default_rng([seed, *name.encode()]))


def _fence(rng: np.random.Generator) -> TruthScene:
    """Return a mesh of wires close to the camera; blocks, balls, cards, a wall and lamps behind."""
    metal = fine(rng, (0.12, 0.12, 0.13), (0.5, 0.48, 0.44))
    bodies = [*stage(rng), *blocks(rng, 7, (2.2, 6.5))]
    near_m = float(rng.uniform(0.78, 0.85))
    for slope in (1.0, -1.0):
        for offset in np.arange(-0.75, 0.75, 0.125):
            t = np.linspace(-0.42, 0.42, 60)
            z = near_m + 0.12 * (t * 0.6 + 0.25 * slope * np.sin(9 * t + offset)) + 0.004 * slope
            points = np.stack([offset + slope * 0.75 * t + 0.006 * np.sin(30 * t + 7 * offset), t, z], axis=1)
            bodies.append(wire(points, 0.0018, metal, 0.03, thin=True))
    lamps = _lamps(rng, 22, (1.6, FAR_M - 0.4))
    return TruthScene("thin", tuple(bodies), lamps, focus_distances_m=(near_m, 1.5, 7.0))


def _leaves(rng: np.random.Generator) -> TruthScene:
    """Twigs with small leaves between 0.75 m and 1.6 m before the same kind of room, under an open sky."""
    greens = [fine(rng, (0.03, 0.1, 0.02), (0.35, 0.55, 0.12)), fine(rng, (0.16, 0.12, 0.02), (0.75, 0.5, 0.1))]
    bark = fine(rng, (0.05, 0.03, 0.02), (0.35, 0.24, 0.15))
    bodies = [*stage(rng, wall_height_m=2.3), *blocks(rng, 7, (2.5, 6.5))]
    for _ in range(11):
        bodies += twig(rng, greens, bark)
    lamps = _lamps(rng, 20, (1.9, FAR_M - 0.4))
    return TruthScene("thin", tuple(bodies), lamps, sky=_clouds(rng), focus_distances_m=(0.95, 1.6, 7.0))


def _checkers(rng: np.random.Generator) -> TruthScene:
    """Slanted checkerboards and blocks with lamps, nothing thin."""
    bodies = [*stage(rng, dark=0.13), *blocks(rng, 3, (3.2, 6.5), dark=0.25)]
    for depth_m in (1.7, 2.7):
        bodies.append(slanted_board(rng, depth_m))
    lamps = _lamps(rng, 12, (1.3, FAR_M - 0.4))
    return TruthScene("open", tuple(bodies), lamps, focus_distances_m=(1.15, 2.0, 5.0))


SCENES: dict[str, Callable[[np.random.Generator], TruthScene]] = {"fence": _fence, "leaves": _leaves, "checkers": _checkers}


def stage(rng: np.random.Generator, wall_height_m: float = 5.0, dark: float = 0.1, light: float = 0.85) -> list[Body]:
    """Ground and far wall with fine detail."""
    ground = checks(1024, rng, colour(rng, dark), colour(rng, light), count=16)
    wall = bricks(1024, rng, rows=24, columns=12, brick=colour(rng, 1.5 * dark), mortar=colour(rng, light + 0.05))
    top = GROUND_M - wall_height_m
    return [
        quad((-6.0, GROUND_M, FAR_M), (12.0, 0.0, 0.0), (0.0, 0.0, 0.3 - FAR_M), ground, (3.0, 2.2)),
        quad((-6.0, top, FAR_M), (12.0, 0.0, 0.0), (0.0, GROUND_M - top, 0.0), wall, (4.0, wall_height_m / 3.0)),
    ]


def blocks(rng: np.random.Generator, count: int, depths_m: tuple[float, float], dark: float = 0.05) -> list[Body]:
    """Boxes and balls on the ground and cards in the air, near and far in equal shares of dioptres."""
    bodies: list[Body] = []
    for depth_m in 1.0 / rng.permutation(np.linspace(1 / depths_m[1], 1 / depths_m[0], count)):
        x_m = float(rng.uniform(-0.9, 0.9) * HALF_X * depth_m)
        size_m = float(rng.uniform(0.14, 0.24) * depth_m)
        texture = any_texture(rng, dark)
        kind = rng.integers(3)
        if kind == 0:
            bodies += box((x_m, GROUND_M, depth_m), (size_m, size_m * rng.uniform(1.0, 2.2), size_m), rng.uniform(-0.7, 0.7), texture)
        elif kind == 1:
            bodies.append(ball((x_m, min(GROUND_M - size_m / 2, float(rng.uniform(-0.1, 0.12)) * depth_m), depth_m), size_m / 2, texture))
        else:
            bodies.append(_card(rng, x_m, depth_m, size_m, texture))
    return bodies


def _card(rng: np.random.Generator, x_m: float, depth_m: float, size_m: float, texture: Texture) -> Body:
    yaw, lean = rng.uniform(-0.9, 0.9), rng.uniform(-0.3, 0.3)
    right = size_m * np.array([np.cos(yaw), 0.0, np.sin(yaw)])
    down = 0.8 * size_m * np.array([np.sin(lean), np.cos(lean), 0.2 * np.sin(lean)])
    y_m = float(rng.uniform(-0.8, 0.3) * HALF_Y * depth_m)
    return quad(np.array([x_m, y_m, depth_m]) - 0.5 * (right + down), right, down, texture)


def slanted_board(rng: np.random.Generator, depth_m: float) -> Body:
    """Return a checkerboard that recedes by about its own width."""
    texture = checks(512, rng, colour(rng, 0.14), colour(rng, 0.65), count=10)
    side_m = 0.3 * depth_m
    yaw = rng.choice([-1.0, 1.0]) * rng.uniform(0.75, 1.1)
    right = side_m * np.array([np.cos(yaw), 0.1, np.sin(yaw)])
    down = side_m * np.array([0.1, 0.9, 0.0])
    x_m, y_m = rng.uniform(-0.75, 0.75) * HALF_X * depth_m, rng.uniform(-0.5, 0.5) * HALF_Y * depth_m
    return quad(np.array([x_m, y_m, depth_m]) - 0.5 * (right + down), right, down, texture)


def twig(rng: np.random.Generator, greens: list[Texture], bark: Texture) -> list[Body]:
    depth_m = 1.0 / rng.uniform(1 / 1.6, 1 / 0.82)
    start = np.array([rng.uniform(-1.1, 1.1) * HALF_X, -1.2 * HALF_Y, 1.0]) * depth_m
    t = np.linspace(0.0, 1.0, 24)[:, None]
    swing = rng.normal(0.0, 0.12, 3) * depth_m * [1.0, 0.3, 0.5]
    points = start + t * np.array([swing[0], rng.uniform(0.2, 0.46) * depth_m, 0.0]) + np.sin(2.5 * t) * swing
    bodies = [wire(points, 0.0012 * depth_m, bark, thin=True)]
    for _ in range(11):
        root = points[rng.integers(3, 24)]
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        if abs(turn[2, 2]) < 0.35:
            turn = turn[[2, 1, 0]] if abs(turn[0, 2]) > abs(turn[1, 2]) else turn[[0, 2, 1]]
        length_m = float(rng.uniform(0.022, 0.042)) * depth_m
        tint = float(rng.uniform(0.7, 1.3))
        bodies.append(leaf(root + 0.5 * length_m * turn[0], length_m, 0.42 * length_m, turn, greens[rng.integers(2)], tint, thin=True))
    return bodies


def _lamps(rng: np.random.Generator, count: int, depths_m: tuple[float, float]) -> tuple[Lamp, ...]:
    """Lamps in the air, evenly in dioptres, about a pixel in size at 640 px, 10 to 1000 in radiance."""
    lamps = []
    for depth_m in 1.0 / np.linspace(1 / depths_m[1], 1 / depths_m[0], count):
        place = (rng.uniform(-0.95, 0.95) * HALF_X * depth_m, rng.uniform(-0.9, 0.35) * HALF_Y * depth_m, depth_m)
        radius_m = rng.uniform(0.7e-3, 1.4e-3) * depth_m
        radiance = np.exp(rng.uniform(np.log(10.0), np.log(1000.0))) * np.asarray(TINTS[rng.integers(len(TINTS))])
        lamps.append(Lamp(vector(np.array(place)), float(radius_m), vector(radiance)))
    return tuple(lamps)


def any_texture(rng: np.random.Generator, darkness: float) -> Texture:
    kind = rng.integers(5)
    dark, light = colour(rng, darkness), colour(rng, 0.85)
    if kind == 0:
        return checks(384, rng, dark, light, count=int(rng.integers(6, 14)))
    if kind == 1:
        return spots(384, rng, light, (dark, colour(rng, 0.3), colour(rng, 0.6)), 60, (6.0, 20.0))
    if kind == 2:
        return page_of_text(384, 384, rng, dark, light, cell=5)
    if kind == 3:
        return wood(384, rng, dark, light, planks=6)
    return mottled(384, rng, dark, light, slope=0.2, contrast=0.4)


def fine(rng: np.random.Generator, dark: Vector, light: Vector) -> Texture:
    return mottled(256, rng, dark, light, slope=0.2, contrast=0.3)


def _clouds(rng: np.random.Generator) -> Texture:
    cover = np.clip(0.45 + 0.35 * fractal_noise(256, 512, rng, 6.0, 200.0, 1.0), 0.0, 1.0)[..., None]
    return ((1 - cover) * np.array([0.15, 0.3, 0.6]) + cover * np.array([0.75, 0.75, 0.73])).astype(np.float32)


def colour(rng: np.random.Generator, brightness: float) -> Vector:
    return vector(np.clip(brightness * rng.uniform(0.65, 1.35, 3), 0.01, 0.92))

"""Virtual objects for the mixed-reality truth: a ball in a hoop, a box and leaves, between the near things of a scene and the rest."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from datasets_scripts.procedural_textures import checks, spots
from datasets_scripts.truth_bodies import Body, ball, box, leaf, wire
from datasets_scripts.truth_scene import PackedScene, TruthScene
from datasets_scripts.truth_scenes import colour, fine, make_scene

_HOOP_POINTS = 96
_SUN, _SKY = slice(6, 9), slice(9, 12)

OBJECT_DISTANCES_M: dict[str, float] = {"fence": 1.25, "leaves": 1.9}
"""Scenes with near things, and the distance of the object's middle: behind all of those, before all of the rest."""


def virtual_object(name: str, seed: int) -> TruthScene:
    """The object of a scene alone, as a thin foreground before nothing; the seed chooses textures and places."""
    rng = np.random.default_rng([seed, *f"object of {name}".encode()])
    distance_m = OBJECT_DISTANCES_M[name]
    centre_m = distance_m * np.array([rng.uniform(-0.06, 0.06), rng.uniform(-0.02, 0.02), 1.0])
    bodies = (
        [make(rng, centre_m, distance_m) for make in (_ball, _hoop)] + _box(rng, centre_m, distance_m) + _leaves(rng, centre_m, distance_m)
    )
    return TruthScene("thin", tuple(replace(body, thin=True) for body in bodies))


def scene_around(name: str, seed: int) -> TruthScene:
    """The truth scene of that name without the lamps that would hang before or in the object."""
    scene, virtual = make_scene(name, seed), virtual_object(name, seed)
    behind_m = max(float(body.vertices_m[:, 2].max()) for body in virtual.bodies)
    return replace(scene, lamps=tuple(lamp for lamp in scene.lamps if lamp.centre_m[2] > behind_m))


def with_object(scene: TruthScene, virtual: TruthScene) -> TruthScene:
    """Both in one world."""
    return replace(scene, bodies=(*scene.bodies, *(replace(body, thin=False) for body in virtual.bodies)))


def without_shadows(packed: PackedScene) -> PackedScene:
    """The sun reaches whatever faces it: then neither of two things changes the light on the other."""
    facets = packed.facets.copy()
    facets[:, _SKY] += facets[:, _SUN]
    facets[:, _SUN] = 0.0
    return replace(packed, facets=facets)


def _ball(rng: np.random.Generator, centre_m: np.ndarray, size_m: float) -> Body:
    texture = spots(384, rng, colour(rng, 0.8), (colour(rng, 0.1), colour(rng, 0.3), colour(rng, 0.6)), 60, (6.0, 20.0))
    return ball(centre_m, 0.055 * size_m, texture)


def _hoop(rng: np.random.Generator, centre_m: np.ndarray, size_m: float) -> Body:
    angle = np.linspace(0.0, 2.0 * np.pi, _HOOP_POINTS)
    lean = rng.uniform(0.3, 0.6)
    circle = np.stack([np.cos(angle), np.sin(angle), lean * np.cos(angle + rng.uniform(0, 6))], axis=1)
    return wire(centre_m + 0.085 * size_m * circle, 0.004 * size_m, fine(rng, (0.5, 0.3, 0.05), (0.9, 0.7, 0.3)))


def _box(rng: np.random.Generator, centre_m: np.ndarray, size_m: float) -> list[Body]:
    texture = checks(384, rng, colour(rng, 0.08), colour(rng, 0.85), count=5)
    base_m = centre_m + size_m * np.array([0.17, 0.07, 0.0])
    return box(base_m, (0.1 * size_m, 0.14 * size_m, 0.08 * size_m), float(rng.uniform(-0.7, 0.7)), texture)


def _leaves(rng: np.random.Generator, centre_m: np.ndarray, size_m: float) -> list[Body]:
    texture = fine(rng, (0.3, 0.02, 0.05), (0.8, 0.2, 0.25))
    places: list[tuple[float, float]] = [(-0.15, -0.07), (-0.19, 0.01), (-0.14, 0.08)]
    return [leaf(centre_m + size_m * np.array([x, y, 0.0]), 0.09 * size_m, 0.035 * size_m, _turn(rng), texture) for x, y in places]


def _turn(rng: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    """Facing the camera within about 30 degrees."""
    roll, yaw = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-0.5, 0.5)
    along = np.array([np.cos(roll) * np.cos(yaw), np.sin(roll), np.cos(roll) * np.sin(yaw)])
    towards = np.array([np.sin(yaw), 0.0, -np.cos(yaw)])
    return np.stack([along, np.cross(towards, along), towards])

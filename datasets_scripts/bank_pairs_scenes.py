"""Layered scenes made from numbers, for training on a measured lens: discs and bars of texture before a wall, with lamps."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float32

from datasets_scripts.procedural_textures import checks, mottled, wood
from datasets_scripts.traced_scene import Texture
from mrbokeh.images.layer import Layer, opaque

NEAREST_M, FARTHEST_M = 0.9, 6.5
_TEXTURES: tuple[Callable[..., Texture], ...] = (mottled, wood, checks)
_LAMPS, _LAMP_RADIANCE = 12, (20.0, 60.0)
_SHAPES = (3, 7)  # least and most, exclusive


def random_layers(size_px: tuple[int, int], rng: np.random.Generator) -> list[Layer]:
    """Front first, each of one depth, the last a slanted opaque wall; (height, width). Edges are hard: a pixel has one depth."""
    dioptres = np.sort(rng.uniform(1.0 / FARTHEST_M, 1.0 / NEAREST_M, int(rng.integers(*_SHAPES)) + 1))[::-1]
    shapes = [_card(size_px, float(1.0 / each), rng) for each in dioptres[:-1]]
    return [*shapes, _wall(size_px, float(dioptres[-1]), rng)]


def _card(size_px: tuple[int, int], depth_m: float, rng: np.random.Generator) -> Layer:
    inside = _disc(size_px, rng) if rng.random() < 0.5 else _bar(size_px, rng)
    rgb = np.where(inside[..., None], _texture(size_px, rng), np.float32(0.0))
    return Layer(rgb, inside.astype(np.float32), np.where(inside, np.float32(depth_m), np.float32(np.inf)).astype(np.float32))


def _wall(size_px: tuple[int, int], dioptres: float, rng: np.random.Generator) -> Layer:
    """Slanted by up to a tenth of its distance, with lamps of one pixel."""
    across = np.linspace(-0.1, 0.1, size_px[1]) * rng.uniform(-1.0, 1.0)
    rgb = _texture(size_px, rng)
    rows, columns = (rng.integers(0, length, _LAMPS) for length in size_px)
    rgb[rows, columns] = rng.uniform(*_LAMP_RADIANCE, (_LAMPS, 1)) * rng.uniform(0.4, 1.0, (_LAMPS, 3))
    depth_m = np.clip((1.0 + across) / dioptres, NEAREST_M, FARTHEST_M)
    return opaque(rgb, np.broadcast_to(depth_m, size_px).astype(np.float32))


def _disc(size_px: tuple[int, int], rng: np.random.Generator) -> Bool[np.ndarray, "height width"]:
    rows, columns = np.indices(size_px) + 0.5
    return np.asarray(
        np.hypot(rows - rng.uniform(0, size_px[0]), columns - rng.uniform(0, size_px[1])) < size_px[0] * rng.uniform(0.1, 0.3)
    )


def _bar(size_px: tuple[int, int], rng: np.random.Generator) -> Bool[np.ndarray, "height width"]:
    rows, columns = np.indices(size_px) + 0.5
    angle_rad, row, column = rng.uniform(0.0, np.pi), rng.uniform(0, size_px[0]), rng.uniform(0, size_px[1])
    away = (columns - column) * np.sin(angle_rad) - (rows - row) * np.cos(angle_rad)
    return np.asarray(np.abs(away) < size_px[0] * rng.uniform(0.01, 0.08))


def _texture(size_px: tuple[int, int], rng: np.random.Generator) -> Float32[np.ndarray, "height width 3"]:
    colours = rng.uniform(0.05, 0.9, (2, 3))
    whole = _TEXTURES[int(rng.integers(len(_TEXTURES)))](max(size_px), rng, tuple(colours[0]), tuple(colours[1]))
    return np.ascontiguousarray(whole[: size_px[0], : size_px[1]]).astype(np.float32)

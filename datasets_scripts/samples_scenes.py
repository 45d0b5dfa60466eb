"""Scenes with defocus and motion at once: the out-of-focus fence of Hasselgren et al. 2015, Fig. 8, and four in the spirit of
Whirl, Coins, Rain and Gear of Leimkuehler et al. 2018. Contents come from a seed, all seen by one lens.

Circles of confusion and motion are in widths of the frame (see `Stage`); they reach about 0.1 of it, 50 px at 512.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from datasets_scripts.procedural_textures import mottled, page_of_text, spots, wood
from datasets_scripts.samples_scene import Mover, MovingScene, Stage
from datasets_scripts.samples_scenes_metal import coins, gear
from datasets_scripts.traced_scene import Texture, Vector, plain_texture
from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError

LENS = Lens(135.0, 1.8, 2.0, 36.0)
_FRONT_COC = -0.03
_TINTS: tuple[Vector, ...] = ((1.0, 0.72, 0.36), (1.0, 0.86, 0.62), (0.55, 0.75, 1.0), (1.0, 0.42, 0.3), (0.55, 1.0, 0.6))


def make_scene(name: str, seed: int, lens: Lens, aspect: float) -> MovingScene:
    """One of SCENES; aspect: height over width of the picture."""
    if name not in SCENES:
        raise InputError(f"expected a scene out of {', '.join(SCENES)}, got {name!r}")
    return SCENES[name](Stage(lens, aspect), np.random.default_rng([seed, *name.encode()]))


def fence(stage: Stage, rng: np.random.Generator) -> MovingScene:
    """A blurred fence before a checkerboard in focus that moves diagonally, and a static one that slants away behind it."""
    bars = [
        Mover(stage.card((x, 0.0, -0.055), (0.05, 1.3 * stage.aspect), _painted(rng, (0.06, 0.3, 0.1), (0.2, 0.6, 0.24))), in_front=True)
        for x in np.arange(-1.2, 1.21, 0.3)
    ]
    rail = _painted(rng, (0.07, 0.26, 0.1), (0.2, 0.52, 0.22))
    rails = [Mover(stage.card((0.0, y * stage.aspect, -0.0548), (1.4, 0.04), rail), in_front=True) for y in (-0.62, 0.62)]
    board = checkerboard(8, (0.02, 0.02, 0.03), (0.92, 0.9, 0.86))
    half, at = 0.42 * min(1.0, stage.aspect), (-0.24, -0.12 * stage.aspect, 0.0)
    moving = Mover(stage.card(at, (half, half), board), stage.velocity_m((0.05, 0.05), 0.0))
    # Its upper edge lies far behind, its lower edge near the focus.
    red_board, at = checkerboard(14, (0.5, 0.06, 0.04), (0.95, 0.82, 0.4)), (0.3, 0.34 * stage.aspect, 0.022)
    slanted = Mover(stage.card(at, (1.25, 0.9), red_board, tilt_rad=-1.1))
    return MovingScene((*bars, *rails, moving, slanted, stage.backdrop(0.075, mottled(256, rng, (0.1, 0.16, 0.3), (0.4, 0.5, 0.62)))))


def whirl(stage: Stage, rng: np.random.Generator) -> MovingScene:
    """Leaves of all depths that whirl round a resting ball in focus, some of them towards the camera, with lamps among them."""
    tones = (((0.3, 0.05, 0.02), (0.9, 0.3, 0.08)), ((0.4, 0.2, 0.02), (0.95, 0.7, 0.16)), ((0.05, 0.2, 0.04), (0.4, 0.62, 0.14)))
    leaves = [_painted(rng, dark, light) for dark, light in tones for _ in range(2)]
    movers = [_leaf(stage, leaves[index % len(leaves)], rng) for index in range(110)]
    for index in range(18):
        x, y, coc = _around(stage, rng, 0.2)
        lamp = stage.lamp((x, y, coc), 0.006, _radiance(rng, 12.0, 60.0))
        movers.append(Mover(lamp, _whirling(stage, x, y, coc, 0.0) if index % 2 else (0.0, 0.0, 0.0), in_front=coc < _FRONT_COC))
    skin = spots(256, rng, (0.5, 0.46, 0.4), ((0.1, 0.3, 0.6), (0.8, 0.2, 0.1)), 40, (6.0, 20.0))
    ball = Mover(stage.ball((0.0, 0.0, 0.0), 0.24, skin, (2.0, 1.0)))
    return MovingScene((*movers, ball, stage.backdrop(0.09, mottled(256, rng, (0.02, 0.1, 0.13), (0.14, 0.34, 0.4)))))


def rain(stage: Stage, rng: np.random.Generator) -> MovingScene:
    """Bright drops that fall in the wind, a sign in focus, and the lamps of a town far behind."""
    movers = [_drop(stage, rng) for _ in range(170)]
    for _ in range(46):
        place = (float(rng.uniform(-1.0, 1.0)), float(rng.uniform(-0.8, 0.7)) * stage.aspect, float(rng.uniform(0.06, 0.1)))
        movers.append(Mover(stage.lamp(place, 0.007, _radiance(rng, 15.0, 90.0))))
    for motion in (-0.06, -0.03, 0.03, 0.07):
        lamp = stage.lamp((float(rng.uniform(-0.9, 0.9)), 0.66 * stage.aspect, 0.085), 0.006, (60.0, 6.0, 4.0))
        movers.append(Mover(lamp, stage.velocity_m((motion, 0.0), 0.085)))
    sign = stage.card((-0.42, -0.1 * stage.aspect, 0.0), (0.36, 0.26), page_of_text(192, 256, rng, (0.04, 0.05, 0.1), (0.85, 0.8, 0.3)))
    post = stage.card((-0.42, 0.9 * stage.aspect, 0.001), (0.03, 1.1 * stage.aspect), _painted(rng, (0.1, 0.1, 0.1), (0.4, 0.4, 0.42)))
    asphalt = wood(256, rng, (0.03, 0.03, 0.04), (0.2, 0.2, 0.24))
    street = stage.card((0.0, 0.95 * stage.aspect, 0.05), (1.6, 0.8), asphalt, tilt_rad=-1.3, repeats=(3.0, 3.0))
    wall = stage.backdrop(0.105, mottled(256, rng, (0.01, 0.012, 0.03), (0.08, 0.09, 0.16)))
    return MovingScene((*movers, Mover(sign), Mover(post), Mover(street), wall))


SCENES: Mapping[str, Callable[[Stage, np.random.Generator], MovingScene]] = MappingProxyType(
    {"fence": fence, "whirl": whirl, "coins": coins, "rain": rain, "gear": gear}
)


def checkerboard(squares: int, first: Vector, second: Vector, texels: int = 24) -> Texture:
    """Squares of two even colours, sharp but for one texel."""
    rows, columns = np.indices((squares, squares))
    board = np.where(((rows + columns) % 2)[..., None], np.asarray(second), np.asarray(first))
    return np.kron(board, np.ones((texels, texels, 1))).astype(np.float32)


def _painted(rng: np.random.Generator, dark: Vector, light: Vector) -> Texture:
    return mottled(96, rng, dark, light, contrast=0.26)


def _radiance(rng: np.random.Generator, least: float, most: float) -> Vector:
    """A tinted radiance, spread evenly in its logarithm."""
    red, green, blue = np.asarray(_TINTS[rng.integers(len(_TINTS))]) * np.exp(rng.uniform(np.log(least), np.log(most)))
    return float(red), float(green), float(blue)


def _around(stage: Stage, rng: np.random.Generator, least: float) -> tuple[float, float, float]:
    """A place (x, y, coc), evenly over the frame but for a disc in its middle."""
    while True:
        x, y = rng.uniform(-1.15, 1.15), rng.uniform(-1.15, 1.15) * stage.aspect
        if np.hypot(x, y) > least:
            return float(x), float(y), float(rng.uniform(-0.085, 0.075))


def _whirling(stage: Stage, x: float, y: float, coc: float, inwards_m: float) -> Vector:
    """Round the middle, 0.16 rad per shutter: 0.08 widths of the frame at its side."""
    return stage.velocity_m((-0.08 * y, 0.08 * x), coc, inwards_m)


def _leaf(stage: Stage, texture: Texture, rng: np.random.Generator) -> Mover:
    x, y, coc = _around(stage, rng, 0.3)
    length = rng.uniform(0.05, 0.12)
    card = stage.card((x, y, coc), (length, 0.45 * length), texture, rng.uniform(0.0, np.pi), rng.uniform(-1.0, 1.0))
    inwards_m = 0.05 * stage.depth_m(coc) * rng.normal()
    return Mover(card, _whirling(stage, x, y, coc, float(inwards_m)), is_round=True, in_front=coc < _FRONT_COC)


def _drop(stage: Stage, rng: np.random.Generator) -> Mover:
    """A bright little ball that falls by 0.05 to 0.13 widths of the frame."""
    place = (float(rng.uniform(-1.1, 1.1)), float(rng.uniform(-1.15, 1.15)) * stage.aspect, float(rng.uniform(-0.1, 0.07)))
    fall, radius = float(rng.uniform(0.05, 0.13)), float(rng.uniform(0.006, 0.016))
    drop = stage.ball(place, radius, plain_texture((1.5, 1.75, 2.1)))
    return Mover(drop, stage.velocity_m((0.22 * fall, fall), place[2]), in_front=place[2] < _FRONT_COC)

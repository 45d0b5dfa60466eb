"""Two scenes of metal with small bright highlights, in the spirit of Coins and Gear of Leimkuehler et al. 2018."""

from collections.abc import Iterator

import numpy as np

from datasets_scripts.procedural_textures import coloured, fractal_noise, mottled, wood
from datasets_scripts.samples_scene import Mover, MovingScene, Stage
from datasets_scripts.traced_scene import Texture, Vector

_FRONT_COC = -0.03
_GOLD: tuple[Vector, Vector] = ((0.36, 0.2, 0.04), (0.95, 0.72, 0.24))
_SILVER: tuple[Vector, Vector] = ((0.28, 0.28, 0.3), (0.88, 0.88, 0.9))
_COPPER: tuple[Vector, Vector] = ((0.3, 0.1, 0.05), (0.85, 0.42, 0.24))
_GLINT_NEARER_COC = 0.0015
_TEETH, _SEGMENTS, _SPOKES, _BLOCKS = 18, 24, 5, 4


def coins(stage: Stage, rng: np.random.Generator) -> MovingScene:
    """Coins that fall through the focus onto others that lie on a table, each with a coloured glint."""
    faces = [_minted(rng, *metal) for metal in (_GOLD, _SILVER, _COPPER)]
    movers: list[Mover] = []
    for index in range(64):
        coc = float(rng.uniform(-0.09, 0.075))
        place = (float(rng.uniform(-1.1, 1.1)), float(rng.uniform(-1.15, 0.75)) * stage.aspect, coc)
        fall = float(rng.uniform(0.03, 0.09))
        velocity_m = stage.velocity_m((float(rng.normal(0.0, 0.012)), fall), coc, 0.03 * float(rng.normal()))
        movers += _coin(stage, place, faces[index % 3], velocity_m, rng)
    for index in range(26):
        coc = float(rng.uniform(-0.01, 0.06))
        place = (float(rng.uniform(-1.0, 1.0)), float(rng.uniform(0.8, 1.0)) * stage.aspect, coc)
        movers += _coin(stage, place, faces[index % 3], (0.0, 0.0, 0.0), rng)
    table = Mover(stage.card((0.0, 1.1 * stage.aspect, 0.02), (1.6, 1.3), wood(256, rng, (0.06, 0.03, 0.02), (0.34, 0.2, 0.1)), 0.0, -1.35))
    return MovingScene((*movers, table, stage.backdrop(0.09, mottled(256, rng, (0.08, 0.02, 0.05), (0.3, 0.1, 0.16)))))


def gear(stage: Stage, rng: np.random.Generator) -> MovingScene:
    """Three gears of different depth that turn; every piece of a gear moves along its tangent, with glints on the teeth."""
    movers: list[Mover] = []
    for (x, y, coc), radius, metal, turn in (
        ((-0.5, 0.1, -0.06), 0.46, _SILVER, 0.3),
        ((0.3, -0.1, 0.0), 0.4, _GOLD, -0.34),
        ((0.75, 0.6, 0.055), 0.42, _COPPER, 0.36),
    ):
        movers += _wheel(stage, (x, y * stage.aspect, coc), radius, _brushed(rng, *metal), turn, rng)
    return MovingScene((*movers, stage.backdrop(0.085, mottled(256, rng, (0.04, 0.05, 0.07), (0.24, 0.27, 0.34)))))


def _coin(
    stage: Stage, place: tuple[float, float, float], face: Texture, velocity_m: Vector, rng: np.random.Generator
) -> tuple[Mover, Mover]:
    radius, in_front = float(rng.uniform(0.06, 0.11)), place[2] < _FRONT_COC
    card = stage.card(place, (radius, radius), face, float(rng.uniform(0.0, 6.28)), float(rng.uniform(-1.1, 1.1)))
    tint = np.array([(1.0, 0.8, 0.45), (0.7, 0.85, 1.0), (1.0, 0.5, 0.35), (0.6, 1.0, 0.7)][rng.integers(4)])
    red, green, blue = tint * np.exp(rng.uniform(np.log(12.0), np.log(80.0)))
    # On the middle line of the coin, which keeps the depth of its centre, and a little before it.
    along = float(rng.uniform(-0.5, 0.5)) * np.asarray(card.edge_u_m)
    glint = stage.lamp((place[0], place[1], place[2] - _GLINT_NEARER_COC), 0.005, (red, green, blue))
    x, y, z = np.asarray(glint.centre_m) + along
    moved = type(glint)((float(x), float(y), float(z)), glint.radius_m, glint.radiance_rgb)
    return Mover(card, velocity_m, is_round=True, in_front=in_front), Mover(moved, velocity_m, in_front=in_front)


def _wheel(
    stage: Stage, middle: tuple[float, float, float], radius: float, metal: Texture, turn_rad: float, rng: np.random.Generator
) -> Iterator[Mover]:
    """Hub, spokes of blocks, rim and teeth; pieces that overlap lie a hair behind one another."""
    in_front, phase = middle[2] < _FRONT_COC, float(rng.uniform(0.0, 6.28))
    pieces = [(phase + 2 * np.pi * i / _SPOKES, r, 0.16, 0.07) for i in range(_SPOKES) for r in np.linspace(0.28, 0.72, _BLOCKS)]
    pieces += [(phase + 2 * np.pi * i / _SEGMENTS, 0.8, 0.09, 0.125) for i in range(_SEGMENTS)]
    teeth = [phase + 2 * np.pi * i / _TEETH for i in range(_TEETH)]
    pieces += [(angle, 0.94, 0.1, 0.075) for angle in teeth]
    for index, (angle, share, deep, wide) in enumerate(pieces):
        place = _on_wheel(middle, radius * share, angle, 1e-5 * index)
        card = stage.card(place, (radius * deep, radius * wide), metal, angle)
        yield Mover(card, _tangent_m(stage, middle[2], radius * share, angle, turn_rad), in_front=in_front)
    yield Mover(stage.card((*middle[:2], middle[2] - 2e-5), (0.27 * radius, 0.27 * radius), metal), is_round=True, in_front=in_front)
    for angle in teeth[::2]:
        place = _on_wheel(middle, radius * 0.97, angle, -_GLINT_NEARER_COC)
        red, green, blue = np.array([1.0, 0.9, 0.75]) * np.exp(rng.uniform(np.log(15.0), np.log(90.0)))
        lamp = stage.lamp(place, 0.006, (float(red), float(green), float(blue)))
        yield Mover(lamp, _tangent_m(stage, middle[2], radius * 0.97, angle, turn_rad), in_front=in_front)


def _on_wheel(middle: tuple[float, float, float], radius: float, angle: float, deeper: float) -> tuple[float, float, float]:
    return middle[0] + radius * float(np.cos(angle)), middle[1] + radius * float(np.sin(angle)), middle[2] + deeper


def _tangent_m(stage: Stage, coc: float, radius: float, angle: float, turn_rad: float) -> Vector:
    """The velocity of a turn; a half width is half a width of the frame."""
    speed = 0.5 * radius * turn_rad
    return stage.velocity_m((-speed * float(np.sin(angle)), speed * float(np.cos(angle))), coc)


def _minted(rng: np.random.Generator, dark: Vector, light: Vector) -> Texture:
    """A rim, rings and grain."""
    size = 128
    y, x = (np.mgrid[:size, :size] + 0.5) / size - 0.5
    radius = np.hypot(x, y)
    relief = 0.25 * np.sign(np.sin(42.0 * radius)) * (radius < 0.38) + 0.3 * (radius > 0.44)
    star = 0.2 * (np.cos(5.0 * np.arctan2(y, x)) > 0.0) * (radius < 0.25)
    return coloured(0.5 + relief + star + 0.1 * fractal_noise(size, size, rng, 4.0, 40.0, 0.4), dark, light)


def _brushed(rng: np.random.Generator, dark: Vector, light: Vector) -> Texture:
    return coloured(0.55 + 0.22 * fractal_noise(128, 128, rng, 3.0, 64.0, 0.3, stretch=10.0), dark, light)

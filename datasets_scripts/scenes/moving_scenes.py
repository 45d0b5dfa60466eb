"""Scenes with defocus and motion at once: the out-of-focus fence of Hasselgren et al. 2015, Fig. 8, and four in the spirit of
Whirl, Coins, Rain and Gear of Leimkuehler et al. 2018. Contents come from a seed, all seen by one lens.

Circles of confusion and motion are in widths of the frame (see `Stage`); they reach about 0.1 of it, 50 px at 512.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from datasets_scripts.scenes.textures import coloured, fractal_noise, mottled, page_of_text, spots, wood
from datasets_scripts.tracers.traced_scene import DiscLight, Mover, MovingScene, Quad, Sphere, Texture, Vector, plain_texture, vector
from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError

_FRONT_COC = -0.03
_GOLD: tuple[Vector, Vector] = ((0.36, 0.2, 0.04), (0.95, 0.72, 0.24))
_SILVER: tuple[Vector, Vector] = ((0.28, 0.28, 0.3), (0.88, 0.88, 0.9))
_COPPER: tuple[Vector, Vector] = ((0.3, 0.1, 0.05), (0.85, 0.42, 0.24))
_GLINT_NEARER_COC = 0.0015
_TEETH, _SEGMENTS, _SPOKES, _BLOCKS = 18, 24, 5, 4
LENS = Lens(135.0, 1.8, 2.0, 36.0)
_TINTS: tuple[Vector, ...] = ((1.0, 0.72, 0.36), (1.0, 0.86, 0.62), (0.55, 0.75, 1.0), (1.0, 0.42, 0.3), (0.55, 1.0, 0.6))


@dataclass(frozen=True)
class Stage:
    """A composition placed by what it looks like: the same blur and motion at every size of the picture.

    Positions and sizes are in half widths of the frame at the depth of the thing (the frame reaches from -1 to 1 across and
    from -aspect to aspect down); coc and motion are in widths of the frame, so pixels are this times width_px.
    """

    lens: Lens
    aspect: float

    def depth_m(self, coc: float) -> float:
        return 1.0 / (1.0 / self.lens.focus_distance_m - coc / self.lens.coc_px_per_dioptre(1))

    def half_width_m(self, depth_m: float) -> float:
        return 0.5 * depth_m / self.lens.focal_px(1)

    def point_m(self, x: float, y: float, coc: float) -> np.ndarray:
        depth_m = self.depth_m(coc)
        return np.array([x * self.half_width_m(depth_m), y * self.half_width_m(depth_m), depth_m])

    def velocity_m(self, motion: tuple[float, float], coc: float, inwards_m: float = 0.0) -> Vector:
        """Return metres per shutter of what moves by so many widths of the frame; inwards_m: away from the camera besides."""
        width_m = 2.0 * self.half_width_m(self.depth_m(coc))
        return motion[0] * width_m, motion[1] * width_m, inwards_m

    def card(
        self,
        place: tuple[float, float, float],
        half_size: tuple[float, float],
        texture: Texture,
        turn_rad: float = 0.0,
        tilt_rad: float = 0.0,
        repeats: tuple[float, float] = (1.0, 1.0),
    ) -> Quad:
        """Return a card around place (x, y, coc), turned in the picture (x towards y), its lower edge tilted away from the camera."""
        centre_m = self.point_m(*place)
        unit_m = self.half_width_m(float(centre_m[2]))
        along = half_size[0] * unit_m * np.array([np.cos(turn_rad), np.sin(turn_rad), 0.0])
        flat = np.cos(tilt_rad)
        down = half_size[1] * unit_m * np.array([-np.sin(turn_rad) * flat, np.cos(turn_rad) * flat, np.sin(tilt_rad)])
        return Quad(
            corner_m=vector(centre_m - along - down),
            edge_u_m=vector(2.0 * along),
            edge_v_m=vector(2.0 * down),
            texture=texture,
            repeats=repeats,
        )

    def backdrop(self, coc: float, texture: Texture, repeats: tuple[float, float] = (1.0, 1.0)) -> Mover:
        """Return a wall that fills the frame and all that its blur can reach."""
        reach = 1.15 + abs(coc)
        return Mover(self.card((0.0, 0.0, coc), (reach, self.aspect + reach - 1.0), texture, repeats=repeats))

    def ball(self, place: tuple[float, float, float], radius: float, texture: Texture, repeats: tuple[float, float] = (1.0, 1.0)) -> Sphere:
        centre_m = self.point_m(*place)
        return Sphere(vector(centre_m), radius * self.half_width_m(float(centre_m[2])), texture, repeats)

    def lamp(self, place: tuple[float, float, float], radius: float, radiance_rgb: Vector) -> DiscLight:
        """Return a small bright disc that faces the sensor."""
        centre_m = self.point_m(*place)
        return DiscLight(vector(centre_m), radius * self.half_width_m(float(centre_m[2])), radiance_rgb)


def make_scene(name: str, seed: int, lens: Lens, aspect: float) -> MovingScene:
    """Build one of SCENES; aspect: height over width of the picture."""
    if name not in SCENES:
        raise InputError(f"expected a scene out of {', '.join(SCENES)}, got {name!r}")
    return SCENES[name](Stage(lens, aspect), np.random.default_rng([seed, *name.encode()]))


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
    """Return the velocity of a turn; a half width is half a width of the frame."""
    speed = 0.5 * radius * turn_rad
    return stage.velocity_m((-speed * float(np.sin(angle)), speed * float(np.cos(angle))), coc)


def _minted(rng: np.random.Generator, dark: Vector, light: Vector) -> Texture:
    """Return the face of a coin: a rim, rings and grain."""
    size = 128
    y, x = (np.mgrid[:size, :size] + 0.5) / size - 0.5
    radius = np.hypot(x, y)
    relief = 0.25 * np.sign(np.sin(42.0 * radius)) * (radius < 0.38) + 0.3 * (radius > 0.44)
    star = 0.2 * (np.cos(5.0 * np.arctan2(y, x)) > 0.0) * (radius < 0.25)
    return coloured(0.5 + relief + star + 0.1 * fractal_noise(size, size, rng, 4.0, 40.0, 0.4), dark, light)


def _brushed(rng: np.random.Generator, dark: Vector, light: Vector) -> Texture:
    return coloured(0.55 + 0.22 * fractal_noise(128, 128, rng, 3.0, 64.0, 0.3, stretch=10.0), dark, light)


def fence(stage: Stage, rng: np.random.Generator) -> MovingScene:
    """Return a blurred fence before a checkerboard in focus that moves diagonally, and a static one that slants away behind it."""
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
    """Return a tinted radiance, spread evenly in its logarithm."""
    red, green, blue = np.asarray(_TINTS[rng.integers(len(_TINTS))]) * np.exp(rng.uniform(np.log(least), np.log(most)))
    return float(red), float(green), float(blue)


def _around(stage: Stage, rng: np.random.Generator, least: float) -> tuple[float, float, float]:
    """Return a place (x, y, coc), evenly over the frame but for a disc in its middle."""
    while True:
        x, y = rng.uniform(-1.15, 1.15), rng.uniform(-1.15, 1.15) * stage.aspect
        if np.hypot(x, y) > least:
            return float(x), float(y), float(rng.uniform(-0.085, 0.075))


def _whirling(stage: Stage, x: float, y: float, coc: float, inwards_m: float) -> Vector:
    """Return the velocity round the middle, 0.16 rad per shutter: 0.08 widths of the frame at its side."""
    return stage.velocity_m((-0.08 * y, 0.08 * x), coc, inwards_m)


def _leaf(stage: Stage, texture: Texture, rng: np.random.Generator) -> Mover:
    x, y, coc = _around(stage, rng, 0.3)
    length = rng.uniform(0.05, 0.12)
    card = stage.card((x, y, coc), (length, 0.45 * length), texture, rng.uniform(0.0, np.pi), rng.uniform(-1.0, 1.0))
    inwards_m = 0.05 * stage.depth_m(coc) * rng.normal()
    return Mover(card, _whirling(stage, x, y, coc, float(inwards_m)), is_round=True, in_front=coc < _FRONT_COC)


def _drop(stage: Stage, rng: np.random.Generator) -> Mover:
    """Return a bright little ball that falls by 0.05 to 0.13 widths of the frame."""
    place = (float(rng.uniform(-1.1, 1.1)), float(rng.uniform(-1.15, 1.15)) * stage.aspect, float(rng.uniform(-0.1, 0.07)))
    fall, radius = float(rng.uniform(0.05, 0.13)), float(rng.uniform(0.006, 0.016))
    drop = stage.ball(place, radius, plain_texture((1.5, 1.75, 2.1)))
    return Mover(drop, stage.velocity_m((0.22 * fall, fall), place[2]), in_front=place[2] < _FRONT_COC)

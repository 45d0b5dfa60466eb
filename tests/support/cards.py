"""Flat cards with lamps on them, all from one random generator: shapes, textures and places.

Outlines are distance fields, positive inside, in pixels, on a grid finer than the pixels. The grid covers the frame and a margin round
it; between its points it is read bilinearly, and that is the exact shape.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from datasets_scripts.scenes.textures import coloured, fractal_noise, page_of_text
from datasets_scripts.tracers.traced_scene import Texture, Vector

Distances = Float[np.ndarray, "rows columns"]
_LAMPS_PER_CARD = (9, 5, 8, 6, 8, 10, 14)
_TINTS = ((1.0, 0.72, 0.4), (1.0, 0.88, 0.66), (0.6, 0.78, 1.0), (1.0, 0.5, 0.34), (0.65, 1.0, 0.6))
_LEAST_RADIANCE, _MOST_RADIANCE = 15.0, 150.0
_LAMP_RADIUS_PX = (0.5, 1.0)
_LAMP_GAP_PX = 5.0
_LAMP_FROM_BORDER = 0.09


@dataclass(frozen=True)
class TexelGrid:
    """Places of the texels of a card: `density` per pixel over a frame with `margin_px` more on every side."""

    height_px: int
    width_px: int
    margin_px: int
    density: int = 2

    @property
    def shape(self) -> tuple[int, int]:
        return (self.height_px + 2 * self.margin_px) * self.density, (self.width_px + 2 * self.margin_px) * self.density

    def positions_px(self) -> tuple[Distances, Distances]:
        """Return x and y of every texel centre in pixels of the frame."""
        rows, columns = self.shape
        x = (np.arange(columns) + 0.5) / self.density - self.margin_px
        y = (np.arange(rows) + 0.5) / self.density - self.margin_px
        return np.broadcast_to(x, self.shape), np.broadcast_to(y[:, None], self.shape)


def mirrored_beyond(grid: TexelGrid, texels: Float[np.ndarray, "rows columns *channels"]) -> Float[np.ndarray, "rows columns *channels"]:
    """Return the same within the frame and its mirror image beyond it."""
    margin = grid.margin_px * grid.density
    frame = texels[margin:-margin, margin:-margin]
    return np.pad(frame, ((margin, margin), (margin, margin)) + ((0, 0),) * (texels.ndim - 2), mode="symmetric")


def everywhere(grid: TexelGrid) -> Distances:
    return np.full(grid.shape, 1e3)


def nowhere(grid: TexelGrid) -> Distances:
    return np.full(grid.shape, -1e3)


def rectangle(grid: TexelGrid, left: float, top: float, right: float, bottom: float, turn_rad: float = 0.0) -> Distances:
    """Return a rectangle turned about its centre."""
    x, y = grid.positions_px()
    dx, dy = x - 0.5 * (left + right), y - 0.5 * (top + bottom)
    along, across = np.cos(turn_rad) * dx + np.sin(turn_rad) * dy, np.cos(turn_rad) * dy - np.sin(turn_rad) * dx
    return np.minimum(0.5 * (right - left) - abs(along), 0.5 * (bottom - top) - abs(across))


def disc(grid: TexelGrid, x_px: float, y_px: float, radius_px: float) -> Distances:
    x, y = grid.positions_px()
    return radius_px - np.hypot(x - x_px, y - y_px)


def leaf(grid: TexelGrid, x_px: float, y_px: float, length_px: float, turn_rad: float, slender: float = 0.42) -> Distances:
    """Return a pointed leaf: the overlap of two discs; `slender` is its width over its length."""
    half, sag = 0.5 * length_px, 0.5 * length_px * slender
    radius = (half**2 + sag**2) / (2.0 * sag)
    away, nx, ny = radius - sag, -np.sin(turn_rad), np.cos(turn_rad)
    return np.minimum(disc(grid, x_px + nx * away, y_px + ny * away, radius), disc(grid, x_px - nx * away, y_px - ny * away, radius))


def wire(grid: TexelGrid, points_px: Sequence[tuple[float, float]], width_px: float) -> Distances:
    """Return a chain of straight pieces of one width with round ends."""
    x, y = grid.positions_px()
    distance = np.full(grid.shape, np.inf)
    for (x0, y0), (x1, y1) in pairwise(points_px):
        dx, dy = x1 - x0, y1 - y0
        t = np.clip(((x - x0) * dx + (y - y0) * dy) / (dx * dx + dy * dy), 0.0, 1.0)
        distance = np.minimum(distance, np.hypot(x - x0 - t * dx, y - y0 - t * dy))
    return 0.5 * width_px - distance


def union(*shapes: Distances) -> Distances:
    return np.maximum.reduce(shapes)


def without(shape: Distances, hole: Distances) -> Distances:
    return np.minimum(shape, -hole)


@dataclass(frozen=True, eq=False)
class Card:
    """A flat card.

    dioptres: (c, x, y): 1/depth is c + x * x_px + y * y_px at a pixel of the frame.
    solid: (rows, columns) distance field, positive where the card is; colour: (rows, columns, 3) linear radiance.
    """

    name: str
    dioptres: tuple[float, float, float]
    solid: Distances
    colour: Texture


@dataclass(frozen=True)
class Lamp:
    """A small disc of even radiance on a card; it is opaque where the card is not."""

    card: int
    x_px: float
    y_px: float
    radius_px: float
    radiance_rgb: Vector


def cards_of(grid: TexelGrid, focus_dioptres: float, farthest_off: float, rng: np.random.Generator) -> tuple[Card, ...]:
    """Seven cards from `farthest_off` dioptres in front of the focus to as much behind it.

    Beyond the frame everything is mirrored: what lies there no renderer can know, and mirroring is the usual guess, so
    that the border does not decide who is better.
    """

    def flat(nearer: float) -> tuple[float, float, float]:
        return focus_dioptres + farthest_off * nearer, 0.0, 0.0

    cards = (
        Card("wires", flat(1.0), _wires(grid, rng), _weave(grid, rng, (0.1, 0.1, 0.11), (0.42, 0.4, 0.36))),
        Card("leaves", flat(0.72), _leaves(grid, rng), _weave(grid, rng, (0.02, 0.09, 0.02), (0.2, 0.42, 0.08))),
        _slanted_board(grid, focus_dioptres, farthest_off, rng),
        Card("focus", flat(0.0), _poster(grid), page_of_text(*grid.shape, rng, (0.06, 0.06, 0.12), (0.5, 0.46, 0.4))),
        Card("fence", flat(-0.36), _fence(grid, rng), _weave(grid, rng, (0.2, 0.13, 0.09), (0.5, 0.39, 0.3))),
        Card("discs", flat(-0.66), _discs(grid, rng), _checks(grid, rng, 14.0, (0.5, 0.12, 0.08), (0.85, 0.72, 0.4))),
        Card("background", flat(-1.0), everywhere(grid), _wall(grid, rng)),
    )
    return tuple(replace(card, solid=mirrored_beyond(grid, card.solid), colour=mirrored_beyond(grid, card.colour)) for card in cards)


def lamps_of(cards: tuple[Card, ...], grid: TexelGrid, rng: np.random.Generator) -> tuple[Lamp, ...]:
    """Place sixty lamps on the cards, each where no card hides it, with radiances spread evenly in their logarithm."""
    radiances = np.geomspace(_LEAST_RADIANCE, _MOST_RADIANCE, sum(_LAMPS_PER_CARD))
    rng.shuffle(radiances)
    lamps: list[Lamp] = []
    for index, count in enumerate(_LAMPS_PER_CARD):
        in_front = union(nowhere(grid), *(card.solid for card in cards[:index]))
        for x_px, y_px in _places(np.minimum(cards[index].solid, -in_front - _LAMP_RADIUS_PX[1]), grid, count, rng):
            tint = _TINTS[rng.integers(len(_TINTS))]
            red, green, blue = (float(radiances[len(lamps)] * part) for part in tint)
            lamps.append(Lamp(index, x_px, y_px, float(rng.uniform(*_LAMP_RADIUS_PX)), (red, green, blue)))
    return tuple(lamps)


def _places(open_to_view: Distances, grid: TexelGrid, count: int, rng: np.random.Generator) -> list[tuple[float, float]]:
    """Draw places where `open_to_view` is positive, a few pixels apart, so far from the border that their discs stay in."""
    x, y = grid.positions_px()
    away = _LAMP_FROM_BORDER * grid.height_px
    candidates = np.argwhere((open_to_view > 0) & (np.minimum(x, grid.width_px - x) > away) & (np.minimum(y, grid.height_px - y) > away))
    places: list[tuple[float, float]] = []
    for row, column in candidates[rng.permutation(len(candidates))]:
        place = (float(x[row, column]), float(y[row, column]))
        if all(np.hypot(place[0] - other[0], place[1] - other[1]) > _LAMP_GAP_PX for other in places):
            places.append(place)
        if len(places) == count:
            break
    return places


def _wires(grid: TexelGrid, rng: np.random.Generator) -> Distances:
    """Two sagging wires of 1 and 2 px."""
    width, height = grid.width_px, grid.height_px
    shapes = []
    for level, thickness in zip((0.1, 0.66), (1.0, 2.0), strict=True):
        t = np.linspace(-0.2, 1.2, 12)
        sag = height * (level + rng.uniform(-0.04, 0.04) + 0.1 * (t - rng.uniform(0.3, 0.7)) ** 2 * rng.choice((-1, 1)))
        shapes.append(wire(grid, list(zip((t * width).tolist(), sag.tolist(), strict=True)), thickness))
    return union(*shapes)


def _leaves(grid: TexelGrid, rng: np.random.Generator) -> Distances:
    """Leaves that hang into the frame from its top right and its bottom left."""
    shapes = []
    for x, y in ((0.8, 0.16), (0.88, 0.24), (0.9, 0.14), (0.1, 0.83), (0.2, 0.86)):
        length = grid.height_px * rng.uniform(0.2, 0.32)
        place = (grid.width_px * x + rng.normal(0, 4), grid.height_px * y + rng.normal(0, 4))
        shapes.append(leaf(grid, *place, length, rng.uniform(0, np.pi)))
    return union(*shapes)


def _slanted_board(grid: TexelGrid, focus_dioptres: float, farthest_off: float, rng: np.random.Generator) -> Card:
    """Return a board right of the middle: its lower edge is near, its upper edge a little behind the focus."""
    top, bottom = 0.3 * grid.height_px, 0.94 * grid.height_px
    solid = rectangle(grid, 0.55 * grid.width_px, top, 0.93 * grid.width_px, bottom)
    slope = farthest_off * (0.55 - -0.22) / (bottom - top)
    dioptres = (focus_dioptres - 0.22 * farthest_off - slope * top, 0.0, slope)
    return Card("board", dioptres, solid, _checks(grid, rng, 12.0, (0.1, 0.13, 0.24), (0.5, 0.52, 0.46)))


def _poster(grid: TexelGrid) -> Distances:
    """Return a sheet left of the middle, with a round and a square hole."""
    width, height = grid.width_px, grid.height_px
    sheet = rectangle(grid, 0.08 * width, 0.16 * height, 0.47 * width, 0.86 * height, 0.05)
    round_hole = disc(grid, 0.36 * width, 0.36 * height, 0.11 * height)
    return without(without(sheet, round_hole), rectangle(grid, 0.14 * width, 0.56 * height, 0.23 * width, 0.74 * height, 0.3))


def _fence(grid: TexelGrid, rng: np.random.Generator) -> Distances:
    """Slats and two rails across the upper half."""
    width, height = grid.width_px, grid.height_px
    slats = [
        rectangle(grid, x - 0.016 * width, 0.1 * height, x + 0.016 * width, 0.62 * height, rng.normal(0, 0.03))
        for x in width * np.arange(0.02, 1.1, 0.19)
    ]
    rails = [rectangle(grid, -1.0 * width, y * height, 2.0 * width, (y + 0.03) * height, 0.01) for y in (0.17,)]
    return union(*slats, *rails)


def _discs(grid: TexelGrid, rng: np.random.Generator) -> Distances:
    shapes = [
        disc(grid, grid.width_px * rng.uniform(0, 1), grid.height_px * rng.uniform(0.1, 1), grid.height_px * rng.uniform(0.06, 0.15))
        for _ in range(6)
    ]
    return union(*shapes)


def _weave(grid: TexelGrid, rng: np.random.Generator, dark: Vector, light: Vector) -> Texture:
    rows, columns = grid.shape
    return coloured(0.5 + 0.24 * fractal_noise(rows, columns, rng, 6.0, rows / 3.0, 0.6), dark, light)


def _checks(grid: TexelGrid, rng: np.random.Generator, side_px: float, dark: Vector, light: Vector) -> Texture:
    x, y = grid.positions_px()
    squares = np.clip(0.5 + side_px * 0.8 * np.sin(np.pi * x / side_px) * np.sin(np.pi * y / side_px), 0, 1)
    rough = 0.12 * fractal_noise(*grid.shape, rng, 6.0, grid.shape[0] / 4.0, 0.5)
    return coloured(0.1 + 0.8 * squares + rough, dark, light)


def _wall(grid: TexelGrid, rng: np.random.Generator) -> Texture:
    """Large patches of colour with detail of all sizes."""
    rows, columns = grid.shape
    tones = [0.5 + 0.2 * fractal_noise(rows, columns, rng, 8.0, rows / 2.0, 0.9) for _ in range(3)]
    shared = 0.22 * fractal_noise(rows, columns, rng, 6.0, rows / 6.0, 0.4)
    base = np.array([0.3, 0.36, 0.45])
    return np.clip(base * 2.0 * (np.stack(tones, axis=-1) * 0.9 + shared[..., None]), 0.01, 0.95).astype(np.float32)

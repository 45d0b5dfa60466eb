"""A scene of flat textured cards with an exact thin-lens truth: what renderers are measured against without a ray tracer's doubts.

Seven cards, front first: near wires of one and two pixels, near leaves, a slanted board that crosses the focus, a card in
focus with holes, a fence, discs farther back, and the background; and sixty small lamps of radiance 15 to 150 on them. What
lies hidden behind a card is there, so that the truth and the layers know it, but the picture with its depth does not.

The truth is a mean over rays: each pixel takes at least 1600 lens points on average, each with its own place in the pixel,
and follows every ray to the card that it meets; shapes and textures are functions and are never resampled. The lamps, which
such rays would seldom find, are followed from their side. At 640x360 and the defaults it agrees with the truth of four times
as many lens points to 61 dB in linear and 63 dB in displayed light.

For mixed reality one card is the virtual object: the photograph is the scene without it, the truth the scene with it. Nothing casts
a shadow, so neither changes the light on the other.
"""

from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
from jaxtyping import Float32, Float64

from mrbokeh.compositing.plate import Plate, plate_of
from mrbokeh.images.layer import Layer
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from tests.support.card_tracer import PINHOLE, PackedCards, card_coverage, trace
from tests.support.cards import Card, Lamp, TexelGrid, cards_of, lamps_of

FOCUS_DISTANCE_M = 2.0
FARTHEST_DIOPTRES_OFF = 0.4
_FOCAL_LENGTH_MM, _SENSOR_WIDTH_MM = 135.0, 36.0
_MARGIN_PX = 44
_PINHOLE_POSITIONS = 256
FOCUS_CARD = 3
"""The poster with holes: two near things before it, three far ones behind it."""


@dataclass(frozen=True, eq=False)
class CardScene:
    """Flat cards, front first, with the lamps on them.

    packed: the same as arrays for compiled code.
    """

    height_px: int
    width_px: int
    cards: tuple[Card, ...]
    lamps: tuple[Lamp, ...]
    grid: TexelGrid
    packed: PackedCards

    def card_depth_m(self, index: int) -> Float32[np.ndarray, "height width"]:
        """Return the depth of one card's plane at every pixel centre."""
        plane = self.cards[index].dioptres
        x, y = np.arange(self.width_px) + 0.5, np.arange(self.height_px)[:, None] + 0.5
        return (1.0 / (plane[0] + plane[1] * x + plane[2] * y)).astype(np.float32)


def card_scene(seed: int = 0, width_px: int = 640, height_px: int = 360) -> CardScene:
    """Build the scene of that seed; equal seeds and sizes give equal scenes. Wires and lamps keep their size in pixels."""
    assert min(width_px, height_px) >= 96, "else its cards find no place"
    grid = TexelGrid(height_px, width_px, _MARGIN_PX)
    rng = np.random.default_rng(seed)
    cards = cards_of(grid, 1.0 / FOCUS_DISTANCE_M, FARTHEST_DIOPTRES_OFF, rng)
    lamps = lamps_of(cards, grid, rng)
    return scene_of(cards, lamps, grid)


def scene_of(cards: tuple[Card, ...], lamps: tuple[Lamp, ...], grid: TexelGrid) -> CardScene:
    """Build a scene of cards of one's own, front first, on one grid."""
    return CardScene(grid.height_px, grid.width_px, cards, lamps, grid, PackedCards.of(cards, lamps, grid))


def lens_of_radius(radius_px: float, width_px: int, aperture: Aperture | None = None) -> Lens:
    """Return a lens focused on the card in focus, under which the farthest and the nearest card have this CoC RADIUS."""
    wanted_px_per_dioptre = 2.0 * radius_px / FARTHEST_DIOPTRES_OFF
    at_f1 = Lens(_FOCAL_LENGTH_MM, 1.0, FOCUS_DISTANCE_M, _SENSOR_WIDTH_MM)
    f_number = at_f1.coc_px_per_dioptre(width_px) / wanted_px_per_dioptre
    return Lens(_FOCAL_LENGTH_MM, f_number, FOCUS_DISTANCE_M, _SENSOR_WIDTH_MM, aperture or Aperture.disc())


def truth(scene: CardScene, lens: Lens, positions: int = 1600) -> Float32[np.ndarray, "height width 3"]:
    """Return what the lens sees: the mean over at least `positions` lens points per pixel, linear RGB."""
    planes = _planes(scene, lens)
    reach_px = 0.5 * float(np.abs(lens.coc_px(_nearest_and_farthest_m(scene), scene.width_px)).max()) * lens.aperture.unit_radius
    assert reach_px <= scene.grid.margin_px - 2, "the lens would see where no cards are"
    return trace(scene.packed, scene.grid, planes, lens.aperture, positions)[..., :3]


def all_in_focus(scene: CardScene, positions: int = _PINHOLE_POSITIONS) -> Float32[np.ndarray, "height width 3"]:
    """Return the sharp picture: the mean over each pixel."""
    sharp = np.zeros((len(scene.cards), 3))
    return trace(scene.packed, scene.grid, sharp, PINHOLE, positions)[..., :3]


def depth_m(scene: CardScene) -> Float32[np.ndarray, "height width"]:
    """Return depth without mixed pixels: that of the card which fills most of the pixel."""
    coverage = card_coverage(scene.packed, scene.grid, _PINHOLE_POSITIONS)
    depths = np.stack([scene.card_depth_m(index) for index in range(len(scene.cards))], axis=-1)
    return np.take_along_axis(depths, coverage.argmax(axis=-1)[..., None], axis=-1)[..., 0]


def layers(scene: CardScene) -> list[Layer]:
    """Return every card alone, front first, with what others hide of it; premultiplied."""
    result = []
    for index in range(len(scene.cards)):
        alone = scene.packed.only(index)
        rgba = trace(alone, scene.grid, np.zeros((1, 3)), PINHOLE, _PINHOLE_POSITIONS)
        depth = np.where(rgba[..., 3] > 0, scene.card_depth_m(index), np.inf).astype(np.float32)
        result.append(Layer(rgba[..., :3], rgba[..., 3], depth))
    return result


def _nearest_and_farthest_m(scene: CardScene) -> Float32[np.ndarray, " two"]:
    """Return the smallest and the largest depth of the cards within the frame."""
    depths = [scene.card_depth_m(index) for index in range(len(scene.cards))]
    return np.array([min(depth.min() for depth in depths), max(depth.max() for depth in depths)], np.float32)


def _planes(scene: CardScene, lens: Lens) -> Float64[np.ndarray, "cards 3"]:
    """Return the signed CoC diameter of every card as a + bx x + by y; the lens law is affine in 1/depth, and so is a plane."""
    assert lens.has_flat_focus and lens.aperture.is_plain
    per_dioptre = lens.coc_px_per_dioptre(scene.width_px)
    dioptres = np.array([card.dioptres for card in scene.cards], np.float64)
    return per_dioptre * (np.array([1.0 / lens.focus_distance_m, 0.0, 0.0]) - dioptres)


@dataclass(frozen=True, eq=False)
class MixedCards:
    """A card scene with one virtual card. scene: without it. both: with it. virtual: the card alone, sharp."""

    scene: CardScene
    both: CardScene
    virtual: Layer

    def photograph(self, lens: Lens, positions: int = 1600) -> Plate:
        """Return the scene alone through the lens, with its all-in-focus picture and depth."""
        return replace(plate_of(truth(self.scene, lens, positions), lens, self._sharp[1]), sharp_rgb=self._sharp[0])

    @cached_property
    def _sharp(self) -> tuple[Float32[np.ndarray, "height width 3"], Float32[np.ndarray, "height width"]]:
        return all_in_focus(self.scene), depth_m(self.scene)

    def focus_distances_m(self) -> tuple[float, float, float]:
        """Return distances on the near leaves, on the card and on the fence behind it."""
        near, card, far = (1.0 / self.both.cards[index].dioptres[0] for index in (1, FOCUS_CARD, FOCUS_CARD + 1))
        return near, card, far


@cache
def mixed_cards(seed: int = 0, width_px: int = 640, height_px: int = 360, virtual: int = FOCUS_CARD) -> MixedCards:
    """Build the card scene of that seed; virtual: which of its cards, front first, is the object."""
    both = card_scene(seed, width_px, height_px)
    others = [index for index in range(len(both.cards)) if index != virtual]
    return MixedCards(_only(both, others), both, layers(_only(both, [virtual]))[0])


def _only(scene: CardScene, indices: list[int]) -> CardScene:
    """Return some cards of a scene with the lamps on them."""
    lamps = tuple(replace(lamp, card=indices.index(lamp.card)) for lamp in scene.lamps if lamp.card in indices)
    return scene_of(tuple(scene.cards[index] for index in indices), lamps, scene.grid)

"""Mixed-reality truth of flat cards, which needs no ray tracer but ours: one card of the card scene is the virtual object.

The photograph is the scene without that card, the truth the scene with it; wires, leaves and a slanted board are nearer, a fence,
discs and a background farther than the card in focus. Nothing casts a shadow, so neither changes the light on the other.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float32

from datasets_scripts.card_scene import CardScene, all_in_focus, card_scene, depth_m, layers, scene_of, truth
from mrbokeh.compositing.plate import Plate, plate_of
from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens

FOCUS_CARD = 3
"""The poster with holes: two near things before it, three far ones behind it."""


@dataclass(frozen=True, eq=False)
class MixedCards:
    """scene: without the virtual card. both: with it. virtual: the card alone, sharp."""

    scene: CardScene
    both: CardScene
    virtual: Layer

    def photograph(self, lens: Lens, positions: int = 1600) -> Plate:
        """The scene alone through the lens, with its all-in-focus picture and depth."""
        return replace(plate_of(truth(self.scene, lens, positions), lens, self._sharp[1]), sharp_rgb=self._sharp[0])

    @cached_property
    def _sharp(self) -> tuple[Float32[np.ndarray, "height width 3"], Float32[np.ndarray, "height width"]]:
        return all_in_focus(self.scene), depth_m(self.scene)

    def focus_distances_m(self) -> tuple[float, float, float]:
        """On the near leaves, on the card and on the fence behind it."""
        near, card, far = (1.0 / self.both.cards[index].dioptres[0] for index in (1, FOCUS_CARD, FOCUS_CARD + 1))
        return near, card, far


def mixed_cards(seed: int = 0, width_px: int = 640, height_px: int = 360, virtual: int = FOCUS_CARD) -> MixedCards:
    """The card scene of that seed; virtual: which of its cards, front first, is the object."""
    both = card_scene(seed, width_px, height_px)
    others = [index for index in range(len(both.cards)) if index != virtual]
    return MixedCards(_only(both, others), both, layers(_only(both, [virtual]))[0])


def _only(scene: CardScene, indices: list[int]) -> CardScene:
    """Some cards of a scene with the lamps on them."""
    lamps = tuple(replace(lamp, card=indices.index(lamp.card)) for lamp in scene.lamps if lamp.card in indices)
    return scene_of(tuple(scene.cards[index] for index in indices), lamps, scene.grid)

"""Virtual objects in defocused photographs whose truth is known, and the simple ways that compositing has to beat."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from datasets_scripts.made_sets.truth_set import lens_shape
from mrbokeh.compositing.between import Between
from mrbokeh.compositing.over import OverPhotograph
from mrbokeh.compositing.plate import Inserted, Plate, plate_of
from mrbokeh.images.exr_io import read_exr
from mrbokeh.images.image_io import read_image, read_layer
from mrbokeh.images.image_metrics import psnr
from mrbokeh.images.layer import Layer
from mrbokeh.layering.hidden_background import continued
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.base import Renderer
from tests.support.card_scene import lens_of_radius, mixed_cards, truth

BASELINES = ("sharp mask", "plain over")
_LEAST = 1e-3


@dataclass(frozen=True, eq=False)
class MixedCase:
    """A photograph with what its focal stack knows, an object as a user would render it, and both seen through the lens."""

    name: str
    plate: Plate
    virtual: Layer
    truth: np.ndarray

    def baselines(self, renderer: Renderer) -> dict[str, Inserted]:
        """sharp mask: the blurred object pasted where the sharp one is visible. plain over: the blurred object over everything."""
        over = OverPhotograph(by_depth=False).insert(self.plate, [self.virtual], renderer)
        assert self.plate.depth_m is not None
        visible = ((self.virtual.alpha > 0) & (self.virtual.depth_m < self.plate.depth_m))[..., None]
        light = Layer(over.virtual.rgb * visible, over.virtual.alpha * visible[..., 0], over.virtual.depth_m)
        return {"sharp mask": Inserted(np.where(visible, over.photo_rgb, self.plate.rgb), light), "plain over": over}

    def union(self, renderer: Renderer) -> np.ndarray:
        """The blurred region of the object and of what is nearer than it."""
        scene = Between(refine_edges=False).cut(self.plate, [self.virtual], renderer)
        blurred = [renderer.render([layer], self.plate.lens).alpha > _LEAST for layer in (scene.near, self.virtual)]
        return blurred[0] | blurred[1]

    def touched(self, renderer: Renderer) -> np.ndarray:
        """The blurred region of the object alone: no other pixel can be wrong."""
        return renderer.render([self.virtual], self.plate.lens).alpha > _LEAST

    def with_near_wider_by(self, by_px: int) -> "MixedCase":
        """Depth in which what is nearer than the object is wider by so many pixels all around (below 0: narrower)."""
        depth_m = self.plate.depth_m
        assert depth_m is not None
        near = depth_m < self.virtual.depth_m[self.virtual.alpha > 0].min() / 1.03
        return replace(self, plate=replace(self.plate, depth_m=wider(depth_m, near, by_px)))

    def measure(self, inserted: Inserted, union: np.ndarray, touched: np.ndarray) -> tuple[float, float, float]:
        """PSNR, linear and clipped to [0, 1], of the frame, of the union and of what the object touches."""
        return psnr(inserted.rgb, self.truth), psnr(inserted.rgb, self.truth, mask=union), psnr(inserted.rgb, self.truth, mask=touched)


def wider(depth_m: np.ndarray, near: np.ndarray, by_px: int) -> np.ndarray:
    """What is near grows (or shrinks, below 0); what is gained has the depth of the nearest pixel that has it."""
    kernel = np.ones((2 * abs(by_px) + 1,) * 2, np.uint8)
    now = (cv2.dilate if by_px > 0 else cv2.erode)(near.astype(np.uint8), kernel) > 0
    wrong = depth_m.copy()
    wrong[now & ~near] = continued(depth_m, near)[now & ~near]
    wrong[near & ~now] = continued(depth_m, ~near)[near & ~now]
    return wrong


def traced_cases(folder: Path) -> Iterator[MixedCase]:
    """All finished pictures of a set by datasets_scripts/mixed_reality.py; equal openings are one object, whose tables renderers keep."""
    shapes: dict[str, Aperture] = {}
    for meta_path in sorted(folder.glob("*/*/meta.json")):
        view, meta = meta_path.parent, json.loads(meta_path.read_text())
        depth_m = read_exr(view / "scene" / "depth.exr")[0].stacked("Z")[..., 0]
        sharp, virtual = read_image(view / "scene" / "all_in_focus.exr"), read_layer(view / "object.exr")
        for shape, names in meta["truth"].items():
            aperture = shapes.setdefault(shape, lens_shape(shape))
            for focus_m, name in zip(meta["focus_distances_m"], names, strict=True):
                if not (view / "both" / name).is_file():
                    continue
                lens = Lens(**meta["lens"], focus_distance_m=focus_m, aperture=aperture)
                plate = replace(plate_of(read_image(view / "scene" / name), lens, depth_m), sharp_rgb=sharp)
                yield MixedCase(f"{meta['scene']}, {shape}, {focus_m:.2f} m", plate, virtual, read_image(view / "both" / name))


def card_cases(width_px: int, height_px: int, shapes: tuple[str, ...], positions: int, radius_px: float = 8.0) -> Iterator[MixedCase]:
    """The card scene with its poster as the object, at three focus distances per opening."""
    cards = mixed_cards(0, width_px, height_px)
    for shape in shapes:
        lens = lens_of_radius(radius_px, width_px, lens_shape(shape))
        for focus_m in cards.focus_distances_m():
            focused = lens.focused_at(focus_m)
            both = truth(cards.both, focused, positions)
            yield MixedCase(f"cards, {shape}, {focus_m:.2f} m", cards.photograph(focused, positions), cards.virtual, both)


@cache
def small_card_cases() -> tuple[MixedCase, ...]:
    return tuple(card_cases(120, 96, ("disc",), positions=60, radius_px=4.5))

"""The depth by which a blurred layer is moved: of all that a blurred pixel shows, the mean, filled outwards where it shows nothing."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float32

from mrbokeh.images.layer import Layer
from mrbokeh.layering.layering import Layering
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.renderers.choose import make_renderer

GRID_PX = 4
"""Pixels of the layer per pixel of the grid of depths."""
_OCTAGON = Aperture.blades(8)
_LEAST = 1e-5

Plane = Float32[np.ndarray, "height width"]


class LayerDepth:
    """Spreads 1 / depth as the lens spreads light, at a quarter of the resolution.

    A pixel of a bokeh disc moves as the point does that it comes from, and that may lie half a disc away: so the depth has to be
    spread with the weights of the light. 1 / depth and not depth is averaged, because parallax is linear in it. An octagon stands for any
    opening.
    """

    def __init__(self) -> None:
        self._renderer: Renderer = make_renderer("polygon", threads=1, layering=Layering(slices=8))

    def seen_dioptres(self, layers: Sequence[Layer], lens: Lens) -> Float32[np.ndarray, "rows columns"]:
        """1 / depth on a grid of every 4th pixel of sharp layers, front first; their sizes are multiples of 4. lens: of these pixels."""
        plain = replace(lens, aperture=_OCTAGON, tilt_rad=(0.0, 0.0), petzval_radius_mm=float("inf"))
        small = _as_light(layers)
        spread = self._renderer.render([small], plain)
        known = 1.0 / small.depth_m[small.alpha > 0]
        # Where next to nothing is seen, rounding decides about the quotient: but it is never beyond what there is.
        return np.clip(filled_outwards(spread.rgb[..., 0], spread.alpha), known.min(initial=np.inf), known.max(initial=0.0))


def _as_light(layers: Sequence[Layer]) -> Layer:
    """All layers as a small one whose light is 1 / depth."""
    size = (layers[0].width_px // GRID_PX, layers[0].height_px // GRID_PX)
    covered, dioptres = np.zeros_like(layers[0].alpha), np.zeros_like(layers[0].alpha)
    for layer in layers:
        share = (1.0 - covered) * layer.alpha
        dioptres += share / layer.depth_m
        covered += share
    alpha, light = _shrunk(covered, size), _shrunk(dioptres, size)
    depth_m = np.full_like(alpha, np.inf)
    np.divide(alpha, light, out=depth_m, where=light > 0)
    return Layer(np.repeat(light[..., None], 3, axis=2), alpha, depth_m)


def filled_outwards(weighted: Plane, weight: Plane) -> Plane:
    """weighted / weight; where the weight is next to nothing, what lies within two pixels, and beyond those what a pyramid pulls from
    all around (pull and push, Gortler et al., The Lumigraph, 1996)."""
    is_known = weight > _LEAST
    levels = [_grown(_grown((np.where(is_known, weighted, np.float32(0)), np.where(is_known, weight, np.float32(0)))))]
    while max(levels[-1][0].shape) > 1:
        height, width = levels[-1][0].shape
        half = (max((width + 1) // 2, 1), max((height + 1) // 2, 1))
        levels.append((_shrunk(levels[-1][0], half), _shrunk(levels[-1][1], half)))
    filled = _mean(*levels[-1], np.zeros((1, 1), np.float32))
    for values, known in reversed(levels[:-1]):
        filled = _mean(values, known, cv2.resize(filled, values.shape[::-1], interpolation=cv2.INTER_LINEAR))
    return filled


def _grown(level: tuple[Plane, Plane]) -> tuple[Plane, Plane]:
    """Unknown pixels beside known ones take the sum of these; the known ones stay."""
    values, known = level
    around = [cv2.boxFilter(plane, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT) for plane in level]
    # A sliding sum leaves crumbs of what it has passed: they are not known.
    reached = (known == 0.0) & (around[1] > _LEAST)
    return np.where(reached, around[0], values), np.where(reached, around[1], known)


def _shrunk(plane: Plane, size: tuple[int, int]) -> Float32[np.ndarray, "rows columns"]:
    return np.asarray(cv2.resize(plane, size, interpolation=cv2.INTER_AREA), np.float32)


def _mean(values: Plane, known: Plane, otherwise: Plane) -> Plane:
    result = otherwise.reshape(values.shape).copy()
    np.divide(values, known, out=result, where=known > 0)
    return result

"""A small scene of textured cards for the simulated camera, rendered through a thin lens with focus breathing."""

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import cv2
import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences

_TEXELS_PER_WIDTH = 960
_FINEST_TEXELS = 6
_OCTAVES = 6
Rgb = Float32[np.ndarray, "height width 3"]


@dataclass(frozen=True)
class Card:
    """A textured rectangle facing the camera.

    depth_m: from the lens. left, top, right, bottom: its place in the picture of a lens without breathing, in fractions of the width
    from the centre (-0.5 to 0.5). seed: of its texture.
    """

    depth_m: float
    left: float
    top: float
    right: float
    bottom: float
    seed: int

    @cached_property
    def texture(self) -> Rgb:
        """Return detail of all sizes, 0.05 to 0.75."""
        height, width = (round(_TEXELS_PER_WIDTH * each) for each in (self.bottom - self.top, self.right - self.left))
        return textured(height, width, self.seed)


@dataclass(frozen=True)
class SimulatedScene:
    """Cards in front of a wall; front first. The wall is the last card and fills the picture."""

    cards: tuple[Card, ...]

    @classmethod
    def between(cls, near_m: float, far_m: float) -> "SimulatedScene":
        """Place three cards from near to far, equally spaced in dioptres; the farthest is the wall."""
        near, far = 1.0 / near_m, 1.0 / far_m
        middle, back = 2.0 / (near + far), min(far_m, 1e3)
        wall = Card(depth_m=back, left=-0.75, top=-0.75, right=0.75, bottom=0.75, seed=3)
        return cls(
            (
                Card(depth_m=near_m, left=-0.44, top=-0.14, right=-0.12, bottom=0.26, seed=1),
                Card(depth_m=middle, left=0.06, top=-0.2, right=0.4, bottom=0.12, seed=2),
                wall,
            )
        )

    def photographed(self, lens: Lens, width_px: int, height_px: int) -> Rgb:
        """Render scene-linear Rec.709 through the lens, with a margin that is cropped again."""
        margin = math.ceil(max(abs(float(lens.coc_px(card.depth_m, width_px))) for card in self.cards) / 2.0) + 2
        layers = [_layer(card, lens, width_px, height_px, margin) for card in self.cards]
        # A wider picture of the same pixels: the sensor grows with it.
        wider = replace(lens, sensor_width_mm=lens.sensor_width_mm * (width_px + 2 * margin) / width_px)
        whole = PolygonDifferences(threads=1).render(layers, wider)
        return np.ascontiguousarray(whole.rgb[margin:-margin, margin:-margin])


@lru_cache(maxsize=8)
def textured(height: int, width: int, seed: int) -> Rgb:
    """Sum octaves of noise in slightly different tones, the finest _FINEST_TEXELS wide."""
    rng = np.random.default_rng(seed)
    shade = np.zeros((height, width, 3), np.float32)
    for octave in range(_OCTAVES):
        rows, columns = (max(2, each // (_FINEST_TEXELS * 2**octave)) for each in (height, width))
        grid = 0.8 * rng.uniform(-1.0, 1.0, (rows, columns, 1)) + 0.2 * rng.uniform(-1.0, 1.0, (rows, columns, 3))
        shade += cv2.resize(grid.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
    texture: Rgb = np.clip(0.4 + 0.13 * shade, 0.05, 0.75).astype(np.float32)
    texture.flags.writeable = False
    return texture


def _layer(card: Card, lens: Lens, width_px: int, height_px: int, margin: int) -> Layer:
    """Draw the card as seen by a pinhole in the centre of the lens; straight edges with area coverage."""
    breathing = lens.image_distance_mm / lens.focal_length_mm
    size = width_px + 2 * margin, height_px + 2 * margin
    left, right = (each * breathing * width_px + size[0] / 2 for each in (card.left, card.right))
    top, bottom = (each * breathing * width_px + size[1] / 2 for each in (card.top, card.bottom))
    rgb = _pasted(card.texture, (left, top, right, bottom), size)
    alpha = np.outer(_covered(size[1], top, bottom), _covered(size[0], left, right)).astype(np.float32)
    depth_m = np.where(alpha > 0.0, np.float32(card.depth_m), np.float32(np.inf))
    return Layer(rgb * alpha[..., None], alpha, depth_m)


def _pasted(
    texture: Rgb, place_px: tuple[float, float, float, float], size_px: tuple[int, int]
) -> Float32[np.ndarray, "new_height new_width 3"]:
    """Resample the texture to (left, top, right, bottom): area averages down to whole pixels, then interpolation."""
    left, top, right, bottom = place_px
    whole = min(texture.shape[1], math.ceil(right - left)), min(texture.shape[0], math.ceil(bottom - top))
    reduced = cv2.resize(texture, whole, interpolation=cv2.INTER_AREA)
    scale = np.array([(right - left) / whole[0], (bottom - top) / whole[1]])
    # OpenCV's pixel centres are whole numbers.
    shift = np.array([left, top]) + 0.5 * scale - 0.5
    matrix = np.column_stack([np.diag(scale), shift])
    pasted = cv2.warpAffine(reduced, matrix, size_px, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)
    return np.maximum(pasted, np.float32(0.0))


def _covered(count: int, start: float, end: float) -> Float[np.ndarray, " count"]:
    """Return the fraction of each of `count` unit cells between start and end."""
    return np.diff(np.clip(np.arange(count + 1), start, end))

"""Grain on the virtual part: as much as the sensor would have given the finished picture, less what the photograph has kept.

Noise belongs to the light that reaches the sensor, object and scene together. With P the photograph, V the premultiplied virtual
light and a its coverage, the picture is M = K + V with K = (1 - a) P. A sensor would give it the variance s(M) = shot M + read. The
photograph's own noise is in it already, scaled by 1 - a like the photograph, so with the variance (1 - a)^2 s(P). Independent
variances add, therefore the virtual part gets

    s(M) - (1 - a)^2 s(P) = shot (V + a (1 - a) P) + read a (2 - a)       (the right side for K = (1 - a) P),

which is never negative, s(V) where the object is opaque and 0 where it is not. A shadow (V = 0) gets grain too: what is left of the
photograph has lost more noise than light.
"""

import numpy as np
from jaxtyping import Float32

from mrbokeh.compositing.plate_look.grain import Grain
from mrbokeh.compositing.plate_look.noise_level import NoiseLevel
from mrbokeh.images.layer import Layer

Picture = Float32[np.ndarray, "height width 3"]


def added_variance(virtual: Layer, photo_rgb: Picture, plate_rgb: Picture, level: NoiseLevel) -> Float32[np.ndarray, "height width 3"]:
    """Variance that grain adds to each value; 0 where nothing virtual is. The plain twin of the compiled loop."""
    kept = (1.0 - virtual.alpha[..., None]) ** 2
    missing = level.variance(photo_rgb + virtual.rgb) - kept * level.variance(plate_rgb)
    touched = (virtual.alpha != 0.0) | (virtual.rgb != 0.0).any(axis=2)
    return np.where(touched[..., None], np.maximum(missing, 0.0), 0.0).astype(np.float32)


def add_grain_to(
    light: Picture, alpha: Float32[np.ndarray, "height width"], photo_rgb: Picture, plate_rgb: Picture, draw: "GrainDraw"
) -> None:
    """In place on light (h, w, 3), a part of the frame like the others."""
    from mrbokeh.compositing.plate_look._grain_numba import add_grain

    shot, read = (np.array(each, np.float32) for each in (draw.grain.level.shot, draw.grain.level.read))
    alpha, photo_rgb, plate_rgb = (np.ascontiguousarray(each) for each in (alpha, photo_rgb, plate_rgb))
    add_grain(light, alpha, photo_rgb, plate_rgb, draw.grain.texture, draw.start, draw.sign, shot, read)


class GrainDraw:
    """Which part of the texture a frame takes: drawn from seed and frame alone, so that neither the box nor the order of frames matters."""

    def __init__(self, grain: Grain, frame: int, origin_px: tuple[int, int] = (0, 0)) -> None:
        rng = np.random.default_rng((grain.seed, frame))
        side = grain.texture.shape[0]
        self.grain, self.sign = grain, np.float32(rng.choice((-1.0, 1.0)))
        row, column = (int(each) for each in rng.integers(0, side, 2))
        self.start = (row + origin_px[0]) % side, (column + origin_px[1]) % side

    def values(self, size_px: tuple[int, int]) -> Picture:
        """(h, w, 3) of variance 1: the plain twin of what the compiled loop looks up."""
        side = self.grain.texture.shape[0]
        rows, columns = ((np.arange(length) + start) % side for length, start in zip(size_px, self.start, strict=True))
        return self.sign * self.grain.texture[np.ix_(rows, columns)]

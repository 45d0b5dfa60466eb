"""Overlay: a blurred virtual layer that stays the same over many frames, cut to the pixels that it touches."""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, UInt8

from mrbokeh.images.layer import Layer
from mrbokeh.video.color import code_from_linear, linear_from_code

# Even steps of linear light this fine move an 8-bit code by at most 0.2, also in the steep foot of sRGB.
_LINEAR_STEPS = 16383


class CodeTables(NamedTuple):
    """Linear light of each 8-bit code (256), and the 8-bit code at even steps of linear light from 0 to 1."""

    linear_from_code: Float32[np.ndarray, " codes"]
    code_from_linear: UInt8[np.ndarray, " steps"]


@lru_cache(maxsize=8)
def code_tables(transfer: str) -> CodeTables:
    """Return the tables of a transfer of `video.color`; every code survives the way to linear light and back."""
    codes = code_from_linear(np.linspace(0.0, 1.0, _LINEAR_STEPS + 1), transfer)
    return CodeTables(linear_from_code(np.arange(256) / 255.0, transfer), np.rint(codes * 255.0).astype(np.uint8))


@dataclass(frozen=True)
class Overlay:
    """Layer to lay over each frame, from pixel (left_px, top_px) on.

    rgb: (h, w, 3) linear premultiplied; shines_through: (h, w) one minus alpha, the part of the frame that stays.
    """

    top_px: int
    left_px: int
    rgb: Float32[np.ndarray, "height width 3"]
    shines_through: Float32[np.ndarray, "height width"]

    @classmethod
    def of(cls, layer: Layer, ignore_below: float = 0.0) -> "Overlay":
        """The box of pixels whose coverage or light exceeds `ignore_below`; empty where there is none."""
        touched = np.maximum(layer.alpha, np.abs(layer.rgb).max(axis=2)) > ignore_below
        rows, columns = np.flatnonzero(touched.any(axis=1)), np.flatnonzero(touched.any(axis=0))
        top, bottom = (int(rows[0]), int(rows[-1]) + 1) if len(rows) else (0, 0)
        left, right = (int(columns[0]), int(columns[-1]) + 1) if len(columns) else (0, 0)
        box = np.s_[top:bottom, left:right]
        return cls(top, left, np.ascontiguousarray(layer.rgb[box]), np.float32(1.0) - layer.alpha[box])

    def over(self, frame_rgb: Float32[np.ndarray, "height width 3"]) -> Float32[np.ndarray, "height width 3"]:
        """Lay the layer over a linear frame; pixels outside the box stay bit for bit as they are."""
        result = frame_rgb.copy()
        height, width = self.shines_through.shape
        box = result[self.top_px : self.top_px + height, self.left_px : self.left_px + width]
        box *= self.shines_through[..., None]
        box += self.rgb
        return result

    def over_codes(self, frame_bgr: UInt8[np.ndarray, "height width 3"], tables: CodeTables) -> UInt8[np.ndarray, "height width 3"]:
        """Lay the layer over 8-bit codes, blue first, in linear light through the tables; light above 1 is clipped."""
        from mrbokeh.compositing._pixel_light_numba import over_codes

        result = frame_bgr.copy()
        over_codes(result, self.top_px, self.left_px, self.rgb, self.shines_through, *tables)
        return result

"""Colour: transfer functions, primaries and the way to the display. Everything else works on scene-linear numbers."""

import numpy as np
from jaxtyping import Float, Float32, UInt8

# Rec.709 / sRGB primaries with D65 white (IEC 61966-2-1); rows give X, Y, Z.
XYZ_from_rec709 = np.array([[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]])
rec709_from_XYZ = np.linalg.inv(XYZ_from_rec709)


def srgb_to_linear(encoded: Float[np.ndarray, "*shape"]) -> Float32[np.ndarray, "*shape"]:
    """sRGB-encoded values in [0, 1] to linear light (IEC 61966-2-1)."""
    encoded = np.asarray(encoded, np.float32)
    return np.where(encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0.04045) + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_to_srgb(linear: Float[np.ndarray, "*shape"]) -> Float32[np.ndarray, "*shape"]:
    """Linear light to sRGB-encoded values; the curve goes on above 1, negatives stay on its straight foot."""
    linear = np.asarray(linear, np.float32)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055).astype(np.float32)


def luminance(rgb: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
    """Y of linear Rec.709."""
    return rgb @ XYZ_from_rec709[1].astype(rgb.dtype)


def convert(rgb: Float[np.ndarray, "*batch 3"], target_from_source: Float[np.ndarray, "3 3"]) -> Float32[np.ndarray, "*batch 3"]:
    """Colours through a 3x3 matrix of primaries."""
    return (rgb @ np.asarray(target_from_source, rgb.dtype).T).astype(np.float32)


def tone_map(rgb: Float32[np.ndarray, "*shape"], exposure_stops: float = 0.0, shoulder: float = 0.8) -> Float32[np.ndarray, "*shape"]:
    """Scene-linear to displayable linear in [0, 1]: identity up to `shoulder`, then highlights roll off towards 1."""
    exposed = np.maximum(rgb * np.float32(2.0**exposure_stops), 0.0)
    room = 1.0 - shoulder
    rolled_off = 1.0 - room * np.exp(-(exposed - shoulder) / room)
    return np.where(exposed <= shoulder, exposed, rolled_off).astype(np.float32)


def display_rgb8(rgb: Float32[np.ndarray, "*batch 3"], exposure_stops: float = 0.0) -> UInt8[np.ndarray, "*batch 3"]:
    """Scene-linear to 8-bit sRGB for people to look at."""
    return np.round(linear_to_srgb(tone_map(rgb, exposure_stops)) * 255.0).astype(np.uint8)

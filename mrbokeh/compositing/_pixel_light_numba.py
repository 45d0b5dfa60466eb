"""Loops over pixels that add virtual light to pictures, compiled; they run without the GIL: overlays on 8-bit codes, grain."""

import numpy as np

from mrbokeh.system.compiled import njit


@njit(cache=True, nogil=True)
def over_codes(
    bgr: np.ndarray,
    top: int,
    left: int,
    rgb: np.ndarray,
    shines_through: np.ndarray,
    linear_from_code: np.ndarray,
    code_from_linear: np.ndarray,
) -> None:
    """Premultiplied "over" in linear light, in place on bgr (H, W, 3) uint8."""
    height, width = shines_through.shape
    steps = np.float32(len(code_from_linear) - 1)
    for j in range(height):
        for i in range(width):
            kept = shines_through[j, i]
            for c in range(3):
                light = rgb[j, i, 2 - c]
                if kept == 1.0 and light == 0.0:
                    continue
                linear = light + kept * linear_from_code[bgr[top + j, left + i, c]]
                position = min(max(linear, np.float32(0.0)), np.float32(1.0)) * steps
                bgr[top + j, left + i, c] = code_from_linear[int(position + np.float32(0.5))]


@njit(cache=True, nogil=True, error_model="numpy")
def add_grain(
    light: np.ndarray,
    alpha: np.ndarray,
    photo: np.ndarray,
    plate: np.ndarray,
    texture: np.ndarray,
    start: tuple[int, int],
    sign: np.float32,
    shot: np.ndarray,
    read: np.ndarray,
) -> None:
    """Add grain in place to light (h, w, 3), as much as `plate_look.grain` states. start: the texture row and column at (0, 0)."""
    height, width = alpha.shape
    side = texture.shape[0]
    for y in range(height):
        row = texture[(start[0] + y) % side]
        for x in range(width):
            a = alpha[y, x]
            if a == 0.0 and light[y, x, 0] == 0.0 and light[y, x, 1] == 0.0 and light[y, x, 2] == 0.0:
                continue
            kept = (np.float32(1.0) - a) ** 2
            drawn = row[(start[1] + x) % side]
            for c in range(3):
                now = max(photo[y, x, c] + light[y, x, c], np.float32(0.0))
                before = max(plate[y, x, c], np.float32(0.0))
                variance = shot[c] * now + read[c] - kept * (shot[c] * before + read[c])
                if variance > 0.0:
                    light[y, x, c] += sign * drawn[c] * np.sqrt(variance)

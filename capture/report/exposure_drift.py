"""How bright a slice is against the all-in-focus picture, without knowing the lens: blur moves light about but keeps it."""

import numpy as np
from jaxtyping import Bool, Float32

Rgb = Float32[np.ndarray, "height width 3"]
Mask = Bool[np.ndarray, "height width"]

_CELLS = (6, 8)
_LEAST_FILLED = 0.6


def low_frequency_gain(rgb: Rgb, all_in_focus: Rgb, counted: Mask) -> float:
    """The median over cells of the picture of their light in the slice over that in the all-in-focus picture; nan where no cell counts."""
    cell = (max(1, rgb.shape[0] // _CELLS[0]), max(1, rgb.shape[1] // _CELLS[1]))
    light, expected, filled = (_cell_means(plane, cell) for plane in (_light(rgb, counted), _light(all_in_focus, counted), counted))
    use = (filled > _LEAST_FILLED) & (expected > 0)
    return float(np.median(light[use] / expected[use])) if use.any() else float("nan")


def _light(rgb: Rgb, counted: Mask) -> Float32[np.ndarray, "height width"]:
    return np.where(counted, rgb.mean(axis=2), 0.0).astype(np.float32)


def _cell_means(plane: np.ndarray, cell: tuple[int, int]) -> np.ndarray:
    rows, columns = plane.shape[0] // cell[0], plane.shape[1] // cell[1]
    cut = plane[: rows * cell[0], : columns * cell[1]].astype(np.float64)
    return cut.reshape(rows, cell[0], columns, cell[1]).mean(axis=(1, 3))

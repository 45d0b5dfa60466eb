"""Sizes of the pyramid on which dense depth is found: the coarsest bounds memory, each finer one has at most twice its pixels a side."""

import numpy as np

_FACTOR = 2.0


def level_sizes(width_px: int, height_px: int, planes: int, most_cells: int) -> list[tuple[int, int]]:
    """(width, height) from the coarsest level, of at most `most_cells` pixels times planes, to the full picture."""
    shrink = max(1.0, np.sqrt(width_px * height_px * planes / most_cells))
    steps = int(np.ceil(np.log(shrink) / np.log(_FACTOR) - 1e-9))
    scales = [shrink ** (-(steps - k) / steps) for k in range(steps)] + [1.0] if steps else [1.0]
    widths = [max(int(width_px * scale), 1) if scale < 1.0 else width_px for scale in scales]
    return [scaled_size((width_px, height_px), width / width_px) for width in widths]


def scaled_size(size: tuple[int, int], scale: float) -> tuple[int, int]:
    """(width, height) in whole pixels."""
    return max(round(size[0] * scale), 1), max(round(size[1] * scale), 1)


def halvings(step: float, finest: float) -> list[float]:
    """Half of the step, half of that and so on, down to `finest` or a little below; one at least."""
    count = max(int(np.ceil(np.log2(step / finest) - 1e-9)), 1)
    return [step * 0.5 ** (k + 1) for k in range(count)]

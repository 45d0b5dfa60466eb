"""How near the kernel of a bank's cell is to that of any circle of confusion and motion in it; `python -m tests.bench.bench_combined_bank`.

Both hold the same light, so that the L1 distance is twice what the overlap (sum of the smaller of both) lacks to 1: one number
tells both. "even": 1,000 random places, even over the whole range, as in Fig. 10 e of Leimkuehler et al. 2018. "octaves": even
over octaves from half a pixel on, because small blur is what most of a picture has; the table is of these.
"""

import argparse
from functools import cache

import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.psf_bank import physical_boxes
from mrbokeh.psf_models.base import centred
from mrbokeh.psf_models.build import PAPER_COUNTS, Combined, bank_head

LARGEST_PX, LEAST_PX, PLACES = 256.0, 0.5, 1000
BORDERS_PX = (0.5, 2.0, 8.0, 32.0, 256.0)


def overlaps(model: Combined, places: Float64[np.ndarray, "places axes"]) -> Float64[np.ndarray, " places"]:
    """Sum of the smaller of the cell's kernel and the exact one, at each place."""
    head = bank_head(model, 0, 0)
    boxes = physical_boxes(head.axes, head.grid)
    units = np.stack([axis.to_unit(places[:, index]) for index, axis in enumerate(head.axes)], axis=1)
    of_cell = cache(lambda cell: model.kernel(boxes[cell], 0, 0))
    return np.array(
        [overlap(of_cell(int(cell)), model.exact(place)) for cell, place in zip(head.grid.index_of(units), places, strict=True)]
    )


def overlap(first: np.ndarray, second: np.ndarray) -> float:
    size = max(len(first), len(second))
    return float(np.minimum(centred(first, size), centred(second, size)).sum(dtype=np.float64))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--places", type=int, default=PLACES)
    count = parser.parse_args().places
    rng = np.random.default_rng(0)
    even = LARGEST_PX * rng.random((count, 2))
    octaves = LEAST_PX * (LARGEST_PX / LEAST_PX) ** rng.random((count, 2))
    banks = {
        "paper's nested grid": Combined(counts=PAPER_COUNTS),
        "proportional": Combined(),
        "paper's, finer": Combined(counts=(300, 300)),
        "proportional, finer": Combined(cells=2000),
    }
    for name, model in banks.items():
        found = {places: overlaps(model, each) for places, each in (("even", even), ("octaves", octaves))}
        numbers = [f"{places} {each.mean():.4f}, worst of 20 {np.percentile(each, 5):.3f}" for places, each in found.items()]
        print(f"{name}, {len(bank_head(model, 0, 0).grid)} cells: overlap {'; '.join(numbers)}")
        row, column = (np.searchsorted(BORDERS_PX, octaves[:, axis]) for axis in (0, 1))
        for low in range(1, len(BORDERS_PX)):
            means = [found["octaves"][(row == low) & (column == high)].mean() for high in range(1, len(BORDERS_PX))]
            print(f"    circle {BORDERS_PX[low - 1]:g}-{BORDERS_PX[low]:g} px, by motion: {' '.join(f'{mean:.3f}' for mean in means)}")


if __name__ == "__main__":
    main()

"""Depth of plain photographs against the points that COLMAP triangulated, which it does not use: `capture depth` on a reconstruction.

python -m tests.bench.bench_views_depth RECONSTRUCTION    # of `mrbokeh capture poses --images`

Prints for each picture how many of its points have that depth within 2 %, and CPU seconds.
"""

import sys
from pathlib import Path
from time import process_time

import numpy as np

from capture.dense.picture_depth import DEPTH_FOLDER, deepen_pictures
from capture.poses.sparse_model import SparseModel, read_sparse_model
from mrbokeh.images.exr_io import read_exr
from tests.bench.machine import machine_line

_WITHIN = 0.02


def main() -> None:
    folder = Path(sys.argv[1])
    model = read_sparse_model(folder)
    began_s = process_time()
    deepen_pictures(folder, overwrite=True)
    took_s = (process_time() - began_s) / len(model.views)
    right = np.concatenate([_right(folder, model, view.name) for view in model.views])
    print(f"{right.mean():.1%} of {len(right)} points within {_WITHIN:.0%}; {took_s:.1f} CPU s a picture; {machine_line()}")


def _right(folder: Path, model: SparseModel, name: str) -> np.ndarray:
    depth = read_exr(folder / DEPTH_FOLDER / f"{name}.exr")[0].channels["Z"]
    xy_px, truth = (model if model.metres_per_unit is None else model.scaled()).depths_in(name)
    column, row = np.floor(xy_px).astype(int).T
    inside = (column >= 0) & (column < depth.shape[1]) & (row >= 0) & (row < depth.shape[0])
    right = np.abs(depth[row[inside], column[inside]] / truth[inside] - 1.0) < _WITHIN
    print(f"{name}: {right.mean():.1%} of {inside.sum()}")
    return right


if __name__ == "__main__":
    main()

"""Layered reconstruction (LRDM) by torch: on an NVIDIA GPU, or on any processor that torch runs on (Hasselgren et al. 2015).

The steps are those of `mrbokeh.renderers.layered_reconstruction`, and so are its formulas; what differs is who waits for whom. All
tiles, all partitions and all samples go through each step together:

1. Samples are sorted by tile and put into buckets (`_light`); sums over chosen ones make rows (`_statistics`).
2. Rows of a tile join partitions (`_partitions`), one row of every tile at a time.
3. Each partition of each tile is a job: samples around the tile are reprojected into a window of its own (`_jobs`).
4. The filter of a job is a kernel; kernels and windows meet in a Fourier transform, in double precision (`_screen`).
5. Jobs of a tile are composited front to back (`_picture`).

Two steps have a Triton kernel for NVIDIA GPUs beside them, with the same result: the sweep, of which each step is too little work for a
GPU, and the reprojection. The host waits for the device some dozen times a picture, to learn sizes: how many buckets, rows, partitions
and pixels there are, and how wide windows must be. Nothing else goes to and fro. Additions on a GPU come in any order, so that pictures
there are the same to rounding only.

torch comes with the extra `train`; without it, importing this package says so.
"""

try:
    import torch as _torch  # noqa: F401
except ModuleNotFoundError as missing:
    from mrbokeh.system.errors import MissingExtraError

    raise MissingExtraError("torch", "train") from missing

from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._light import DeviceSamples
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._picture import TorchReconstruction

__all__ = ["DeviceSamples", "TorchReconstruction"]

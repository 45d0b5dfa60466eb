"""Depth for sets that have none: maps of the user's, and the distance in focus, found from what is as sharp in both pictures."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from scipy import ndimage

from datasets_scripts.public_stack import PublicStack
from mrbokeh.images.exr_io import read_exr
from mrbokeh.images.image_io import read_depth, read_image
from mrbokeh.system.errors import InputError

_MAPS = (".exr", ".png", ".tif", ".tiff")
_BINS = 24
_FEWEST_PX = 30
_SMOOTH_PX = 2.0

Plane = Float32[np.ndarray, "height width"]


@dataclass(frozen=True)
class DepthMaps:
    """folder: KEY.exr with metres, or KEY.png and KEY.tif with disparity, white nearest, between near_m and far_m; None: there is none."""

    folder: Path | None = None
    near_m: float | None = None
    far_m: float | None = None

    def depth_m(self, stack: PublicStack) -> Plane:
        """Raises InputError with what is missing."""
        if stack.depth is not None:
            return _metres(stack.depth)
        if self.folder is None:
            raise InputError(
                f"{stack.name} comes without depth, which the circle of confusion needs: make a depth map for each sharp picture (any "
                f"depth estimator) and give their folder with --depth"
            )
        path = next((found for suffix in _MAPS if (found := self.folder / f"{stack.key}{suffix}").is_file()), None)
        if path is None:
            raise InputError(f"expected the depth of {stack.name} as {stack.key}.exr, .png or .tif in {self.folder}, found none")
        return _metres(path) if path.suffix == ".exr" else self._from_disparity(path)

    def _from_disparity(self, path: Path) -> Plane:
        if self.near_m is None or self.far_m is None or not 0.0 < self.near_m < self.far_m:
            raise InputError(
                f"{path} holds disparity without a scale: say with --near-m and --far-m at which distances its white and its black lie "
                f"(0 < near < far), or give depth in metres as EXR"
            )
        white = read_image(path, "linear").mean(axis=2)
        return (1.0 / (1.0 / self.far_m + white * (1.0 / self.near_m - 1.0 / self.far_m))).astype(np.float32)


def _metres(path: Path) -> Plane:
    """Depth passes are written as Z, as Y, or as a picture of three equal channels."""
    channels = read_exr(path)[0].channels
    if "R" in channels and "Z" not in channels:
        red = channels["R"].astype(np.float32)
        return np.where(red > 0, red, np.float32(np.inf))
    return read_depth(path)


def sharpest_depth_m(sharp: Float32[np.ndarray, "height width 3"], blurred: Float32[np.ndarray, "height width 3"], depth_m: Plane) -> float:
    """The depth at which the blurred picture keeps most of the sharp one's detail: the focus distance, where nobody wrote it down.

    Detail is the energy of gradients, pixels are sorted into 24 bins of equal count by dioptre. Raises InputError where all is flat.
    """
    dioptres = 1.0 / depth_m
    detail, kept = (ndimage.gaussian_gradient_magnitude(rgb.mean(axis=2), _SMOOTH_PX / 2.0) ** 2 for rgb in (sharp, blurred))
    edges = np.unique(np.quantile(dioptres, np.linspace(0.0, 1.0, _BINS + 1)))
    number = np.clip(np.searchsorted(edges, dioptres, side="right") - 1, 0, max(len(edges) - 2, 0)).ravel()
    count, total, left = (np.bincount(number, weights) for weights in (None, detail.ravel(), kept.ravel()))
    enough = (count >= _FEWEST_PX) & (total > 1e-3 * total.max(initial=0.0))
    if not enough.any():
        raise InputError("the focus distance cannot be found: the sharp picture has no detail; state it with --focus-m")
    best = int(np.argmax(np.where(enough, left / np.maximum(total, 1e-30), -1.0)))
    return float(1.0 / np.median(dioptres.ravel()[number == best]))

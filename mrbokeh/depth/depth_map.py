"""DepthMap: depth of a photograph, pixel by pixel, with what is known of it."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32

Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]


@dataclass(frozen=True)
class DepthMap:
    """depth_m: (H, W) along the optical axis, above 0, inf is background. valid: (H, W) where it was measured; elsewhere it is the
    depth of the nearest place where it was. note: where it comes from, for people.
    """

    depth_m: Plane
    valid: Mask
    note: str

    @property
    def dioptres(self) -> Plane:
        return (1.0 / self.depth_m).astype(np.float32)

    @classmethod
    def of_dioptres(cls, dioptres: Float[np.ndarray, "height width"], valid: Mask, note: str) -> "DepthMap":
        """What is not above 0 lies at infinity."""
        near = dioptres > 0
        depth_m = np.full(dioptres.shape, np.inf, np.float32)
        np.divide(1.0, dioptres, out=depth_m, where=near, casting="same_kind")
        return cls(depth_m, valid, note)


def with_holes_filled(depth: DepthMap) -> DepthMap:
    """Where nothing was measured the depth of the nearest measured pixel."""
    if depth.valid.all() or not depth.valid.any():
        return depth
    from scipy.ndimage import distance_transform_edt

    rows, columns = distance_transform_edt(~depth.valid, return_distances=False, return_indices=True)
    return replace(depth, depth_m=depth.depth_m[rows, columns])

"""What a network must see of a layer: depth beyond its silhouette, and the window around what it can reach."""

import numpy as np
from jaxtyping import Bool, Float32


def depth_around(
    depth_m: Float32[np.ndarray, "height width"], covered: Bool[np.ndarray, "height width"]
) -> Float32[np.ndarray, "height width"]:
    """Depth with every uncovered pixel given that of the nearest covered one, so that blur can spread beyond the silhouette."""
    from scipy.ndimage import distance_transform_edt

    if covered.all():
        return depth_m
    nearest = distance_transform_edt(~covered, return_distances=False, return_indices=True)
    return depth_m[tuple(nearest)]


def grown(covered: Bool[np.ndarray, "height width"], radius_px: int) -> Bool[np.ndarray, "height width"]:
    """Everything within radius_px of what is covered."""
    from scipy.ndimage import distance_transform_edt

    return covered if covered.all() else distance_transform_edt(~covered) <= radius_px + 0.5


def window_around(reached: Bool[np.ndarray, "height width"], margin_px: int) -> tuple[slice, slice]:
    """The rectangle around everything reached, with what the network must see around it."""
    rows, columns = np.flatnonzero(reached.any(axis=1)), np.flatnonzero(reached.any(axis=0))
    return tuple(slice(max(0, int(each[0]) - margin_px), int(each[-1]) + 1 + margin_px) for each in (rows, columns))  # type: ignore[return-value]

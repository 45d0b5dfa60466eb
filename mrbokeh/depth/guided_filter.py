"""Guided filter with a colour guide (He, Sun and Tang, Guided Image Filtering, 2013), its coefficients at low resolution (Fast Guided
Filter, 2015): values of a small map follow the edges of a large photograph.
"""

import numpy as np
from jaxtyping import Float32

Plane = Float32[np.ndarray, "height width"]
Picture = Float32[np.ndarray, "rows columns 3"]


def guided_upsampling(
    values: Plane, guide: Picture, radius_px: int, epsilon: float, weight: Plane | None = None
) -> Float32[np.ndarray, "rows columns"]:
    """Values (h, w) as a linear function of the guide's colour (H, W, 3) in every window, at the guide's size.

    radius_px: of the window, in pixels of the small map. epsilon: variance of the guide (in its own unit, squared) below which it is
    taken as even. weight: (h, w), 0 where values are unknown.
    """
    import cv2

    small = cv2.resize(guide, values.shape[::-1], interpolation=cv2.INTER_AREA) if guide.shape[:2] != values.shape else guide
    slope, offset = _coefficients(values, small, radius_px, epsilon, np.ones_like(values) if weight is None else weight)
    size = guide.shape[1::-1]
    slope, offset = (cv2.resize(each, size, interpolation=cv2.INTER_LINEAR) for each in (slope, offset))
    return np.einsum("ijc,ijc->ij", slope, guide) + offset


def _coefficients(values: Plane, guide: Float32[np.ndarray, "height width 3"], radius_px: int, epsilon: float, weight: Plane) -> tuple:
    """Slope (H, W, 3) and offset (H, W), Eqs. 19 to 21 of the paper, each averaged over the windows that hold the pixel."""
    known = np.maximum(_box(weight, radius_px), 1e-6)

    def mean(picture: np.ndarray) -> np.ndarray:
        return _box(picture * (weight if picture.ndim == 2 else weight[..., None]), radius_px) / (
            known if picture.ndim == 2 else known[..., None]
        )

    mean_guide, mean_values = mean(guide), mean(values)
    products = mean((guide[..., :, None] * guide[..., None, :]).reshape(*values.shape, 9))
    covariance = products.reshape(*values.shape, 3, 3) - mean_guide[..., :, None] * mean_guide[..., None, :]
    shared = mean(guide * values[..., None]) - mean_guide * mean_values[..., None]
    slope = np.linalg.solve(covariance + np.float32(epsilon) * np.eye(3, dtype=np.float32), shared[..., None])[..., 0]
    offset = mean_values - (slope * mean_guide).sum(axis=2)
    return np.ascontiguousarray(_box(slope.astype(np.float32), radius_px)), _box(offset.astype(np.float32), radius_px)


def _box(picture: np.ndarray, radius_px: int) -> np.ndarray:
    import cv2

    width = 2 * radius_px + 1
    channels = [picture] if picture.ndim == 2 else np.moveaxis(picture, 2, 0)
    blurred = [cv2.blur(np.ascontiguousarray(each), (width, width), borderType=cv2.BORDER_REFLECT) for each in channels]
    return blurred[0] if picture.ndim == 2 else np.stack(blurred, axis=2)

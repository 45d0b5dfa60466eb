"""Depth maps refined: hard edges along the photograph, gaps filled along it, and films steadied over time.

Depth maps of phones and networks are small and soft. Blurred as they are, the soft rim becomes a ghost surface between near and far. So
each pixel beside an edge gets the depth of one of its two sides. Which side it is on, the photograph tells by a guided filter with a
colour guide (He, Sun and Tang 2013; coefficients at low resolution, Fast Guided Filter 2015); how deep that side is, its settled pixels
tell.

In a film the depth is filtered, never the picture, so that blur and occlusion hold still where the scene does: a recursive mean per pixel
in dioptres. A change larger than the noise, which is measured from the film itself, starts afresh, so that a moving edge does not lag.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.depth.edge_votes import highest, lowest
from mrbokeh.system.errors import InputError

Plane = Float32[np.ndarray, "height width"]
Picture = Float32[np.ndarray, "rows columns 3"]


def guided_upsampling(values: Plane, guide: Picture, radius_px: int, epsilon: float) -> Float32[np.ndarray, "rows columns"]:
    """Return values (h, w) as a linear function of the guide's colour (H, W, 3) in every window, at the guide's size.

    radius_px: of the window, in pixels of the small map. epsilon: variance of the guide (in its own unit, squared) below which it is
    taken as even.
    """
    import cv2

    small = cv2.resize(guide, values.shape[::-1], interpolation=cv2.INTER_AREA) if guide.shape[:2] != values.shape else guide
    slope, offset = _coefficients(values, small, radius_px, epsilon)
    size = guide.shape[1::-1]
    slope, offset = (cv2.resize(each, size, interpolation=cv2.INTER_LINEAR) for each in (slope, offset))
    return np.einsum("ijc,ijc->ij", slope, guide) + offset


def _coefficients(values: Plane, guide: Float32[np.ndarray, "height width 3"], radius_px: int, epsilon: float) -> tuple:
    """Return slope (H, W, 3) and offset (H, W), Eqs. 19 to 21 of the paper, each averaged over the windows that hold the pixel."""

    def mean(picture: np.ndarray) -> np.ndarray:
        return _box(picture, radius_px)

    mean_guide, mean_values = mean(guide), mean(values)
    products = mean((guide[..., :, None] * guide[..., None, :]).reshape(*values.shape, 9))
    covariance = products.reshape(*values.shape, 3, 3) - mean_guide[..., :, None] * mean_guide[..., None, :]
    shared = mean(guide * values[..., None]) - mean_guide * mean_values[..., None]
    slope = np.linalg.solve(covariance + np.float32(epsilon) * np.eye(3, dtype=np.float32), shared[..., None])[..., 0]
    offset = mean_values - (slope * mean_guide).sum(axis=2)
    return mean(np.ascontiguousarray(slope.astype(np.float32))), mean(offset.astype(np.float32))


def _box(picture: np.ndarray, radius_px: int) -> np.ndarray:
    import cv2

    width = 2 * radius_px + 1
    channels = [picture] if picture.ndim == 2 else np.moveaxis(picture, 2, 0)
    blurred = [cv2.blur(np.ascontiguousarray(each), (width, width), borderType=cv2.BORDER_REFLECT) for each in channels]
    return blurred[0] if picture.ndim == 2 else np.stack(blurred, axis=2)


_ROUNDS = 3
_FALL = 4.0


def smooth(
    values: Float32[np.ndarray, "height width channels"],
    guide: Float32[np.ndarray, "height width colours"],
    smoothness: float,
    contrast: float,
) -> Float32[np.ndarray, "height width channels"]:
    """Smooth values (H, W, C) within what the guide shows as one surface; their mean over a closed region is preserved.

    OpenCV's fast global smoother (Min et al. 2014) takes a guide of 8 bits and the smoothness of the first round.
    smoothness: lambda of the paper; a single value in an even region reaches about sqrt(lambda) pixels.
    contrast: a difference of the guide by this much lets 1/e through.
    """
    import cv2

    levels = 255.0 / max(float(guide.max()), 1e-6)
    # Eq. 12 of the paper: rounds fall by 4, so that streaks of one direction are wiped out by the next.
    first = 1.5 * _FALL ** (_ROUNDS - 1) / (_FALL**_ROUNDS - 1.0) * smoothness
    codes = np.round(guide * levels).astype(np.uint8)
    smoother = cv2.ximgproc.createFastGlobalSmootherFilter(codes, first, contrast * levels, 1.0 / _FALL, _ROUNDS)
    return np.stack([smoother.filter(np.ascontiguousarray(each)) for each in np.moveaxis(values, 2, 0)], axis=2)


def interpolate(
    values: Plane, weights: Plane, guide: Float32[np.ndarray, "height width colours"], smoothness: float, contrast: float
) -> Plane:
    """Smooth values by their weights in [0, 1], filling pixels without weight from their surroundings (Min et al. 2014, section V-C)."""
    known = np.where(weights > 0, values, 0.0) * weights
    both = smooth(np.stack([known, weights], axis=-1).astype(np.float32), guide, smoothness, contrast)
    return both[..., 0] / np.maximum(both[..., 1], 1e-12)


Mask = Bool[np.ndarray, "height width"]

LEAST_JUMP = 0.05
"""Least jump as a share of the map's range in dioptres: what rises by less within a few pixels is a surface."""
EPSILON = 1e-4
"""Variance of the root of light in [0, 1] below which the photograph tells nothing."""
_LARGEST_SIDE_PX = 1536
_SETTLED = 0.05
_SLANTED = 2.0


@dataclass(frozen=True)
class EdgeSides:
    """Pixels near a jump of depth, and its two sides.

    at_edge: (H, W) pixels near a jump. near, far: (H, W) dioptres of its two sides, meaningful at edges only.
    """

    at_edge: Mask
    near: Plane
    far: Plane


def refined_dioptres(
    dioptres: Plane, photo_rgb: Float32[np.ndarray, "rows columns 3"], edge_px: int = 3, least_jump: float = LEAST_JUMP
) -> Float32[np.ndarray, "rows columns"]:
    """Enlarge a soft map (h, w) to the size of its photograph (H, W, 3; linear), with hard edges where the photograph has them.

    edge_px: how far, in pixels of the map, its edges may be soft or misplaced.
    """
    import cv2

    size = photo_rgb.shape[1::-1]
    # A root is as good a guide as the sRGB curve, and 30 times quicker.
    guide = np.sqrt(np.clip(photo_rgb, 0.0, 1.0))
    plain = cv2.resize(dioptres, size, interpolation=cv2.INTER_LINEAR)
    coarse = _at_most(dioptres, _LARGEST_SIDE_PX)
    followed = guided_upsampling(coarse, guide, edge_px, EPSILON)
    sides = edge_sides(coarse, edge_px, least_jump * float(np.ptp(coarse)))
    at_edge = cv2.resize(sides.at_edge.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    near, far = (cv2.resize(each, size, interpolation=cv2.INTER_NEAREST) for each in (sides.near, sides.far))
    is_near = cv2.blur((followed > 0.5 * (near + far)).astype(np.float32), (3, 3)) > 0.5
    return np.where(at_edge, np.where(is_near, near, far), plain).astype(np.float32)


def _at_most(dioptres: Plane, side_px: int) -> Plane:
    import cv2

    shrink = side_px / max(dioptres.shape)
    size = (round(dioptres.shape[1] * shrink), round(dioptres.shape[0] * shrink))
    return dioptres if shrink >= 1.0 else cv2.resize(dioptres, size, interpolation=cv2.INTER_NEAREST)


def edge_sides(dioptres: Plane, edge_px: int, least_jump: float) -> EdgeSides:
    """Find edges, where the map jumps within edge_px and hardly rises farther out, and their sides; what goes on rising is a slanted
    surface.

    The sides come from the nearest settled pixels: those that are as near or as far as anything around them, so that a wire one
    pixel wide is one too, and a pixel of the soft rim is not.
    """
    window = 2 * edge_px + 1
    low, high = lowest(dioptres, window), highest(dioptres, window)
    jump = high - low
    wide = highest(dioptres, 3 * window) - lowest(dioptres, 3 * window)
    at_edge = (jump > least_jump) & (wide < _SLANTED * jump)
    slack = _SETTLED * jump
    settled_high = (dioptres >= highest(dioptres, 3) - slack) & (dioptres > high - 0.5 * jump)
    settled_low = (dioptres <= lowest(dioptres, 3) + slack) & (dioptres < low + 0.5 * jump)
    near, has_near = _nearest(dioptres, settled_high & at_edge, 2 * edge_px)
    far, has_far = _nearest(dioptres, settled_low & at_edge, 2 * edge_px)
    return EdgeSides(at_edge & has_near & has_far, near, far)


def _nearest(values: Plane, known: Mask, reach_px: int) -> tuple[Plane, Mask]:
    """Return the value of the nearest known pixel, and where that is within reach."""
    from scipy.ndimage import distance_transform_edt

    if not known.any():
        return values, known
    distance, (rows, columns) = distance_transform_edt(~known, return_indices=True)
    return values[rows, columns], distance <= reach_px


_MAD_PER_SIGMA = 0.6745
_VOTES = 3
_NOISE_GROWTH = 1.05
_LEAST_NOISE = 1e-5
_AREA_PX = 7


@dataclass
class TemporalDepthFilter:
    """Filter that takes frames in order; each comes out with the mean of what the same surface showed before.

    gate: a change of more than this many sigmas of the measured noise, seen by a pixel and two of its neighbours, is motion.
    memory: frames over which a still pixel is averaged at most. noise: relative standard deviation, measured so far; None before the
    second frame. It may grow by 5 % a frame only, so that a pan is not taken for noise.
    """

    gate: float = 4.0
    memory: int = 24
    noise: float | None = field(default=None, init=False)
    area_noise: float | None = field(default=None, init=False)
    _mean: Plane | None = field(default=None, init=False, repr=False)
    _count: Plane | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        if not self.gate > 0 or self.memory < 1:
            raise InputError(f"expected a gate above 0 and a memory of at least 1 frame, got {self.gate} and {self.memory}")

    def filtered(self, depth_m: Plane) -> Plane:
        """Steady the depth of the next frame (H, W) in metres, inf allowed. Raises InputError if its size changes."""
        dioptres = (1.0 / depth_m).astype(np.float32)
        if self._mean is None or self._count is None:
            self._mean, self._count = dioptres, np.ones_like(dioptres)
            return depth_m
        if self._mean.shape != dioptres.shape:
            raise InputError(
                f"the depth of a film must keep its size, but went from {self._mean.shape} to {dioptres.shape} (rows, columns)"
            )
        moved = self._moved(dioptres)
        count = np.where(moved, np.float32(1.0), np.minimum(self._count + 1.0, self.memory)).astype(np.float32)
        self._mean = np.where(moved, dioptres, self._mean + (dioptres - self._mean) / count)
        self._count = count
        return _metres(self._mean)

    def _moved(self, dioptres: Plane) -> Bool[np.ndarray, "height width"]:
        """Return where the scene changed: a jump of a pixel, or a smaller step of its whole neighbourhood."""
        import cv2

        assert self._mean is not None
        assert self._count is not None
        # Against the mean of n frames, the noise of a new one is larger by sqrt(1 + 1/n).
        level = np.maximum(np.maximum(dioptres, self._mean), 1e-6)
        change = ((dioptres - self._mean) / (level * np.sqrt(1.0 + 1.0 / self._count))).astype(np.float32)
        area = cv2.blur(change, (_AREA_PX, _AREA_PX), borderType=cv2.BORDER_REFLECT)
        self.noise, self.area_noise = _measured(change, self.noise), _measured(area, self.area_noise)
        loud = (np.abs(change) > self.gate * self.noise).astype(np.float32)
        votes = cv2.blur(loud, (3, 3), borderType=cv2.BORDER_REFLECT) * 9.0
        return (votes > _VOTES - 0.5) & (loud > 0) | (np.abs(area) > self.gate * self.area_noise)


def _measured(change: Plane, before: float | None) -> float:
    """Return the standard deviation from the median, which moving things do not affect while they fill less than half of the picture."""
    found = max(float(np.median(np.abs(change))) / _MAD_PER_SIGMA, _LEAST_NOISE)
    return found if before is None else min(found, _NOISE_GROWTH * before)


def _metres(dioptres: Plane) -> Plane:
    depth_m = np.full(dioptres.shape, np.inf, np.float32)
    np.divide(np.float32(1.0), dioptres, out=depth_m, where=dioptres > 0)
    return depth_m

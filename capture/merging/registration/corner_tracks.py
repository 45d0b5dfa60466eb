"""Corners found in one slice, tracked into another to a fraction of a pixel, and the similarity that most tracks agree on.

Slices are compared by their detail, freed from exposure, vignetting and contrast, at several sizes.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from capture.merging.registration.plane_transforms import Transform, inverse, moved

# Of the largest picture that corners are looked for in. Several hundred of them give a slice's place to a hundredth of its pixel; the
# last pixels of larger pictures are never quite sharp and cost most of the time.
_MOST_PIXELS = 1_500_000
# The shorter side of the smallest picture is at least this long.
_SMALLEST_SIDE_PX = 160
MOST_CORNERS = 1200
_WEAKEST_CORNER = 0.05  # of the strongest
_CORNER_BLOCK_PX = 7
_NOISE_SIGMA_PX = 1.0
_SURROUND_PX = 33
# Contrast (of log luminance) below which detail counts as noise: flat and strongly defocused areas fade to grey there.
_LEAST_CONTRAST = 0.1
_GREY, _GREY_PER_DEVIATION = 128.0, 45.0
# Saturated and missing pixels spoil the corners around them, whose outlines move with the focus.
_SPOILT_PX = 9
_WINDOW_PX = 19
_FIRST_PYRAMID_LEVELS = 1
_FARTHEST_PX = 6.0  # from where the first guess puts a corner
_LARGEST_ROUND_TRIP_PX = 0.15
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)
AGREEING_PX = 1.0
_SMALLEST_SCATTER_PX = 0.05
_ROUNDS = 12

Plane = Float32[np.ndarray, "height width"]
Grey = UInt8[np.ndarray, "height width"]
Corners = Float32[np.ndarray, "corners 2"]
Points = Float[np.ndarray, "tracks 2"]
Distances = Float[np.ndarray, " tracks"]


@dataclass(frozen=True)
class DetailLevel:
    """Detail of a slice 2^level times smaller.

    detail: band-passed log luminance over its local deviation; 128 is none.
    usable: 255 where the slice has data that is neither saturated nor near saturated pixels, else 0.
    corners_px: (N, 2) where detail can be located in both directions, in pixels of this level, (0.5, 0.5) at the first centre.
    """

    level: int
    detail: Grey
    usable: Grey
    corners_px: Corners


@dataclass(frozen=True)
class SliceStructure:
    """A slice as registration sees it.

    size_px: (width, height) of the slice.
    levels: from small to large.
    coarse, coarse_usable: log luminance and its mask at the first of the levels.
    """

    size_px: tuple[int, int]
    levels: tuple[DetailLevel, ...]
    coarse: Plane
    coarse_usable: Grey


@dataclass(frozen=True)
class CornerTracks:
    """Places seen in two slices, (0.5, 0.5) at the centre of the first pixel.

    scatter_px: standard deviation of a single track.
    """

    target_px: Points
    source_px: Points
    scatter_px: float = 1.0

    def __len__(self) -> int:
        return len(self.target_px)

    def enlarged(self, factor: float) -> "CornerTracks":
        """Return the tracks in pixels that are smaller by a factor."""
        return CornerTracks(self.target_px * factor, self.source_px * factor, self.scatter_px * factor)


def structure_of(rgb: Float32[np.ndarray, "height width 3"], valid: Bool[np.ndarray, "height width"] | None = None) -> SliceStructure:
    """Compute the detail and the corners of a slice. valid: where it has data that is not saturated; None is everywhere."""
    luminance = cv2.transform(rgb, np.array([[0.2126, 0.7152, 0.0722]], np.float32))
    finest = max(0, int(np.ceil(0.5 * np.log2(luminance.size / _MOST_PIXELS))))
    coarsest = max(finest, int(np.log2(max(1.0, min(luminance.shape) / _SMALLEST_SIDE_PX))))
    # Of the logarithm a change of exposure is an offset, and bright lights do not dominate it.
    logarithm = cv2.log(np.maximum(shrunk(luminance, finest), 0.0) + np.float32(0.02))
    usable = np.full(logarithm.shape, 255, np.uint8) if valid is None else shrunk_mask(np.where(valid, np.uint8(255), np.uint8(0)), finest)
    pictures = [
        (level, shrunk(logarithm, level - finest), shrunk_mask(usable, level - finest)) for level in range(coarsest, finest - 1, -1)
    ]
    levels = tuple(_detail_level(*each) for each in pictures)
    return SliceStructure((rgb.shape[1], rgb.shape[0]), levels, pictures[0][1], pictures[0][2])


def track_corners(target: DetailLevel, source: DetailLevel, target_from_source: Transform, is_first_guess: bool = True) -> CornerTracks:
    """Follow corners of both slices into the other (Lucas and Kanade 1981, Bouguet 2000) and back; drop those that do not return.

    All in pixels of the level. is_first_guess: the transform may be pixels off. Blur that is the same on all sides of a corner
    does not move it, so a track is unbiased where depth is even. Depth edges shift single tracks, which a robust fit leaves
    out and a correlation of whole pictures cannot.
    """
    levels = _FIRST_PYRAMID_LEVELS if is_first_guess else 0
    there = _followed(target, source, inverse(target_from_source), levels)
    back = _followed(source, target, target_from_source, levels)
    return CornerTracks(np.vstack([there[0], back[1]]), np.vstack([there[1], back[0]]))


def similarity_of_tracks(tracks: CornerTracks) -> Transform:
    """Fit target_from_source by least squares, reweighted until outliers do not count. Needs at least 2 tracks."""
    weights = np.ones(len(tracks))
    for _ in range(_ROUNDS):
        similarity = _weighted_similarity(tracks, weights)
        off_px = distances_px(tracks, similarity)
        weights = robust_weights(off_px, typical_px(off_px))
    return similarity


def distances_px(tracks: CornerTracks, target_from_source: Transform) -> Distances:
    """Return the distance at which each track's source lands from its target."""
    return np.hypot(*(tracks.target_px - moved(target_from_source, tracks.source_px)).T)


def typical_px(distances: Distances) -> float:
    """Return 1.5 times the median distance, which is never 0."""
    return max(_SMALLEST_SCATTER_PX, 1.5 * float(np.median(distances))) if len(distances) else 1.0


def robust_weights(distances: Distances, scatter_px: float) -> Distances:
    """Return the weights of Geman and McClure 1985: 1 for what agrees, towards 0 for what is many times the scatter off."""
    return 1.0 / (1.0 + (distances / scatter_px) ** 2) ** 2


def shrunk(plane: Plane, level: int) -> Float32[np.ndarray, "small_height small_width"]:
    """Average over areas of exactly 2^level pixels; rows and columns that do not fill a pixel are left out."""
    if level == 0:
        return plane
    height, width = (max(1, side >> level) for side in plane.shape)
    return cv2.resize(plane[: height << level, : width << level], (width, height), interpolation=cv2.INTER_AREA)


def shrunk_mask(mask: Grey, level: int) -> UInt8[np.ndarray, "small_height small_width"]:
    """Return 255 where the whole of a larger pixel is 255."""
    if level == 0:
        return mask
    return np.where(shrunk(mask.astype(np.float32), level) > 254.5, np.uint8(255), np.uint8(0))


def _detail_level(level: int, logarithm: Plane, usable: Grey) -> DetailLevel:
    detail = _normalised_detail(logarithm)
    unspoilt = cv2.erode(usable, np.ones((_SPOILT_PX, _SPOILT_PX), np.uint8))
    return DetailLevel(level, detail, unspoilt, _corners_px(detail, unspoilt))


def _normalised_detail(logarithm: Plane) -> Grey:
    """Normalise the detail locally, so that sharp and blurred versions of a texture look alike and every part of the picture counts."""
    box = (_SURROUND_PX, _SURROUND_PX)
    band = cv2.GaussianBlur(logarithm, (0, 0), _NOISE_SIGMA_PX) - cv2.boxFilter(logarithm, -1, box)
    deviation = cv2.sqrt(cv2.boxFilter(band * band, -1, box) + np.float32(_LEAST_CONTRAST**2))
    return np.clip(band / deviation * _GREY_PER_DEVIATION + _GREY, 0, 255).astype(np.uint8)


def _corners_px(detail: Grey, usable: Grey) -> Corners:
    """Find corners (Shi and Tomasi 1994), spread over the picture by a least distance."""
    apart_px = max(6.0, 0.5 * float(np.sqrt(detail.size / MOST_CORNERS)))
    found = cv2.goodFeaturesToTrack(detail, MOST_CORNERS, _WEAKEST_CORNER, apart_px, mask=usable, blockSize=_CORNER_BLOCK_PX)
    return np.zeros((0, 2), np.float32) if found is None else found.reshape(-1, 2) + np.float32(0.5)


def _followed(origin: DetailLevel, goal: DetailLevel, goal_from_origin: Transform, pyramid_levels: int) -> tuple[Points, Points]:
    corners = origin.corners_px
    if not len(corners):
        return np.zeros((0, 2)), np.zeros((0, 2))
    expected = moved(goal_from_origin, corners).astype(np.float32)
    found, ok_there = _lucas_kanade(origin, goal, corners, expected, pyramid_levels)
    returned, ok_back = _lucas_kanade(goal, origin, found, corners, 0)
    near = np.hypot(*(found - expected).T) < _FARTHEST_PX
    kept = ok_there & ok_back & near & (np.hypot(*(returned - corners).T) < _LARGEST_ROUND_TRIP_PX) & _is_usable(goal, found)
    return corners[kept].astype(np.float64), found[kept].astype(np.float64)


def _lucas_kanade(
    origin: DetailLevel,
    goal: DetailLevel,
    points: Float32[np.ndarray, "tracks 2"],
    guess: Float32[np.ndarray, "tracks 2"],
    pyramid_levels: int,
) -> tuple[Float32[np.ndarray, "tracks 2"], Bool[np.ndarray, " tracks"]]:
    half = np.float32(0.5)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        origin.detail, goal.detail, points - half, guess - half,
        winSize=(_WINDOW_PX, _WINDOW_PX), maxLevel=pyramid_levels, criteria=_STOP, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return found.reshape(-1, 2) + half, status.ravel() > 0


def _is_usable(level: DetailLevel, points: Float32[np.ndarray, "tracks 2"]) -> Bool[np.ndarray, " tracks"]:
    height, width = level.usable.shape
    column, row = np.floor(np.nan_to_num(points, nan=-1.0, posinf=-1.0, neginf=-1.0)).astype(int).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return inside & (level.usable[row.clip(0, height - 1), column.clip(0, width - 1)] > 0)


def _weighted_similarity(tracks: CornerTracks, weights: Distances) -> Transform:
    """Fit a weighted similarity in the plane (Umeyama 1991)."""
    share = (weights / weights.sum())[:, None]
    middle_target, middle_source = (share * tracks.target_px).sum(0), (share * tracks.source_px).sum(0)
    p, q = tracks.source_px - middle_source, tracks.target_px - middle_target
    spread = max(float((share * p * p).sum()), 1e-12)
    a = float((share * p * q).sum()) / spread
    b = float((share[:, 0] * (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])).sum()) / spread
    turn = np.array([[a, -b], [b, a]])
    return np.column_stack([turn, middle_target - turn @ middle_source])

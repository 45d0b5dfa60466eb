"""Transforms between slices: pairs by masked ECC and tracked corners, and all slices of a stack jointly from the tracks of all pairs."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from capture.merging.registration.corner_tracks import (
    AGREEING_PX,
    CornerTracks,
    DetailLevel,
    SliceStructure,
    distances_px,
    robust_weights,
    shrunk,
    shrunk_mask,
    similarity_of_tracks,
    track_corners,
    typical_px,
)
from capture.merging.registration.plane_transforms import (
    Transform,
    about_centre,
    as_similarity,
    at_level,
    at_scale,
    chained,
    from_opencv_centres,
    inverse,
    moved,
    scale_of,
    to_opencv_centres,
)

LEAST_CORRELATION = 0.6
# Far more than any lens breathes between neighbouring slices of a stack.
LARGEST_STEP = 0.15
_COARSEST_PX = 80
_SIGMA_PX = 1.5
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
_OPENCV_SMOOTHING_PX = 5
_MOST_ROUNDS = 12
_STANDING_STILL_PX = 5e-3  # A tenth of what the best tracks scatter.
# Of a similarity x -> a x - b y + t_x, b x + a y + t_y there are 4; a homography has its matrix, row by row, without the last element.
_SIMILARITY, _HOMOGRAPHY = 4, 8
# Tracks count up to so many times their scatter: a camera that turned in the hand has moved as well, and where homographies follow the
# middle depths alone, the far parts of the picture lie twice as far off (7.5 and 4.4 px for 5 % of the corners of a phone's desk).
_LENIENT = 2.0
FEWEST_AGREEING = 24
LEAST_SHARE_AGREEING = 0.5
# Finer detail is believed even at so many times the standard error: it lies in the depths that both slices show sharp, while
# the outlines of large discs move with more than the camera (depth edges, pupils off the axis).
_FINER_IS_WORTH = 2.0
# Where a similarity leaves half of the corners farther apart than this, and a homography brings them nearer by this factor, the camera
# has turned.
NOTICEABLE_PX = 0.1
_CLEARLY_BETTER = 1.4

Plane = Float32[np.ndarray, "height width"]
Mask = UInt8[np.ndarray, "height width"]
PairTracks = Mapping[tuple[int, int], CornerTracks]
Points = Float[np.ndarray, "tracks 2"]
Unknowns = Float[np.ndarray, " unknowns"]


@dataclass(frozen=True)
class CoarseMatch:
    """A first guess by ECC. correlation: of the smoothed log luminance, 1 is perfect, 0 where ECC found nothing."""

    target_from_source: Transform
    correlation: float

    @property
    def holds(self) -> bool:
        return self.correlation >= LEAST_CORRELATION


@dataclass(frozen=True)
class PairMatch:
    """A match of two slices.

    tracks: at the size of picture that locates the slice best; None where too few agree on one similarity.
    correlation: of the small pictures (ECC), 0 where none was computed.
    guess_holds: where there are no tracks, target_from_source is what ECC found, else only what was expected.
    """

    target_from_source: Transform
    tracks: CornerTracks | None
    correlation: float = 0.0
    guess_holds: bool = False


def match_neighbours(target: SliceStructure, source: SliceStructure, expected_scale: float = 1.0) -> PairMatch:
    """Match two slices of which nothing is known but the scale that the lens should give."""
    expected = about_centre(expected_scale, *target.size_px)
    coarse = match_coarsely(target, source, expected)
    match = match_from(target, source, coarse.target_from_source if coarse.holds else expected)
    return replace(match, correlation=coarse.correlation, guess_holds=coarse.holds)


def match_from(target: SliceStructure, source: SliceStructure, start: Transform) -> PairMatch:
    """Match two slices that lie within a few pixels of `start`.

    The larger the pictures, the finer the detail, until defocus and noise leave too little that both show. Keeps the largest size
    at which corners agree and the standard error (scatter over the root of their number) does not grow much.
    """
    best, least_error_px = PairMatch(start, None), np.inf
    for of_target, of_source in zip(target.levels, source.levels, strict=True):
        found = _tracked(of_target, of_source, best.target_from_source, is_first_guess=best.tracks is None)
        if found is None:
            break
        transform, tracks, agreeing = found
        error_px = tracks.scatter_px / np.sqrt(agreeing)
        if error_px >= _FINER_IS_WORTH * least_error_px:
            break
        best, least_error_px = PairMatch(transform, tracks), min(error_px, least_error_px)
    return best


def joint_transforms(count: int, pairs: PairTracks, size_px: tuple[int, int], perspective: bool = False) -> tuple[Transform, ...]:
    """Return first_from_slice for every slice: minimises the distances at which each track's two ends land in the first slice.

    Gauss-Newton with robust weights, for all slices at once, so that the errors of a chain do not add up. For similarities the problem is
    linear (as in the linear bundle adjustments of image mosaics), so that every step solves it. pairs: tracks of (target, source), which
    together must connect all slices. perspective: homographies.
    """
    unchanged = np.eye(3).reshape(-1)[:_HOMOGRAPHY] if perspective else [1.0, 0.0, 0.0, 0.0]
    unknowns = np.tile(unchanged, (count, 1))
    places = {pair: tuple(_in_widths(ends, size_px) for ends in (tracks.target_px, tracks.source_px)) for pair, tracks in pairs.items()}
    trust = {pair: np.full(len(tracks), tracks.scatter_px**-2) for pair, tracks in pairs.items()}
    weights, lenient = dict(trust), _LENIENT if perspective else 1.0
    for steps_made in range(_MOST_ROUNDS):
        step = _step(unknowns, places, weights)
        unknowns[1:] -= step
        if steps_made and np.abs(step).max(initial=0.0) * size_px[0] < _STANDING_STILL_PX:
            break
        for pair, ends in places.items():
            apart = np.subtract(*(moved(_transform(unknowns[k]), xy) for k, xy in zip(pair, ends, strict=True)))
            weights[pair] = trust[pair] * robust_weights(size_px[0] * np.hypot(*apart.T), lenient * pairs[pair].scatter_px)
    return tuple(_in_pixels(_transform(each), size_px) for each in unknowns)


def match_coarsely(target: SliceStructure, source: SliceStructure, start: Transform) -> CoarseMatch:
    """Match neighbouring slices by ECC from coarse to fine (Evangelidis and Psarakis 2008) over what is usable in both.

    The result is projected to a similarity. A level that does not correlate, or whose scale leaves start by more than LARGEST_STEP, moves
    nothing; the correlation is that of the finest level.
    """
    transform, correlation = start, 0.0
    for level in range(max(0, int(np.log2(max(1.0, min(target.coarse.shape) / _COARSEST_PX)))), -1, -1):
        found, correlation = _match_at(level, target, source, transform)
        if abs(scale_of(found) / scale_of(start) - 1.0) > LARGEST_STEP:
            correlation = 0.0
        if correlation >= LEAST_CORRELATION:
            transform = found
    return CoarseMatch(transform, correlation)


def _tracked(
    target: DetailLevel, source: DetailLevel, start: Transform, is_first_guess: bool
) -> tuple[Transform, CornerTracks, int] | None:
    """Return (target_from_source, tracks, how many agree) in pixels of the slices; None where too few agree."""
    tracks = track_corners(target, source, at_level(start, target.level), is_first_guess)
    if len(tracks) < FEWEST_AGREEING:
        return None
    found = similarity_of_tracks(tracks)
    off_px = distances_px(tracks, found)
    if np.median(off_px) > NOTICEABLE_PX:
        turned = joint_transforms(2, {(0, 1): tracks}, target.detail.shape[::-1], perspective=True)[1]
        turned_px = distances_px(tracks, turned)
        if np.median(off_px) > _CLEARLY_BETTER * np.median(turned_px):
            found, off_px = turned, turned_px
    agreeing = int(np.count_nonzero(off_px < AGREEING_PX))
    if agreeing < max(FEWEST_AGREEING, LEAST_SHARE_AGREEING * len(tracks)):
        return None
    weighed = replace(tracks, scatter_px=typical_px(off_px))
    return at_level(found, -target.level), weighed.enlarged(2.0**target.level), agreeing


def _match_at(level: int, target: SliceStructure, source: SliceStructure, guess: Transform) -> tuple[Transform, float]:
    in_all = target.levels[0].level + level
    # Smoothed so that two slices differ less by their focus.
    one, other = (cv2.GaussianBlur(shrunk(each.coarse, level), (0, 0), _SIGMA_PX) for each in (target, source))
    mask, other_mask = (shrunk_mask(each.coarse_usable, level) for each in (target, source))
    start = to_opencv_centres(inverse(at_level(guess, in_all))).astype(np.float32)
    try:
        correlation, found = cv2.findTransformECCWithMask(
            one, other, mask, other_mask, start, cv2.MOTION_AFFINE, _STOP, _OPENCV_SMOOTHING_PX
        )
        # OpenCV wants, and returns, source_from_target.
        affine = inverse(from_opencv_centres(np.asarray(found, np.float64)))
    except (cv2.error, np.linalg.LinAlgError):  # it did not converge
        return guess, 0.0
    if not (np.isfinite(correlation) and np.isfinite(affine).all()):  # nothing to compare: flat, or all masked
        return guess, 0.0
    return at_level(as_similarity(affine, one.shape[1], one.shape[0]), -in_all), float(correlation)


def _step(
    unknowns: Float[np.ndarray, "slices unknowns"],
    places: Mapping[tuple[int, int], tuple[Points, ...]],
    weights: Mapping[tuple[int, int], Float[np.ndarray, " tracks"]],
) -> Float[np.ndarray, "moved_slices unknowns"]:
    """Return the change to subtract from the unknowns of all slices but the first, which is held."""
    count, terms = unknowns.shape
    normal, slope = np.zeros((count, terms, count, terms)), np.zeros((count, terms))
    for (i, j), ends in places.items():
        (at_i, by_i), (at_j, by_j) = (_linearised(unknowns[k], xy) for k, xy in zip((i, j), ends, strict=True))
        w = np.repeat(weights[i, j], 2)[:, None]
        across = by_i.T @ (w * by_j)
        normal[i, :, i] += by_i.T @ (w * by_i)
        normal[j, :, j] += by_j.T @ (w * by_j)
        normal[i, :, j] -= across
        normal[j, :, i] -= across.T
        apart = w * (at_i - at_j).reshape(-1, 1)
        slope[i] += (by_i.T @ apart)[:, 0]
        slope[j] -= (by_j.T @ apart)[:, 0]
    matrix = normal.reshape(count * terms, -1)[terms:, terms:]
    return np.asarray(np.linalg.solve(matrix, slope[1:].reshape(-1)).reshape(-1, terms))


def _linearised(unknowns: Unknowns, xy: Points) -> tuple[Points, Float[np.ndarray, "rows unknowns"]]:
    """Return the moved points, and the derivatives of their x and y in turn by the unknowns."""
    (x, y), ends = xy.T, moved(_transform(unknowns), xy)
    by = np.zeros((len(xy), 2, len(unknowns)))
    along_x, along_y = by[:, 0].T, by[:, 1].T
    if len(unknowns) == _SIMILARITY:
        along_x[0], along_x[1], along_x[2] = x, -y, 1.0
        along_y[0], along_y[1], along_y[3] = y, x, 1.0
        return ends, by.reshape(-1, _SIMILARITY)
    along_x[0], along_x[1], along_x[2] = along_y[3], along_y[4], along_y[5] = x, y, 1.0
    by[:, :, 6:] = -ends[:, :, None] * xy[:, None]
    by /= (1.0 + xy @ unknowns[6:])[:, None, None]
    return ends, by.reshape(-1, _HOMOGRAPHY)


def _transform(unknowns: Unknowns) -> Transform:
    if len(unknowns) == _HOMOGRAPHY:
        return np.array([*unknowns, 1.0]).reshape(3, 3)
    a, b, x, y = unknowns
    return np.array([[a, -b, x], [b, a, y]])


def _in_widths(xy_px: Points, size_px: tuple[int, int]) -> Points:
    """Return lengths in widths from the centre, which keep the equations well conditioned."""
    return (xy_px - 0.5 * np.asarray(size_px)) / size_px[0]


def _in_pixels(transform: Transform, size_px: tuple[int, int]) -> Transform:
    """Convert a transform of lengths in widths from the centre to pixels."""
    to_corner = np.array([[1.0, 0.0, 0.5 * size_px[0]], [0.0, 1.0, 0.5 * size_px[1]]])
    to_centre = np.array([[1.0, 0.0, -0.5 * size_px[0]], [0.0, 1.0, -0.5 * size_px[1]]])
    return chained(to_corner, chained(at_scale(transform, float(size_px[0])), to_centre))

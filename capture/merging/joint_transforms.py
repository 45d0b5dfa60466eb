"""One transform per slice from the tracks of all pairs at once, so that the errors of a chain do not add up."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from capture.merging.corner_tracks import CornerTracks
from capture.merging.plane_transforms import Transform, at_scale, chained, moved
from capture.merging.track_fit import robust_weights

PairTracks = Mapping[tuple[int, int], CornerTracks]

_MOST_ROUNDS = 12
_STANDING_STILL_PX = 5e-3  # A tenth of what the best tracks scatter.
# Of a similarity x -> a x - b y + t_x, b x + a y + t_y there are 4; a homography has its matrix, row by row, without the last element.
_SIMILARITY, _HOMOGRAPHY = 4, 8
# Tracks count up to so many times their scatter: a camera that turned in the hand has moved as well, and where homographies follow the
# middle depths alone, the far parts of the picture lie twice as far off (7.5 and 4.4 px for 5 % of the corners of a phone's desk).
_LENIENT = 2.0

Points = Float[np.ndarray, "tracks 2"]
Unknowns = Float[np.ndarray, " unknowns"]


def joint_transforms(count: int, pairs: PairTracks, size_px: tuple[int, int], perspective: bool = False) -> tuple[Transform, ...]:
    """Return first_from_slice for every slice: minimises the distances at which each track's two ends land in the first slice.

    Gauss-Newton with robust weights; of similarities the problem is linear (as the linear bundle adjustments of image mosaics), so that
    every step solves it. pairs: tracks of (target, source), which together must connect all slices. perspective: homographies.
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


def _step(
    unknowns: Float[np.ndarray, "slices unknowns"],
    places: Mapping[tuple[int, int], tuple[Points, ...]],
    weights: Mapping[tuple[int, int], Float[np.ndarray, " tracks"]],
) -> Float[np.ndarray, "moved_slices unknowns"]:
    """Return what to take from the unknowns of all slices but the first, which is held."""
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
    """Return where points go, and how their x and y in turn change with the unknowns."""
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
    """Lengths in widths from the centre keep the equations well conditioned."""
    return (xy_px - 0.5 * np.asarray(size_px)) / size_px[0]


def _in_pixels(transform: Transform, size_px: tuple[int, int]) -> Transform:
    """Return a transform of lengths in widths from the centre in pixels."""
    to_corner = np.array([[1.0, 0.0, 0.5 * size_px[0]], [0.0, 1.0, 0.5 * size_px[1]]])
    to_centre = np.array([[1.0, 0.0, -0.5 * size_px[0]], [0.0, 1.0, -0.5 * size_px[1]]])
    return chained(to_corner, chained(at_scale(transform, float(size_px[0])), to_centre))

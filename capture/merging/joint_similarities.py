"""One similarity per slice from the tracks of all pairs at once, so that the errors of a chain do not add up."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from capture.merging.corner_tracks import CornerTracks
from capture.merging.similarity import Similarity
from capture.merging.track_fit import robust_weights

PairTracks = Mapping[tuple[int, int], CornerTracks]

_ROUNDS = 12

Rows = Float[np.ndarray, "tracks 2 4"]


def joint_similarities(count: int, pairs: PairTracks, size_px: tuple[int, int]) -> tuple[Similarity, ...]:
    """first_from_slice for every slice: minimises the distances at which each track's two ends land in the first slice.

    A similarity x -> a x - b y + t_x, b x + a y + t_y is linear in (a, b, t_x, t_y), so that this is one linear least-squares
    problem of 4 unknowns per slice (as the linear bundle adjustments of image mosaics), solved again with robust weights.
    pairs: tracks of (target, source), which together must connect all slices.
    """
    rows = {pair: (_rows(tracks.target_px, size_px), _rows(tracks.source_px, size_px)) for pair, tracks in pairs.items()}
    trust = {pair: np.full(len(tracks), tracks.scatter_px**-2) for pair, tracks in pairs.items()}
    weights = dict(trust)
    for _ in range(_ROUNDS):
        unknowns = _solved(count, rows, weights)
        for pair, ends in rows.items():
            off_px = size_px[0] * _apart(unknowns, pair, ends)
            weights[pair] = trust[pair] * robust_weights(off_px, pairs[pair].scatter_px)
    return tuple(_similarity(each, size_px) for each in unknowns)


def _solved(
    count: int, rows: Mapping[tuple[int, int], tuple[Rows, Rows]], weights: Mapping[tuple[int, int], Float[np.ndarray, " tracks"]]
) -> Float[np.ndarray, "slices 4"]:
    """The unknowns (a, b, t_x, t_y) of all slices with the first one held at the identity."""
    normal = np.zeros((count, 4, count, 4))
    for pair, ends in rows.items():
        _add(normal, pair, ends, weights[pair])
    matrix = normal.reshape(4 * count, 4 * count)
    unknowns = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    unknowns[1:] = np.linalg.solve(matrix[4:, 4:], -matrix[4:, :4] @ unknowns[0]).reshape(-1, 4)
    return unknowns


def _apart(unknowns: Float[np.ndarray, "slices 4"], pair: tuple[int, int], ends: tuple[Rows, Rows]) -> Float[np.ndarray, " tracks"]:
    """How far apart the two ends of each track land, in widths."""
    return np.hypot(*(ends[0] @ unknowns[pair[0]] - ends[1] @ unknowns[pair[1]]).T)


def _add(normal: np.ndarray, pair: tuple[int, int], ends: tuple[Rows, Rows], weights: Float[np.ndarray, " tracks"]) -> None:
    """The squares of (end in i moved by i's similarity) - (end in j moved by j's)."""
    (i, j), (a, b) = pair, (each.reshape(-1, 4) for each in ends)
    w = np.repeat(weights, 2)[:, None]
    across = a.T @ (w * b)
    normal[i, :, i] += a.T @ (w * a)
    normal[j, :, j] += b.T @ (w * b)
    normal[i, :, j] -= across
    normal[j, :, i] -= across.T


def _rows(xy_px: Float[np.ndarray, "tracks 2"], size_px: tuple[int, int]) -> Rows:
    """What (a, b, t_x, t_y) are multiplied with; lengths in widths from the centre keep the equations well conditioned."""
    x, y = ((xy_px - 0.5 * np.asarray(size_px)) / size_px[0]).T
    one, none = np.ones_like(x), np.zeros_like(x)
    return np.stack([np.column_stack([x, -y, one, none]), np.column_stack([y, x, none, one])], axis=1)


def _similarity(unknowns: Float[np.ndarray, "4"], size_px: tuple[int, int]) -> Similarity:
    a, b, x, y = unknowns
    turn, centre = np.array([[a, -b], [b, a]]), 0.5 * np.asarray(size_px)
    return np.column_stack([turn, centre + size_px[0] * np.array([x, y]) - turn @ centre])

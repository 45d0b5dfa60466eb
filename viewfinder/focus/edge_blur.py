"""Blur of the edges of a tracking board: the diameter of the disc that spreads each, from the profile across it.

1. `board_edges`: the straight edges between black and white squares.
2. `edge_profiles`: what a picture shows across each, from the middle of a black square over its rim into the white one.
3. `edge_blurs`: the diameter that explains the profile.

A step seen through a disc of the diameter c rises as the area of a circle up to a chord. Across an edge of a square there are two:
up to the white of the next square, and down to the border of its marker. The profile (mean along the edge) is compared with
that for all diameters and places; black and white are fitted to each. The disc is the lens; what else blurs (pixels, interpolation,
the lens at its best) is a Gaussian of known width.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy.special import erf

from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import MM_PER_M
from mrbokeh.tracking.charuco.board import CharucoBoard, CharucoGrid

# Of an edge only the middle is used: towards its ends the squares change colour.
_USED = 0.4


@dataclass(frozen=True)
class BoardEdges:
    """Edges on the board, in metres, z = 0. starts, ends: of the part to be used. to_white: unit vectors across, to the white square.

    clear_m: how wide the white is, up to the marker; border_m: how wide the black border of the marker is behind it.
    """

    starts_m: Float64[np.ndarray, "edges 3"]
    ends_m: Float64[np.ndarray, "edges 3"]
    to_white: Float64[np.ndarray, "edges 3"]
    clear_m: Float64[np.ndarray, " edges"]
    border_m: Float64[np.ndarray, " edges"]


def board_edges(board: CharucoBoard) -> BoardEdges:
    """Return the inner edges of all grids, each once."""
    cells = int(board.opencv_dictionary().markerSize) + 2
    rows = np.array([row for grid in board.grids for row in _edges_mm(grid, cells)], np.float64)
    flat = np.pad(rows[:, :6].reshape(-1, 3, 2), ((0, 0), (0, 0), (0, 1)))
    return BoardEdges(
        starts_m=flat[:, 0] / MM_PER_M,
        ends_m=flat[:, 1] / MM_PER_M,
        to_white=flat[:, 2],
        clear_m=rows[:, 6] / MM_PER_M,
        border_m=rows[:, 7] / MM_PER_M,
    )


def _edges_mm(grid: CharucoGrid, cells: int) -> Iterator[tuple[float, ...]]:
    """Yield (start x, y, end x, y, to white x, y, clear, border); the square in column c, row r is black where c + r is even."""
    columns, rows = grid.squares
    size, (left, top) = grid.square_mm, grid.offset_mm
    clear, border = (size - grid.marker_mm) / 2.0, grid.marker_mm / cells
    first, last = (1.0 - _USED) / 2.0 * size, (1.0 + _USED) / 2.0 * size
    for row in range(rows):
        for column in range(columns):
            x, y = left + column * size, top + row * size
            sign = -1.0 if (column + row) % 2 else 1.0  # from a black square its neighbours are white
            if column + 1 < columns:
                yield x + size, y + first, x + size, y + last, sign, 0.0, clear, border
            if row + 1 < rows:
                yield x + first, y + size, x + last, y + size, 0.0, sign, clear, border


_HALF_WIDTH_PX = 20.0
_OFFSET_STEP_PX = 0.5
_ALONG = 12
_NARROWEST_PX = 2.5
_SHORTEST_PX = 4.0

Luminance = Float32[np.ndarray, "height width"]


@dataclass(frozen=True)
class EdgeProfiles:
    """Profiles across the edges in a picture.

    mean: along each edge, at `offsets_px` across it, dark to light. weights: 1 where nothing but the edge is near.
    """

    mean: Float64[np.ndarray, "edges offsets"]
    weights: Float64[np.ndarray, "edges offsets"]
    depth_m: Float64[np.ndarray, " edges"]
    clear_px: Float64[np.ndarray, " edges"]
    border_px: Float64[np.ndarray, " edges"]


def offsets_px() -> Float64[np.ndarray, " offsets"]:
    return np.arange(-_HALF_WIDTH_PX, _HALF_WIDTH_PX + _OFFSET_STEP_PX / 2, _OFFSET_STEP_PX)


def edge_profiles(luminance: Luminance, camera: Camera, edges: BoardEdges) -> EdgeProfiles:
    """Sample the edges that lie before the camera and within the picture, long and wide enough."""
    height, width = luminance.shape
    (starts, _), (ends, _) = camera.project(edges.starts_m), camera.project(edges.ends_m)
    middles_m = (edges.starts_m + edges.ends_m) / 2.0
    middles, depth_m = camera.project(middles_m)
    whites, _ = camera.project(middles_m + edges.clear_m[:, None] * edges.to_white)
    along = ends - starts
    length_px = np.maximum(np.linalg.norm(along, axis=1), 1e-9)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1) / length_px[:, None]
    reach = np.sum((whites - middles) * across, axis=1)
    across, clear_px = across * np.sign(reach)[:, None], np.abs(reach)
    border_px = clear_px * edges.border_m / edges.clear_m
    inside = ((np.minimum(starts, ends) > 1) & (np.maximum(starts, ends) < (width - 1, height - 1))).all(axis=1)
    usable = inside & (depth_m > 0) & (clear_px >= _NARROWEST_PX) & (length_px >= _SHORTEST_PX)
    profiles, in_picture = _profiles(luminance, starts[usable], along[usable], across[usable])
    offsets, clear = offsets_px()[None, :], clear_px[usable, None]
    weights = in_picture & (offsets <= clear) & (offsets >= -2.0 * clear)
    return EdgeProfiles(
        mean=profiles, weights=weights.astype(np.float64), depth_m=depth_m[usable], clear_px=clear_px[usable], border_px=border_px[usable]
    )


def _profiles(
    luminance: Luminance,
    starts: Float64[np.ndarray, "edges 2"],
    along: Float64[np.ndarray, "edges 2"],
    across: Float64[np.ndarray, "edges 2"],
) -> tuple[Float64[np.ndarray, "edges offsets"], Bool[np.ndarray, "edges offsets"]]:
    """Return (mean over places along each edge, whether all of them lie in the picture)."""
    shares = np.linspace(0.0, 1.0, _ALONG)
    places = (
        starts[:, None, None]
        + shares[None, :, None, None] * along[:, None, None]
        + offsets_px()[None, None, :, None] * across[:, None, None]
    )
    height, width = luminance.shape
    inside = ((places >= 0.5) & (places <= (width - 0.5, height - 0.5))).all(axis=(1, 3))
    x, y = ((places[..., axis] - 0.5).astype(np.float32).reshape(-1, len(offsets_px())) for axis in (0, 1))
    # OpenCV takes at most 32767 rows at a time, which is 2730 edges.
    values = cv2.remap(luminance, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) if len(x) else x
    return values.reshape(len(starts), _ALONG, len(offsets_px())).mean(axis=1).astype(np.float64), inside


LARGEST_DIAMETER_PX = 24.0
DIAMETER_STEP_PX = 0.5

_FARTHEST_PX = 20.0  # beyond it all is black or white
_FINE_PX = 0.02
_SHIFTS_PX = np.arange(-1.5, 1.51, 0.25)
_LEAST_CONTRAST = 0.05
_WORST_FIT = 0.1
_INDEPENDENT = 0.4  # of the samples; neighbours at half a pixel share pixels
_SMALLEST_SIGMA_PX = 0.1
_LARGEST_SIGMA_PX = 2.0


@dataclass(frozen=True)
class EdgeBlurs:
    """Measured edges: depth along the camera's axis, diameter of the blur, and its standard deviation."""

    depth_m: Float64[np.ndarray, " edges"]
    diameter_px: Float64[np.ndarray, " edges"]
    sigma_px: Float64[np.ndarray, " edges"]

    def __len__(self) -> int:
        return len(self.depth_m)


def edge_blurs(luminance: Luminance, camera: Camera, edges: BoardEdges, sharpest_px: float = 0.5) -> EdgeBlurs:
    """Measure the blur of each edge that can be measured.

    luminance: linear. camera: intrinsics of that picture and the pose over the board. sharpest_px: sigma of a focused edge's blur.
    """
    profiles = edge_profiles(luminance, camera, edges)
    costs, contrast = _costs(profiles, sharpest_px)
    diameter_px, sigma_px, misfit = _least(costs, profiles)
    # Where a blur reaches over the border of the marker, what is inside of it comes in.
    seen = diameter_px <= np.minimum(2.0 * profiles.border_px, LARGEST_DIAMETER_PX - DIAMETER_STEP_PX)
    good = seen & (contrast > _LEAST_CONTRAST * float(np.max(luminance, initial=0.0))) & (misfit < _WORST_FIT) & np.isfinite(sigma_px)
    return EdgeBlurs(profiles.depth_m[good], diameter_px[good], sigma_px[good])


def edge_rise(x_px: Float64[np.ndarray, "*batch"], diameter_px: float, sigma_px: float) -> Float64[np.ndarray, "*batch"]:
    """Return the rise from 0 to 1 across a step at 0 that is blurred by a disc and then a Gaussian (sigma_px above 0).

    The disc is cut into strips along the edge (Gauss-Chebyshev's nodes of the second kind), finer than the Gaussian is wide.
    """
    count = max(16, int(np.ceil(4.0 * diameter_px / sigma_px)))
    angles = np.arange(1, count + 1) * np.pi / (count + 1)
    weights = 2.0 / (count + 1) * np.sin(angles) ** 2
    strips = 0.5 * diameter_px * np.cos(angles)
    return np.asarray(0.5 + 0.5 * (weights * erf((x_px[..., None] - strips) / (np.sqrt(2.0) * sigma_px))).sum(axis=-1))


@lru_cache(maxsize=4)
def _rises(sharpest_px: float) -> Float64[np.ndarray, "diameters places"]:
    """Tabulate the rises of all diameters; pixels and bilinear samples widen the Gaussian by variances of 1/12 and 1/6."""
    sigma_px = float(np.sqrt(sharpest_px**2 + 1.0 / 12.0 + 1.0 / 6.0))
    places = np.arange(-_FARTHEST_PX, _FARTHEST_PX + _FINE_PX / 2, _FINE_PX)
    diameters_px = np.arange(0.0, LARGEST_DIAMETER_PX + DIAMETER_STEP_PX / 2, DIAMETER_STEP_PX)
    return np.stack([edge_rise(places, diameter, sigma_px) for diameter in diameters_px])


def _shapes(profiles: EdgeProfiles, sharpest_px: float) -> Float64[np.ndarray, "diameters edges shifts offsets"]:
    """Return what each edge looks like with each diameter and place, from 0 for black to 1 for white."""
    rises = _rises(sharpest_px)
    places = np.broadcast_to(offsets_px()[None, :] - _SHIFTS_PX[:, None], (len(profiles.clear_px), len(_SHIFTS_PX), len(offsets_px())))

    def risen(x_px: np.ndarray) -> np.ndarray:
        index = np.round((x_px + _FARTHEST_PX) / _FINE_PX).astype(np.int64)
        return rises[:, index.clip(0, rises.shape[1] - 1)]

    return risen(places) - risen(places - profiles.clear_px[:, None, None])


def _costs(profiles: EdgeProfiles, sharpest_px: float) -> tuple[Float64[np.ndarray, "edges diameters"], Float64[np.ndarray, " edges"]]:
    """Return (relative variance left by the best shape of each diameter; contrast, 0 where the profile falls)."""
    shapes = _shapes(profiles, sharpest_px)
    weights = profiles.weights / np.maximum(profiles.weights.sum(axis=1, keepdims=True), 1e-9)
    deviation = profiles.mean - (weights * profiles.mean).sum(axis=1, keepdims=True)
    variance = np.maximum((weights * deviation**2).sum(axis=1), 1e-12)
    covariance = np.maximum(np.einsum("deso,eo->eds", shapes, weights * deviation), 0.0)
    of_shape = np.einsum("deso,deso,eo->eds", shapes, shapes, weights) - np.einsum("deso,eo->eds", shapes, weights) ** 2
    of_shape = np.maximum(of_shape, 1e-9)
    left = 1.0 - covariance**2 / (of_shape * variance[:, None, None])
    best = left.reshape(len(left), -1).argmin(axis=1) if len(left) else np.zeros(0, np.int64)
    contrast = (covariance / of_shape).reshape(len(left), shapes.shape[0] * shapes.shape[2])[np.arange(len(left)), best]
    return np.maximum(left, 1e-6).min(axis=2), contrast


def _least(costs: Float64[np.ndarray, "edges diameters"], profiles: EdgeProfiles) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (diameter of the least cost, its standard deviation from how the cost rises beside it, what is left there) of each edge."""
    edge = np.arange(len(costs))
    best = costs.argmin(axis=1).clip(1, costs.shape[1] - 2) if len(costs) else np.zeros(0, np.int64)
    before, here, after = (costs[edge, best + step] for step in (-1, 0, 1))
    curvature = np.maximum(before - 2.0 * here + after, 1e-12)
    shift = np.clip(0.5 * (before - after) / curvature, -1.0, 1.0)
    least = np.maximum(here - 0.125 * (before - after) ** 2 / curvature, 1e-6)
    samples = np.maximum(_INDEPENDENT * profiles.weights.sum(axis=1), 1.0)
    sigma = DIAMETER_STEP_PX * np.sqrt(2.0 * least / (samples * curvature))
    return (best + shift) * DIAMETER_STEP_PX, sigma.clip(_SMALLEST_SIGMA_PX, _LARGEST_SIGMA_PX), least

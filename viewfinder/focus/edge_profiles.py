"""The profile across each edge of a board in a picture: from the middle of a black square over its rim into the white one."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64

from mrbokeh.optics.camera import Camera
from viewfinder.focus.board_edges import BoardEdges

_HALF_WIDTH_PX = 20.0
_STEP_PX = 0.5
_ALONG = 12
_NARROWEST_PX = 2.5
_SHORTEST_PX = 4.0

Luminance = Float32[np.ndarray, "height width"]


@dataclass(frozen=True)
class EdgeProfiles:
    """mean: along each edge, at `offsets_px` across it, dark to light. weights: 1 where nothing but the edge is near."""

    mean: Float64[np.ndarray, "edges offsets"]
    weights: Float64[np.ndarray, "edges offsets"]
    depth_m: Float64[np.ndarray, " edges"]
    clear_px: Float64[np.ndarray, " edges"]
    border_px: Float64[np.ndarray, " edges"]


def offsets_px() -> Float64[np.ndarray, " offsets"]:
    return np.arange(-_HALF_WIDTH_PX, _HALF_WIDTH_PX + _STEP_PX / 2, _STEP_PX)


def edge_profiles(luminance: Luminance, camera: Camera, edges: BoardEdges) -> EdgeProfiles:
    """Those that lie before the camera and within the picture, long and wide enough."""
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
    return EdgeProfiles(profiles, weights.astype(np.float64), depth_m[usable], clear_px[usable], border_px[usable])


def _profiles(
    luminance: Luminance,
    starts: Float64[np.ndarray, "edges 2"],
    along: Float64[np.ndarray, "edges 2"],
    across: Float64[np.ndarray, "edges 2"],
) -> tuple[Float64[np.ndarray, "edges offsets"], Bool[np.ndarray, "edges offsets"]]:
    """(mean over places along each edge, whether all of them lie in the picture)."""
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

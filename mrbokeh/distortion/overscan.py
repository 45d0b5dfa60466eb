"""The pinhole camera with overscan: its picture holds everything that the distorted plate sees."""

from functools import lru_cache

import numpy as np
from jaxtyping import Float

from mrbokeh.distortion.distortion import LensDistortion
from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError

GRID_STEP_PX = 16
_ROOM_PX = 1
"""So that filters at the frame's edge find samples on both sides."""
_FINE_STEP_PX = 2
_ENOUGH = 0.999
_MOST_ENLARGED = 2.0

Pair = tuple[float, float]


def overscan_camera(camera: Camera, distortion: LensDistortion) -> Camera:
    """A pinhole in the plate camera's place whose frame contains all that the plate shows, grown (or cut) by whole pixels.

    The focal length stays, so that pixels are the plate's own, unless somewhere a pixel of the pinhole would cover more than
    one of the plate's; then it is raised, at most to twice, until none does. Without distortion it is the camera itself.
    """
    if distortion.is_none:
        return camera
    frame = _frame(distortion, camera.width_px, camera.height_px, camera.focal_px, camera.principal_px)
    return Camera(*frame, camera.camera_from_world)


@lru_cache(maxsize=64)
def _frame(distortion: LensDistortion, width_px: int, height_px: int, focal_px: Pair, principal_px: Pair) -> tuple[int, int, Pair, Pair]:
    """(width, height, focal length, principal point) of the overscan: poses, which change from frame to frame, do not matter."""
    camera = Camera(width_px, height_px, focal_px, principal_px)
    xy_px = distortion.undistorted_px(_grid_px(camera, GRID_STEP_PX), camera)
    if not np.isfinite(xy_px).all():
        # What is seen ends within the frame: the extremes lie next to that end.
        xy_px = distortion.undistorted_px(_grid_px(camera, _FINE_STEP_PX), camera)
    seen = np.isfinite(xy_px).all(axis=-1)
    if not seen.any():
        raise InputError("the lens distortion lets the camera see nothing at all: check its values and the focal length in pixels")
    principal, enlarged = np.asarray(principal_px), _needed_enlargement(distortion, camera)
    moved_px = principal + (xy_px[seen] - principal) * enlarged
    left, top = (np.floor(moved_px.min(axis=0)) - _ROOM_PX).astype(int).tolist()
    right, bottom = (np.ceil(moved_px.max(axis=0)) + _ROOM_PX).astype(int).tolist()
    fx, fy = (np.asarray(focal_px) * enlarged).tolist()
    cx, cy = (principal - (left, top)).tolist()
    return right - left, bottom - top, (fx, fy), (cx, cy)


def source_positions_px(
    distortion: LensDistortion, plate: Camera, overscan: Camera, xy_px: Float[np.ndarray, "*b 2"]
) -> Float[np.ndarray, "*b 2"]:
    """Where in the overscanned picture the plate's positions are seen; NaN where the lens sees nothing."""
    enlarged = np.asarray(overscan.focal_px) / np.asarray(plate.focal_px)
    undistorted = distortion.undistorted_px(xy_px, plate)
    return (undistorted - np.asarray(plate.principal_px)) * enlarged + np.asarray(overscan.principal_px)


def _grid_px(camera: Camera, step_px: int) -> Float[np.ndarray, "rows columns 2"]:
    x, y = (np.linspace(0.0, size, -(-size // step_px) + 1) for size in (camera.width_px, camera.height_px))
    return np.stack(np.meshgrid(x, y), axis=-1)


def _needed_enlargement(distortion: LensDistortion, camera: Camera) -> float:
    """1 over the least length, in undistorted pixels, to which a pixel of the plate comes in any direction."""
    around = [np.array(way) for way in ((0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5))]
    right, left, down, up = (distortion.undistorted_px(_grid_px(camera, GRID_STEP_PX) + way, camera) for way in around)
    derivative = np.stack([right - left, down - up], axis=-1)
    derivative = derivative[np.isfinite(derivative).all(axis=(-1, -2))]
    if not len(derivative):
        return 1.0
    least = float(np.linalg.svd(derivative, compute_uv=False)[:, 1].min())
    return 1.0 if least >= _ENOUGH else min(1.0 / least, _MOST_ENLARGED)

"""Ground that an object stands on: its slope by the depth around the foot, what of it may hide the object, and where its shadow ends."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32

from mrbokeh.compositing.plate import Inserted, Insertion, Plate
from mrbokeh.images.layer import Layer
from mrbokeh.renderers.base import Renderer
from mrbokeh.scene.staging.scene_description import looking_down

Pixel = tuple[float, float]

_SAME_SURFACE, _SURELY_SAME = 0.02, 0.01
"""Largest shares by which depth changes from pixel to pixel of one surface: along a table, and where no edge may be missed."""
_FARTHER, _STANDS_BEFORE, _JUST_BEFORE = 0.05, 0.1, np.float32(0.999)
_NEARER = (0.05, 0.12)
"""Shares by which what stands on the ground is nearer than its plane: the first still catches the shadow whole, the second none of it."""
_SPECK, _UNSURE, _FEW_SLICES = 0.005, 0.1, 3.0
"""Share of what is put in below which a part that hides it is small; mean confidence and slices before it below which it is a speck."""
_FOUND = 2
_NEAR_FOOT = 0.05
"""Half width of the ground that is looked at around a foot, in widths of the picture."""
_ROUNDS, _ROUGH, _EVEN = 10, 0.01, 0.02
_STEEPEST_DEG, _ROLL_DEG = 60.0, 10.0


def ground_under(plate: Plate, foot_px: Pixel) -> Float[np.ndarray, "3 3"] | None:
    """Return the rotation from camera axes to upright ones (x right, y down, z forward) by the ground's slope at a pixel, or None.

    The plane of the depth around the pixel is taken for level along the view; across it the camera is, as photographs are taken. None
    without depth, where that is no plane, and for what is no ground: a wall, a ceiling, what slopes by more than 60 degrees towards the
    camera, or by more than 10 to a side.
    """
    if plate.depth_m is None:
        return None
    height_px, width_px = plate.depth_m.shape
    reach, (x_px, y_px) = max(4, round(_NEAR_FOOT * width_px)), (int(each) for each in foot_px)
    beside = np.zeros((height_px, width_px), bool)
    beside[max(0, y_px - reach) : y_px + reach + 1, max(0, x_px - reach) : x_px + reach + 1] = True
    place = np.nonzero(_same_surface(plate.depth_m, foot_px, beside, _SAME_SURFACE))
    near = 1.0 / plate.depth_m[place].astype(np.float64)
    camera = plate.camera
    rays = np.column_stack([(np.stack(place[::-1], axis=-1) + 0.5 - camera.principal_px) / camera.focal_px, np.ones(len(near))])
    if len(near) < 32 or not (np.isfinite(near) & (near > 0.0)).all():
        return None
    normal = _plane_of(rays, near)
    if normal is None or normal[1] >= -np.cos(np.radians(_STEEPEST_DEG)) or abs(normal[0]) > -normal[1] * np.tan(np.radians(_ROLL_DEG)):
        return None
    return looking_down(float(np.arctan2(-normal[2], -normal[1])))


def _plane_of(rays: Float[np.ndarray, "points 3"], near: Float[np.ndarray, " points"]) -> Float[np.ndarray, "3"] | None:
    """Return the unit normal, towards the camera, of the plane on which most points lie; None where fewer than half lie on one.

    Along rays (x, y, 1), 1 / z of a plane is linear. near: 1 / z of each point.
    """
    weights = np.ones(len(near))
    for _ in range(_ROUNDS):
        slope, *_rest = np.linalg.lstsq(rays * weights[:, None], near * weights, rcond=None)
        apart = np.abs(rays @ slope - near) / near
        weights = 1.0 / np.sqrt(1.0 + (apart / _ROUGH) ** 2)
    if np.median(apart) > _EVEN:
        return None
    return -slope / np.linalg.norm(slope)


def with_ground_behind(plate: Plate, feet_px: Sequence[Pixel], layers: Sequence[Layer]) -> Plate:
    """Return the plate with the ground on which things stand no nearer than those, where it is seen above their feet.

    A floor or a table is the farther the higher it is in the picture, so that it never hides what stands on it; depth that says otherwise
    is wrong. The ground is what goes on from a foot without a jump of depth, but not what is clearly nearer than the foot although it is
    higher (by a tenth, or in a stack by what lies between two slices if that is less): that stands before the object. Below the foot,
    where near things stand, it is only what is nearer than the object by no more than the depth may be off.
    """
    if plate.depth_m is None:
        return plate
    covered_m = np.minimum.reduce([np.where(layer.alpha > 0.0, layer.depth_m, np.inf) for layer in layers])
    ground, calm_m, error = np.zeros(covered_m.shape, bool), _calm(plate.depth_m), plate.depth_error_dioptres
    as_near = 1.0 / calm_m - 1.0 / covered_m < np.float32(error)
    for x_px, y_px in feet_px:
        foot_m = float(calm_m[int(y_px), int(x_px)])
        before = min(_STANDS_BEFORE, 1.0 - 1.0 / (1.0 + 2.0 * error * foot_m)) if error else _STANDS_BEFORE
        is_above = np.arange(len(covered_m))[:, None] <= int(y_px)
        within = np.where(is_above, calm_m > np.float32((1.0 - before) * foot_m), as_near)
        ground |= _same_surface(plate.depth_m, (x_px, y_px), within, _SAME_SURFACE) & np.isfinite(covered_m)
    return replace(plate, depth_m=np.where(ground, np.maximum(plate.depth_m, covered_m), plate.depth_m))


def without_specks(plate: Plate, layers: Sequence[Layer]) -> Plate:
    """Return the plate in which no specks of depth from focus hide what is put in.

    Specks are small, and hardly more than a guess; or lie within the covered area and but a few slices before it.
    """
    import cv2

    if plate.depth_m is None or plate.depth_confidence is None:
        return plate
    covered_m = np.minimum.reduce([np.where(layer.alpha > 0.0, layer.depth_m, np.inf) for layer in layers])
    covered = np.isfinite(covered_m)
    before = 1.0 / plate.depth_m - 1.0 / covered_m
    count, parts, facts, _ = cv2.connectedComponentsWithStats((covered & (before > 0.0)).astype(np.uint8), connectivity=8)
    area_px, on_edge = facts[:, cv2.CC_STAT_AREA], cv2.dilate((~covered).astype(np.uint8), np.ones((3, 3))) > 0
    trust, mean_before = (np.bincount(parts.ravel(), each.ravel(), count) / area_px for each in (plate.depth_confidence, before))
    within = (np.bincount(parts[on_edge], minlength=count) == 0) & (mean_before < _FEW_SLICES * 2.0 * plate.depth_error_dioptres)
    speck = (area_px < _SPECK * covered.sum()) & ((trust < _UNSURE) | within)
    speck[0] = False
    return replace(plate, depth_m=np.where(speck[parts], covered_m, plate.depth_m))


@dataclass(frozen=True)
class Standing:
    """Insertion of what stands on the ground at some pixels, which never hides it (`with_ground_behind`)."""

    insertion: Insertion
    feet_px: Sequence[Pixel]

    def insert(self, plate: Plate, layers: Sequence[Layer], renderer: Renderer) -> Inserted:
        return self.insertion.insert(without_specks(with_ground_behind(plate, self.feet_px, layers), layers), layers, renderer)


def ended_shadow(plate: Plate, feet_px: Sequence[Pixel], objects: Layer, shadow: Layer) -> Layer:
    """Return the shadow of objects as far as the ground goes on which they stand at some pixels.

    It was drawn on a plane without end, and would hang sharp in the air over what lies blurred beyond a table's edge: past a jump of depth,
    and clearly farther than the plane. A shadow apart from the feet, as of a thing in the air, stays. On the ground itself it lies as far
    away as that: a plane that is a little too far would be hidden by what it darkens. What stands on the ground goes on from it without a
    jump, but is ever nearer than the plane the higher one looks: it catches ever less.
    """
    covered = (objects.alpha > 0.0) | (shadow.alpha > 0.0)
    if plate.depth_m is None or not shadow.alpha.any():
        return shadow
    even = np.ones_like(plate.depth_m)
    beside = np.logical_or.reduce([_same_surface(even, foot_px, covered, _SURELY_SAME) for foot_px in feet_px])
    same = np.logical_or.reduce([_same_surface(plate.depth_m, foot_px, covered, _SURELY_SAME) for foot_px in feet_px])
    beyond = beside & ~same & (plate.depth_m > shadow.depth_m * np.float32(1.0 + _FARTHER))
    lies = same & (shadow.alpha > 0.0)
    caught = np.where(beyond, np.float32(0.0), np.float32(1.0))
    share = np.nan_to_num(_calm(plate.depth_m)[lies] / shadow.depth_m[lies], nan=1.0)
    caught[lies] = np.clip((share - np.float32(1.0 - _NEARER[1])) / np.float32(_NEARER[1] - _NEARER[0]), 0.0, 1.0)
    moved = lies & (objects.alpha == 0.0)
    return replace(
        shadow,
        alpha=shadow.alpha * caught,
        rgb=shadow.rgb * caught[..., None],
        depth_m=np.where(moved, np.minimum(shadow.depth_m, plate.depth_m * _JUST_BEFORE), shadow.depth_m),
    )


def _calm(depth_m: Float32[np.ndarray, "height width"]) -> Float32[np.ndarray, "height width"]:
    """Return the median of 5x5 pixels: noise of single ones is no surface."""
    import cv2

    return np.asarray(cv2.medianBlur(depth_m, 5))


def _same_surface(
    depth_m: Float32[np.ndarray, "height width"], start_px: Pixel, within: Bool[np.ndarray, "height width"], step: float
) -> Bool[np.ndarray, "height width"]:
    """Return the pixels (H, W) that are reached from one of them without a jump of depth by more than a share, and within a mask.

    Noise of single pixels is no jump: depth is that of the median of 5x5 pixels.
    """
    import cv2

    x_px, y_px = (int(each) for each in start_px)
    found = cv2.copyMakeBorder((~within).astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=1)
    found[y_px + 1, x_px + 1] = 0
    logs = _calm(np.log(np.minimum(depth_m, np.float32(1e6))))
    cv2.floodFill(logs, found, (x_px, y_px), 0.0, step, step, 4 | (_FOUND << 8) | cv2.FLOODFILL_MASK_ONLY)
    return found[1:-1, 1:-1] == _FOUND

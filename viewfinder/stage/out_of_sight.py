"""Reasons why nothing of a scene is seen by a camera, in a sentence and an arrow for the page."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from mrbokeh.optics.camera import Camera
from mrbokeh.scene.staging.picture_box import NEAREST_M
from mrbokeh.scene.staging.scene_description import PlacedObject
from mrbokeh.system.compiled import kernels_compiled
from viewfinder.frames import Remark

_MIDDLE = 1e-6


def preparing(busy: bool) -> str:
    """Say what keeps the first drawing. busy: it has been begun."""
    if not busy:
        return "the scene waits for the first picture of a camera whose place is known"
    count = kernels_compiled()
    done = f"compiling for this machine, kernel {count}: " if count else ""
    return f"preparing the scene; {done}the first time on a machine that takes a minute"


def reason_unseen(objects: Sequence[PlacedObject], extent_m: Float[np.ndarray, "2 3"] | None, camera: Camera) -> Remark:
    """Return why nothing of a drawn scene is in the picture of an upright camera.

    extent_m: the least and the largest coordinates of its points. The arrow points from the middle of the picture to where they are.
    """
    if not any(each.visible for each in objects):
        return Remark("every object is hidden: show one" if objects else "the scene has no object: add one to the scene file")
    if extent_m is None:
        return Remark("the objects of the scene have no surfaces: choose other files for them")
    corners_m = np.array([[extent_m[i, 0], extent_m[j, 1], extent_m[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    middle_m, seen_m = (
        points_m @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3] for points_m in (extent_m.mean(axis=0), corners_m)
    )
    if seen_m[:, 2].max() < NEAREST_M:
        return Remark("the object is behind the camera: turn round, along the arrow", _direction(middle_m, camera))
    xy_px = middle_m[:2] / max(middle_m[2], NEAREST_M) * camera.focal_px + camera.principal_px
    if middle_m[2] > NEAREST_M and (xy_px >= 0).all() and (xy_px <= (camera.width_px, camera.height_px)).all():
        return Remark("the object is in the picture, but nothing of it can be seen: it is hidden, far too small or far too blurred")
    return Remark("the object is outside the picture: turn the camera along the arrow", _direction(middle_m, camera))


def _direction(middle_m: Float[np.ndarray, "3"], camera: Camera) -> tuple[float, float]:
    """Return right and down, of length 1; where it is straight behind, right is as good as any."""
    towards = middle_m[:2] * camera.focal_px
    length = float(np.linalg.norm(towards))
    return (1.0, 0.0) if length < _MIDDLE else (float(towards[0]) / length, float(towards[1]) / length)

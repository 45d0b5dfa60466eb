"""Reasons why nothing of a scene is seen by a camera, in a sentence and an arrow for the page."""

import numpy as np
from jaxtyping import Float

from mrbokeh.optics.camera import Camera
from mrbokeh.scene.staging.picture_box import NEAREST_M
from mrbokeh.scene.staging.staged_scene import StagedScene
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


def reason_unseen(staged: StagedScene, time_s: float, camera: Camera) -> Remark:
    """Return why nothing of a drawn scene is in the picture of an upright camera.

    The arrow points from the middle of the picture to where the objects are.
    """
    objects = staged.description.objects
    if not any(each.visible for each in objects):
        hidden = "every object is hidden: show one" if objects else "the scene has no object: add one to the scene file"
        return Remark(hidden)
    points_m = staged.drawn_points_m(time_s)
    if not len(points_m):
        return Remark("the objects of the scene have no surfaces: choose other files for them")
    seen_m = points_m @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
    if seen_m[:, 2].max() < NEAREST_M:
        return Remark("the object is behind the camera: turn round, along the arrow", _direction(seen_m, camera))
    ahead_m = seen_m[seen_m[:, 2] >= NEAREST_M]
    xy_px = ahead_m[:, :2] / ahead_m[:, 2:] * camera.focal_px + camera.principal_px
    if ((xy_px >= 0) & (xy_px <= (camera.width_px, camera.height_px))).all(axis=1).any():
        return Remark("the object is in the picture, but nothing of it can be seen: it is hidden, far too small or far too blurred")
    return Remark("the object is outside the picture: turn the camera along the arrow", _direction(seen_m, camera))


def _direction(seen_m: Float[np.ndarray, "points 3"], camera: Camera) -> tuple[float, float]:
    """Return right and down, of length 1; where it is straight behind, right is as good as any."""
    towards = (seen_m.min(axis=0) + seen_m.max(axis=0))[:2] * camera.focal_px
    length = float(np.linalg.norm(towards))
    return (1.0, 0.0) if length < _MIDDLE else (float(towards[0]) / length, float(towards[1]) / length)

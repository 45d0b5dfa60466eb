"""PictureBox: the part of a picture (it may reach beyond the frame) in which something is drawn, and the Camera cut to it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mrbokeh.layering.pixel_box import NOWHERE, Box, is_same_everywhere
from mrbokeh.layering.psf_over_field import reach_px
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.scene import Light, Mesh, Scene

STEP_PX = 16
"""Boxes are whole multiples of this, so that they have whole pixels at 3/4 and 1/2 resolution and in a grid of every 4th of those."""
_BEYOND_FRAME = 1 / 16
"""How much of the frame's width is drawn beyond its border: what the next poses may bring into the picture."""
NEAREST_M = 0.01
_ROOM_PX = 2


@dataclass(frozen=True)
class PictureBox:
    left_px: int
    top_px: int
    width_px: int
    height_px: int

    @property
    def box(self) -> Box:
        return Box(self.top_px, self.top_px + self.height_px, self.left_px, self.left_px + self.width_px)

    def cut(self, camera: Camera, resolution: float = 1.0) -> Camera:
        """The camera that sees just this part, at `resolution` of the pixels (1, 3/4 or 1/2)."""
        part = self.box.camera_of(camera)
        return part if resolution == 1.0 else part.resized(round(self.width_px * resolution), round(self.height_px * resolution))

    def lens_of(self, lens: Lens, frame_width_px: int) -> Lens:
        return self.box.lens_of(lens, frame_width_px)


def box_around(points_m: Float[np.ndarray, "points 3"], camera: Camera, lens: Lens) -> PictureBox | None:
    """Return the box of the points as the camera sees them, with room for their blur; None if it touches nothing of the frame.

    Lenses whose blur depends on the place in the frame need the whole frame. Points behind the camera or too near for a picture may
    project anywhere: then the box is as large as it can be.
    """
    depth_m = points_m @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
    if not len(points_m) or depth_m.max() < NEAREST_M:
        return None
    if not is_same_everywhere(lens):
        return PictureBox(0, 0, camera.width_px, camera.height_px)
    nearest_m = max(float(depth_m.min()), NEAREST_M)
    reach = largest_reach_px(lens, nearest_m, float(depth_m.max()), camera.width_px)
    beyond = reach + int(_BEYOND_FRAME * camera.width_px)
    low, high = np.array([-beyond, -beyond]), np.array([camera.width_px + beyond, camera.height_px + beyond])
    if depth_m.min() >= NEAREST_M:
        xy_px, _ = camera.project(points_m)
        low = np.maximum(low, np.floor(xy_px.min(0)).astype(int) - reach)
        high = np.minimum(high, np.ceil(xy_px.max(0)).astype(int) + reach)
    if (low >= high).any():
        return None
    width, height = (-(-int(size) // STEP_PX) * STEP_PX for size in high - low)
    return PictureBox(int(low[0]), int(low[1]), width, height)


def largest_reach_px(lens: Lens, nearest_m: float, farthest_m: float, frame_width_px: int) -> int:
    """Return how many whole pixels light between two depths can travel, plus one for the pixel's own edge; at most a frame."""
    coc_px = np.abs(lens.coc_px(np.array([nearest_m, farthest_m]), frame_width_px)).max()
    return min(reach_px(lens.aperture, float(coc_px)) + 1, frame_width_px)


def drawn_points_m(scene: Scene, catcher: Mesh | None) -> Float[np.ndarray, "points 3"]:
    """Vertices of all that is drawn, and where the lights throw them onto the level catcher."""
    points = [mesh.positions_m for mesh in scene.meshes if not mesh.catches_shadow]
    if not points:
        return np.zeros((0, 3))
    points_m = np.concatenate(points)
    shadows = [] if catcher is None else [_thrown(points_m, light, catcher) for light in scene.lighting[0] if light.casts_shadow]
    return np.concatenate([points_m, *shadows])


def shadow_box(scene: Scene, camera: Camera, catcher: Mesh) -> Box:
    """Return the part of the frame that may see hard shadows on the level catcher; the whole frame if the camera is too near to tell."""
    points_m = [mesh.positions_m for mesh in scene.meshes if not mesh.catches_shadow]
    lights = [light for light in scene.lighting[0] if light.casts_shadow]
    if not points_m or not lights:
        return NOWHERE
    thrown_m = np.concatenate([_thrown(np.concatenate(points_m), light, catcher) for light in lights])
    frame_px = (camera.height_px, camera.width_px)
    depth_m = thrown_m @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
    if not len(thrown_m) or depth_m.min() < NEAREST_M:
        return Box(0, frame_px[0], 0, frame_px[1]) if len(thrown_m) else NOWHERE
    xy_px, _ = camera.project(thrown_m)
    (left, top), (right, bottom) = (each.astype(int).tolist() for each in (np.floor(xy_px.min(0)), np.ceil(xy_px.max(0))))
    found = Box(top, bottom, left, right).grown(_ROOM_PX).within(frame_px)
    return NOWHERE if found.is_empty else found


def _thrown(points_m: Float[np.ndarray, "points 3"], light: Light, catcher: Mesh) -> Float[np.ndarray, "shadows 3"]:
    """Shadows of points on the plane of the catcher (level, y down), kept within it; those that light sends upwards have none."""
    low_m, high_m = catcher.positions_m.min(0), catcher.positions_m.max(0)
    towards, _, _ = light.arriving_at(points_m)
    below_m = low_m[1] - points_m[:, 1]
    falls = towards[:, 1] < -1e-3
    steps = np.maximum(below_m, 0.0)[falls] / towards[falls, 1]
    return np.clip(points_m[falls] + steps[:, None] * towards[falls], low_m, high_m)

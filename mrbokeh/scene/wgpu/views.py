"""How cameras and lights look at a scene: the matrices and rays that the visibility shader takes."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64

from mrbokeh.optics.camera import Camera
from mrbokeh.scene.light import Light

_NEAREST = 2.0**-12
"""Nothing nearer than this share of a scene's reach is drawn where the scene lies around the eye; a camera inside an object
is no use, while a near plane much nearer than the surfaces costs the depth test its precision."""
_WIDEST_TANGENT = 2.0


@dataclass(frozen=True, eq=False)
class View:
    """struct View of visibility.wgsl, without its flags; points are relative to the geometry's centre.

    way, way_right, way_down: of a camera the ray through (0, 0) of the picture and its change per pixel; of a sun the origin.
    texel: width of a pixel, at unit depth of a camera, in metres of a sun.
    """

    clip_from_point: Float64[np.ndarray, "4 4"]
    eye: Float64[np.ndarray, "4"]
    way: Float64[np.ndarray, "3"]
    way_right: Float64[np.ndarray, "3"]
    way_down: Float64[np.ndarray, "3"]
    texel: float

    def words(self, one_sided: bool, peels: bool, is_hidden: bool) -> Float32[np.ndarray, "36"]:
        """The struct as the device reads it; a matrix goes column by column."""
        rows = np.zeros((9, 4), np.float32)
        rows[:4], rows[4] = self.clip_from_point.T, self.eye
        rows[5, :3], rows[6, :3], rows[7, :3], rows[5, 3] = self.way, self.way_right, self.way_down, self.texel
        rows[8] = np.array([one_sided, peels, is_hidden, 0], np.uint32).view(np.float32)
        return rows.ravel()


def camera_view(camera: Camera, centre_m: Float[np.ndarray, "3"], nearest_m: float) -> View:
    """A pinhole camera with any focal lengths and principal point; depth is reversed (near is 1), its far end at infinity."""
    fx, fy = camera.focal_px
    cx, cy = camera.principal_px
    rotation = camera.camera_from_world[:3, :3]
    camera_from_point = np.eye(4)
    camera_from_point[:3, :3], camera_from_point[:3, 3] = rotation, rotation @ centre_m + camera.camera_from_world[:3, 3]
    clip_from_camera = np.array(
        [
            [2 * fx / camera.width_px, 0, 2 * cx / camera.width_px - 1, 0],
            [0, -2 * fy / camera.height_px, 1 - 2 * cy / camera.height_px, 0],
            [0, 0, 0, nearest_m],
            [0, 0, 1, 0],
        ]
    )
    right, down, forward = rotation
    return View(
        clip_from_point=clip_from_camera @ camera_from_point,
        eye=np.append(camera.world_from_camera[:3, 3] - centre_m, 1.0),
        way=forward - cx / fx * right - cy / fy * down,
        way_right=right / fx,
        way_down=down / fy,
        texel=1.0 / float(np.sqrt(fx * fy)),
    )


def nearest_m(camera: Camera, centre_m: Float[np.ndarray, "3"], box_m: Float[np.ndarray, "8 3"]) -> float:
    """Where the near plane has to lie so that the box's content is seen and depth is told apart well."""
    depth_m = (box_m + centre_m) @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
    reach_m = float(np.ptp(box_m, axis=0).max())
    return max(0.9 * float(depth_m.min()), _NEAREST * reach_m, 1e-9)


def light_views(light: Light, box_m: Float[np.ndarray, "8 3"], size_px: int) -> list[View]:
    """One view that takes in all of the box, or six around a lamp that is too near or inside.

    box_m and the light's position are relative to the geometry's centre.
    """
    if light.kind == "directional":
        return [_sun_view(light, box_m, size_px)]
    position = np.asarray(light.position_m)
    if light.kind == "spot" and np.tan(light.outer_cone_rad) < _WIDEST_TANGENT:
        half = 1.02 * max(float(np.tan(light.outer_cone_rad)), 1e-3)
        return [_lamp_view(position, _axes_along(np.asarray(light.direction)), half, box_m, size_px)]
    middle = box_m.mean(0) - position
    axes = _axes_along(middle / max(float(np.linalg.norm(middle)), 1e-12))
    across, depth = (box_m - position) @ axes[:2].T, (box_m - position) @ axes[2]
    half = 1.02 * float(np.abs(across / depth[:, None]).max()) if depth.min() > 0 else np.inf
    if half < _WIDEST_TANGENT:
        return [_lamp_view(position, axes, max(half, 1e-6), box_m, size_px)]
    ways = [sign * np.eye(3)[axis] for axis in range(3) for sign in (1.0, -1.0)]
    return [_lamp_view(position, _axes_along(way), 1.0, box_m, size_px) for way in ways]


def _axes_along(forward: Float[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Rows right, down, forward."""
    aside = np.eye(3)[int(np.argmin(np.abs(forward)))]
    right = np.cross(aside, forward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def _lamp_view(
    position: Float[np.ndarray, "3"], axes: Float[np.ndarray, "3 3"], half: float, box_m: Float[np.ndarray, "8 3"], size_px: int
) -> View:
    """half: tangent of half the field of view."""
    camera_from_point = np.eye(4)
    camera_from_point[:3, :3], camera_from_point[:3, 3] = axes, -axes @ position
    focal_px = size_px / (2 * half)
    camera = Camera(size_px, size_px, (focal_px, focal_px), (size_px / 2, size_px / 2), camera_from_point)
    return camera_view(camera, np.zeros(3), nearest_m(camera, np.zeros(3), box_m))


def _sun_view(light: Light, box_m: Float[np.ndarray, "8 3"], size_px: int) -> View:
    """Along the light's rays; depth is 1 before the box and 0 behind it, as of cameras."""
    axes = _axes_along(np.asarray(light.direction))
    low, high = (box_m @ axes.T).min(0), (box_m @ axes.T).max(0)
    # A little wider, so that no triangle lies on the very border or at the very end of the depth.
    half, middle = np.maximum((high - low) / 2, 1e-9 + 1e-3 * np.ptp(box_m)) * 1.01, (low + high) / 2
    clip_from_point = np.eye(4)
    clip_from_point[0, :3], clip_from_point[0, 3] = axes[0] / half[0], -middle[0] / half[0]
    clip_from_point[1, :3], clip_from_point[1, 3] = -axes[1] / half[1], middle[1] / half[1]
    clip_from_point[2, :3], clip_from_point[2, 3] = -axes[2] / (2 * half[2]), 0.5 + middle[2] / (2 * half[2])
    return View(
        clip_from_point=clip_from_point,
        eye=np.append(axes[2], 0.0),
        way=axes.T @ np.array([middle[0] - half[0], middle[1] - half[1], low[2] - half[2]]),
        way_right=2 * half[0] / size_px * axes[0],
        way_down=2 * half[1] / size_px * axes[1],
        texel=2 * float(max(half[0], half[1])) / size_px,
    )

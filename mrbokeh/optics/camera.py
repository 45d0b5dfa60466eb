"""Camera: an undistorted pinhole with a pose, where world points land in the picture and back, and its JSON."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError


def field_positions(
    size_px: tuple[int, int], frame_px: tuple[int, int] | None = None, origin_px: tuple[int, int] = (0, 0)
) -> Float32[np.ndarray, "height width 2"]:
    """Return (H, W, 2) field positions (x, y) of pixel centres in half diagonals; length 1 is reached in the corner of a corner pixel.

    size_px: (height, width) of the part wanted, whose top left pixel is origin_px (row, column) of a frame of frame_px (height, width);
    None: the part is the whole frame.
    """
    frame_px = frame_px or size_px
    half_diagonal_px = 0.5 * float(np.hypot(*frame_px))
    down, right = (
        (origin + 0.5 + np.arange(length) - 0.5 * whole) / half_diagonal_px
        for length, whole, origin in zip(size_px, frame_px, origin_px, strict=True)
    )
    return np.stack(np.meshgrid(right, down), axis=2).astype(np.float32)


_SAME_SHAPE = 0.01


@dataclass(frozen=True)
class Camera:
    """Pinhole camera: x right, y down, z forward; the centre of pixel (0, 0) is at (0.5, 0.5).

    focal_px, principal_px: (x, y) in pixels.
    camera_from_world: (4, 4) rigid transform of world points (metres) into camera axes.
    """

    width_px: int
    height_px: int
    focal_px: tuple[float, float]
    principal_px: tuple[float, float]
    camera_from_world: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        if self.width_px < 1 or self.height_px < 1 or min(self.focal_px) <= 0:
            raise InputError(
                f"a camera needs a positive size and focal length, but came with {self.width_px}x{self.height_px} px "
                f"and focal length {self.focal_px} px: check the intrinsics"
            )

    @property
    def world_from_camera(self) -> Float[np.ndarray, "4 4"]:
        """Return (4, 4), the inverse of camera_from_world; its last column is where the camera stands."""
        return np.linalg.inv(self.camera_from_world)

    def project(self, points_m: Float[np.ndarray, "*batch 3"]) -> tuple[Float[np.ndarray, "*batch 2"], Float[np.ndarray, "*batch"]]:
        """Project world points to (pixel positions, depth in metres along the optical axis)."""
        in_camera = points_m @ self.camera_from_world[:3, :3].T + self.camera_from_world[:3, 3]
        depth_m = in_camera[..., 2]
        return in_camera[..., :2] / depth_m[..., None] * self.focal_px + self.principal_px, depth_m

    def unproject(self, xy_px: Float[np.ndarray, "*batch 2"], depth_m: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch 3"]:
        """Return the world points of pixel positions at a depth (metres along the optical axis): the inverse of `project`."""
        plane = (xy_px - np.asarray(self.principal_px)) / np.asarray(self.focal_px)
        in_camera = np.concatenate([plane, np.ones_like(plane[..., :1])], axis=-1) * depth_m[..., None]
        world_from_camera = self.world_from_camera
        return in_camera @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]

    def pixel_centres_px(self) -> Float[np.ndarray, "height width 2"]:
        """Return (H, W, 2): the x, y position of each pixel's centre."""
        x, y = np.meshgrid(np.arange(self.width_px) + 0.5, np.arange(self.height_px) + 0.5)
        return np.stack([x, y], axis=-1)

    def resized(self, width_px: int, height_px: int) -> "Camera":
        """Return the same view sampled with another number of pixels."""
        scale = np.array([width_px / self.width_px, height_px / self.height_px])
        fx, fy = np.asarray(self.focal_px) * scale
        cx, cy = np.asarray(self.principal_px) * scale
        return Camera(
            width_px=width_px,
            height_px=height_px,
            focal_px=(float(fx), float(fy)),
            principal_px=(float(cx), float(cy)),
            camera_from_world=self.camera_from_world,
        )


def have_same_shape(size_px: tuple[int, int], other_px: tuple[int, int], within: float = _SAME_SHAPE) -> bool:
    """Return whether two pictures (width, height) have one aspect ratio, up to rounding to whole or even pixels."""
    return abs(size_px[0] * other_px[1] / (size_px[1] * other_px[0]) - 1.0) <= within


def camera_of_lens(lens: Lens, width_px: int, height_px: int) -> Camera:
    """Return a camera with square pixels and the principal point in the middle of the picture."""
    focal_px = lens.focal_px(width_px)
    return Camera(width_px, height_px, (focal_px, focal_px), (width_px / 2.0, height_px / 2.0))


def camera_to_json(camera: Camera) -> dict[str, Any]:
    return {
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "focal_px": list(camera.focal_px),
        "principal_px": list(camera.principal_px),
        "camera_from_world": camera.camera_from_world.tolist(),
    }


def camera_from_json(document: dict[str, Any], where: str = "camera") -> Camera:
    try:
        (fx, fy), (cx, cy) = document["focal_px"], document["principal_px"]
        pose = np.asarray(document["camera_from_world"], np.float64)
        return Camera(
            width_px=int(document["width_px"]),
            height_px=int(document["height_px"]),
            focal_px=(float(fx), float(fy)),
            principal_px=(float(cx), float(cy)),
            camera_from_world=pose,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{where}: expected width_px, height_px, focal_px, principal_px and camera_from_world ({error!r})") from None


def level_plane_dioptres(camera: Camera, y_m: float = 0.0) -> Float32[np.ndarray, "height width"]:
    """Return (H, W) 1 / depth along the optical axis of the world plane y = y_m at every pixel; 0 where it is not seen.

    Up is -y. On a plane 1 / depth is linear in the pixel's position, so it is finite up to the horizon and beyond. Any pose is allowed.
    """
    turn, eye_y_m = camera.world_from_camera[1, :3], float(camera.world_from_camera[1, 3])
    below_m = y_m - eye_y_m
    if below_m == 0.0:
        return np.zeros((camera.height_px, camera.width_px), np.float32)
    # How far down a ray goes that is 1 long along the axis: of its column, and of its row.
    x = (np.arange(camera.width_px) + 0.5 - camera.principal_px[0]) / camera.focal_px[0] * turn[0]
    y = (np.arange(camera.height_px) + 0.5 - camera.principal_px[1]) / camera.focal_px[1] * turn[1] + turn[2]
    dioptres = (y / below_m).astype(np.float32)[:, None] + (x / below_m).astype(np.float32)
    return np.maximum(dioptres, 0.0, out=dioptres)

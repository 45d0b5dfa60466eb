"""Camera: an undistorted pinhole with a pose; where world points land in the picture and back."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from mrbokeh.system.errors import InputError

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
        return np.linalg.inv(self.camera_from_world)

    def project(self, points_m: Float[np.ndarray, "*batch 3"]) -> tuple[Float[np.ndarray, "*batch 2"], Float[np.ndarray, "*batch"]]:
        """World points to (pixel positions, depth in metres along the optical axis)."""
        in_camera = points_m @ self.camera_from_world[:3, :3].T + self.camera_from_world[:3, 3]
        depth_m = in_camera[..., 2]
        return in_camera[..., :2] / depth_m[..., None] * self.focal_px + self.principal_px, depth_m

    def unproject(self, xy_px: Float[np.ndarray, "*batch 2"], depth_m: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch 3"]:
        """Pixel positions at a depth (metres along the optical axis) to world points: the inverse of `project`."""
        plane = (xy_px - np.asarray(self.principal_px)) / np.asarray(self.focal_px)
        in_camera = np.concatenate([plane, np.ones_like(plane[..., :1])], axis=-1) * depth_m[..., None]
        world_from_camera = self.world_from_camera
        return in_camera @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]

    def pixel_centres_px(self) -> Float[np.ndarray, "height width 2"]:
        """(H, W, 2): the x, y position of each pixel's centre."""
        x, y = np.meshgrid(np.arange(self.width_px) + 0.5, np.arange(self.height_px) + 0.5)
        return np.stack([x, y], axis=-1)

    def resized(self, width_px: int, height_px: int) -> "Camera":
        """The same view sampled with another number of pixels."""
        scale = np.array([width_px / self.width_px, height_px / self.height_px])
        fx, fy = np.asarray(self.focal_px) * scale
        cx, cy = np.asarray(self.principal_px) * scale
        return Camera(width_px, height_px, (float(fx), float(fy)), (float(cx), float(cy)), self.camera_from_world)


def have_same_shape(size_px: tuple[int, int], other_px: tuple[int, int], within: float = _SAME_SHAPE) -> bool:
    """Whether (width, height) of two pictures are of one shape, up to the rounding to whole or even pixels."""
    return abs(size_px[0] * other_px[1] / (size_px[1] * other_px[0]) - 1.0) <= within


def depth_m_from_zbuffer(zbuffer: Float[np.ndarray, "*batch"], near_m: float, far_m: float) -> Float[np.ndarray, "*batch"]:
    """An OpenGL depth buffer in [0, 1] to metres along the optical axis; 1 (nothing drawn) becomes inf."""
    depth_m = near_m * far_m / (far_m - zbuffer * (far_m - near_m))
    return np.where(zbuffer >= 1.0, np.inf, depth_m)

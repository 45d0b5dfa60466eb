"""Pictures of a tracking board through a thin lens with a round opening, exact but for sampling: the truth for focus from blur.

Through each point of the opening a pinhole sees the plane of the board by a homography; the sensor adds them up where the plane in
focus stays put. A ray from the lens's point L through Q meets the plane in focus (depth d_f) above the pixel's direction
(Q - L) / Q_z + L / d_f, by similar triangles.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from mrbokeh.images.color import linear_to_srgb
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import MM_PER_M, Lens
from mrbokeh.tracking.charuco.board import CharucoBoard, black_rectangles_mm

DARK, LIGHT, TABLE = 0.03, 0.75, 0.3
_RIM_MM = 10.0
_OVER = 3


@dataclass(frozen=True)
class Shot:
    """rng: of the noise of the sensor, None for none."""

    lens: Lens
    camera: Camera
    noise: float = 0.0
    rng: np.random.Generator | None = None


def camera_over(board: CharucoBoard, lens: Lens, width_px: int, height_px: int, distance_m: float, tilt_deg: float) -> Camera:
    """Looks at the middle of the board from so far away, tilted about the picture's x axis; 0 is straight down."""
    middle = np.array([*board.size_mm, 0.0]) / 2.0 / MM_PER_M
    angle = np.radians(tilt_deg)
    rotation = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, np.array([0.0, 0.0, distance_m]) - rotation @ middle
    focal_px = lens.focal_px(width_px)
    return Camera(width_px, height_px, (focal_px, focal_px), (width_px / 2, height_px / 2), pose)


def board_texture(board: CharucoBoard, per_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """(linear luminance, the place in metres on the board of texture coordinates (x, y, 1), by a 3x3 matrix)."""
    width, height = (int(round((size + 2 * _RIM_MM) * per_mm)) for size in board.size_mm)
    texture = np.full((height, width), LIGHT, np.float32)
    for x, y, across, down in black_rectangles_mm(board):
        left, top = (round((place + _RIM_MM) * per_mm) for place in (x, y))
        right, bottom = (round((place + _RIM_MM) * per_mm) for place in (x + across, y + down))
        texture[top:bottom, left:right] = DARK
    metre = 1.0 / (per_mm * MM_PER_M)
    return texture, np.array([[metre, 0, -_RIM_MM / MM_PER_M], [0, metre, -_RIM_MM / MM_PER_M], [0, 0, 1.0]])


def disc_points(count: int) -> np.ndarray:
    """Evenly over the unit disc: Vogel's spiral (1979)."""
    numbers = np.arange(count) + 0.5
    angles = numbers * np.pi * (3.0 - np.sqrt(5.0))
    return np.sqrt(numbers / count)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def photograph(board: CharucoBoard, shot: Shot, rays: int = 96) -> np.ndarray:
    """Linear luminance (H, W)."""
    camera, lens = shot.camera, shot.lens
    texture, metres_from_texture = board_texture(board, per_mm=4.0)
    # Texture and fine picture count from the corner of their first pixel, OpenCV from its centre.
    corner_from_centre = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    fine = np.diag([_OVER, _OVER, 1.0])
    width, height = camera.width_px * _OVER, camera.height_px * _OVER
    matrix = np.array([[camera.focal_px[0], 0, camera.principal_px[0]], [0, camera.focal_px[1], camera.principal_px[1]], [0, 0, 1.0]])
    pose = camera.camera_from_world
    total = np.zeros((height, width), np.float32)
    for u, v in disc_points(rays) * lens.aperture_diameter_mm / 2.0 / MM_PER_M:
        shift = np.array([[1, 0, u / lens.focus_distance_m], [0, 1, v / lens.focus_distance_m], [0, 0, 1.0]])
        plane = np.column_stack([pose[:3, 0], pose[:3, 1], pose[:3, 3] - np.array([u, v, 0.0])])
        homography = np.linalg.inv(corner_from_centre) @ fine @ matrix @ shift @ plane @ metres_from_texture @ corner_from_centre
        total += cv2.warpPerspective(texture, homography, (width, height), flags=cv2.INTER_LINEAR, borderValue=TABLE)
    picture = cv2.resize(total / rays, (camera.width_px, camera.height_px), interpolation=cv2.INTER_AREA)
    return picture if shot.rng is None else picture + shot.rng.normal(0.0, shot.noise, picture.shape).astype(np.float32)


def display_bgr(picture: np.ndarray) -> np.ndarray:
    codes = np.round(255 * np.clip(linear_to_srgb(picture), 0, 1)).astype(np.uint8)
    return np.repeat(codes[..., None], 3, axis=2)

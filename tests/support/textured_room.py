"""A room of a floor and two walls with speckled paper, drawn from any pose by rays through the pixels: pictures to localise in."""

import cv2
import numpy as np

from mrbokeh.optics.camera import Camera
from mrbokeh.tracking.world_axes import inverted, rigid

WIDTH_PX, HEIGHT_PX, FOCAL_PX = 400, 300, 380.0
_TEXTURE_PX = 1024
_PER_M = 256.0


def room_camera(place_m: tuple[float, float, float], look_at_m: tuple[float, float, float] = (0.0, 0.0, 3.0)) -> Camera:
    """x right, y down, z into the room, whose corner is at (1.5, 0.8, 3.5)."""
    forward = np.asarray(look_at_m) - np.asarray(place_m)
    forward = forward / np.linalg.norm(forward)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right = right / np.linalg.norm(right)
    world_from_camera = rigid(np.column_stack([right, np.cross(forward, right), forward]), np.asarray(place_m, np.float64))
    return Camera(WIDTH_PX, HEIGHT_PX, (FOCAL_PX, FOCAL_PX), (WIDTH_PX / 2, HEIGHT_PX / 2), inverted(world_from_camera))


def paper(seed: int) -> np.ndarray:
    """Speckles of several sizes, 8 bits."""
    rng = np.random.default_rng(seed)
    total = np.zeros((_TEXTURE_PX, _TEXTURE_PX), np.float32)
    for cells in (32, 96, 256, 512):
        noise = rng.normal(size=(cells, cells)).astype(np.float32)
        total += cv2.resize(noise, (_TEXTURE_PX, _TEXTURE_PX), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 45 * total, 0, 255).astype(np.uint8)


PAPERS = [paper(seed) for seed in range(3)]


def picture(camera: Camera) -> np.ndarray:
    """Grey, 8 bits; four rays for each pixel."""
    fine = camera.resized(2 * camera.width_px, 2 * camera.height_px)
    size_px, origin = (fine.width_px, fine.height_px), camera.world_from_camera[:3, 3].astype(np.float32)
    right, down = ((np.arange(n) + 0.5 - middle) / f for n, middle, f in zip(size_px, fine.principal_px, fine.focal_px, strict=True))
    rays = [(x * right + (y * down + z)[:, None]).astype(np.float32) for x, y, z in fine.world_from_camera[:3, :3]]
    best, grey = np.full(size_px[::-1], np.inf, np.float32), np.zeros(size_px[::-1], np.uint8)
    for texture, axis, place, across in zip(PAPERS, (0, 1, 2), (1.5, 0.8, 3.5), ((1, 2), (0, 2), (0, 1)), strict=True):
        with np.errstate(divide="ignore", invalid="ignore"):
            far = (np.float32(place) - origin[axis]) / rays[axis]
        nearer = (far > 0) & (far < best)
        hit = np.where(nearer, far, np.float32(0.0))
        x, y = (_PER_M * (origin[one] + hit * rays[one]) + np.float32(_TEXTURE_PX / 2) for one in across)
        seen = cv2.remap(texture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        grey, best = np.where(nearer, seen, grey), np.where(nearer, far, best)
    return cv2.resize(grey, (camera.width_px, camera.height_px), interpolation=cv2.INTER_AREA)


def similarity(to: np.ndarray, start: np.ndarray) -> tuple[float, np.ndarray]:
    """(scale, rotation) that take places (n, 3) to others best, about their means (Umeyama 1991)."""
    to, start = to - to.mean(axis=0), start - start.mean(axis=0)
    u, sizes, vt = np.linalg.svd(to.T @ start)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return float((sizes * np.diag(flip)).sum() / (start**2).sum()), u @ flip @ vt

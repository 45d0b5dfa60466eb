"""Rooms, streets and tables of textured boxes, projected through a known pinhole and kept as JPEG: pictures whose camera is known."""

from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from scipy.spatial.transform import Rotation

from mrbokeh.images.color import srgb_to_linear

KINDS = ("room", "street", "table")
FULL_FRAME_MM = 36.0
LENSES_MM = (24.0, 35.0, 50.0)
_NEAR_M = 0.05


@dataclass
class Place:
    """A picture under way. camera_from_world: rotation of world axes (right, down, forward) into the camera's; the eye is at the origin."""

    focal_px: float
    width_px: int
    height_px: int
    camera_from_world: np.ndarray
    rng: np.random.Generator
    codes: UInt8[np.ndarray, "height width 3"] = field(init=False)

    def __post_init__(self) -> None:
        self.codes = np.full((self.height_px, self.width_px, 3), 200, np.uint8)

    @property
    def down(self) -> np.ndarray:
        return self.camera_from_world[:, 1]

    def colour(self, low: int = 40, high: int = 230) -> tuple[int, int, int]:
        grey = self.rng.uniform(low, high)
        return tuple(int(np.clip(grey + self.rng.normal(0, 20), 0, 255)) for _ in range(3))  # type: ignore[return-value]

    def polygon(self, corners_m: np.ndarray, colour: tuple[int, int, int]) -> None:
        """Draw a convex polygon of world points, cut off where it comes nearer than 5 cm."""
        points = _ahead(np.asarray(corners_m, float) @ self.camera_from_world.T)
        if len(points) < 3:
            return
        xy = points[:, :2] / points[:, 2:] * self.focal_px + [self.width_px / 2, self.height_px / 2] - 0.5
        xy = np.clip(xy, -2e4, 2e4)
        cv2.fillConvexPoly(self.codes, np.round(xy * 16).astype(np.int32), colour, cv2.LINE_AA, 4)

    def face(self, corner: np.ndarray, u: np.ndarray, v: np.ndarray, cells: tuple[int, int], joint: float = 0.04) -> None:
        """Draw a rectangle with cells of another colour, each a little smaller than its place: tiles, windows, panels."""
        self.polygon(np.array([corner, corner + u, corner + u + v, corner + v]), self.colour())
        base = self.rng.uniform(60, 220)
        for i in range(cells[0]):
            for j in range(cells[1]):
                low, high = np.array([i + joint, j + joint]), np.array([i + 1 - joint, j + 1 - joint])
                (a, b), (c, d) = low / cells, high / cells
                grey = int(np.clip(base + self.rng.normal(0, 14), 0, 255))
                corners = np.array([corner + a * u + b * v, corner + c * u + b * v, corner + c * u + d * v, corner + a * u + d * v])
                self.polygon(corners, (grey, grey, int(min(255, grey + 8))))

    def box(self, base: np.ndarray, size: np.ndarray, yaw_rad: float = 0.0, cells: tuple[int, int] = (1, 1)) -> None:
        """Draw the sides and the top of a box that stands on the middle of its base."""
        turn = Rotation.from_rotvec([0, yaw_rad, 0]).as_matrix()
        x, y, z = turn @ [size[0], 0, 0], np.array([0, -size[1], 0.0]), turn @ [0, 0, size[2]]
        low = base - x / 2 - z / 2
        faces = [(low, x, y), (low + z, x, y), (low, z, y), (low + x, z, y), (low + y, x, z)]
        for corner, u, v in sorted(faces, key=lambda each: -float(np.linalg.norm(each[0] + each[1] / 2 + each[2] / 2))):
            self.face(corner, u, v, cells, 0.08)

    def speckle(self, count: int) -> None:
        """Draw small lines and discs that point nowhere: leaves, hair, print."""
        for _ in range(count):
            x, y = self.rng.uniform(0, [self.width_px, self.height_px])
            angle, length = self.rng.uniform(0, np.pi), self.rng.uniform(10, 60)
            if self.rng.uniform() < 0.5:
                end = (int(x + length * np.cos(angle)), int(y + length * np.sin(angle)))
                cv2.line(self.codes, (int(x), int(y)), end, self.colour(), int(self.rng.integers(1, 4)), cv2.LINE_AA)
            else:
                cv2.circle(self.codes, (int(x), int(y)), int(length / 3), self.colour(), -1, cv2.LINE_AA)

    def taken(self) -> UInt8[np.ndarray, "height width 3"]:
        """Return the picture as a camera keeps it: a little soft, noisy, as JPEG of quality 85."""
        soft = cv2.GaussianBlur(self.codes, (0, 0), 0.8).astype(np.float32)
        shade = np.linspace(1.0, self.rng.uniform(0.6, 1.0), self.width_px)[None, :, None]
        noisy = np.clip(soft * shade + self.rng.normal(0, 4, soft.shape), 0, 255).astype(np.uint8)
        return cv2.imdecode(cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, 85])[1], cv2.IMREAD_COLOR)

    def linear(self) -> Float32[np.ndarray, "height width 3"]:
        return srgb_to_linear(self.taken()[..., ::-1].astype(np.float32) / 255.0)


def _ahead(points: np.ndarray) -> np.ndarray:
    kept = []
    for a, b in zip(points, np.roll(points, -1, axis=0), strict=True):
        if a[2] >= _NEAR_M:
            kept.append(a)
        if (a[2] >= _NEAR_M) != (b[2] >= _NEAR_M):
            kept.append(a + (_NEAR_M - a[2]) / (b[2] - a[2]) * (b - a))
    return np.array(kept).reshape(-1, 3)


def place(kind: str, seed: int, lens_mm: float | None = None, width_px: int = 1500) -> Place:
    """Return a picture of a kind of place by a lens, full frame, held within 4 degrees of level.

    Streets are seen at 8 degrees at least from their own direction: straight along it, lines hardly tell the focal length.
    """
    rng = np.random.default_rng(seed)
    lens_mm = lens_mm or LENSES_MM[seed % 3]
    yaw = rng.choice([-1, 1]) * (rng.uniform(8, 25) if kind == "street" else rng.uniform(15, 40))
    pitch = {"room": rng.uniform(-14, 6), "street": rng.uniform(-5, 14), "table": rng.uniform(-38, -20)}[kind]
    world_from_camera = Rotation.from_euler("YXZ", [yaw, pitch, rng.uniform(-4, 4)], degrees=True).as_matrix()
    made = Place(lens_mm / FULL_FRAME_MM * width_px, width_px, width_px * 2 // 3, world_from_camera.T, rng)
    {"room": _room, "street": _street, "table": _table}[kind](made)
    return made


def _vectors(*rows: tuple[float, float, float]) -> list[np.ndarray]:
    return [np.array(row, float) for row in rows]


def _room(made: Place) -> None:
    rng, eye_m = made.rng, made.rng.uniform(1.3, 1.7)
    wide, deep, high = rng.uniform(4, 6), rng.uniform(6, 9), rng.uniform(2.5, 3.2)
    low, x, y, z = _vectors((-wide / 2, eye_m, -1.5), (wide, 0, 0), (0, -high, 0), (0, 0, deep))
    made.face(low + y, x, z, (1, 1))
    made.face(low, x, z, (int(rng.integers(6, 14)), int(rng.integers(8, 16))), 0.03)
    for corner, side in ((low, z), (low + x, z), (low + z, x)):
        made.face(corner, side, y, (1, 1))
        for k in range(int(rng.integers(1, 4))):
            at, size, up, tall = (0.1 + 0.3 * k) * side, rng.uniform(0.12, 0.22) * side, rng.uniform(0, 0.4) * y, rng.uniform(0.3, 0.5) * y
            made.face(corner + at + up, size, tall, (int(rng.integers(1, 4)), int(rng.integers(1, 4))), 0.06)
    for far in np.sort(rng.uniform(1.8, deep - 2.2, int(rng.integers(2, 6))))[::-1]:
        turned = 0.0 if rng.uniform() < 0.5 else rng.uniform(0, np.pi)
        made.box(np.array([rng.uniform(-wide / 3, wide / 3), eye_m, far]), rng.uniform(0.3, 1.0, 3), turned, (1, int(rng.integers(1, 4))))
    made.speckle(40)


def _street(made: Place) -> None:
    rng, eye_m = made.rng, 1.6
    made.polygon(np.array([[-60, eye_m, 0], [60, eye_m, 0], [60, eye_m, 200], [-60, eye_m, 200]]), (110, 112, 115))
    half = rng.uniform(5, 8)
    for near in 3.0 + 6.0 * np.arange(12):
        stripe = [[-0.1, eye_m, near], [0.1, eye_m, near], [0.1, eye_m, near + 3], [-0.1, eye_m, near + 3]]
        made.polygon(np.array(stripe), (230, 230, 230))
    blocks = [(side, float(z), rng.uniform(6, 14)) for side in (-1, 1) for z in np.arange(0, 70, 15)]
    made.face(np.array([-half - 12, eye_m, 90.0]), np.array([2 * half + 24, 0, 0]), np.array([0, -14.0, 0]), (9, 5), 0.2)
    for side, z, high in sorted(blocks, key=lambda each: -each[1]):
        floors = int(high // 3)
        made.face(np.array([side * half, eye_m, z]), np.array([side * 12.0, 0, 0]), np.array([0, -high, 0]), (4, floors), 0.25)
        made.face(np.array([side * half, eye_m, z]), np.array([0, 0, 13.0]), np.array([0, -high, 0]), (5, floors), 0.25)
    for far in np.sort(rng.uniform(6, 40, 5))[::-1]:
        made.box(np.array([rng.uniform(-half + 1, half - 1), eye_m, far]), np.array([1.6, 1.4, 3.5]), rng.normal(0, 0.3), (2, 2))
    made.speckle(60)


def _table(made: Place) -> None:
    rng, eye_m = made.rng, made.rng.uniform(0.45, 0.7)
    wide = rng.uniform(1.4, 2.2)
    made.face(np.array([-4.0, eye_m + 0.7, 4.0]), np.array([8.0, 0, 0]), np.array([0, -3.0, 0]), (8, 2), 0.03)
    made.face(np.array([-wide / 2, eye_m, 0.1]), np.array([wide, 0, 0]), np.array([0, 0, 1.6]), (1, int(rng.integers(5, 10))), 0.02)
    for far in np.sort(rng.uniform(0.6, 1.4, int(rng.integers(5, 9))))[::-1]:
        turned = 0.0 if rng.uniform() < 0.65 else rng.uniform(0, np.pi)
        size = np.array([rng.uniform(0.08, 0.3), rng.uniform(0.05, 0.3), rng.uniform(0.08, 0.25)])
        made.box(np.array([rng.uniform(-wide / 3, wide / 3), eye_m, far]), size, turned, (int(rng.integers(1, 3)), int(rng.integers(1, 4))))
    made.speckle(30)

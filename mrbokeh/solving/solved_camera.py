"""SolvedCamera: focal length, turn and height of a camera as one picture tells them, with standard deviations, and its file.

The world stands upright: x right, y down, z forward; the ground is the plane y = 0, below the camera.
"""

from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from mrbokeh.optics.camera import Camera, level_plane_dioptres
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError

GUESSED_HEIGHT_M = 1.5
HIGH, FAIR, LOW = "high", "fair", "low"
KNOWN, SOLVED, GUESSED = "known", "solved", "guessed"
_POINTED_PX, _MOST_LEAN = 2.0, 0.36
_EXPECTED = "a camera of `mrbokeh capture solve`"


@dataclass(frozen=True)
class SolvedCamera:
    """Camera of one picture.

    focal_length_source: known (told beforehand), solved, or guessed; camera_height_source: known or guessed. solved_focal_length_px: what
    the segments alone say, also where the focal length was known; None if they do not tell. camera_from_world: (3, 3) rotation; its second
    column is down. segments_by_direction: how many segments point along x, y and z; 0: not found. confidence: high, fair or low.
    distortion_percent: how much farther out the lens shows what is in the corners, negative: nearer, as far as lines tell; the camera
    itself is the pinhole without it. assumed: what was taken for granted, in sentences. segments_px: (N, 4) x and y of both ends, and
    axes: (N,) 0, 1, 2 or -1, for pictures.
    """

    width_px: int
    height_px: int
    focal_length_px: float
    focal_length_source: str
    camera_from_world: Float64[np.ndarray, "3 3"]
    focal_length_sd_px: float = 0.0
    roll_sd_deg: float = 0.0
    pitch_sd_deg: float = 0.0
    solved_focal_length_px: float | None = None
    solved_focal_length_sd_px: float | None = None
    segments_by_direction: dict[str, int] = field(default_factory=dict)
    distortion_percent: float = 0.0
    confidence: str = LOW
    camera_height_m: float = GUESSED_HEIGHT_M
    camera_height_source: str = GUESSED
    sensor_width_mm: float | None = None
    assumed: tuple[str, ...] = ()
    segments_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)), compare=False, repr=False)
    axes: np.ndarray = field(default_factory=lambda: np.zeros(0, int), compare=False, repr=False)

    @property
    def principal_point_px(self) -> tuple[float, float]:
        """Return the middle of the picture, which is assumed."""
        return (self.width_px / 2.0, self.height_px / 2.0)

    @property
    def focal_length_mm(self) -> float | None:
        return None if self.sensor_width_mm is None else self.focal_length_px * self.sensor_width_mm / self.width_px

    @property
    def focal_length_35mm(self) -> float:
        """Return the focal length in mm of the same view on full frame, by the diagonal."""
        return self.focal_length_px * float(np.hypot(36.0, 24.0) / np.hypot(self.width_px, self.height_px))

    @property
    def roll_deg(self) -> float:
        """Return how far the camera is turned clockwise about its axis: the horizon rises to the right."""
        return float(np.degrees(np.arctan2(self.camera_from_world[0, 1], self.camera_from_world[1, 1])))

    @property
    def pitch_deg(self) -> float:
        """Return how far the camera looks up; negative: down."""
        return -float(np.degrees(np.arcsin(np.clip(self.camera_from_world[2, 1], -1.0, 1.0))))

    @property
    def horizon_px(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the (x, y) of the horizon at the left and right edge of the picture; y may lie outside of it."""
        right, down, ahead = self.camera_from_world[:, 1]
        (middle_x, middle_y), down = self.principal_point_px, max(abs(down), 1e-9) * (1.0 if down >= 0.0 else -1.0)
        left_y, right_y = (middle_y - (right * (x - middle_x) + ahead * self.focal_length_px) / down for x in (0.0, float(self.width_px)))
        return (0.0, float(left_y)), (float(self.width_px), float(right_y))

    def disagreement(self) -> str:
        """Return in words how the known focal length and that of the lines differ, "" up to 2 standard deviations or 5 %."""
        own, sd_px = self.solved_focal_length_px, self.solved_focal_length_sd_px
        if self.focal_length_source != KNOWN or own is None or sd_px is None:
            return ""
        off_px = abs(own - self.focal_length_px)
        if off_px <= 2.0 * sd_px or off_px <= 0.05 * self.focal_length_px:
            return ""
        return f"the lines say {own:.0f} +- {sd_px:.0f} px, but {self.focal_length_px:.0f} px are stated"

    def of_sensor(self, width_mm: float | None) -> "SolvedCamera":
        """Return the camera with the width of its sensor along the rows of the picture, None if it is unknown."""
        return replace(self, sensor_width_mm=width_mm)

    def resized(self, width_px: int, height_px: int) -> "SolvedCamera":
        """Return the camera of the same picture in another size; its sizes in pixels go by the width."""
        factor, own, own_sd = width_px / self.width_px, self.solved_focal_length_px, self.solved_focal_length_sd_px
        return replace(
            self,
            width_px=width_px,
            height_px=height_px,
            focal_length_px=factor * self.focal_length_px,
            focal_length_sd_px=factor * self.focal_length_sd_px,
            solved_focal_length_px=None if own is None else factor * own,
            solved_focal_length_sd_px=None if own_sd is None else factor * own_sd,
            segments_px=factor * self.segments_px,
        )

    def camera(self) -> Camera:
        """Return the pinhole, which stands camera_height_m above the world's origin."""
        pose = np.eye(4)
        pose[:3, :3] = self.camera_from_world
        pose[:3, 3] = self.camera_from_world @ [0.0, self.camera_height_m, 0.0]
        focal_px = (self.focal_length_px, self.focal_length_px)
        return Camera(self.width_px, self.height_px, focal_px=focal_px, principal_px=self.principal_point_px, camera_from_world=pose)

    def ground_depth(self, height_px: int, width_px: int) -> Float32[np.ndarray, "height width"]:
        """Return (H, W) depth of the ground in metres along the optical axis, inf above the horizon, for a picture of that size."""
        dioptres = level_plane_dioptres(self.camera().resized(width_px, height_px))
        with np.errstate(divide="ignore"):
            return (np.float32(1.0) / dioptres).astype(np.float32)

    def standing(self, height_m: float) -> "SolvedCamera":
        """Return the camera at a known height above the ground."""
        if not 0.0 < height_m < np.inf:
            raise InputError(f"expected the height of the camera above the ground in metres, above 0, got {height_m:g}")
        return replace(self, camera_height_m=float(height_m), camera_height_source=KNOWN)

    def with_length(self, ends_px: tuple[float, float, float, float], metres: float) -> "SolvedCamera":
        """Return the camera at the height for which two pixels of the ground, x1, y1, x2, y2, are so many metres apart."""
        if not 0.0 < metres < np.inf:
            raise InputError(f"expected a length on the ground in metres, above 0, got {metres:g}")
        in_world = self._rays_in_world(ends_px)
        if in_world[:, 1].min() <= 1e-6:
            raise InputError(
                f"expected both ends of a length on the ground below the horizon, but {ends_px} reaches above it: give other pixels"
            )
        on_plane = in_world / in_world[:, 1:2]
        apart = float(np.linalg.norm(on_plane[0] - on_plane[1]))
        if apart == 0.0:
            raise InputError(f"expected a length between two pixels, but {ends_px} is one: give two")
        return self.standing(metres / apart)

    def with_height(self, ends_px: tuple[float, float, float, float], metres: float) -> "SolvedCamera":
        """Return the camera at the height for which something upright is so many metres high: x1, y1, x2, y2 of its foot on the ground and
        of its top, in either order.
        """
        if not 0.0 < metres < np.inf:
            raise InputError(f"expected the height of something upright in metres, above 0, got {metres:g}")
        in_world = self._rays_in_world(ends_px)
        top, foot = in_world[np.argsort(in_world[:, 1] / np.linalg.norm(in_world, axis=1))]
        if foot[1] <= 1e-6:
            raise InputError(
                f"expected the foot of something upright on the ground, below the horizon, but {ends_px} lies above it: give other pixels"
            )
        level, foot = [0, 2], foot / foot[1]
        # The top stands over the foot: where its ray is nearest to the vertical there, for a camera 1 m above the ground.
        reach = float(top[level] @ foot[level]) / max(float(top[level] @ top[level]), 1e-12)
        risen = 1.0 - reach * float(top[1])
        aside = float(np.linalg.norm(reach * top[level] - foot[level]))
        if reach <= 0.0 or risen <= 1e-3 or aside > _MOST_LEAN * risen:
            raise InputError(
                f"expected the top of something upright above its foot, but {ends_px} is a point or leans by more than 20 degrees: give "
                f"the pixels of its foot and of its top, and check how the camera was held"
            )
        return self.standing(metres / risen)

    def height_off_m(self, ends_px: tuple[float, float, float, float], metres: float, *, upright: bool) -> float:
        """Return the standard deviation of a camera's height by `with_length` or `with_height`: for ends that are 2 px off, and the
        camera's own pitch.
        """

        def height_m(camera: "SolvedCamera", ends: np.ndarray) -> float:
            made = camera.with_height if upright else camera.with_length
            try:
                return made((float(ends[0]), float(ends[1]), float(ends[2]), float(ends[3])), metres).camera_height_m
            except InputError:
                return float("inf")

        ends, tilt = np.array(ends_px), np.radians(self.pitch_sd_deg)
        turn = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(tilt), np.sin(tilt)], [0.0, -np.sin(tilt), np.cos(tilt)]])
        tilted = replace(self, camera_from_world=turn @ self.camera_from_world)
        moved = [height_m(self, ends + shift) for shift in _POINTED_PX * np.eye(4)]
        return float(np.linalg.norm(np.array([*moved, height_m(tilted, ends)]) - height_m(self, ends)))

    def _rays_in_world(self, ends_px: tuple[float, float, float, float]) -> Float64[np.ndarray, "2 3"]:
        rays = np.array([[*(np.array(end) - self.principal_point_px) / self.focal_length_px, 1.0] for end in (ends_px[:2], ends_px[2:])])
        return np.asarray(rays @ self.camera_from_world, np.float64)


def camera_document(camera: SolvedCamera) -> dict[str, Any]:
    """Return what a file keeps: plain keys with units."""
    left, right = camera.horizon_px
    stored = {each.name: getattr(camera, each.name) for each in fields(camera) if each.name not in ("segments_px", "axes")}
    derived = {
        "principal_point_px": list(camera.principal_point_px),
        "focal_length_mm": camera.focal_length_mm,
        "focal_length_35mm": camera.focal_length_35mm,
        "roll_deg": camera.roll_deg,
        "pitch_deg": camera.pitch_deg,
        "horizon_px": [list(left), list(right)],
    }
    return stored | derived | {"camera_from_world": camera.camera_from_world.tolist(), "assumed": list(camera.assumed)}


def write_solved_camera(path: Path | str, camera: SolvedCamera) -> None:
    write_json(path, camera_document(camera))


def read_solved_camera(path: Path | str) -> SolvedCamera:
    """Read the camera that `mrbokeh capture solve` wrote, without its segments. Raises InputError if it is another file."""
    document = read_json(path, _EXPECTED)
    names = [each.name for each in fields(SolvedCamera) if each.name not in ("segments_px", "axes")]
    missing = [name for name in names if name not in document] if isinstance(document, dict) else names
    if missing:
        raise InputError(f"expected {_EXPECTED} at {path}, but it lacks {', '.join(missing[:4])}: solve the picture again")
    values = {name: document[name] for name in names}
    try:
        rotation = np.asarray(values["camera_from_world"], np.float64)
        camera = SolvedCamera(**values | {"camera_from_world": rotation, "assumed": tuple(values["assumed"])})
        sound = camera.width_px > 0 and camera.height_px > 0 and camera.focal_length_px > 0.0 and camera.camera_height_m > 0.0
        if rotation.shape != (3, 3) or not sound or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4):
            raise ValueError("its sizes are not above 0, or its camera_from_world is no rotation")
    except (TypeError, ValueError) as error:
        raise InputError(f"expected {_EXPECTED} at {path}, but {error}: solve the picture again") from None
    return camera

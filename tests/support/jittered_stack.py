"""A small traced focal stack of a camera that moved a little between its slices, with the true transforms."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from capture.merging.registration.plane_transforms import Transform, about_centre, chained, farthest_corner_px, inverse, moved
from datasets_scripts.scenes.desk import desk_camera
from datasets_scripts.tracers.thin_lens import trace
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from tests.support.traced_focal_stack import still_life

WIDTH_PX, HEIGHT_PX = 320, 214
SLICES = 6
NEAREST_M, FARTHEST_M = 0.7, 2.0
LENS = Lens(35.0, 2.0, NEAREST_M, 23.5)
SAMPLES = 16
JITTER_PX, JITTER_RAD = 1.2, np.deg2rad(0.03)


@dataclass(frozen=True)
class JitteredStack:
    """slices: (H, W, 3) each; first_from_slice: where their pixels belong in an unmoved slice 0; image_distances: of the thin lens."""

    slices: tuple[np.ndarray, ...]
    first_from_slice: tuple[np.ndarray, ...]
    image_distances: tuple[float, ...]

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height)."""
        return self.slices[0].shape[1], self.slices[0].shape[0]

    def errors_px(self, reference: int, reference_from_slice: tuple[np.ndarray, ...]) -> list[float]:
        """How far off each slice's worst corner is, in the geometry of the reference."""
        back = inverse(self.first_from_slice[reference])
        truth = [chained(back, each) for each in self.first_from_slice]
        return [farthest_corner_px(a, b, *self.size_px) for a, b in zip(reference_from_slice, truth, strict=True)]


@cache
def jittered_stack(
    jitter_px: float = JITTER_PX,
    jitter_rad: float = JITTER_RAD,
    size_px: tuple[int, int] = (WIDTH_PX, HEIGHT_PX),
    count: int = SLICES,
    samples: int = SAMPLES,
    turn_rad: float = 0.0,
) -> JitteredStack:
    """The camera shifts by up to jitter_px right and down and rolls by up to jitter_rad between slices.

    turn_rad: by how much it turns to the side from slice to slice, about its pupil.
    """
    rng = np.random.default_rng(3)
    scene, slices, transforms = still_life(), [], []
    lenses = [LENS.focused_at(float(1.0 / each)) for each in np.linspace(1.0 / NEAREST_M, 1.0 / FARTHEST_M, count)]
    for index, lens in enumerate(lenses):
        movement = _movement(rng.uniform(-jitter_rad, jitter_rad), rng.uniform(-jitter_px, jitter_px, 2), size_px)
        camera = _turned_camera(desk_camera(0, *size_px, lens), index * turn_rad)
        slices.append(trace(scene, _moved_camera(camera, movement), lens, samples, 50 + index))
        movement = chained(movement, _turn(camera, index * turn_rad))
        breathing = about_centre(LENS.image_distance_mm / lens.image_distance_mm, *size_px)
        transforms.append(chained(breathing, inverse(movement)))
    return JitteredStack(tuple(slices), tuple(transforms), tuple(lens.image_distance_mm for lens in lenses))


def _turned_camera(camera: Camera, turn_rad: float) -> Camera:
    return replace(camera, camera_from_world=_about_y(turn_rad) @ camera.camera_from_world)


def _turn(camera: Camera, turn_rad: float) -> Transform:
    """What the turn does to the picture: K R K^-1 of the matrix K of the camera."""
    (focal_x, focal_y), (x, y) = camera.focal_px, camera.principal_px
    matrix = np.array([[focal_x, 0.0, x], [0.0, focal_y, y], [0.0, 0.0, 1.0]])
    turned = matrix @ _about_y(turn_rad)[:3, :3] @ np.linalg.inv(matrix)
    return np.asarray(turned / turned[2, 2]) if turn_rad else np.eye(2, 3)


def _about_y(turn_rad: float) -> np.ndarray:
    turn = np.eye(4)
    turn[:3, :3] = [[np.cos(turn_rad), 0.0, np.sin(turn_rad)], [0.0, 1.0, 0.0], [-np.sin(turn_rad), 0.0, np.cos(turn_rad)]]
    return turn


def _moved_camera(camera: Camera, movement: Transform) -> Camera:
    """A roll turns the camera about its axis, a shift moves the principal point."""
    roll = np.eye(4)
    roll[:2, :2] = movement[:, :2]
    principal_px = moved(movement, np.array([camera.principal_px]))[0]
    return replace(camera, camera_from_world=roll @ camera.camera_from_world, principal_px=(float(principal_px[0]), float(principal_px[1])))


def _movement(roll_rad: float, shift_px: np.ndarray, size_px: tuple[int, int]) -> Transform:
    """What the roll about the centre and then the shift do to the picture."""
    turn = np.array([[np.cos(roll_rad), -np.sin(roll_rad)], [np.sin(roll_rad), np.cos(roll_rad)]])
    centre = 0.5 * np.asarray(size_px)
    return np.column_stack([turn, centre - turn @ centre + shift_px])

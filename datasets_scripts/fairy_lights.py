"""Fairy lights for a traced scene: small lamps on the surfaces that the viewpoints see, far enough apart to be told apart."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy import ndimage

from datasets_scripts.thin_lens_tracer import trace_pinhole
from datasets_scripts.traced_scene import DiscLight, Scene
from mrbokeh.optics.camera import Camera

LIGHTS_PER_VIEW = 12

_TINTS = ((1.0, 0.72, 0.36), (1.0, 0.86, 0.62), (0.55, 0.75, 1.0), (1.0, 0.45, 0.3), (0.6, 1.0, 0.55))
_RADIANCE = (1.0, 2.6)
_RADIUS_M_AT_1_M = (1.8e-3, 2.6e-3)
_GAP_M = 0.008
_SMOOTH_DIOPTRES = 0.12
_LEAST_DISTANCE_SHARE = 0.05
_ATTEMPTS = 60


@dataclass(frozen=True)
class _View:
    """A viewpoint at low resolution: where its lamps may be hung."""

    camera: Camera
    depth_m: Float32[np.ndarray, "height width"]

    @property
    def candidates(self) -> Int[np.ndarray, "pixels 2"]:
        """(row, column) of pixels away from depth edges and from the border."""
        dioptres = 1.0 / self.depth_m
        span = ndimage.maximum_filter(dioptres, 5) - ndimage.minimum_filter(dioptres, 5)
        inner = np.zeros(dioptres.shape, bool)
        inner[6:-6, 6:-6] = True
        return np.argwhere(inner & (span < _SMOOTH_DIOPTRES))

    def point_before_m(self, row: int, column: int) -> Float[np.ndarray, "3"]:
        """Just before the surface under a pixel: a lamp far from what it is seen against could not be merged with it."""
        xy_px = np.array([column + 0.5, row + 0.5])
        point_m = self.camera.unproject(xy_px, np.array(float(self.depth_m[row, column])))
        towards = self.camera.world_from_camera[:3, 3] - point_m
        return point_m + _GAP_M * towards / np.linalg.norm(towards)


def fairy_lights(scene: Scene, cameras: Sequence[Camera], rng: np.random.Generator) -> Iterator[DiscLight]:
    """LIGHTS_PER_VIEW lamps hung in the sight of each camera, spread evenly over its dioptres.

    A lamp that would come within 5 % of the picture's width of another in any view is hung elsewhere.
    """
    views = [_View(camera, trace_pinhole(scene, camera, 1)[1]) for camera in cameras]
    hung_m: list[Float[np.ndarray, "3"]] = []
    for number, view in enumerate(views):
        for index, members in enumerate(_ranges_of_depth(view)):
            for row, column in members[rng.permutation(len(members))[:_ATTEMPTS]]:
                point_m = view.point_before_m(int(row), int(column))
                if all(_apart(point_m, hung_m, each.camera) for each in views):
                    hung_m.append(point_m)
                    tint = np.asarray(_TINTS[(index + number) % len(_TINTS)])
                    radius_m = rng.uniform(*_RADIUS_M_AT_1_M) * max(float(view.depth_m[row, column]), 0.8)
                    yield DiscLight(_triple(point_m), float(radius_m), _triple(tint * rng.uniform(*_RADIANCE)))
                    break


def _ranges_of_depth(view: _View) -> Iterator[Int[np.ndarray, "pixels 2"]]:
    """The candidates in LIGHTS_PER_VIEW equal ranges of dioptres."""
    pixels = view.candidates
    dioptres = 1.0 / view.depth_m[pixels[:, 0], pixels[:, 1]]
    number = np.floor((dioptres - dioptres.min()) / (np.ptp(dioptres) * (1 + 1e-6)) * LIGHTS_PER_VIEW).astype(int)
    return (pixels[number == each] for each in range(LIGHTS_PER_VIEW))


def _apart(point_m: Float[np.ndarray, "3"], others_m: Sequence[Float[np.ndarray, "3"]], camera: Camera) -> bool:
    """No other lamp is near in this camera's picture."""
    if not others_m:
        return True
    xy_px, _ = camera.project(np.stack([point_m, *others_m]))
    return bool(np.hypot(*(xy_px[1:] - xy_px[0]).T).min() >= _LEAST_DISTANCE_SHARE * camera.width_px)


def _triple(vector: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])

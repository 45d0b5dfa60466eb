"""Pictures of a printed sheet on a table, ray-traced through a thin lens: every edge of the print is exact, not a texture.

The sheet lies in the plane z = 0, x right, y down, z into the table (board axes of OpenCV); a camera above it has z < 0.
A ray leaves a pixel through a point of the round pupil and the focus plane (Cook et al. 1984), as in `thin_lens_tracer`.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64

from datasets_scripts.tracers._sheet_numba import PackedLens, PackedTable, shade
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import MM_PER_M, Lens


@dataclass(frozen=True)
class Sheet:
    """A printed sheet. black_mm: (N, 4) x, y, width, height, without overlap. margin_mm: white paper around. paper, ink: reflectances."""

    black_mm: Float64[np.ndarray, "rectangles 4"]
    margin_mm: float = 12.0
    paper: float = 0.62
    ink: float = 0.03

    @property
    def middle_m(self) -> Float64[np.ndarray, "3"]:
        ends = self.black_mm[:, :2] + self.black_mm[:, 2:]
        return np.append((self.black_mm[:, :2].min(axis=0) + ends.max(axis=0)) / 2.0, 0.0) / MM_PER_M


def trace_sheet(
    table: PackedTable, camera: Camera, lens: Lens | None, samples: int, seed: int = 0
) -> Float32[np.ndarray, "height width 3"]:
    """Return scene-linear RGB. lens: None is a pinhole; else its focus and aperture blur, while the geometry is that of the camera.

    samples: rays per pixel, Sobol points that every pixel shifts by its own vector.
    """
    from scipy.stats import qmc

    rng = np.random.default_rng(seed)
    points = qmc.Sobol(4, scramble=True, rng=rng).random_base2(int(np.ceil(np.log2(samples))))[:samples]
    rgb = np.empty((camera.height_px, camera.width_px, 3), np.float32)
    radius_m, focus_m = (0.0, 1.0) if lens is None else (lens.aperture_diameter_mm / 2.0 / MM_PER_M, lens.focus_distance_m)
    intrinsics = np.array(camera.focal_px), np.array(camera.principal_px)
    shade(table, PackedLens(camera.world_from_camera, *intrinsics, radius_m, focus_m), points, rng.random((*rgb.shape[:2], 4)), rgb)
    return rgb


def with_noise(rgb: Float[np.ndarray, "height width 3"], noise: float, rng: np.random.Generator) -> Float32[np.ndarray, "height width 3"]:
    """Add noise. noise: standard deviation at radiance 1; photons make it fall with the root, read noise adds a tenth of it."""
    sigma = noise * np.sqrt(np.maximum(rgb, 0.0) + 0.01)
    return (rgb + sigma * rng.standard_normal(rgb.shape)).astype(np.float32)

"""A small ray tracer whose lens, occlusion and depth are exact: the truth for photographs made with it and for lens-blur renderers.

A ray leaves pixel position p through lens point u (unit pupil, camera axes x right, y down) and meets, in the focus plane,
the point that a pinhole at the lens centre sees through p (Cook et al. 1984, Distributed Ray Tracing; thin lens). So a point
behind the focus plane is displaced by u times half the signed circle of confusion, a point in front the other way.
A pixel is the mean radiance over its footprint and the pupil: no vignetting, no bellows factor, no loss in the glass.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32

from datasets_scripts._scene_packing import pack_scene, pack_view, pupil_areas
from datasets_scripts._thin_lens_tracer_numba import PackedView, shade_picture, trace_depth
from datasets_scripts.traced_scene import Scene
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError

_LENS_DIFFERS = 1e-3
_LEAST_DRAWN = 32  # so that no pixel of a thin ring is left without a ray
_PINHOLE_PUPIL = Aperture((np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]),), (1.0,))


@dataclass(frozen=True)
class _Samples:
    """Low-discrepancy points: pixel x, y and pupil x, y in [0, 1); light_points serve lights sampled on their own."""

    points: Float[np.ndarray, "samples 4"]
    light_points: Float[np.ndarray, "light_samples 4"]


def camera_for_lens(camera: Camera, lens: Lens) -> Camera:
    """The camera with the focal length in pixels that the focused lens really has (focus breathing, square pixels)."""
    focal_px = lens.focal_px(camera.width_px)
    return replace(camera, focal_px=(focal_px, focal_px))


def trace(
    scene: Scene, camera: Camera, lens: Lens, samples: int, seed: int = 0, footprint_px: float = 1.0
) -> Float32[np.ndarray, "height width 3"]:
    """Scene-linear RGB (H, W, 3) through the lens.

    samples: rays per pixel that pass the aperture (on average).
    camera: its focal_px must be that of the lens as focused (see `camera_for_lens`), else blur and geometry would disagree.
    footprint_px: side of the square that a pixel averages; above 1 it stands for an optical low-pass filter.
    """
    expected_px = lens.focal_px(camera.width_px)
    if max(abs(focal / expected_px - 1.0) for focal in camera.focal_px) > _LENS_DIFFERS:
        raise InputError(
            f"the camera has a focal length of {camera.focal_px} px, but the lens focused at {lens.focus_distance_m} m "
            f"has {expected_px:.3f} px: use camera_for_lens(camera, lens)"
        )
    view = pack_view(camera, lens.aperture, 0.5e-3 * lens.aperture_diameter_mm, 1.0 / lens.focus_distance_m, footprint_px)
    return _shaded(scene, camera, view, samples, seed)


def trace_pinhole(
    scene: Scene, camera: Camera, samples: int, seed: int = 0, footprint_px: float = 1.0
) -> tuple[Float32[np.ndarray, "height width 3"], Float32[np.ndarray, "height width"]]:
    """(RGB averaged over each pixel's footprint, depth in metres along the axis at each pixel's centre) from the middle of the lens."""
    view = pack_view(camera, _PINHOLE_PUPIL, 0.0, 0.0, footprint_px)
    depth_m = np.empty((camera.height_px, camera.width_px), np.float32)
    trace_depth(pack_scene(scene, camera, view), view, depth_m)
    return _shaded(scene, camera, view, samples, seed), depth_m


def _shaded(scene: Scene, camera: Camera, view: PackedView, samples: int, seed: int) -> Float32[np.ndarray, "height width 3"]:
    if samples < 1:
        raise InputError(f"expected at least 1 sample per pixel, got {samples}")
    packed = pack_scene(scene, camera, view)
    drawn = _draw_samples(view, samples, seed)
    rgb = np.empty((view.height, view.width, 3), np.float32)
    shade_picture(packed, view, drawn.points, drawn.light_points, seed, rgb)
    return rgb


def _draw_samples(view: PackedView, samples: int, seed: int) -> _Samples:
    """Scrambled Sobol points; every pixel later shifts them by its own vector (Cranley and Patterson 1976).

    Points of the square around the pupil that miss it are dropped while tracing, so more are drawn than asked for.
    """
    from scipy.stats import qmc

    covered = pupil_areas(view).max() / (2.0 * view.pupil_extent) ** 2
    count = max(int(np.ceil(samples / covered)), _LEAST_DRAWN)
    sobol = qmc.Sobol(4, scramble=True, rng=np.random.default_rng(seed))
    points = sobol.random_base2(int(np.ceil(np.log2(count))))
    return _Samples(points[:count], points[: max(samples // 4, 16)])

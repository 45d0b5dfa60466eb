"""Textured planes, moving and out of focus, met by rays through the lens and the shutter in closed form: truth for reconstruction.

A plane in space has a circle of confusion that is linear over the picture, c(x0) = c + g.x0 (one over its depth is), and
what lies on it at x0 (seen from the middle of the pupil at half time) appears at x0 + c(x0)/2 uv + motion (t - 1/2).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import qmc

from mrbokeh.layering.light_field_samples import LightFieldSamples
from mrbokeh.optics.lens import Lens

LENS = Lens(focal_length_mm=50.0, f_number=0.7, focus_distance_m=0.5, sensor_width_mm=12.0)
Picture = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Plane:
    """colour: from x0, y0 (N,) to (N, 3). covers: to bool (N,), None is everywhere. coc_px: in the middle of the picture."""

    colour: Picture
    coc_px: float = 0.0
    gradient: tuple[float, float] = (0.0, 0.0)
    motion_px: tuple[float, float] = (0.0, 0.0)
    covers: Picture | None = None


def sample_planes(planes: Sequence[Plane], size_px: int, per_pixel: int, seed: int = 0, lens: Lens = LENS) -> LightFieldSamples:
    """The planes, front first. Each pixel gets one Sobol sequence over area, pupil and shutter, shifted by chance."""
    rng = np.random.default_rng(seed)
    unit = qmc.Sobol(5, seed=rng).random(per_pixel)[None] + rng.uniform(size=(size_px * size_px, 1, 5))
    unit = (unit - (unit >= 1.0)).reshape(-1, 5)
    rows, columns = np.repeat(np.indices((size_px, size_px)).reshape(2, -1), per_pixel, axis=1)
    xy_px = np.column_stack([columns, rows]) + unit[:, :2]
    radius, angle = np.sqrt(unit[:, 2]), 2.0 * np.pi * unit[:, 3]
    uv, time = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)]), unit[:, 4]
    rgb, coc_px, motion_px = np.zeros((len(unit), 3)), np.zeros(len(unit)), np.zeros((len(unit), 2))
    free = np.arange(len(unit))
    for plane in planes:
        at = _met_at_px(plane, xy_px[free], uv[free], time[free], 0.5 * size_px)
        covered = np.ones(len(free), bool) if plane.covers is None else plane.covers(at[:, 0], at[:, 1])
        hit, at, free = free[covered], at[covered], free[~covered]
        rgb[hit] = plane.colour(at[:, 0], at[:, 1])
        coc_px[hit] = plane.coc_px + (at - 0.5 * size_px) @ np.array(plane.gradient)
        motion_px[hit] = plane.motion_px
    depth_m = 1.0 / (1.0 / lens.focus_distance_m - coc_px / lens.coc_px_per_dioptre(size_px))
    arrays = (xy_px, uv, time, rgb, depth_m, motion_px)
    return LightFieldSamples(size_px, size_px, *(values.astype(np.float32) for values in arrays))


def _met_at_px(plane: Plane, xy_px: np.ndarray, uv: np.ndarray, time: np.ndarray, middle_px: float) -> np.ndarray:
    """x0 of x = x0 + (c + g.(x0 - middle))/2 uv + m (t - 1/2): linear in x0, solved by Sherman and Morrison's formula."""
    rest = xy_px - middle_px - 0.5 * plane.coc_px * uv - (time - 0.5)[:, None] * np.array(plane.motion_px)
    slope = 0.5 * np.array(plane.gradient)
    return middle_px + rest - uv * ((rest @ slope) / (1.0 + uv @ slope))[:, None]


def truth(planes: Sequence[Plane], size_px: int, per_pixel: int = 1024, lens: Lens = LENS) -> np.ndarray:
    """The mean of many samples a pixel, in parts, (H, W, 3)."""
    part = 64
    parts = [
        sample_planes(planes, size_px, part, seed, lens).raw_picture().astype(np.float64) for seed in range(1000, 1000 + per_pixel // part)
    ]
    return np.mean(parts, axis=0).astype(np.float32)


def checker(cell_px: float, dark: float = 0.1, bright: float = 0.9, angle_rad: float = 0.0) -> Picture:
    def colour(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        along, across = x * np.cos(angle_rad) + y * np.sin(angle_rad), y * np.cos(angle_rad) - x * np.sin(angle_rad)
        odd = (np.floor(along / cell_px) + np.floor(across / cell_px)) % 2
        return np.where(odd[:, None] > 0, dark, bright) * np.array([1.0, 0.9, 0.7])

    return colour


def waves(period_px: float, angle_rad: float = 0.4) -> Picture:
    """A smooth texture of three waves, one for each colour, from 0.1 to 0.9."""

    def colour(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        angles = angle_rad + np.array([0.0, 1.0, 2.1])
        phase = 2.0 * np.pi / period_px * (x[:, None] * np.cos(angles) + y[:, None] * np.sin(angles))
        return 0.5 + 0.4 * np.sin(phase)

    return colour


def even(value: float) -> Picture:
    return lambda x, _: np.full((len(x), 3), value)


def fence(pitch_px: float, bar_px: float) -> Picture:
    return lambda x, y: ((x + y) % pitch_px < bar_px) | ((x - y) % pitch_px < bar_px)


def half_plane(border_px: float) -> Picture:
    return lambda x, _: x < border_px


def fence_scene(size_px: int) -> list[Plane]:
    """After Hasselgren Fig. 8: a fence out of focus before a checkerboard that moves and a slanted one that stands still."""
    moving = Plane(checker(12.0, angle_rad=0.3), 3.0, motion_px=(14.0, 9.0), covers=half_plane(0.55 * size_px))
    slanted = Plane(checker(16.0, 0.05, 0.8), 2.0, gradient=(0.04, 0.02))
    return [Plane(even(0.35), -14.0, covers=fence(40.0, 6.0)), moving, slanted]

"""Settings of layered reconstruction."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mrbokeh.system.errors import InputError

ScreenFilter = Literal["windows", "sheared", "texture", "texture_one_tap", "direct"]
SCREEN_FILTERS: tuple[ScreenFilter, ...] = ("windows", "sheared", "texture", "texture_one_tap", "direct")
_LEAST_SIGMA_PX = float(np.sqrt(1.0 / 12.0))
_MOST_PARTS = 16


@dataclass(frozen=True)
class Settings:
    """Settings, whose defaults are the paper's where it names one, else what measured best (tests/bench/bench_layered_reconstruction.py).

    tile_px: side of a tile, a power of two from 4 to 256.
    coc_step_px, near_coc_px: depth buckets take equal steps of the circle of confusion up to near_coc_px on both sides of the focus.
    depth_buckets: and the range of depth is cut into so many equal buckets everywhere.
    motion_step_px: samples at one depth are told apart by cells of motion of this side; inf leaves that to depth alone.
    bandwidth: how many standard deviations of the slopes within a partition the filter's passband spans; larger trusts fewer
      samples from elsewhere.
    sigma_x_px: the spatial filter, at least that of a pixel (0.289); larger hides streaks and loses sharpness (Fig. 9).
    sparse_statistics: statistics from one sample in 3 x spp, picked stratified in Morton order; else from all.
    merge: put buckets together whose common filter is at most the share merge_tolerance narrower than that of any of them (the paper
      has 0.1), and, beyond the paper, what the next two say.
    faint: buckets that can hide no more than this share of what lies behind them, and are no brighter, join the partition of the
      nearest slopes; 0 for none.
    part_tolerance: parts of pupil and shutter are filtered on their own only where what they add to the whole has more detail, as a
      share of what is there, than pixels of 4 px can hold; 0 for everywhere. Of samples; layers are always rendered in parts.
    screen_filter: "windows" (not the paper's: pupil and shutter in their true shapes), or a Gaussian in their place: "sheared"
      (recursive along x, Eq. 9 and 10), "texture" (mip map, anisotropic, four taps), "texture_one_tap", "direct" (slow).
    recursive_passes: of Eq. 10, which share the variance; 1 is the paper's double exponential, more come nearer to a Gaussian.
    tap_distance: d of the four taps (Fig. 4). energy: share of the Gaussian within the footprint of a look-up (Eq. 3).
    enough: a reprojected place weighs at most as much as this many samples; inf lets all count, as in the paper.
    support: how many standard deviations the guard band of a tile holds.
    motion: False leaves motion out (defocus only).
    pupil_parts, shutter_parts: cells across the pupil (their square in all) and stretches of the shutter. Layers hide one another
      by their opacities within each part alone ("windows" only); 1 and 1 are the paper's.
    """

    tile_px: int = 32
    coc_step_px: float = 0.5
    near_coc_px: float = 64.0
    depth_buckets: int = 128
    motion_step_px: float = 16.0
    bandwidth: float = 1.0
    sigma_x_px: float = 0.33
    sparse_statistics: bool = True
    merge: bool = True
    merge_tolerance: float = 0.07
    faint: float = 0.01
    part_tolerance: float = 0.0125
    screen_filter: ScreenFilter = "windows"
    recursive_passes: int = 2
    tap_distance: float = 0.33
    energy: float = 0.95
    enough: float = 0.5
    support: float = 3.0
    motion: bool = True
    pupil_parts: int = 3
    shutter_parts: int = 3

    def __post_init__(self) -> None:
        if self.tile_px not in (4, 8, 16, 32, 64, 128, 256):
            raise InputError(f"tile_px must be a power of two from 4 to 256, got {self.tile_px}")
        if not (self.coc_step_px > 0 and self.near_coc_px >= 0 and self.depth_buckets >= 1):
            raise InputError(
                f"depth buckets need a positive coc_step_px, near_coc_px of at least 0 and depth_buckets of at least 1, "
                f"got {self.coc_step_px}, {self.near_coc_px}, {self.depth_buckets}"
            )
        if not self.sigma_x_px >= _LEAST_SIGMA_PX:
            raise InputError(f"sigma_x_px must be at least that of a pixel, {_LEAST_SIGMA_PX:.3f} px, got {self.sigma_x_px}")
        if not self.motion_step_px > 0:
            raise InputError(f"motion_step_px must be above 0 (inf for one cell), got {self.motion_step_px}")
        if self.screen_filter not in SCREEN_FILTERS:
            raise InputError(f"screen_filter must be one of {', '.join(SCREEN_FILTERS)}, got {self.screen_filter!r}")
        if not (0 <= self.merge_tolerance < 1 and 0 < self.energy < 1 and 0 <= self.tap_distance < 1):
            raise InputError(
                f"merge_tolerance, energy and tap_distance are shares from 0 to below 1 (energy above 0), "
                f"got {self.merge_tolerance}, {self.energy}, {self.tap_distance}"
            )
        if not (0 <= self.faint < 1 and self.part_tolerance >= 0):
            raise InputError(
                f"faint is a share from 0 to below 1 and part_tolerance at least 0 (0 merges nothing), "
                f"got {self.faint}, {self.part_tolerance}"
            )
        if not (self.bandwidth >= 0 and self.support >= 1 and self.recursive_passes >= 1):
            raise InputError(
                f"bandwidth must be at least 0, support and recursive_passes at least 1, "
                f"got {self.bandwidth}, {self.support}, {self.recursive_passes}"
            )
        if not (1 <= self.pupil_parts <= _MOST_PARTS and 1 <= self.shutter_parts <= _MOST_PARTS):
            raise InputError(
                f"pupil_parts and shutter_parts must be whole numbers from 1 to {_MOST_PARTS}, got {self.pupil_parts}, {self.shutter_parts}"
            )

    @property
    def parts(self) -> tuple[int, int]:
        """Parts of pupil and shutter as far as they mean anything: a Gaussian has no parts, and without motion time has none."""
        if self.screen_filter != "windows":
            return 1, 1
        return self.pupil_parts, self.shutter_parts if self.motion else 1


def footprint_sigmas(energy: float) -> float:
    """Return alpha of Eq. 3: half the side, in standard deviations, of the square that holds this share of a 2D Gaussian."""
    from scipy.special import erfinv

    return float(np.sqrt(2.0) * erfinv(np.sqrt(energy)))

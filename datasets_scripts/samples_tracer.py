"""Stochastic samples of a moving scene through a thin lens, their converged mean, and the sharp picture in the middle of the exposure.

A ray leaves film point xy through lens point (u, v) of the unit pupil and meets, in the focus plane, what a pinhole in the
middle of the lens sees through xy (Cook et al., Distributed Ray Tracing, SIGGRAPH 1984), with all bodies where they are at
its time. So what it hits at depth Z is displaced in the picture by coc(Z) / 2 * (u, v), coc as `Lens.coc_px` gives it.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from os import cpu_count

import numpy as np
from jaxtyping import Float, Float32, UInt32

from datasets_scripts._samples_bodies_numba import LAMP, RADIANCE, PackedBodies
from datasets_scripts._samples_lamps_numba import follow_lamp, gather_rows
from datasets_scripts._samples_numba import TILE_PX, Pinhole, mean_rows, sample_rows, sharp_rows
from datasets_scripts._samples_random_numba import DIMENSIONS
from datasets_scripts.samples_packing import gathered_lamps, pack, pinhole_of
from datasets_scripts.samples_pupil import lens_table, light_through
from datasets_scripts.samples_scene import MovingScene
from datasets_scripts.truth_sampling import reversed_bits
from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError

WIDEST_PX = 1 << 11
_STREAMS_PER_SEED = 64
_SAMPLES, _REFERENCE, _LAMPS, _SHARP = 0, 1, 2, 3
_GATHERED_SHARE = 4
_FOLLOWED_RAYS = 1024

Advance = Callable[[], object]


def _silent() -> None:
    pass


@dataclass(frozen=True)
class SampleArrays:
    """What the sampler yields, (H, W, spp, ...) float32: the fields of LightFieldSamples before they are put in a row.

    depth_m: along the optical axis at the sample's time, inf where nothing was hit. motion_px: pixels per shutter of the hit
    point in the pinhole picture, averaged from the sample's time to the middle of the exposure (the derivative, exact to first
    order; for what keeps its depth they are the same), so that xy - coc(depth) / 2 * uv - motion * (time - 0.5) is exact.
    """

    xy_px: Float32[np.ndarray, "height width spp 2"]
    lens_uv: Float32[np.ndarray, "height width spp 2"]
    time: Float32[np.ndarray, "height width spp"]
    rgb: Float32[np.ndarray, "height width spp 3"]
    depth_m: Float32[np.ndarray, "height width spp"]
    motion_px: Float32[np.ndarray, "height width spp 2"]


@dataclass(frozen=True)
class SampleTracer:
    """A moving scene seen by a lens; equal seeds give equal bits for any number of threads (0: all cores).

    seed: of the sampling alone; the samples and the reference draw independent numbers.
    """

    scene: MovingScene
    lens: Lens
    width_px: int
    height_px: int
    seed: int = 0
    threads: int = 0

    def __post_init__(self) -> None:
        if not (1 <= self.width_px <= WIDEST_PX and 1 <= self.height_px <= WIDEST_PX):
            raise InputError(f"expected a picture of 1 to {WIDEST_PX} px a side, got {self.width_px}x{self.height_px}")
        if not self.lens.has_flat_focus:
            raise InputError("the stochastic sampler takes lenses with a flat focus: leave tilt and field curvature out")

    @property
    def steps(self) -> int:
        """How often `samples`, `mean` and `sharp` call `advance`."""
        return -(-self.height_px // TILE_PX)

    def samples(self, spp: int, advance: Advance = _silent) -> SampleArrays:
        """spp rays per pixel; lamps are seen by the rays that happen to hit them, as in a path tracer's frame."""
        size = (self.height_px, self.width_px, spp)
        out = SampleArrays(*(np.empty((*size, *more), np.float32) for more in ((2,), (2,), (), (3,), (), (2,))))
        arrays = (out.xy_px, out.lens_uv, out.time, out.rgb, out.depth_m, out.motion_px)
        packed, table, points = self._packed(), lens_table(self.lens.aperture), mirrored_sobol(spp)
        self._run(lambda top: sample_rows(packed, self._view, table, points, self._stream(_SAMPLES), top, *arrays), advance)
        return out

    def mean(self, spp: int, advance: Advance = _silent) -> Float32[np.ndarray, "height width 3"]:
        """The mean over spp rays per pixel (box filter); lamps are sampled on themselves and much better than that."""
        rgb = np.empty((self.height_px, self.width_px, 3))
        packed, table, points = self._packed(), lens_table(self.lens.aperture), mirrored_sobol(spp)
        self._run(lambda top: mean_rows(packed, self._view, table, points, self._stream(_REFERENCE), top, rgb), advance)
        self._add_lamps(packed, spp, rgb)
        return rgb.astype(np.float32)

    def sharp(self, spp: int, advance: Advance = _silent) -> Layer:
        """The pinhole picture at (u, v, t) = (0, 0, 0.5) with motion as the extra channels forward.u (right)
        and forward.v (up, as renderers count).

        Colour and coverage are means over the pixel; depth and motion are those of one surface, met nearest to the pixel's
        centre, or of the lamps where they give over half of the light. Motion is premultiplied by coverage, as extras are.
        """
        size, view = (self.height_px, self.width_px), self._view._replace(pupil_radius=0.0)
        rgba, depth_m, motion_px = np.zeros((*size, 4)), np.empty(size, np.float32), np.empty((*size, 2), np.float32)
        packed, points = pack(self.scene, view, 0.0), mirrored_sobol(spp)
        self._run(lambda top: sharp_rows(packed, view, points, self._stream(_SHARP), top, rgba, depth_m, motion_px), advance)
        extra = {"forward.u": motion_px[..., :1], "forward.v": -motion_px[..., 1:]}
        return Layer(rgba[..., :3].astype(np.float32), np.minimum(rgba[..., 3], 1.0).astype(np.float32), depth_m, extra)

    @property
    def _view(self) -> Pinhole:
        return pinhole_of(self.lens, self.width_px, self.height_px)

    def _packed(self) -> PackedBodies:
        return pack(self.scene, self._view, self.lens.aperture.unit_radius)

    def _stream(self, use: int) -> int:
        return self.seed * _STREAMS_PER_SEED + use * DIMENSIONS

    def _run(self, rows: Callable[[int], None], advance: Advance = _silent) -> None:
        with _executor(self.threads) as pool:
            for _ in pool.map(rows, range(0, self.height_px, TILE_PX)):
                advance()

    def _add_lamps(self, packed: PackedBodies, spp: int, rgb: Float[np.ndarray, "height width 3"]) -> None:
        """What is much blurred from spp / 4 points on each lamp per pixel, the rest from 1024 spp rays of each lamp."""
        outlines, area, view, stream = self.lens.aperture.packed(), light_through(self.lens.aperture), self._view, self._stream(_LAMPS)
        gathered = gathered_lamps(packed, view, area)
        followed = np.flatnonzero((packed.kind == LAMP) & ~gathered)
        points = mirrored_sobol(max(spp // _GATHERED_SHARE, 16))
        if gathered.any():
            self._run(lambda top: gather_rows(packed, view, *outlines, area, gathered, points, stream, top, rgb))
        if len(followed):
            table, points = lens_table(self.lens.aperture), mirrored_sobol(spp * _FOLLOWED_RAYS)

            def follow(lamp: int) -> tuple[slice, slice, np.ndarray]:
                left, top, right, bottom = packed.bounds_px[lamp].clip(0, (self.width_px, self.height_px) * 2).astype(int).tolist()
                light = np.zeros((min(bottom + 1, self.height_px) - top, min(right + 1, self.width_px) - left))
                follow_lamp(packed, view, table, lamp, points, stream, left, top, light)
                return slice(top, top + len(light)), slice(left, left + light.shape[1]), light

            with _executor(self.threads) as pool:
                for lamp, (rows, columns, light) in zip(followed, pool.map(follow, followed.tolist()), strict=True):
                    rgb[rows, columns] += light[..., None] * packed.table[lamp, RADIANCE : RADIANCE + 3]


@contextmanager
def _executor(threads: int) -> Iterator[ThreadPoolExecutor]:
    """Threads that stop early when the block is left by an exception."""
    pool = ThreadPoolExecutor(threads or cpu_count() or 1)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def mirrored_sobol(count: int) -> UInt32[np.ndarray, "count 5"]:
    """The first points of the five-dimensional Sobol sequence as 32-bit fractions with their bits in reverse order."""
    from scipy.stats import qmc

    if count < 1:
        raise InputError(f"expected at least 1 sample per pixel, got {count}")
    points = qmc.Sobol(DIMENSIONS, scramble=False, bits=32).random_base2((count - 1).bit_length())[:count]
    return reversed_bits(np.round(points * 2.0**32).astype(np.uint64).astype(np.uint32))

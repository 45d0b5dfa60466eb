"""Camera rays for path tracing: any focal lengths, any principal point, many rays in each of some pixels."""

from collections.abc import Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from jaxtyping import Float, Int64

from mrbokeh.optics.camera import Camera
from mrbokeh.scene.mitsuba.paths import Seen
from mrbokeh.system.console import track

_RAYS_AT_ONCE = 1 << 20


class CameraRays:
    """Rays through pixels, `samples` in each (rounded up to a grid), computed from the intrinsics themselves.

    Mitsuba's own cameras know square pixels only; and so no picture has to be resampled.
    """

    def __init__(self, camera: Camera, centre_m: Float[np.ndarray, "3"], samples: int) -> None:
        self._sampler = mi.load_dict({"type": "multijitter", "sample_count": samples})
        self.samples = int(self._sampler.sample_count())
        world_from_camera = camera.world_from_camera
        eye_m = world_from_camera[:3, 3] - centre_m
        numbers = [*(1.0 / np.asarray(camera.focal_px)), *camera.principal_px, *world_from_camera[:3, :3].ravel(), *eye_m]
        self._numbers, self._width_px = mi.Float(np.array(numbers, np.float32)), camera.width_px
        self._width_per_m = dr.opaque(mi.Float, (camera.focal_px[0] * camera.focal_px[1] * self.samples) ** -0.5)

    def parts(self, pixels: Int64[np.ndarray, " pixels"], seed: int, description: str | None) -> Iterator[tuple[Any, Any, Any, Any]]:
        """(origin, direction, width of what a ray stands for at one metre, sampler) for as many pixels as are traced at once.

        description: for a progress bar, if there are several parts; None shows none.
        """
        at_once = max(1, _RAYS_AT_ONCE // self.samples)
        starts = range(0, len(pixels), at_once)
        for number in track(starts, description) if description and len(starts) > 1 else starts:
            part = pixels[number : number + at_once]
            sampler = self._sampler.clone()
            sampler.set_samples_per_wavefront(self.samples)
            sampler.seed(seed * 0x10001 + number // at_once, self.samples * len(part))
            yield (*self._rays(part, sampler), self._width_per_m, sampler)

    def _rays(self, pixels: Int64[np.ndarray, " pixels"], sampler: Any) -> tuple[Any, Any]:
        lane = dr.arange(mi.UInt32, self.samples * len(pixels))
        pixel = dr.gather(mi.UInt32, mi.UInt32(pixels.astype(np.uint32)), lane // dr.opaque(mi.UInt32, self.samples))
        width, within = dr.opaque(mi.UInt32, self._width_px), sampler.next_2d()
        fx, fy, cx, cy, *rest = (dr.gather(mi.Float, self._numbers, mi.UInt32(entry)) for entry in range(16))
        row = pixel // width
        x, y = (mi.Float(pixel - row * width) + within.x - cx) * fx, (mi.Float(row) + within.y - cy) * fy
        towards = mi.Vector3f(*(rest[3 * axis] * x + rest[3 * axis + 1] * y + rest[3 * axis + 2] for axis in range(3)))
        return mi.Point3f(*rest[9:]), dr.normalize(towards)

    def means(self, seen: Seen) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """(share that stands (pixels,), radiance, albedo, normal (pixels, 3)): means over the rays of each pixel."""
        stands = dr.select(seen.stands, mi.Float(1.0), 0.0)
        share, *rest = self.sums(stands, *seen.radiance, *seen.albedo, *seen.normal)
        means = np.stack(rest, axis=-1) / np.float32(self.samples)
        return share / np.float32(self.samples), means[:, :3], means[:, 3:6], means[:, 6:]

    def sums(self, *values: Any) -> list[np.ndarray]:
        """Sums of numbers over the rays of each pixel."""
        count = max(dr.width(value) for value in values)
        values = tuple(mi.Float(value) + dr.zeros(mi.Float, count) for value in values)
        dr.eval(*values)  # together: else the paths are traced again for each of them
        sums = [dr.block_sum(value, self.samples) for value in values]
        dr.eval(sums)
        return [np.array(each) for each in sums]

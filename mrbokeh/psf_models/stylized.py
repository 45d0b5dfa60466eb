"""STYLIZED: any picture as a point spread function, a little larger or smaller in each colour (Leimkuehler 2018, Section 5.1)."""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Float64

from mrbokeh.optics.psf import kernel_radius_px
from mrbokeh.optics.psf_bank import Axis, Turns
from mrbokeh.psf_models.base import Kernel, check_positive, digest, nodes, sobol_blocks
from mrbokeh.system.errors import InputError

if TYPE_CHECKING:
    from scipy.sparse import csr_array

EXPONENT = 1.5
SAMPLES = 200
LARGEST_PX = 480.0
"""Largest diameter, which with the chromatic scale of red fits the paper's 512 pixels."""
CHROMATIC = (0.05, 0.0, -0.05)
_LARGEST_PICTURE_PX = 512
_STEP_PX = 0.5
_LEAST_PX = 1e-6


class Stylized:
    """Picture, light where light falls, scaled with the circle of confusion; in front of the focus turned by half a turn.

    picture: (H, W, 3) scene-linear, >= 0, every colour with some light; averaged down to 512 pixels where it is larger. The
    centroid of its light (of all colours) is where an unblurred point lies, the farthest lit corner of a pixel lies at the
    radius of the circle of confusion. Each colour keeps its energy: the picture's tint shifts over the blur, white stays white.
    chromatic: (r, g, b), each in (-1, 1); a colour's blur is 1 + that as large (on both sides of the focus: it is a style).
    diameter_px: the largest of the bank. counts: samples, 200 in the paper's Table 1.
    """

    name = "stylized"
    knee_px: float | None = None
    turns: Turns = "none"
    near_side_turned = True
    channels = 3
    default_rays = 0

    def __init__(
        self,
        picture: Float[np.ndarray, "height width 3"],
        diameter_px: float = LARGEST_PX,
        counts: tuple[int, ...] = (SAMPLES,),
        chromatic: tuple[float, float, float] = CHROMATIC,
        device: str = "",
    ) -> None:
        self.device = device
        if not all(abs(share) < 1.0 for share in chromatic):
            raise InputError(f"the chromatic scales of a stylized PSF are three numbers within (-1, 1), got {chromatic}")
        self.axes = (Axis("diameter_px", 0.0, check_positive("the largest diameter of a stylized PSF", diameter_px), EXPONENT),)
        self.counts = counts
        self.scales = tuple(1.0 + share for share in chromatic)
        self._light = _light_of(picture)
        self._origin, self._unit = _settled(self._light)

    @property
    def settings(self) -> dict[str, Any]:
        return {"picture": digest(self._light), "scales": list(self.scales)}

    def kernel(self, box: Float64[np.ndarray, "axes 2"], rays: int, seed: int) -> Kernel:
        """See `PsfModel.kernel`."""
        low, high = float(box[0, 0]), float(box[0, 1])
        size = self._size(high)
        if rays:
            return self._traced(low, high, size, rays, seed).astype(np.float32)
        places = nodes(self.axes[0], low, high, _STEP_PX)
        total = np.zeros((size, size, 3))
        for place in places.tolist():
            total += self._closed_form(place, size) / len(places)
        return total.astype(np.float32)

    def exact(self, coords: Float64[np.ndarray, " axes"]) -> Kernel:
        """Return the picture with its pixels as squares of even light, cut up by the pixels of the kernel."""
        diameter_px = abs(float(coords[0]))
        return self._closed_form(diameter_px, self._size(diameter_px)).astype(np.float32)

    def _size(self, diameter_px: float) -> int:
        return 2 * kernel_radius_px(diameter_px * max(self.scales)) + 1

    def _closed_form(self, diameter_px: float, size: int) -> Float64[np.ndarray, "size size 3"]:
        kernel = np.empty((size, size, 3))
        for channel, scale in enumerate(self.scales):
            px = 0.5 * max(diameter_px * scale, _LEAST_PX) * self._unit
            height, width = self._light.shape[:2]
            rows, columns = (_shares(count, origin, px, size) for count, origin in zip((height, width), self._origin[::-1], strict=True))
            kernel[..., channel] = (columns @ (rows @ self._light[..., channel]).T).T
        return kernel

    def _traced(self, low: float, high: float, size: int, rays: int, seed: int) -> Float64[np.ndarray, "size size 3"]:
        trace = _tracer(self.device)
        kernel = np.zeros((3, size, size))
        for channel, scale in enumerate(self.scales):
            light = self._light[..., channel]
            rows = np.concatenate([[0.0], np.cumsum(light.sum(axis=1))])
            columns = np.pad(np.cumsum(light, axis=1), ((0, 0), (1, 0)))
            columns /= np.where(columns[:, -1:] > 0.0, columns[:, -1:], 1.0)
            places = (self._origin, self._unit, rows / rows[-1], columns)
            blocks = sobol_blocks(3, rays, seed, self.device)
            kernel[channel] /= sum(trace(kernel[channel], low * scale, high * scale, block, *places) for block in blocks)
        return kernel.transpose(1, 2, 0)


def _tracer(device: str) -> Callable[..., float]:
    if device:
        from mrbokeh.psf_models.torch_tracing import trace_picture as trace_on

        return partial(trace_on, device)
    from mrbokeh.psf_models._lens_points_numba import trace_picture

    return trace_picture


def _shares(count: int, origin: float, px: float, size: int) -> "csr_array":
    """Return the share of each of `count` source pixels, `px` wide, in each of `size` pixels (size, count); `origin` is in the middle."""
    from scipy.sparse import csr_array

    edges = (np.arange(count + 1) - origin) * px
    pixels = np.arange(size + 1) - 0.5 * size
    overlap = np.minimum(edges[1:], pixels[1:, None]) - np.maximum(edges[:-1], pixels[:-1, None])
    return csr_array(np.clip(overlap, 0.0, None) / px)


def _light_of(picture: Float[np.ndarray, "height width 3"]) -> Float64[np.ndarray, "height width 3"]:
    """Return the picture in float64, at most 512 pixels wide and high, each colour with a sum of 1."""
    import cv2

    if not (np.isfinite(picture).all() and picture.min() >= 0.0 and (picture.max(axis=(0, 1)) > 0.0).all()):
        raise InputError("a stylized PSF needs a picture of finite values from 0 up, with some light in each of red, green and blue")
    shrink = max(1.0, max(picture.shape[:2]) / _LARGEST_PICTURE_PX)
    light = picture.astype(np.float64)
    if shrink > 1.0:
        height, width = (max(1, round(length / shrink)) for length in picture.shape[:2])
        light = np.asarray(cv2.resize(light, (width, height), interpolation=cv2.INTER_AREA), np.float64)
    return light / light.sum(axis=(0, 1))


def _settled(light: Float64[np.ndarray, "height width 3"]) -> tuple[Float64[np.ndarray, "2"], float]:
    """Return (centroid of the light (x, y) in pixels, pupil radii per pixel so that the farthest corner of a lit pixel lies at 1)."""
    total = light.sum(axis=2) / 3.0
    height, width = total.shape
    origin = np.array([total.sum(axis=0) @ (np.arange(width) + 0.5), total.sum(axis=1) @ (np.arange(height) + 0.5)])
    y, x = np.nonzero(total)
    reach = np.hypot(np.abs(x + 0.5 - origin[0]) + 0.5, np.abs(y + 0.5 - origin[1]) + 0.5).max()
    return origin, 1.0 / float(reach)

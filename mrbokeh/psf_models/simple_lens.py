"""SIMPLELENS and STYLIZED: models whose only coordinate is the circle of confusion (Leimkuehler 2018, Section 5.1).

The one is a thin lens with any opening, the other any picture as a point spread function, a little larger or smaller in each colour.
"""

from collections.abc import Callable, Mapping
from functools import cached_property, partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Float64, Int64

from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.psf import kernel_radius_px
from mrbokeh.optics.psf_bank import Axis, Turns
from mrbokeh.psf_models.base import Kernel, centred, check_positive, digest, nodes, sobol_blocks
from mrbokeh.system.errors import InputError

if TYPE_CHECKING:
    from scipy.sparse import csr_array

STYLIZED_EXPONENT = 1.5
STYLIZED_SAMPLES = 200
LARGEST_STYLIZED_PX = 480.0
"""Largest diameter, which with the chromatic scale of red fits the paper's 512 pixels."""
CHROMATIC = (0.05, 0.0, -0.05)
_LARGEST_PICTURE_PX = 512
_STYLIZED_STEP_PX = 0.5
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
        diameter_px: float = LARGEST_STYLIZED_PX,
        counts: tuple[int, ...] = (STYLIZED_SAMPLES,),
        chromatic: tuple[float, float, float] = CHROMATIC,
        device: str = "",
    ) -> None:
        self.device = device
        if not all(abs(share) < 1.0 for share in chromatic):
            raise InputError(f"the chromatic scales of a stylized PSF are three numbers within (-1, 1), got {chromatic}")
        self.axes = (Axis("diameter_px", 0.0, check_positive("the largest diameter of a stylized PSF", diameter_px), STYLIZED_EXPONENT),)
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
        places = nodes(self.axes[0], low, high, _STYLIZED_STEP_PX)
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
        trace = _stylized_tracer(self.device)
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


def _stylized_tracer(device: str) -> Callable[..., float]:
    if device:
        from mrbokeh.psf_models.torch_tracing import trace_picture as trace_on

        return partial(trace_on, device)
    from mrbokeh.psf_models._rays_numba import trace_picture

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


EXPONENT = 2.0
SAMPLES = 100
LARGEST_PX = 512.0
_BANDS = 256
_STEP_PX = 0.25
"""Diameters of the closed form lie so near to one another when it is averaged: edges move by an eighth of a pixel."""


class SimpleLens:
    """Opening of a thin lens, as large as the circle of confusion: shift-invariant, one coordinate.

    aperture: its spherical aberration and axial colour make the sides of the focus differ, then diameters are signed; what
    varies over the field (cat's eyes, lateral colour) needs a model with an eccentricity.
    diameter_px: the largest of the bank. counts: samples, 100 (twice as many where diameters are signed) in the paper's Table 1.
    lens: what has this opening, if that is known (`mrbokeh.optics.lens_file.stated_facts`).
    """

    name = "simple"
    knee_px: float | None = None
    turns: Turns = "none"
    default_rays = 0

    def __init__(
        self,
        aperture: Aperture | None = None,
        diameter_px: float = LARGEST_PX,
        counts: tuple[int, ...] | None = None,
        device: str = "",
        lens: Mapping[str, Any] | None = None,
    ) -> None:
        self.device, self.lens = device, lens
        self.aperture = Aperture.disc() if aperture is None else aperture
        if self.aperture.varies_over_field:
            raise InputError(
                "a simple lens looks the same all over the frame: give a lens without cat_eye, rims and lateral_chromatic, or trace a "
                "prescription by `lens psf physical`"
            )
        self._signed = not self.aperture.is_plain
        largest = check_positive("the largest diameter of a simple lens", diameter_px)
        self.axes = (Axis("diameter_px", -largest if self._signed else 0.0, largest, EXPONENT),)
        self.counts = counts or ((2 * SAMPLES,) if self._signed else (SAMPLES,))
        self.channels = 3 if self.aperture.is_chromatic else 1

    @cached_property
    def near_side_turned(self) -> bool:
        """Return whether the near side is the far side turned; not if diameters are signed, or half a turn maps the opening to itself."""
        behind = self.aperture.rasterize(64.0).kernel
        return not self._signed and not np.allclose(behind, behind[::-1, ::-1], atol=1e-9)

    @property
    def settings(self) -> dict[str, Any]:
        opening = self.aperture
        modifiers = np.array([opening.spherical_aberration, *opening.axial_chromatic])
        made_for = {} if self.lens is None else {"lens": dict(self.lens)}
        return made_for | {"aperture": digest(*opening.outlines, np.array(opening.weights), modifiers)}

    def kernel(self, box: Float64[np.ndarray, "axes 2"], rays: int, seed: int) -> Kernel:
        """See `PsfModel.kernel`. Rays go through all of the pupil, evenly, and carry the weight that the opening has there."""
        low, high = float(box[0, 0]), float(box[0, 1])
        size = self._size(max(abs(low), abs(high)))
        total = np.zeros((size, size, self.channels))
        for part_low, part_high in _sides(low, high):
            share = 1.0 if high == low else (part_high - part_low) / (high - low)
            if rays:
                total += share * self._traced(part_low, part_high, size, max(1, round(rays * share)), seed)
            else:
                places = nodes(self.axes[0], part_low, part_high, _STEP_PX)
                total += share * sum(centred(self._closed_form(place), size) for place in places.tolist()) / len(places)
        return np.maximum(total, 0.0).astype(np.float32)

    def exact(self, coords: Float64[np.ndarray, " axes"]) -> Kernel:
        """Return the opening's polygons clipped against pixels (`Aperture.rasterize`)."""
        return self.kernel(np.stack([coords, coords], axis=1), 0, 0)

    def _size(self, largest_px: float) -> int:
        return 2 * kernel_radius_px(largest_px * max(self._scales(1) + self._scales(-1)), self.aperture.unit_radius) + 1

    def _scales(self, side: int) -> tuple[float, ...]:
        return self.aperture.channel_scale(side) if self.channels == 3 else (1.0,)

    def _closed_form(self, diameter_px: float) -> Float64[np.ndarray, "size size channels"]:
        kernels = [self.aperture.rasterize(diameter_px * scale).kernel for scale in self._scales(1 if diameter_px >= 0.0 else -1)]
        size = max(map(len, kernels))
        return np.stack([centred(kernel, size) for kernel in kernels], axis=2)

    def _traced(self, low: float, high: float, size: int, rays: int, seed: int) -> Float64[np.ndarray, "size size channels"]:
        trace, side = _tracer(self.device), 1 if low + high >= 0.0 else -1
        extent = self.aperture.unit_radius
        opening = (extent, *banded_edges(self.aperture.seen(side), extent))
        traced = np.zeros((self.channels, size, size))
        for kernel, scale in zip(traced, self._scales(side), strict=True):
            blocks = sobol_blocks(3, rays, seed, self.device)
            light = sum(trace(kernel, low * scale, high * scale, block, *opening) for block in blocks)
            if not light > 0.0:
                raise InputError(f"none of {rays} rays found the opening: trace more of them")
            kernel /= light
        return traced.transpose(1, 2, 0)


def _tracer(device: str) -> Callable[..., float]:
    if device:
        from mrbokeh.psf_models.torch_tracing import trace_lens as trace_on

        return partial(trace_on, device)
    from mrbokeh.psf_models._rays_numba import trace_lens

    return trace_lens


def banded_edges(plain: Aperture, extent: float) -> tuple[Float64[np.ndarray, "edges 5"], Int64[np.ndarray, " bands_and_end"]]:
    """Return (edges, starts) as `_rays_numba.opening_at` takes them: the edges of all outlines, sorted into bands of height.

    The winding direction of an outline does not matter: its weight takes the sign of its area.
    """
    edges = []
    for outline, weight in zip(plain.outlines, plain.weights, strict=True):
        following = np.roll(outline, -1, axis=0)
        area = float(np.sum(outline[:, 0] * following[:, 1] - outline[:, 1] * following[:, 0]))
        up = np.sign(following[:, 1] - outline[:, 1]) * weight * np.sign(area)
        edges.append(np.column_stack([outline, following, up]))
    rows = np.concatenate(edges)
    low, high = np.minimum(rows[:, 1], rows[:, 3]), np.maximum(rows[:, 1], rows[:, 3])
    borders = np.linspace(-extent, extent, _BANDS + 1)
    bands = [rows[(low <= top) & (high >= bottom)] for bottom, top in pairwise(borders)]
    return np.concatenate(bands), np.cumsum([0, *map(len, bands)], dtype=np.int64)


def _sides(low: float, high: float) -> list[tuple[float, float]]:
    """Return an interval of diameters, cut at the focus."""
    return [(low, 0.0), (0.0, high)] if low < 0.0 < high else [(low, high)]

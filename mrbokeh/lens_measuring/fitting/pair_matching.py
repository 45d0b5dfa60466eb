"""Registration and light of a sharp picture and a blurred one, through the blur between them.

Two pictures of one scene are never quite alike but for their blur: focusing shifts and enlarges (breathing), exposures differ, and shiny
surfaces mirror something else once a light or a camera has moved. A kernel would have to explain it all. So the sharp picture is blurred by
a disc of the diameters that are known, and what brings that nearest to the blurred one is solved for by Gauss and Newton's steps (Lucas and
Kanade 1981): six numbers of an affine map, the light in common and its slow change over the frame. The shape of the kernel, which is not
known yet, is not needed: a disc of the right size has the right middle.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64

from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences

Plane = Float32[np.ndarray, "height width"]
Rgb = Float32[np.ndarray, "height width 3"]
Mask = Bool[np.ndarray, "height width"]

_PIXELS = 30_000
_STEPS = 5
_MOST_PX = 20.0
"""Farther than this pictures of one scene do not lie apart: what is found beyond it is no registration."""
_LEAST_PIXELS = 1000
_LEAST_SLOPE, _LEAST_SHARE = 1e-3, 1e-4  # of the light, per pixel; and of the strongest equation: less is the rounding of flat surfaces


@dataclass(frozen=True)
class Match:
    """Affine map and light between two pictures.

    sharp_from_blurred: leads from pixels of the blurred picture to those of the sharp one. gain, black: blurred = gain * (sharp, blurred
    by the lens) + black.
    """

    sharp_from_blurred: Float64[np.ndarray, "2 3"]
    gain: float = 1.0
    black: float = 0.0

    def registered(self, values: np.ndarray, nearest: bool = False) -> np.ndarray:
        """Return the sharp picture, or with `nearest` a map of it, as it lies under the blurred one."""
        flags = (cv2.INTER_NEAREST if nearest else cv2.INTER_CUBIC) | cv2.WARP_INVERSE_MAP
        opencv = self.sharp_from_blurred.copy()
        opencv[:, 2] += 0.5 * opencv[:, :2].sum(axis=1) - 0.5  # OpenCV counts from the middle of the first pixel
        size = (values.shape[1], values.shape[0])
        return np.asarray(cv2.warpAffine(values, opencv, size, flags=flags, borderMode=cv2.BORDER_REPLICATE))


def blurred_by_disc(rgb: Rgb, coc_px: Plane) -> Rgb:
    """Return a picture with every pixel spread over its disc; what is hidden is not told apart, so edges of depth come out wrong."""
    values = np.concatenate([rgb, np.ones((*coc_px.shape, 1), np.float32)], axis=2)
    summed = PolygonDifferences().sum_kernels(np.ascontiguousarray(values), np.ascontiguousarray(coc_px), Aperture.disc())
    return np.asarray(summed[..., :3] / np.maximum(summed[..., 3:], 1e-3), np.float32)


def match(sharp: Rgb, coc_px: Plane, blurred: Rgb, usable: Mask, seed: int = 0) -> Match:
    """Find how a sharp picture lies under a blurred one and how their light differs. usable: pixels far from edges of depth and frame.

    With fewer than 1000 of them, or none with texture, the pictures are taken as they lie.
    """
    where = np.flatnonzero(usable)
    if where.size < _LEAST_PIXELS:
        return Match(np.eye(2, 3))
    where = np.sort(np.random.default_rng(seed).permutation(where)[:_PIXELS])
    rows, columns = np.unravel_index(where, usable.shape)
    spread = blurred_by_disc(sharp, coc_px).mean(axis=2, dtype=np.float64).astype(np.float32)
    seen = blurred.mean(axis=2, dtype=np.float64).ravel()[where]
    problem = _Problem(np.stack([spread, *reversed(np.gradient(spread))]), np.stack([columns, rows], axis=1) + 0.5, seen)
    found = problem.solved()
    light = problem.sampled(found)[0]
    if not light.std() > _LEAST_SLOPE * abs(light.mean()):
        return Match(np.eye(2, 3))
    gain, black = np.polyfit(light, seen, 1)
    return Match(found, float(gain), float(black))


@dataclass(frozen=True)
class _Problem:
    """planes: a blurred picture and its slopes along x and y. places: x, y of pixels. seen: the light there in the other picture."""

    planes: Float32[np.ndarray, "3 height width"]
    places: Float64[np.ndarray, "pixels 2"]
    seen: Float64[np.ndarray, " pixels"]

    def solved(self) -> Float64[np.ndarray, "2 3"]:
        """Return the affine map that brings the planes nearest to what is seen; the one that changes nothing where none is found."""
        height, width = self.planes.shape[1:]
        scale = 0.5 * max(width, height)
        middle = np.array([0.5 * width, 0.5 * height])
        unit = (self.places - middle) / scale
        ones = np.ones((len(unit), 1))
        affine, slow = np.hstack([ones, unit]), np.hstack([ones, unit, unit**2, unit[:, :1] * unit[:, 1:]])
        moved_px = np.zeros((2, 3))
        for _ in range(_STEPS):
            light, along_x, along_y = self.sampled(self._map(moved_px, middle, scale))[..., None]
            columns = np.hstack([along_x * affine, along_y * affine, light * slow, ones])
            size = np.maximum(np.abs(columns).mean(axis=0), _LEAST_SLOPE * np.abs(light).mean() + 1e-12)
            found = np.linalg.lstsq(columns / size, self.seen, rcond=_LEAST_SHARE)[0] / size
            moved_px = moved_px + found[:6].reshape(2, 3) / max(found[6], 1e-6)
            if not np.abs(moved_px).max() < _MOST_PX:
                return np.eye(2, 3)
        return self._map(moved_px, middle, scale)

    def sampled(self, sharp_from_blurred: Float64[np.ndarray, "2 3"]) -> Float64[np.ndarray, "3 pixels"]:
        """Return the planes where an affine map leads."""
        at = (self.places @ sharp_from_blurred[:, :2].T + sharp_from_blurred[:, 2] - 0.5).astype(np.float32)
        x, y = (np.ascontiguousarray(each.reshape(-1, 100)) for each in np.pad(at, ((0, -len(at) % 100), (0, 0)), mode="edge").T)
        found = [cv2.remap(plane, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for plane in self.planes]
        return np.stack(found).reshape(3, -1)[:, : len(at)].astype(np.float64)

    def _map(self, moved_px: Float64[np.ndarray, "2 3"], middle: Float64[np.ndarray, " 2"], scale: float) -> Float64[np.ndarray, "2 3"]:
        """Return the map that moves the middle by the first column, and grows by the others."""
        linear = np.eye(2) + moved_px[:, 1:] / scale
        return np.hstack([linear, (middle + moved_px[:, 0] - linear @ middle)[:, None]])


def even_light(seen: Rgb, expected: Rgb, usable: Mask, width_px: float) -> Plane:
    """Return by how much more light a picture has than expected, averaged over about this width; 1 where nothing is known."""

    def averaged(values: Plane) -> Plane:
        return np.asarray(cv2.GaussianBlur(np.where(usable, values, np.float32(0.0)), (0, 0), 0.5 * width_px))

    has, wants = averaged(seen.mean(axis=2)), averaged(expected.mean(axis=2))
    return np.where((wants > 1e-6) & (has > 0.0), has / np.maximum(wants, 1e-6), np.float32(1.0)).astype(np.float32)

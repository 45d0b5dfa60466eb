"""An Environment made ready for image-based lighting: once per panorama, then every surface reads it in constant time."""

from collections import deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.scene._lighting_numba import PanoramaLevels, brdf_integral, cosine_convolved, ggx_convolved, ggx_lobe
from mrbokeh.scene.light import Environment, directions, solid_angles_sr

_LARGEST_WIDTH_PX = 2048
_MATTE_SIZE_PX = (32, 64)
_BLOCKS = (64, 128)
_PEAKS = 16
_SAME = 1e-5
_FINER = 2
"""Reflections have at most so many times the pixels of a small panorama in width."""
_SMALL_WIDTH_PX = 64
_ROUGH_LEVELS = ((512, 16), (256, 32), (128, 64), (128, 64), (64, 128), (64, 128), (64, 256), (64, 256))
"""(width in pixels, samples) of the reflections at roughness (k / 8)**1.5, k = 1 to 8: as fine as each lobe is wide."""


@dataclass(frozen=True, eq=False)
class LightingMaps:
    """Panorama filtered for shading.

    irradiance: one panorama of irradiance / pi by normal, without its peaks. peaks: (P, 3 colours, 3) the brightest parts, each adding
    max(0, normal . peak). reflections: GGX-blurred panoramas; level 8 * roughness**(2/3).
    """

    peaks: Float[np.ndarray, "peaks 3 3"]
    irradiance: PanoramaLevels
    reflections: PanoramaLevels
    environment_from_world: Float[np.ndarray, "3 3"]

    def brighter(self, factor: float) -> "LightingMaps":
        """The maps of the same panorama at another exposure: filtering is linear."""
        if factor == 1.0:
            return self
        irradiance, reflections = (
            levels._replace(radiance=levels.radiance * np.float32(factor)) for levels in (self.irradiance, self.reflections)
        )
        return replace(self, peaks=self.peaks * factor, irradiance=irradiance, reflections=reflections)


def lighting_maps(environment: Environment) -> LightingMaps:
    """Filter a panorama for matte and glossy surfaces.

    Takes half a second; but where the panorama is one of the last two at another exposure or turned, as it is while somebody tries
    light, what was filtered then is scaled and turned.
    """
    radiance = _at_most(np.ascontiguousarray(environment.radiance), _LARGEST_WIDTH_PX)
    from_world = np.ascontiguousarray(environment.world_from_environment.T)
    for known, maps in tuple(_last_filtered):
        factor = _brighter_by(known, radiance)
        if factor is not None:
            return replace(maps.brighter(factor), environment_from_world=from_world)
    maps = replace(filtered(radiance), environment_from_world=from_world)
    _last_filtered.append((radiance, maps))
    return maps


_last_filtered: deque[tuple[Float32[np.ndarray, "height width 3"], LightingMaps]] = deque(maxlen=2)


def _brighter_by(known: Float32[np.ndarray, "h w 3"], radiance: Float32[np.ndarray, "height width 3"]) -> float | None:
    """The factor from one panorama to another; None where it is not the same everywhere."""
    if known.shape != radiance.shape or not known.any():
        return None
    if known is radiance:
        return 1.0
    factor = float(radiance.sum(dtype=np.float64) / known.sum(dtype=np.float64))
    if not factor > 0:
        return None
    for step in (16, 1):  # most others are told apart by few pixels
        few, others = radiance[::step, ::step], known[::step, ::step] * np.float32(factor)
        if (np.abs(few - others) > _SAME * others).any():
            return None
    return 1.0 if abs(factor - 1.0) < _SAME else factor


def filtered(radiance: Float32[np.ndarray, "height width 3"]) -> LightingMaps:
    """The maps of a panorama in its own axes.

    Matte light is the exact cosine convolution (`cosine_convolved`), not spherical harmonics of order 2 (Ramamoorthi and
    Hanrahan 2001): measured over all normals those are 2 % off on average under a smooth sky with two wide lights, but 10 %
    on average and by a factor of 2 in the shade under a photographed sky with its sun. The brightest blocks are kept apart,
    as interpolating in a map would round off the terminator of a small sun.
    """
    if (radiance == radiance[0, 0]).all():
        # Even light is the same for every surface, and filtering takes a fifth of a small composite's time.
        even = [radiance[:8, :16]] * (1 + len(_ROUGH_LEVELS))
        return LightingMaps(np.zeros((0, 3, 3)), _joined(even[:1]), _joined(even), np.eye(3))
    if radiance.shape[1] <= _SMALL_WIDTH_PX:
        return _filtered_small(radiance)
    smooth = np.zeros((_MATTE_SIZE_PX[0] * _MATTE_SIZE_PX[1], 3), np.float32)
    moments = _moments(radiance)
    brightest = np.argsort(-np.abs(moments).sum((1, 2)))[:_PEAKS]
    peaks = moments[brightest] / np.pi
    moments[brightest] = 0.0
    cosine_convolved(moments, directions(*_MATTE_SIZE_PX).reshape(-1, 3), smooth)
    source, count = _joined(_halved(radiance)), len(_ROUGH_LEVELS)

    def blurred(number: int) -> Float32[np.ndarray, "_ _ 3"]:
        width, samples = _ROUGH_LEVELS[number - 1]
        width = min(width, max(_MATTE_SIZE_PX[1], _FINER * radiance.shape[1]))
        result = np.zeros((width * width // 2, 3), np.float32)
        lobe = np.zeros((samples, 4))
        ggx_lobe((number / count) ** 1.5, 4 * np.pi / float(source.size[0].prod()), samples, lobe)
        ggx_convolved(source, directions(width // 2, width).reshape(-1, 3), lobe, result)
        return result.reshape(width // 2, width, 3)

    with ThreadPoolExecutor() as pool:
        reflections = [radiance, *pool.map(blurred, range(1, count + 1))]
    return LightingMaps(
        peaks=peaks,
        irradiance=_joined([smooth.reshape(*_MATTE_SIZE_PX, 3)]),
        reflections=_joined(reflections),
        environment_from_world=np.eye(3),
    )


def _filtered_small(radiance: Float32[np.ndarray, "height width 3"]) -> LightingMaps:
    """Return the maps of a panorama of few pixels, each the sum over all pixels: a convolution around the vertical, by FFT.

    It needs no compiled code, whose loading would take longer. Lobes narrower than a pixel show that pixel.
    """
    height, width = radiance.shape[:2]
    towards, sr = directions(height, width), solid_angles_sr(height, width)
    cosines = np.einsum("ik,jlk->ijl", towards[:, 0], towards)  # between the first pixel of each row and all pixels
    facing, spectrum = np.maximum(cosines, 0.0), np.fft.rfft(radiance * sr[..., None], axis=1)

    def seen(kernel: Float[np.ndarray, "height height width"]) -> Float32[np.ndarray, "height width 3"]:
        products = np.einsum("ijf,jfc->ifc", np.fft.rfft(kernel, axis=2).conj(), spectrum)
        return np.fft.irfft(products, width, axis=1).astype(np.float32)

    def mirrored(number: int) -> Float32[np.ndarray, "height width 3"]:
        alpha2 = (number / len(_ROUGH_LEVELS)) ** 6.0
        lobe = facing / (1.0 - (1.0 - alpha2) * (1.0 + cosines) / 2.0) ** 2
        return seen(lobe / np.einsum("ijl,jl->i", lobe, sr)[:, None, None])

    reflections = [radiance, *(mirrored(number) for number in range(1, len(_ROUGH_LEVELS) + 1))]
    return LightingMaps(np.zeros((0, 3, 3)), _joined([seen(facing) / np.float32(np.pi)]), _joined(reflections), np.eye(3))


@cache
def reflected_share_table() -> Float32[np.ndarray, "size size 2"]:
    """The BRDF's integral over uniform light, by roughness and viewing angle; see `brdf_integral`."""
    table = np.zeros((33, 33, 2), np.float32)
    brdf_integral(33, 1024, table)
    return table


def _at_most(radiance: Float32[np.ndarray, "height width 3"], width_px: int) -> Float32[np.ndarray, "h w 3"]:
    if radiance.shape[1] <= width_px:
        return radiance
    return _area_resized(radiance, width_px // 2, width_px)


def _area_resized(radiance: Float32[np.ndarray, "height width 3"], height_px: int, width_px: int) -> Float32[np.ndarray, "h w 3"]:
    """Area averages that keep the energy: rows count by their solid angle."""
    row_sr = solid_angles_sr(*radiance.shape[:2])[:, :1, None].astype(np.float32)
    energy = cv2.resize(radiance * row_sr, (width_px, height_px), interpolation=cv2.INTER_AREA)
    return energy / cv2.resize(row_sr[..., 0], (1, height_px), interpolation=cv2.INTER_AREA)[:, :, None]


def _halved(radiance: Float32[np.ndarray, "height width 3"]) -> list[Float32[np.ndarray, "_ _ 3"]]:
    levels = [radiance]
    while min(levels[-1].shape[:2]) > 4:
        height, width = levels[-1].shape[:2]
        levels.append(_area_resized(levels[-1], height // 2, width // 2))
    return levels


def _moments(radiance: Float32[np.ndarray, "height width 3"]) -> Float[np.ndarray, "blocks 3 3"]:
    """Integral of radiance (by colour) times direction over blocks of the panorama."""
    # Few large pixels are cut up first, so that the horizon cuts small blocks only.
    radiance = radiance.repeat(-(-_BLOCKS[0] // radiance.shape[0]), axis=0).repeat(-(-_BLOCKS[1] // radiance.shape[1]), axis=1)
    height, width = radiance.shape[:2]
    rows, columns = (np.linspace(0, size, blocks + 1).astype(int)[:-1] for size, blocks in zip((height, width), _BLOCKS, strict=True))
    row_sr = solid_angles_sr(height, width)[:, :1, None]
    # A direction is a part that depends on the column, (sin, 1, cos) of the longitude, times one that depends on the row:
    # so the columns are summed first.
    level, upright = directions(1, width)[0], directions(height, 1)[:, 0]
    around = np.stack([level[:, 0], np.ones(width), level[:, 2]], axis=1).astype(np.float32)
    rising = np.stack([upright[:, 2], upright[:, 1], upright[:, 2]], axis=1)
    sums = [np.add.reduceat(radiance * around[:, axis, None], columns, axis=1, dtype=np.float64) for axis in range(3)]
    parts = [np.add.reduceat(part * (row_sr * rising[:, axis, None, None]), rows, axis=0) for axis, part in enumerate(sums)]
    return np.ascontiguousarray(np.stack([part.reshape(-1, 3) for part in parts], axis=2))


def _joined(levels: Sequence[Float32[np.ndarray, "_ _ 3"]]) -> PanoramaLevels:
    sizes = np.array([level.shape[:2] for level in levels], np.int32)
    starts = np.concatenate([[0], np.cumsum(sizes.prod(1))[:-1]]).astype(np.int32)
    return PanoramaLevels(np.ascontiguousarray(np.concatenate([level.reshape(-1, 3) for level in levels])), starts, sizes)

"""An Environment made ready for image-based lighting: once per panorama, then every surface reads it in constant time."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.scene._environment_numba import PanoramaLevels, brdf_integral, cosine_convolved, ggx_convolved
from mrbokeh.scene.environment import Environment, directions, solid_angles_sr

_LARGEST_WIDTH_PX = 2048
_MATTE_SIZE_PX = (32, 64)
_BLOCKS = (64, 128)
_PEAKS = 16
_ROUGH_LEVELS = ((512, 16), (256, 32), (128, 64), (128, 64), (64, 128), (64, 128), (64, 256), (64, 256))
"""(width in pixels, samples) of the reflections at roughness (k / 8)**1.5, k = 1 to 8: as fine as each lobe is wide."""


@dataclass(frozen=True, eq=False)
class LightingMaps:
    """irradiance: one panorama of irradiance / pi by normal, without its peaks. peaks: (P, 3 colours, 3) the brightest parts,
    each adding max(0, normal . peak). reflections: GGX-blurred panoramas; level 8 * roughness**(2/3).
    """

    peaks: Float[np.ndarray, "peaks 3 3"]
    irradiance: PanoramaLevels
    reflections: PanoramaLevels
    environment_from_world: Float[np.ndarray, "3 3"]


def lighting_maps(environment: Environment) -> LightingMaps:
    """Filter a panorama for matte and glossy surfaces.

    Matte light is the exact cosine convolution (`cosine_convolved`), not spherical harmonics of order 2 (Ramamoorthi and
    Hanrahan 2001): measured over all normals those are 2 % off on average under a smooth sky with two wide lamps, but 10 %
    on average and by a factor of 2 in the shade under a photographed sky with its sun. The brightest blocks are kept apart,
    as interpolating in a map would round off the terminator of a small sun.
    """
    radiance = _at_most(np.ascontiguousarray(environment.radiance), _LARGEST_WIDTH_PX)
    smooth = np.zeros((_MATTE_SIZE_PX[0] * _MATTE_SIZE_PX[1], 3), np.float32)
    moments = _moments(radiance)
    brightest = np.argsort(-np.abs(moments).sum((1, 2)))[:_PEAKS]
    peaks = moments[brightest] / np.pi
    moments[brightest] = 0.0
    cosine_convolved(moments, directions(*_MATTE_SIZE_PX).reshape(-1, 3), smooth)
    source, count = _joined(_halved(radiance)), len(_ROUGH_LEVELS)

    def blurred(number: int) -> Float32[np.ndarray, "_ _ 3"]:
        width, samples = _ROUGH_LEVELS[number - 1]
        result = np.zeros((width * width // 2, 3), np.float32)
        ggx_convolved(source, directions(width // 2, width).reshape(-1, 3), (number / count) ** 1.5, samples, result)
        return result.reshape(width // 2, width, 3)

    with ThreadPoolExecutor() as pool:
        reflections = [radiance, *pool.map(blurred, range(1, count + 1))]
    return LightingMaps(
        peaks=peaks,
        irradiance=_joined([smooth.reshape(*_MATTE_SIZE_PX, 3)]),
        reflections=_joined(reflections),
        environment_from_world=np.ascontiguousarray(environment.world_from_environment.T),
    )


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
    light = radiance * solid_angles_sr(height, width)[..., None]
    towards = directions(height, width)
    rows, columns = (np.linspace(0, size, blocks + 1).astype(int)[:-1] for size, blocks in zip((height, width), _BLOCKS, strict=True))
    sums = [np.add.reduceat(np.add.reduceat(light[..., k : k + 1] * towards, rows, axis=0), columns, axis=1) for k in range(3)]
    return np.ascontiguousarray(np.stack([part.reshape(-1, 3) for part in sums], axis=1))


def _joined(levels: Sequence[Float32[np.ndarray, "_ _ 3"]]) -> PanoramaLevels:
    sizes = np.array([level.shape[:2] for level in levels], np.int32)
    starts = np.concatenate([[0], np.cumsum(sizes.prod(1))[:-1]]).astype(np.int32)
    return PanoramaLevels(np.ascontiguousarray(np.concatenate([level.reshape(-1, 3) for level in levels])), starts, sizes)

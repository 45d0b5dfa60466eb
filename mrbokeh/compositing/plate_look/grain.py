"""Grain: the noise of a camera in its linear pictures, measured, kept as a JSON file, and put on virtual light.

Grain is a periodic texture of normal noise with the measured correlation between neighbours and channels. The virtual part gets as much
as the sensor would have given the finished picture, less what the photograph has kept.

Noise belongs to the light that reaches the sensor, object and scene together. With P the photograph, V the premultiplied virtual light
and a its coverage, the picture is M = K + V with K = (1 - a) P. A sensor would give it the variance s(M) = shot M + read. The
photograph's own noise is in it already, scaled by 1 - a like the photograph, so with the variance (1 - a)^2 s(P). Independent variances
add, therefore the virtual part gets

    s(M) - (1 - a)^2 s(P) = shot (V + a (1 - a) P) + read a (2 - a)       (the right side for K = (1 - a) P),

which is never negative, s(V) where the object is opaque and 0 where it is not. A shadow (V = 0) gets grain too: what is left of the
photograph has lost more noise than light.
"""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Complex128, Float32

from mrbokeh.compositing.plate_look.colour_match import Triple, triple_of
from mrbokeh.compositing.plate_look.noise_measurement import (
    LAGS,
    REACH_PX,
    Correlation,
    NoiseBlocks,
    NoiseLevel,
    fit_noise_level,
    measured_correlation,
    noise_blocks,
    noise_blocks_of_pair,
    white,
)
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError

SIDE_PX = 1024
_GRID_PX = 32

Picture = Float32[np.ndarray, "height width 3"]
FORMAT, VERSION = "mrbokeh-grain", 1


def grain_texture(correlation: Correlation, seed: int) -> Float32[np.ndarray, "side side 3"]:
    """Filter white noise by the root of the spectrum that belongs to the correlation (Wiener-Khinchin); mean 0, variance 1.

    The spectrum of white noise is white noise: it is drawn as such. In the two columns that belong to themselves only the part counts that
    is alike at opposite frequencies, half of their light.
    """
    kernels = np.fft.irfft2(_root_of_spectrum(correlation), (_GRID_PX, _GRID_PX), axes=(0, 1))
    drawn = np.random.default_rng(seed).standard_normal((3, SIDE_PX, SIDE_PX // 2 + 1, 2), np.float32).view(np.complex64)[..., 0]
    drawn[..., [0, -1]] *= np.sqrt(np.float32(2.0))
    mixed, turns = np.zeros_like(drawn), _turns()
    for i, j in np.ndindex(3, 3):
        mixed[i] += (turns @ kernels[..., i, j].astype(np.complex64) @ turns[: SIDE_PX // 2 + 1].T) * drawn[j]
    texture = np.fft.irfft2(mixed, (SIDE_PX, SIDE_PX)).astype(np.float32)
    texture -= texture.mean(axis=(1, 2), keepdims=True, dtype=np.float64).astype(np.float32)
    deviation = texture.std(axis=(1, 2), keepdims=True, dtype=np.float64).astype(np.float32)
    return np.ascontiguousarray((texture / np.where(deviation > 0.0, deviation, 1.0)).transpose(1, 2, 0))


def _root_of_spectrum(correlation: Correlation) -> Complex128[np.ndarray, "rows columns 3 3"]:
    """The Hermitian root per frequency. Cutting a correlation off may make a spectrum slightly negative: there it is taken as 0."""
    grid = np.zeros((_GRID_PX, _GRID_PX, 3, 3))
    places = np.arange(-REACH_PX, REACH_PX + 1)
    grid[np.ix_(places, places)] = correlation
    # n_i(p) n_j(p + d) summed with exp(-i f d) has conj(N_i) N_j; the filter's spectrum is N_i conj(N_j).
    spectrum = np.fft.rfft2(grid, axes=(0, 1)).conj()
    values, vectors = np.linalg.eigh(0.5 * (spectrum + spectrum.conj().swapaxes(2, 3)))
    return (vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]) @ vectors.conj().swapaxes(2, 3)


def _turns() -> np.ndarray:
    """Return what brings a small kernel about pixel (0, 0) to the spectrum of a texture, along one side."""
    places = np.arange(_GRID_PX) - _GRID_PX * (np.arange(_GRID_PX) >= _GRID_PX // 2)
    return np.exp(-2j * np.pi / SIDE_PX * np.outer(np.arange(SIDE_PX), places)).astype(np.complex64)


@dataclass(frozen=True)
class Grain:
    """Grain of a camera. level: strength by light. correlation: between neighbours and channels. seed: the same seed and frame give the
    same grain.
    """

    level: NoiseLevel
    correlation: Correlation = field(default_factory=white)
    seed: int = 0

    def __post_init__(self) -> None:
        if self.correlation.shape != (LAGS, LAGS, 3, 3):
            raise InputError(f"expected the correlation of grain as {(LAGS, LAGS, 3, 3)}, got {self.correlation.shape}")
        if min(self.level.shot + self.level.read) < 0.0:
            raise InputError(f"expected variances of grain not below 0, got shot {self.level.shot} and read {self.level.read}")

    @property
    def is_nothing(self) -> bool:
        return not any(self.level.shot + self.level.read)

    @cached_property
    def texture(self) -> Float32[np.ndarray, "side side 3"]:
        """Periodic noise of variance 1 with this correlation; made once."""
        return grain_texture(self.correlation, self.seed)


def measured_grain(rgb: Picture, seed: int = 0) -> Grain:
    """The grain of one linear picture, from its smooth places (of which a defocused one has many). Raises InputError where none are.

    Texture as fine as grain and everywhere cannot be told from it; two frames can (`measured_grain_of_pair`).
    """
    return _grain_of(noise_blocks(rgb), seed)


def measured_grain_of_pair(first: Picture, second: Picture, seed: int = 0) -> Grain:
    """Measure grain by the change between two neighbouring frames of a still camera, wherever nothing moves; texture cancels."""
    return _grain_of(noise_blocks_of_pair(first, second), seed)


def _grain_of(blocks: NoiseBlocks, seed: int) -> Grain:
    level, accepted = fit_noise_level(blocks)
    correlation, variance = measured_correlation(blocks.only(accepted), level)
    shot, read = (triple_of(np.array(each) * variance) for each in (level.shot, level.read))
    return Grain(NoiseLevel(shot, read), correlation, seed)


def write_grain(path: Path | str, grain: Grain) -> None:
    document = {"format": FORMAT, "version": VERSION, "shot": grain.level.shot, "read": grain.level.read, "seed": grain.seed}
    write_json(path, document | {"correlation": np.round(grain.correlation, 6).tolist()})


def read_grain(path: Path | str) -> Grain:
    """Read a grain file. Raises InputError if the file is none."""
    document = read_json(path, "a grain file")
    if not isinstance(document, dict) or document.get("format") != FORMAT or document.get("version") != VERSION:
        raise InputError(f'{path}: expected a grain file with "format": "{FORMAT}" and "version": {VERSION}: measure the grain again')
    level = NoiseLevel(_three(document, "shot", path), _three(document, "read", path))
    seed = document.get("seed", 0)
    if not isinstance(seed, int) or seed < 0:
        raise InputError(f"{path}: expected seed as a whole number not below 0, got {seed!r}")
    return Grain(level, _numbers(document, "correlation", (LAGS, LAGS, 3, 3), path), seed)


def _three(document: dict[str, Any], key: str, path: Path | str) -> Triple:
    return triple_of(_numbers(document, key, (3,), path))


def _numbers(document: dict[str, Any], key: str, shape: tuple[int, ...], path: Path | str) -> np.ndarray:
    try:
        values = np.array(document.get(key), np.float64)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.shape != shape or not np.isfinite(values).all():
        raise InputError(f"{path}: expected {key} as numbers of shape {shape}, got something else: measure the grain again")
    return values


class GrainDraw:
    """Part of the texture that a frame takes: drawn from seed and frame alone, so that neither the box nor the order of frames matters."""

    def __init__(self, grain: Grain, frame: int, origin_px: tuple[int, int] = (0, 0)) -> None:
        rng = np.random.default_rng((grain.seed, frame))
        side = grain.texture.shape[0]
        self.grain, self.sign = grain, np.float32(rng.choice((-1.0, 1.0)))
        row, column = (int(each) for each in rng.integers(0, side, 2))
        self.start = (row + origin_px[0]) % side, (column + origin_px[1]) % side


def add_grain_to(
    light: Picture, alpha: Float32[np.ndarray, "height width"], photo_rgb: Picture, plate_rgb: Picture, draw: GrainDraw
) -> None:
    """Add grain in place to light (h, w, 3), a part of the frame like the others."""
    from mrbokeh.compositing._pixel_light_numba import add_grain

    shot, read = (np.array(each, np.float32) for each in (draw.grain.level.shot, draw.grain.level.read))
    alpha, photo_rgb, plate_rgb = (np.ascontiguousarray(each) for each in (alpha, photo_rgb, plate_rgb))
    add_grain(light, alpha, photo_rgb, plate_rgb, draw.grain.texture, draw.start, draw.sign, shot, read)

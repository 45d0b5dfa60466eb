"""Grain: the noise of a camera as it stands in its linear pictures, and how it is measured in them."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Float32

from mrbokeh.compositing.plate_look.colour_match import triple_of
from mrbokeh.compositing.plate_look.grain_texture import grain_texture
from mrbokeh.compositing.plate_look.noise_blocks import NoiseBlocks, noise_blocks, noise_blocks_of_pair
from mrbokeh.compositing.plate_look.noise_correlation import LAGS, Correlation, measured_correlation, white
from mrbokeh.compositing.plate_look.noise_level import NoiseLevel, fit_noise_level
from mrbokeh.system.errors import InputError

Picture = Float32[np.ndarray, "height width 3"]


@dataclass(frozen=True)
class Grain:
    """level: how strong; correlation: how it hangs together; seed: which draw. The same seed and frame give the same grain."""

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
    """From what changes between two neighbouring frames of a still camera, wherever nothing moves; texture cancels."""
    return _grain_of(noise_blocks_of_pair(first, second), seed)


def _grain_of(blocks: NoiseBlocks, seed: int) -> Grain:
    level, accepted = fit_noise_level(blocks)
    correlation, variance = measured_correlation(blocks.only(accepted), level)
    shot, read = (triple_of(np.array(each) * variance) for each in (level.shot, level.read))
    return Grain(NoiseLevel(shot, read), correlation, seed)

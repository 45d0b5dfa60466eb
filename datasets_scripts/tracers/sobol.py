"""Sobol points with a nested uniform (Owen) scramble of their own for every pixel.

Burley, Practical Hash-based Owen Scrambling (JCGT 9(4), 2020), whose constants are used here, after Laine and Karras (2011).
The functions take arrays of unsigned 32-bit numbers of NumPy or Dr.Jit alike: both wrap around.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import UInt32

DIMENSIONS = 4


def sobol_table(samples: int) -> UInt32[np.ndarray, "samples 4"]:
    """Return the first points of the four-dimensional Sobol sequence as 32-bit fractions; a power of two is best."""
    from scipy.stats import qmc

    sequence = qmc.Sobol(DIMENSIONS, scramble=False, bits=32)
    points = sequence.random(1 << max(0, (samples - 1).bit_length()))[:samples]
    return np.round(points * 2.0**32).astype(np.uint64).astype(np.uint32)


def owen_scrambled(bits: Any, seed: Any, reverse_bits: Callable[[Any], Any]) -> Any:
    """Scramble a 32-bit fraction; points of one sequence stay well spread where they share the seed."""
    x = reverse_bits(bits) + seed
    x = x ^ (x * 0x6C50B47C)
    x = x ^ (x * 0xB82F1E52)
    x = x ^ (x * 0xC7AFE638)
    x = x ^ (x * 0x8D22F6E6)
    return reverse_bits(x)


def scramble_seed(pixel: Any, stream: Any) -> Any:
    """Return a seed for each pixel and each stream (a dimension of one picture)."""
    return _mixed(pixel * 0x9E3779B9 + _mixed(stream + 0x85EBCA6B))


def _mixed(x: Any) -> Any:
    """Mix a number by the finaliser of MurmurHash3: every bit changes about half of the bits of the result."""
    x = (x ^ (x >> 16)) * 0x85EBCA6B
    x = (x ^ (x >> 13)) * 0xC2B2AE35
    return x ^ (x >> 16)

"""Quasi-random shares: points that fill the unit cube evenly, for light tracing."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64

_BLOCK = 1 << 16
_PRIMES = np.array([2.0, 3.0, 5.0, 7.0, 11.0, 13.0, 17.0, 19.0])


def sobol_blocks(dimensions: int, rays: int, seed: int) -> Iterator[Float64[np.ndarray, "rays dimensions"]]:
    """The first `rays` points of a Sobol sequence, scrambled by the seed, in [0, 1), block by block; best for powers of two."""
    from scipy.stats import qmc

    sequence = qmc.Sobol(dimensions, scramble=True, bits=32, rng=np.random.default_rng(seed))
    for first in range(0, rays, _BLOCK):
        yield sequence.random(_BLOCK)[: rays - first]


def quasi_random(dimensions: int, seed: int) -> tuple[Float64[np.ndarray, " dimensions"], Float64[np.ndarray, " dimensions"]]:
    """(offset, step) of an additive recurrence: point i is frac(offset + i step). For any one i without the ones before it.

    Steps are the square roots of primes (Richtmyer 1951), at most 8; the offset comes from the seed (a Cranley-Patterson
    rotation). Plain, but with five dimensions a pair of them is no better than chance: `sobol_blocks` is, at the same speed.
    """
    return np.random.default_rng(seed).random(dimensions), np.sqrt(_PRIMES[:dimensions]) % 1.0

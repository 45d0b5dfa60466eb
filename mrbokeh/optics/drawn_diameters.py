"""Diameters at which kernels are drawn, so that they blur a picture of pixels as much as the lens blurs the scene.

A kernel holds the share of an opening that lies in each pixel, and a pixel of the sharp picture is a mean over its area already. That
area would count twice: a disc drawn at 2 px blurs as one of 2.3 px does. Kernels are drawn at the diameter at which they pass an edge
most like the opening itself does, but never larger than it is: between 1.5 and 3.5 px up to half a pixel smaller, beyond 6 px by one or
two hundredths. Up to one pixel kernels stay the identity.
"""

import hashlib
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.optics.aperture import Aperture
from mrbokeh.system.atomic_files import atomic_path

Plane = Float32[np.ndarray, "height width"]
Transfers = Float[np.ndarray, "_ values"]

STEPS_PER_PX = 16
"""Steps of the table per pixel."""
_WIDEST_PX = 16.0
"""End of the table, beyond which the difference of squares stays: variances add, and a pixel's does not depend on the diameter."""
_DRAWN_PX = np.concatenate([np.arange(1.0, 4.0, 0.1), np.arange(4.0, 8.0, 0.25), np.arange(8.0, 18.0, 0.5)])
_BLURS_PX = np.arange(0.0, 18.0, 0.05)
_FINE_PX = 100.0
_FREQUENCIES = np.linspace(0.02, 0.5, 25)
"""Cycles per pixel."""
_WEIGHTS = _FREQUENCIES**-2.0
"""The power of an edge along its axis."""
_RISE = 1e-6
_EVEN = np.hanning(17)[1:-1]
"""Over half a pixel to each side: where blur grows from pixel to pixel, a bend here would show as a dip of opacity."""


def drawn_diameters_px(coc_px: Plane, aperture: Aperture) -> Plane:
    """Return (H, W) signed diameters to draw for blur of diameters coc_px, in the same order and of the same sign.

    An aperture that changes over the frame, with the side of the focus or with the colour is taken as in the middle of the frame, behind
    the focus, without colour.
    """
    from mrbokeh.optics._aperture_numba import look_up

    drawn = np.empty(coc_px.shape, np.float32)
    look_up(drawn.reshape(-1), np.ascontiguousarray(coc_px).reshape(-1), drawn_table(aperture), STEPS_PER_PX)
    return drawn


@lru_cache(maxsize=64)
def drawn_table(aperture: Aperture) -> Float32[np.ndarray, " steps"]:
    """Return the diameters to draw for 0, 1 / STEPS_PER_PX, ... px of blur; the last one determines how it continues.

    It takes half a second and is kept where compiled kernels are.
    """
    from mrbokeh.system.compiled import folder_of

    modifiers = (aperture.weights, aperture.cat_eye, aperture.spherical_aberration, aperture.axial_chromatic, aperture.lateral_chromatic)
    name = hashlib.sha256(b"".join([repr(modifiers).encode(), *(each.tobytes() for each in aperture.outlines)])).hexdigest()[:32]
    folder = folder_of(Path(__file__), __name__)
    path = None if folder is None else folder / f"{name}.npy"
    with suppress(OSError, ValueError, EOFError):
        if path is not None and path.is_file():
            return np.load(path)
    made = _made_table(aperture)
    with suppress(OSError):
        if path is not None:
            with atomic_path(path, is_result=False) as temporary, temporary.open("wb") as file:
                np.save(file, made)
    return made


def _made_table(aperture: Aperture) -> Float32[np.ndarray, " steps"]:
    steps_px = np.arange(_WIDEST_PX * STEPS_PER_PX + 1.0) / STEPS_PER_PX
    off = _distances(_drawn_transfers(aperture), _transfers(aperture))
    meant = np.maximum.accumulate([_lowest(_BLURS_PX, row) for row in off]) + _RISE * _DRAWN_PX
    drawn = np.minimum(np.interp(steps_px, meant, _DRAWN_PX), steps_px)
    around = np.pad(drawn, len(_EVEN) // 2, mode="reflect", reflect_type="odd")
    return np.where(steps_px > 1.0, np.convolve(around, _EVEN / _EVEN.sum(), mode="valid"), steps_px).astype(np.float32)


def _distances(one: Transfers, other: Transfers) -> Float[np.ndarray, "ones others"]:
    """Return (ones, others) squared weighted distances."""
    weights = np.tile(_WEIGHTS, 2)
    return np.stack([((row - other) ** 2) @ weights for row in one])


def _lowest(places: Float[np.ndarray, " places"], values: Float[np.ndarray, " places"]) -> float:
    """Return the minimum of the parabola through the lowest value and its neighbours."""
    middle = int(np.clip(np.argmin(values), 1, len(values) - 2))
    before, here, after = values[middle - 1 : middle + 2]
    bend = before - 2.0 * here + after
    step = 0.5 * (before - after) / bend if bend > 0.0 else 0.0
    return float(places[middle] + (places[1] - places[0]) * np.clip(step, -1.0, 1.0))


def _drawn_transfers(aperture: Aperture) -> Transfers:
    return np.stack([_transfer(aperture.rasterize(float(each)).kernel, _FREQUENCIES) for each in _DRAWN_PX])


def _transfers(aperture: Aperture) -> Transfers:
    """Return the transfer of blur itself: a kernel so large that its pixels do not matter, scaled down."""
    fine = aperture.rasterize(_FINE_PX).kernel
    return _transfer(fine, np.multiply.outer(_BLURS_PX / _FINE_PX, _FREQUENCIES))


def _transfer(kernel: Float[np.ndarray, "size size"], frequencies: Float[np.ndarray, "*batch values"]) -> Float[np.ndarray, "*batch _"]:
    """Return cosine parts along x and along y; frequencies in cycles per pixel."""
    along = np.arange(len(kernel)) - len(kernel) // 2
    waves = np.cos(2.0 * np.pi * frequencies[..., None] * along)
    return np.concatenate([waves @ kernel.sum(axis=0), waves @ kernel.sum(axis=1)], axis=-1)

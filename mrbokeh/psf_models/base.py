"""PsfModel: what every model of point spread functions offers (Leimkuehler et al. 2018, Section 5.1 and Table 1), and what models share."""

from collections.abc import Iterator
from hashlib import sha256
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64

from mrbokeh.optics.psf_bank import Axis, Turns
from mrbokeh.system.errors import InputError

_BLOCK, _GPU_BLOCK = 1 << 16, 1 << 18
"""A GPU is not busy with less; a block of rays through a lens takes some 350 MB there."""


def sobol_blocks(dimensions: int, rays: int, seed: int, device: str = "") -> Iterator[Float64[np.ndarray, "rays dimensions"]]:
    """Yield the first `rays` points of a Sobol sequence, scrambled by the seed, in [0, 1), block by block; best for powers of two.

    device: where they are traced; the points are the same, a GPU takes more of them at once.
    Not the plainer additive recurrence frac(offset + i sqrt(prime)): with the five dimensions of a physical lens two of its
    steps come near to a resonance and the light lies in streaks. Of the double Gauss (0.65 to 0.82 m, on the axis) 2^20 rays
    of it missed a picture of many rays by 2.2 % of the light, as pseudo-random ones do; these miss it by 0.9 %.
    """
    from scipy.stats import qmc

    sequence = qmc.Sobol(dimensions, scramble=True, bits=32, rng=np.random.default_rng(seed))
    block = _GPU_BLOCK if device.startswith("cuda") else _BLOCK
    for first in range(0, rays, block):
        yield sequence.random(block)[: rays - first]


Kernel = Float32[np.ndarray, "size size channels"]


@runtime_checkable
class PsfModel(Protocol):
    """Function from a few physical coordinates to a point spread function.

    Positions are pixels, x right, y down; the source of the light is the centre of the middle pixel of a kernel. A model
    that `turns` with the motion gives kernels for motion to the right (+x), one that turns with the field gives them for
    a source to the right of the middle of the frame; whoever uses them turns them (from x towards y).

    name: as on the command line. axes: the coordinates, in the order in which they are passed. counts: steps of the
    (nested) grid along each axis. knee_px: not None makes the grid a proportional one (`PsfBank`). channels: 1, or 3 for red,
    green, blue. near_side_turned: in front of the focus (negative diameter) the kernel is the one behind it, turned by half a turn.
    default_rays: rays per kernel of a bank unless the user says otherwise; 0 where the closed form is better.
    device: of torch, on which rays are traced ("cuda", "cpu"; `torch_tracing`); "" takes the compiled loops. The light is the same.
    settings: what else the kernels depend on, as JSON values; a half-built bank is only gone on with where they agree.
    """

    @property
    def name(self) -> str: ...
    @property
    def axes(self) -> tuple[Axis, ...]: ...
    @property
    def counts(self) -> tuple[int, ...]: ...
    @property
    def knee_px(self) -> float | None: ...
    @property
    def channels(self) -> int: ...
    @property
    def turns(self) -> Turns: ...
    @property
    def near_side_turned(self) -> bool: ...
    @property
    def default_rays(self) -> int: ...
    @property
    def device(self) -> str: ...
    @property
    def settings(self) -> dict[str, Any]: ...

    def kernel(self, box: Float64[np.ndarray, "axes 2"], rays: int, seed: int) -> Kernel:
        """Return the PSF averaged over a box of coordinates (rows: axes; columns: low and high end): pre-filtering, Section 5.4.

        The average is uniform over the box, along each axis in the measure of `Axis.between`: a ray takes the coordinates
        `axis.between(low, high, share)` for quasi-random shares in [0, 1). A box without extent gives one PSF.
        rays: how many are traced; the same rays and seed give the same kernel to the last bit (on one device). 0: the closed
        form, averaged (InputError where the model has none).
        Returns (K, K, C), K odd, at least as large as the light reaches, >= 0; each channel sums to 1, or to the share of
        light that is not absorbed.
        """
        ...

    def exact(self, coords: Float64[np.ndarray, " axes"]) -> Kernel | None:
        """Return the PSF at a point in closed form, each pixel the exact integral over its area; None if there is no such form."""
        ...


def digest(*arrays: np.ndarray) -> str:
    """Return a short name for the contents of arrays (rounded to 9 decimals), for `settings` that would be long."""
    rounded = b"".join(np.round(np.asarray(array, np.float64), 9).tobytes() for array in arrays)
    return sha256(rounded).hexdigest()[:16]


def nodes(axis: Axis, low: float, high: float, largest_step: float) -> Float64[np.ndarray, " nodes"]:
    """Return the middles of equal parts of an interval, none longer than `largest_step`: where a closed form is averaged over it."""
    count = max(1, int(np.ceil((high - low) / largest_step)))
    return axis.between(low, high, (np.arange(count) + 0.5) / count)


def check_positive(name: str, value: float) -> float:
    if not (np.isfinite(value) and value > 0.0):
        raise InputError(f"{name} must be a positive number, got {value}")
    return float(value)


def centred(kernel: np.ndarray, size: int) -> np.ndarray:
    """Return a kernel (K, K, ...) with a border of zeros, so that it is `size` wide; both odd."""
    border = (size - kernel.shape[0]) // 2
    return np.pad(kernel, ((border, border), (border, border), *((0, 0),) * (kernel.ndim - 2)))

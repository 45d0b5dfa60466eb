"""Blending of a bank's kernels: every pixel's light is divided among the kernels around it, and each share is summed by its own.

Places in the frame share in proportion (bilinearly), so that nothing jumps where one cell of the bank ends; the shares of a
pixel sum to 1, so no light is lost or doubled. Renderers differ in how a side of the focus is summed (`SideSum`); `scatter_side` is
the plain way, by the exact kernels, blended.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property, reduce
from itertools import product
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float64, Int64

from mrbokeh.layering.psf_over_field import Channels, Plane
from mrbokeh.optics.psf import kernel_radius_px
from mrbokeh.renderers.bank.lattice import Around, BankLattice
from mrbokeh.renderers.bank.tables import BankTables, Place, turned_kernel
from mrbokeh.system.errors import InputError

_LARGE_PX = 8.0
_ALL_LIGHT = 1e-6  # kernels that sum to 1 within the rounding of float32
SHARP_PX = 1.0

Shares = Iterator[tuple[Plane | None, Any]]
"""How much of each pixel's light an opening takes, and the opening; None is all, for the only opening there is."""


@runtime_checkable
class SideSum(Protocol):
    """The sum over pixels on one side of the focus (signed diameters coc_px) of value times kernel of a channel of the bank.

    Kernels sum to 1 here. A pixel whose values are all 0 adds nothing. Same size out; light that leaves the frame is lost.
    """

    def __call__(self, values: Channels, coc_px: Plane, side: int, channel: int, around: Around) -> Channels: ...


@dataclass
class BlendedTables(BankTables):
    """Tables for mrbokeh.renderers.bank.bank_psf.BankPsf of a bank whose kernels are blended with those of the cells beside.

    unit_radius: how far apertures that stand for the kernels reach, 0 if none do.
    """

    unit_radius: float = 0.0

    @cached_property
    def lattice(self) -> BankLattice:
        return BankLattice(self.bank)

    @cached_property
    def largest_px(self) -> float:
        return float(np.abs(self.bank.boxes[:, self.diameter_axis]).max())

    @cached_property
    def reaches_px(self) -> Int64[np.ndarray, " cells"]:
        """Reach of each cell's kernel, the kernels of the cells beside it, and the apertures that stand for them."""
        own, axes = super().reaches_px, range(len(self.bank.axes))
        reaches, steps = own.copy(), list(product((-1, 0, 1), repeat=len(axes)))
        for cell, box in enumerate(self.bank.boxes):
            middle, width = self.bank.centres[cell], 0.75 * (box[:, 1] - box[:, 0])
            beside = self.bank.nearest(np.array([middle + np.array(step) * width for step in steps]))
            drawn = kernel_radius_px(float(np.abs(box[self.diameter_axis]).max()), self.unit_radius)
            reaches[cell] = max(int(own[beside].max()), drawn if self.unit_radius else 0)
        return reaches

    @cached_property
    def diameter_axis(self) -> int:
        return [axis.name for axis in self.bank.axes].index("diameter_px")


@dataclass(frozen=True, eq=False)
class AnchorKernels:
    """The kernels of a lattice turned to where they are used, kept."""

    lattice: BankLattice
    _kept: dict[tuple[int, int, int], Float64[np.ndarray, "_ _ channels"]] = field(default_factory=dict, repr=False)

    def kernel(self, side: int, node: int, anchor: int) -> Float64[np.ndarray, "size size channels"]:
        """Return the kernel as behind the focus, each channel with sum 1."""
        key = side, node, anchor
        if key not in self._kept:
            place, angle_rad = self.lattice.place_and_angle(anchor)
            kernel = self.lattice.kernel(side, node, place)
            turned = turned_kernel(kernel.astype(np.float32), angle_rad) if angle_rad else kernel
            self._kept[key] = _without_border(turned / turned.sum(axis=(0, 1)))
        return self._kept[key]

    @cached_property
    def unit_radius(self) -> float:
        """Reach of kernels of 8 px or more, in radii of their circles of confusion; at least 1."""
        tables = BlendedTables(self.lattice.bank, None)
        reaches = 2.0 * BankTables(self.lattice.bank, None).reaches_px + 1.0
        diameters_px = np.abs(self.lattice.bank.centres[:, tables.diameter_axis])
        large = diameters_px >= _LARGE_PX
        return float(np.max(reaches[large] / diameters_px[large], initial=1.0))


def _without_border(kernel: Float64[np.ndarray, "_ _ channels"]) -> Float64[np.ndarray, "_ _ channels"]:
    """Return a kernel without rows and columns of zeros all around."""
    middle = len(kernel) // 2
    reach = int(np.abs(np.argwhere(kernel.any(axis=2)) - middle).max())
    return np.ascontiguousarray(kernel[middle - reach : middle + reach + 1, middle - reach : middle + reach + 1])


def blend_colours(tables: BlendedTables, sum_side: SideSum, values: Channels, coc_px: Plane, place: Place) -> Channels:
    """Return R, G, B, coverage (three times for a bank of three colours) and others, as LaplacianSpreadlets.sum_bank_kernels does."""
    lit = not_black(values)
    if not np.isfinite(coc_px[lit]).all():
        raise InputError("every visible pixel needs a finite circle of confusion: depth must be positive (or inf), not 0 or NaN")
    coc_px = np.where(lit, np.clip(coc_px, -tables.largest_px, tables.largest_px), np.float32(0.0)).astype(np.float32)
    around = Around.of(tables.lattice, place, coc_px.shape)
    behind = coc_px > 0
    sides = {side: here for side, here in ((1, behind), (-1, lit & ~behind)) if here.any()}

    def summed(picked: Channels, colours: int, channel: int) -> Channels:
        """Sum both sides of the focus. picked: channels of the picture, the first of which are colours."""
        total = np.zeros_like(picked) if len(sides) != 1 else None
        for side, here in sides.items():
            passed = _passed(tables.lattice, coc_px, side, channel, around)
            mine = picked if len(sides) == 1 and passed is None else picked * here[..., None]
            if passed is not None:
                mine[..., :colours] *= passed[..., None]
            seen = sum_side(mine, coc_px, side, channel, around)
            total = seen if total is None else total + seen
        assert total is not None
        return total

    if tables.bank.channels == 1:
        return summed(values, 3, 0)
    others = list(range(3, values.shape[2]))
    each = [summed(values[..., [c, *(others if c == 1 else [3])]], 1, c) for c in range(3)]
    return np.concatenate([*(light[..., :1] for light in each), *(light[..., 1:2] for light in each), each[1][..., 2:]], axis=2)


def sum_openings(values: Channels, coc_px: Plane, shares: Shares, kernel_sum: Callable[..., Channels]) -> Channels:
    """Return sharp pixels as they are, and add every opening's share of light, blurred within the window that it reaches."""
    blurred = not_black(values) & (np.abs(coc_px) > SHARP_PX)
    total = np.where(blurred[..., None], np.float32(0.0), values)
    for share, opening in shares:
        if share is None:
            return kernel_sum(np.ascontiguousarray(values), coc_px, opening)
        mine = blurred & (share > 0)
        rows, columns = np.flatnonzero(mine.any(axis=1)), np.flatnonzero(mine.any(axis=0))
        if not rows.size:
            continue
        reach = kernel_radius_px(float(np.abs(coc_px[mine]).max()), opening.unit_radius)
        ends = ((each[0], each[-1] + 1, length) for each, length in zip((rows, columns), mine.shape, strict=True))
        window = tuple(slice(max(0, first - reach), min(length, stop + reach)) for first, stop, length in ends)
        part = values[window] * np.where(mine[window], share[window], np.float32(0.0))[..., None]
        total[window] += kernel_sum(np.ascontiguousarray(part), np.ascontiguousarray(coc_px[window]), opening)
    return total


def not_black(values: Channels) -> Bool[np.ndarray, "height width"]:
    """Return the pixels that hold any light, faster than `any` along a short axis."""
    return np.asarray(reduce(np.logical_or, np.moveaxis(values[..., 1:], -1, 0), values[..., 0] != 0.0))


def _passed(lattice: BankLattice, coc_px: Plane, side: int, channel: int, around: Around) -> Plane | None:
    """Return the share of each pixel's light that the lens lets through; None is all."""
    known = lattice.light(side)[..., channel]
    if np.abs(known - 1.0).max() < _ALL_LIGHT:
        return None
    lower, upper = lattice.diameter_shares(side, np.abs(coc_px))
    places = around.anchors // lattice.directions
    ends = [(known[np.minimum(lower + i, len(known) - 1)[..., None], places] * around.shares).sum(axis=-1) for i in (0, 1)]
    return ((1.0 - upper) * ends[0] + upper * ends[1]).astype(np.float32)


def scatter_side(kernels: AnchorKernels, values: Channels, coc_px: Plane, side: int, channel: int, around: Around) -> Channels:
    """Sum a side of the focus plainly (`SideSum`); kernels are blended over place (bilinearly) and diameter (linearly), summed in
    float64.
    """
    from mrbokeh.renderers.bank._scatter_numba import scatter_blended

    lattice = kernels.lattice
    lower, upper = lattice.diameter_shares(side, np.abs(coc_px))
    nodes = np.stack([lower, np.minimum(lower + 1, len(lattice.diameters_px[side]) - 1)], axis=-1)
    of_nodes = np.stack([1.0 - upper, upper], axis=-1)
    weights = (of_nodes[..., :, None] * around.shares[..., None, :]).reshape(*coc_px.shape, 8)
    weights = np.where(np.any(values != 0, axis=-1)[..., None], weights, 0.0)
    codes = (nodes[..., :, None] * lattice.anchors + around.anchors[..., None, :]).reshape(*coc_px.shape, 8)
    used = np.unique(codes[weights > 0.0])
    found = [kernels.kernel(side, *divmod(int(code), lattice.anchors))[..., channel] for code in used]
    taps = [kernel if side > 0 else kernel[::-1, ::-1] for kernel in found]
    radii_px = np.array([len(each) // 2 for each in taps], np.int64)
    starts = np.cumsum([0, *(each.size for each in taps[:-1])])
    margin, (height, width) = int(radii_px.max()), coc_px.shape
    padded = np.zeros((height + 2 * margin, width + 2 * margin, values.shape[2]))
    numbers = np.searchsorted(used, np.where(weights > 0.0, codes, used[0]))
    scatter_blended(
        padded, values.astype(np.float64), numbers, weights, np.concatenate([each.ravel() for each in taps]), starts, radii_px, margin
    )
    return padded[margin : margin + height, margin : margin + width].astype(np.float32)

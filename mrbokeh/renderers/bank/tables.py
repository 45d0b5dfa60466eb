"""Tables of a bank: the kernel of every pixel, the nearest sample turned to where it is used (Leimkuehler et al. 2018, Section 6.2)."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64

from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.renderers.kernels.laplacian_tables import Points, by_rows, joined_points, taps_of
from mrbokeh.renderers.kernels.spreadlets import Sparsification, Spreadlet, Spreadlets, sparsify, turned, whole_laplacian
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError

_LEAST_ANGLES, _MOST_ANGLES = 16, 256
_DENSE_TAPS = 452  # those of a disc of 24 px: fewer are splatted as they are
_DENSE_RIM = 2  # taps for each on the rim: a line that is up to about 4 px wide
_MOST_TURNED = 1024
"""Turning a spreadlet takes the cube of its points, seconds beyond this; a kernel so busy is turned before its Laplacian is taken."""
_SHOW_FROM = 8
_MOST_KERNELS = 1 << 15  # that are kept between calls


@dataclass(frozen=True)
class Place:
    """Coordinates of pixels in a bank besides the circle of confusion; those that the bank does not need may be None.

    motion_px (..., 2): right and down per shutter. field_xy (..., 2): position in half diagonals. depth_m (...).
    """

    motion_px: Float[np.ndarray, "*batch 2"] | None = None
    field_xy: Float[np.ndarray, "*batch 2"] | None = None
    depth_m: Float[np.ndarray, "*batch"] | None = None


@dataclass
class BankTables:
    """Spreadlets of a bank's kernels, made once, and their turned copies, kept. A code is cell * angles + angle, twice:
    even for the sparse kernel, odd for the whole one."""

    bank: PsfBank
    sparsification: Sparsification | None
    spreadlets: Spreadlets | None = None
    _kept: dict[tuple[int, bool], Spreadlet] = field(default_factory=dict)

    @cached_property
    def angles(self) -> int:
        """Number of directions that are told apart, even so that half a turn is one of them."""
        if self.bank.turns == "none":
            return 2
        return int(np.clip(4 * self.bank.radius_px, _LEAST_ANGLES, _MOST_ANGLES)) // 2 * 2

    @cached_property
    def needed(self) -> frozenset[str]:
        """Names of what a `Place` must hold: "motion", "field", "depth"."""
        of_axes = {"motion_px": "motion", "eccentricity": "field", "field_x": "field", "field_y": "field", "depth_m": "depth"}
        names = {self.bank.turns, *(of_axes.get(axis.name, "none") for axis in self.bank.axes)}
        return frozenset(names - {"none"})

    @property
    def holds_motion(self) -> bool:
        return "motion" in self.needed

    @cached_property
    def reaches_px(self) -> Int64[np.ndarray, " cells"]:
        """Whole pixels that the light of each cell's kernel travels at most along rows or columns, however it is turned."""
        return np.array([_reach_px(kernel, self.bank.turns != "none") for kernel in self.bank.kernels], np.int64)

    def cells(self, coc_px: Float32[np.ndarray, "*batch"], place: Place) -> Int64[np.ndarray, "*batch"]:
        """Return the cell of the bank that holds each pixel."""
        planes = [self._coordinate(axis.name, coc_px, place) for axis in self.bank.axes]
        return self.bank.nearest(np.stack(planes, axis=-1).astype(np.float64))

    def farthest_px(self, coc_px: Float32[np.ndarray, " pixels"]) -> int:
        """Return how far light of these diameters travels at most, by a bank over diameters alone."""
        if coc_px.size == 0:
            return 0
        diameters_px = coc_px if self.bank.axes[0].is_signed else np.abs(coc_px)
        first, last = self.cells(np.array([diameters_px.min(), diameters_px.max()], np.float32), Place())
        return int(self.reaches_px[first : last + 1].max())

    def codes(
        self, coc_px: Float32[np.ndarray, "height width"], bright: Bool[np.ndarray, "height width"], place: Place
    ) -> Int64[np.ndarray, "height width"]:
        """Return the code of every pixel's kernel."""
        turn = np.zeros(coc_px.shape, np.int64)
        if self.bank.turns != "none":
            way = self._needed(place.motion_px if self.bank.turns == "motion" else place.field_xy, self.bank.turns)
            turn = np.rint(np.arctan2(way[..., 1], way[..., 0]) * self.angles / (2.0 * np.pi)).astype(np.int64)
        if self.bank.near_side_turned:
            turn = turn + np.where(coc_px < 0, self.angles // 2, 0)
        return 2 * (self.cells(coc_px, place) * self.angles + turn % self.angles) + bright

    def light(self, codes: Int64[np.ndarray, "*batch"]) -> Float32[np.ndarray, "*batch channels"]:
        """Return the sum of each code's kernel."""
        return self.bank.throughput.astype(np.float32)[codes // 2 // self.angles]

    def is_dense(self, code: int) -> bool:
        """Return whether a kernel is splatted tap by tap (Section 6.4): it has few taps, or most are rim, so that points would be no
        fewer.
        """
        return bool(self._dense[code // 2 // self.angles])

    @cached_property
    def _dense(self) -> Bool[np.ndarray, " cells"]:
        from scipy.ndimage import binary_erosion

        supports = [kernel.any(axis=2) for kernel in self.bank.kernels]
        return np.array([seen.sum() <= max(_DENSE_TAPS, _DENSE_RIM * (seen & ~binary_erosion(seen)).sum()) for seen in supports])

    def points(self, codes: Sequence[int], dense: bool, channel: int) -> Points:
        """Return the points of these codes, in their order; new ones are computed and kept. dense: all taps."""
        if len(self._kept) > _MOST_KERNELS:
            self._kept.clear()
        found = {code: self._kept.get((code, dense)) for code in codes}
        new = [code for code, spreadlet in found.items() if spreadlet is None]
        for code in track(new, "spreadlets of the bank") if len(new) >= _SHOW_FROM else new:
            found[code] = self._made(code, dense)
        return joined_points([found[code] for code in codes], channel)

    def _made(self, code: int, dense: bool) -> Spreadlet:
        """Return the points of a code, sorted by row, and keep them."""
        if (code, dense) not in self._kept:
            self._kept[code, dense] = by_rows(self._computed(code, dense))
        return self._kept[code, dense]

    def _computed(self, code: int, dense: bool) -> Spreadlet:
        cell, turn = divmod(code // 2, self.angles)
        angle_rad = 2.0 * np.pi * turn / self.angles
        if dense or code % 2 or self.sparsification is None:
            kernel = turned_kernel(self.bank.kernels[cell], angle_rad)
            return taps_of(kernel) if dense else whole_laplacian(kernel)
        if turn:
            upright = self._made(code - 2 * turn, dense=False)
            if len(upright.points) > _MOST_TURNED:
                return whole_laplacian(turned_kernel(self.bank.kernels[cell], angle_rad))
            return Spreadlet(*turned(upright.points, upright.values, angle_rad))
        return self.spreadlets[cell] if self.spreadlets is not None else sparsify(self.bank.kernels[cell], self.sparsification)

    def _coordinate(self, name: str, coc_px: np.ndarray, place: Place) -> np.ndarray:
        if name == "diameter_px":
            return coc_px
        if name == "depth_m":
            return self._needed(place.depth_m, "depth")
        if name == "motion_px":
            return np.hypot(*np.moveaxis(self._needed(place.motion_px, "motion"), -1, 0))
        right, down = np.moveaxis(self._needed(place.field_xy, "the place in the frame"), -1, 0)
        return {"field_x": right, "field_y": down}.get(name, np.hypot(right, down))

    def _needed(self, plane: np.ndarray | None, what: str) -> np.ndarray:
        if plane is None:
            raise InputError(f"the bank '{self.bank.model}' needs {what} for every pixel, but none came: give it or take another bank")
        return plane


def _reach_px(kernel: Float32[np.ndarray, "size size channels"], turns: bool) -> int:
    """Return the distance to the farthest tap along rows or columns; as the crow flies, and with what interpolation adds, for a kernel
    that turns.
    """
    down, right = np.abs(np.argwhere(kernel.any(axis=2)) - kernel.shape[0] // 2).T
    return int(np.ceil(np.hypot(down, right).max() + np.sqrt(2.0))) if turns else int(max(down.max(), right.max()))


def turned_kernel(kernel: Float32[np.ndarray, "size size channels"], angle_rad: float) -> Float64[np.ndarray, "side side channels"]:
    """Return a kernel turned about its middle pixel from x towards y, interpolated, with its light; half turns are exact."""
    quarters = angle_rad / (0.5 * np.pi)
    if abs(quarters - round(quarters)) < 1e-9:
        return np.ascontiguousarray(np.rot90(kernel, -round(quarters))).astype(np.float64)
    from scipy.ndimage import affine_transform

    radius = kernel.shape[0] // 2
    side = int(np.ceil(np.sqrt(2.0) * radius)) + 1 - radius
    wide = np.pad(kernel.astype(np.float64), ((side, side), (side, side), (0, 0)))
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    back, middle = np.array([[cosine, -sine], [sine, cosine]]), np.full(2, wide.shape[0] // 2)
    out = np.stack([affine_transform(wide[..., c], back, middle - back @ middle, order=1) for c in range(wide.shape[2])], axis=2)
    return out * (kernel.sum(axis=(0, 1), dtype=np.float64) / out.sum(axis=(0, 1)))

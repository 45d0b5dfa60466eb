"""The PSF over the field of a bank: the kernel that each pixel of a layer takes, how far its light travels, and how much gets through.

The bank's coordinates come from what a slice holds anyway: depth from the circle of confusion, the place in the frame from
that of the pixel, motion from the extra channels that carry it. Pixels with which a layer is continued beyond the frame see
the lens as it is there, outside (at most as far out as the bank goes).

Slices are still sorted by the circle of confusion: pixels that differ in depth but not in it share a slice and hide nothing of it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float32, Float64, Int64

from mrbokeh.images.layer import Layer
from mrbokeh.layering.motion import MOTION, farthest_px, motion_channels, motion_of, moved
from mrbokeh.layering.padded_layers import Part
from mrbokeh.layering.psf_over_field import Channels, Frame, Plane
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.drawn_diameters import drawn_diameters_px
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.psf_bank import Axis
from mrbokeh.renderers.bank.bank_lens import is_lossless, opening_of, stated_lens
from mrbokeh.renderers.bank.tables import BankTables, Place
from mrbokeh.system.errors import InputError

_SAME_SCALE, _SAME_FOCUS_PX = 0.03, 2.0
_BEYOND_PX, _BEYOND = 1.0, 1.05  # how far the largest kernel stands for larger ones


@dataclass(frozen=True)
class BankPsf:
    """PsfField of a bank of kernels (mrbokeh.layering.psf_over_field).

    sum_bank_kernels: the sum of kernels (LaplacianSpreadlets). motion: the channels that hold it, if there are any, and farthest_px:
    how far light moves at most. A bank without motion gets its light drawn out along its path before, as an aperture does.
    """

    tables: BankTables
    sum_bank_kernels: Callable[[Channels, Plane, Place], Channels]
    lens: Lens
    size: tuple[int, int]
    motion: slice | None
    farthest_px: int

    @classmethod
    def of(
        cls, layers: Sequence[Layer], lens: Lens, tables: BankTables, sum_bank_kernels: Callable[[Channels, Plane, Place], Channels]
    ) -> "BankPsf":
        """Make one for these layers."""
        return cls(
            tables=tables,
            sum_bank_kernels=sum_bank_kernels,
            lens=lens,
            size=layers[0].alpha.shape,
            motion=motion_channels(layers[0].extra),
            farthest_px=farthest_px(layers),
        )

    @property
    def coverages(self) -> int:
        return self.tables.bank.channels

    @property
    def opening(self) -> Aperture | None:
        is_one = self.farthest_px == 0 and self.coverages == 1 and not self.tables.needed
        return opening_of(self.tables.bank) if is_one and is_lossless(self.tables.bank) else None

    def drawn_px(self, coc_px: Plane) -> Plane:
        """Return drawn diameters: kernels of banks hold the pixel's area as those of openings do.

        Those of a disc would differ by 0.3 px: 0.7 dB in a composite through a heart.
        """
        return drawn_diameters_px(coc_px, opening_of(self.tables.bank))

    def margin_px(self, layers: Sequence[Layer], coc_px: Sequence[Plane]) -> int:
        """Return the margin; InputError if blur or motion is clearly larger than the bank's largest, or it is of another focus or scale."""
        self._check_made_for()
        reach, frame = 0, Frame(self.size[1], self.size[0])
        for layer, circles in zip(layers, coc_px, strict=True):
            rows, columns = np.nonzero(layer.alpha > 0)
            motion_px = motion_of(layer.extra[MOTION], layer.alpha)[rows, columns] if MOTION in layer.extra else None
            self._check_range("diameter_px", np.abs(circles))
            self._check_range("motion_px", np.zeros(1) if motion_px is None else np.hypot(*motion_px.T))
            reach = max(reach, self._reach_px(circles[rows, columns], motion_px, rows, columns, frame))
        return reach

    def reach_px(self, parts: Sequence[Part], largest_coc_px: float, frame: Frame) -> int:  # noqa: ARG002
        """Return the reach of the farthest reaching kernel among those of the pixels."""
        width = frame.width_px - 2 * frame.left_px
        reach = 0
        for part in parts:
            who = _members(part)
            values = part.pixels.values
            motion_px = None if self.motion is None else motion_of(values[who, self.motion], values[who, 3])
            places = part.pixels.places[who].astype(np.int64)
            reach = max(reach, self._reach_px(part.pixels.coc_px[who], motion_px, places // width, places % width, frame))
        return reach

    def blur(self, values: Channels, coc_px: Plane, frame: Frame) -> Channels:
        motion_px = None
        if self.motion is not None and self.tables.holds_motion:
            motion_px = motion_of(values[..., self.motion], values[..., 3])
        elif self.motion is not None and self.farthest_px > 0:
            values, coc_px = moved(values, coc_px, self.motion)
        rows_columns = np.indices(coc_px.shape)
        return self.sum_bank_kernels(values, coc_px, self._place(coc_px, motion_px, rows_columns[0], rows_columns[1], frame))

    def _reach_px(
        self,
        coc_px: Float32[np.ndarray, " pixels"],
        motion_px: Float32[np.ndarray, "pixels 2"] | None,
        rows: Int64[np.ndarray, " pixels"],
        columns: Int64[np.ndarray, " pixels"],
        frame: Frame,
    ) -> int:
        if len(self.tables.bank.axes) == 1 and not self.tables.needed:
            reach = self.tables.farthest_px(coc_px)
        else:
            cells = self.tables.cells(coc_px, self._place(coc_px, motion_px, rows, columns, frame))
            reach = int(self.tables.reaches_px[cells].max(initial=0))
        return reach if self.tables.holds_motion else reach + self.farthest_px

    def _place(
        self,
        coc_px: Float32[np.ndarray, "*batch"],
        motion_px: Float32[np.ndarray, "*batch 2"] | None,
        rows: Int64[np.ndarray, "*batch"],
        columns: Int64[np.ndarray, "*batch"],
        frame: Frame,
    ) -> Place:
        """Return the bank's coordinates of pixels; motion is 0 for pixels that do not move."""
        needed, (height, width) = self.tables.needed, self.size
        still = np.zeros((*coc_px.shape, 2), np.float32) if motion_px is None else motion_px
        down, right = rows + frame.top_px, columns + frame.left_px
        middle, half_diagonal_px = (0.5 * width - 0.5, 0.5 * height - 0.5), 0.5 * np.hypot(width, height)
        return Place(
            still if "motion" in needed else None,
            np.stack([right - middle[0], down - middle[1]], axis=-1) / half_diagonal_px if "field" in needed else None,
            self._depth_m(coc_px, down, right) if "depth" in needed else None,
        )

    def _depth_m(
        self, coc_px: Float32[np.ndarray, "*batch"], down: Int64[np.ndarray, "*batch"], right: Int64[np.ndarray, "*batch"]
    ) -> Float64[np.ndarray, "*batch"]:
        """Return the depth at which a pixel has this circle of confusion: `Lens.coc_px` solved for depth."""
        focus = self._focus_dioptres
        in_focus = focus if focus.ndim == 0 else focus[np.clip(down, 0, self.size[0] - 1), np.clip(right, 0, self.size[1] - 1)]
        dioptres = in_focus - coc_px.astype(np.float64) / self.lens.coc_px_per_dioptre(self.size[1])
        return np.divide(1.0, dioptres, out=np.full(coc_px.shape, np.inf), where=dioptres > 0.0)

    @cached_property
    def _focus_dioptres(self) -> Float64[np.ndarray, "..."]:
        if self.lens.has_flat_focus:
            return np.array(1.0 / self.lens.focus_distance_m)
        return self.lens.focus_dioptres(self.size[1], self.size[0])

    def _check_made_for(self) -> None:
        """Raise InputError if kernels over depth, which hold one focus distance and one size of the pixels, are used with others."""
        bank, made_for = self.tables.bank, stated_lens(self.tables.bank)
        if made_for is None or "mm_per_px" not in bank.settings:
            return
        wanted_px = round(self.lens.sensor_width_mm / bank.settings["mm_per_px"])
        if abs(self.size[1] / wanted_px - 1.0) > _SAME_SCALE:
            raise InputError(
                f"the bank '{bank.model}' is for pictures {wanted_px} px wide, but this one is {self.size[1]} px wide: build one with "
                f"--image-width {self.size[1]}, or resize the picture"
            )
        off_px = abs(float(self.lens.coc_px(made_for.focus_distance_m, self.size[1])))
        if off_px > _SAME_FOCUS_PX:
            raise InputError(
                f"the bank '{bank.model}' is focused at {made_for.focus_described}, but the lens at {self.lens.focus_described}: build one "
                f"with --focus {self.lens.focus_distance_m:.4g}"
            )

    def _check_range(self, name: str, values: np.ndarray) -> None:
        axis = next((each for each in self.tables.bank.axes if each.name == name), None)
        largest = float(values.max(initial=0.0))
        if axis is not None and largest > axis.high * _BEYOND + _BEYOND_PX:
            raise InputError(_too_small(self.tables.bank.model, axis, largest))


def _too_small(model: str, axis: Axis, largest: float) -> str:
    what, option = ("circles of confusion", "--diameter") if axis.name == "diameter_px" else ("motion", "--longest-motion")
    return (
        f"the bank '{model}' holds {what} up to {axis.high:g} px, but this picture has {largest:.1f} px: "
        f"build one that goes so far ({option}), or blur less"
    )


def _members(part: Part) -> Int64[np.ndarray, " members"]:
    """Return the numbers of the pixels in a part's runs."""
    first, lengths = part.runs[:, 0].astype(np.int64), (part.runs[:, 1] - part.runs[:, 0]).astype(np.int64)
    return np.arange(lengths.sum()) + np.repeat(first - np.cumsum(lengths) + lengths, lengths)

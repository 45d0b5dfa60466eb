"""The PSF over the field (`PsfField`) and the sum of kernels (`KernelSum`): how far a slice's light travels, and where it arrives.

A `KernelSum` is what classical renderers differ in. It knows plain apertures only, weighted polygons that hold for every pixel and
colour. What varies with the side of the focus, the place in the frame or the colour is resolved once for all of them by `AperturePsf`:
pixels are sorted by side and by field cell, and each group goes through the plain aperture that it sees. Kernels that come from
elsewhere may be wide where an opening's are points, hold motion themselves, or lose light: they bring a PsfField of their own
(mrbokeh.renderers.bank.bank_psf).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.layer import Layer
from mrbokeh.layering.motion import farthest_px, motion_channels, moved
from mrbokeh.layering.padded_layers import Part
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.drawn_diameters import drawn_diameters_px
from mrbokeh.optics.psf import kernel_radius_px

FIELD_CELLS = (16, 9)
"""Columns and rows of field cells: within one, every pixel sees the opening as the cell's centre does."""


@runtime_checkable
class KernelSum(Protocol):
    """The sum over all pixels of value times PSF, same size out; light that leaves the frame is lost.

    values: (H, W, C), HDR; a pixel whose values are all 0 adds nothing, whatever its circle of confusion.
    coc_px: (H, W) signed diameters. aperture: plain. The result is the same to the bit for any number of threads.
    """

    def __call__(
        self, values: Float32[np.ndarray, "height width channels"], coc_px: Float32[np.ndarray, "height width"], aperture: Aperture
    ) -> Float32[np.ndarray, "height width channels"]: ...


@dataclass(frozen=True)
class Frame:
    """Placement of an array of pixels in the picture that the lens sees: its top left corner and the picture's size."""

    width_px: int
    height_px: int
    left_px: int = 0
    top_px: int = 0

    def moved(self, right_px: int, down_px: int) -> "Frame":
        """Return the frame of a part of the array that begins so much farther right and down."""
        return Frame(self.width_px, self.height_px, self.left_px + right_px, self.top_px + down_px)

    def field_at(self, x_px: float, y_px: float) -> tuple[float, float]:
        """Return the field position of a place in the array: 0 in the middle of the picture, 1 half a diagonal away; x right, y down."""
        half_diagonal_px = 0.5 * float(np.hypot(self.width_px, self.height_px))
        right_px, down_px = x_px + self.left_px - 0.5 * self.width_px, y_px + self.top_px - 0.5 * self.height_px
        return right_px / half_diagonal_px, down_px / half_diagonal_px


def field_cells_of(rows: np.ndarray, columns: np.ndarray, aperture: Aperture, frame: Frame) -> np.ndarray:
    """Return the field cell of places of the picture, counted row by row; 0 where the opening is the same all over it."""
    if not aperture.varies_over_field:
        return np.zeros(np.broadcast(rows, columns).shape, np.int64)
    across, down = FIELD_CELLS
    cell_row = np.clip(rows * down // frame.height_px, 0, down - 1)
    return cell_row * across + np.clip(columns * across // frame.width_px, 0, across - 1)


def opening_of_cell(aperture: Aperture, cell: int, frame: Frame) -> Aperture:
    """Return the opening that a field cell sees."""
    if not aperture.varies_over_field:
        return aperture.seen(1)
    (row, column), picture = divmod(cell, FIELD_CELLS[0]), replace(frame, left_px=0, top_px=0)
    return aperture.seen(
        1, picture.field_at((column + 0.5) * frame.width_px / FIELD_CELLS[0], (row + 0.5) * frame.height_px / FIELD_CELLS[1])
    )


def reach_px(aperture: Aperture, largest_coc_px: float) -> int:
    """Return how many whole pixels light travels at most at this diameter, whatever the colour and the place."""
    if largest_coc_px == 0.0:
        return 0
    drift = max(map(abs, aperture.lateral_chromatic))
    growth = max(max(aperture.channel_scale(side)) for side in (-1, 1)) if aperture.is_chromatic else 1.0
    return kernel_radius_px(largest_coc_px * growth, aperture.unit_radius + drift)


def blur_colours(
    kernel_sum: KernelSum,
    values: Float32[np.ndarray, "height width channels"],
    coc_px: Float32[np.ndarray, "height width"],
    aperture: Aperture,
    frame: Frame,
    field_cells: tuple[int, int] = FIELD_CELLS,
) -> Float32[np.ndarray, "height width channels_out"]:
    """Blur premultiplied R, G, B, coverage and any other channels by an aperture with all that varies, colour by colour if it is chromatic.

    For a chromatic aperture the coverage differs by colour: three channels of coverage come back in place of one, so that the result has
    R, G, B, three coverages and the others (which go with green).
    """
    if aperture.is_plain:
        return kernel_sum(values, coc_px, aperture)
    if not aperture.is_chromatic:
        return _blur_field_cells(kernel_sum, values, coc_px, aperture, frame, field_cells, None)
    rest = list(range(4, values.shape[2]))
    spreads = []
    for channel, also in ((0, []), (1, rest), (2, [])):
        scale = np.where(coc_px > 0, aperture.channel_scale(1)[channel], aperture.channel_scale(-1)[channel]).astype(np.float32)
        picked = np.ascontiguousarray(values[..., [channel, 3, *also]])
        spreads.append(_blur_field_cells(kernel_sum, picked, coc_px * scale, aperture, frame, field_cells, channel))
    colours, coverages = [each[..., :1] for each in spreads], [each[..., 1:2] for each in spreads]
    return np.concatenate([*colours, *coverages, spreads[1][..., 2:]], axis=2)


def _blur_field_cells(
    kernel_sum: KernelSum,
    values: Float32[np.ndarray, "height width channels"],
    coc_px: Float32[np.ndarray, "height width"],
    aperture: Aperture,
    frame: Frame,
    field_cells: tuple[int, int],
    channel: int | None,
) -> Float32[np.ndarray, "height width channels"]:
    """Blur each side of the focus and each field cell by the plain aperture that it sees, within the window that its light reaches."""
    total = np.zeros_like(values)
    live = np.any(values != 0, axis=-1)
    for side, on_side in ((1, live & (coc_px > 0)), (-1, live & ~(coc_px > 0))):
        for cell, field_xy in _cells(live.shape, frame, field_cells if aperture.varies_over_field else (1, 1)):
            here = on_side[cell]
            if not here.any():
                continue
            reach = reach_px(aperture, float(np.abs(coc_px[cell][here]).max()))
            window = tuple(slice(max(0, part.start - reach), part.stop + reach) for part in cell)
            inner = tuple(slice(part.start - around.start, part.stop - around.start) for part, around in zip(cell, window, strict=True))
            part_values = np.zeros((*total[window].shape[:2], values.shape[2]), np.float32)
            part_values[inner] = values[cell] * here[..., None]
            part_coc_px = np.ascontiguousarray(coc_px[window])
            total[window] += kernel_sum(part_values, part_coc_px, aperture.seen(side, field_xy, channel))
    return total


def _cells(shape: tuple[int, ...], frame: Frame, field_cells: tuple[int, int]) -> Iterator[tuple[tuple[slice, slice], tuple[float, float]]]:
    """Yield slices of the array and the field position of each cell's centre; pixels beyond the picture belong to its outermost cells."""
    columns = _cuts(shape[1], frame.left_px, frame.width_px, field_cells[0])
    rows = _cuts(shape[0], frame.top_px, frame.height_px, field_cells[1])
    for row, y_px in rows:
        for column, x_px in columns:
            yield (row, column), frame.field_at(x_px, y_px)


def _cuts(length: int, offset_px: int, size_px: int, cells: int) -> list[tuple[slice, float]]:
    """Return parts of one axis and, in the array's own pixels, the middle of the cell that each belongs to."""
    borders = np.rint(np.linspace(0, size_px, cells + 1)).astype(int) - offset_px
    middles = 0.5 * (borders[:-1] + borders[1:])
    borders[0], borders[-1] = min(borders[0], 0), max(borders[-1], length)
    parts = [slice(int(max(0, a)), int(min(length, b))) for a, b in pairwise(borders)]
    return [(part, float(middle)) for part, middle in zip(parts, middles, strict=True) if part.stop > part.start]


Plane = Float32[np.ndarray, "height width"]
Channels = Float32[np.ndarray, "height width _"]


@runtime_checkable
class PsfField(Protocol):
    """Point spread function over the field: how light travels from the sharp picture to the blurred one.

    coverages: 1, or 3 where red, green and blue each cover their own share of the pupil.
    """

    @property
    def coverages(self) -> int: ...

    @property
    def opening(self) -> Aperture | None:
        """Return the opening through which single rays are followed; None where none stands for all colours and sides of the focus."""
        ...

    def drawn_px(self, coc_px: Plane) -> Plane:
        """Return the signed diameters by which kernels are chosen for circles of confusion, in the same order."""
        ...

    def margin_px(self, layers: Sequence[Layer], coc_px: Sequence[Plane]) -> int:
        """Return how many whole pixels the light of any pixel of the layers, with these signed diameters, travels at most."""
        ...

    def reach_px(self, parts: Sequence[Part], largest_coc_px: float, frame: Frame) -> int:
        """Return the same for the pixels of a slice, none of whose diameters is larger. Light beyond it is dropped."""
        ...

    def blur(self, values: Channels, coc_px: Plane, frame: Frame) -> Channels:
        """Return the light (R, G, B, coverage, others, premultiplied) where it arrives, of the same height and width.

        R, G, B, then `coverages` of coverage, then others. Coverage counts shares of the pupil as this place sees it: where
        something opaque fills all of it, it is 1, however much light is lost on the way. Other channels go with coverage.
        """
        ...


@dataclass(frozen=True)
class AperturePsf:
    """PsfField of an opening, by a renderer's KernelSum; motion is drawn out along its path before (mrbokeh.layering.motion).

    motion: the channels that hold it, if anything moves, and farthest_px: by how many whole pixels at most.
    """

    aperture: Aperture
    kernel_sum: KernelSum
    field_cells: tuple[int, int] = FIELD_CELLS
    motion: slice | None = None
    farthest_px: int = 0

    @classmethod
    def of(cls, layers: Sequence[Layer], aperture: Aperture, kernel_sum: KernelSum, field_cells: tuple[int, int]) -> "AperturePsf":
        """Make one that knows the motion of these layers."""
        farthest = farthest_px(layers)
        return cls(
            aperture=aperture,
            kernel_sum=kernel_sum,
            field_cells=field_cells,
            motion=motion_channels(layers[0].extra) if farthest else None,
            farthest_px=farthest,
        )

    @property
    def coverages(self) -> int:
        return 3 if self.aperture.is_chromatic else 1

    @property
    def opening(self) -> Aperture | None:
        is_one = self.motion is None and not self.aperture.is_chromatic and self.aperture.spherical_aberration == 0.0
        return self.aperture if is_one else None

    def drawn_px(self, coc_px: Plane) -> Plane:
        return drawn_diameters_px(coc_px, self.aperture)

    def margin_px(self, layers: Sequence[Layer], coc_px: Sequence[Plane]) -> int:  # noqa: ARG002
        return reach_px(self.aperture, max(float(np.abs(each).max()) for each in coc_px)) + self.farthest_px

    def reach_px(self, parts: Sequence[Part], largest_coc_px: float, frame: Frame) -> int:  # noqa: ARG002
        return reach_px(self.aperture, largest_coc_px) + self.farthest_px

    def blur(self, values: Channels, coc_px: Plane, frame: Frame) -> Channels:
        drawn, drawn_coc_px = (values, coc_px) if self.motion is None else moved(values, coc_px, self.motion)
        return blur_colours(self.kernel_sum, drawn, drawn_coc_px, self.aperture, frame, self.field_cells)

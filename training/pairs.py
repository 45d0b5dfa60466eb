"""Training pairs from FocalStack folders: (all-in-focus picture, circles of confusion) -> photographed slice."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.optics.camera import field_positions
from mrbokeh.stacks.focal_stack import FocalStack
from training.slice_rows import StackRows, read_slice_rows, slice_size_px
from training.weights import Counting, pixel_weight


@dataclass(frozen=True)
class Pair:
    """One slice, or a part of it, and what it was made of.

    all_in_focus, target: (H, W, 3) linear radiance. coc_px: (H, W) signed diameters.
    weight: (H, W), 1 where the pixel counts, 0 where its depth or its radiance is not known or something moved.
    f_number, focal_length_mm: of the lens. coc_px_per_dioptre: how fast blur grows; focus_dioptres: what is in focus on the axis.
    origin_px: (top, left) in the whole frame, of frame_px (height, width).
    saturated: (H, W) where the target is only known to be at least so bright; None where no pixel is looked at so.
    """

    all_in_focus: Float32[np.ndarray, "height width 3"]
    coc_px: Float32[np.ndarray, "height width"]
    target: Float32[np.ndarray, "height width 3"]
    weight: Float32[np.ndarray, "height width"]
    f_number: float
    focal_length_mm: float
    coc_px_per_dioptre: float
    focus_dioptres: float
    frame_px: tuple[int, int]
    origin_px: tuple[int, int] = (0, 0)
    saturated: Bool[np.ndarray, "height width"] | None = None

    @property
    def bytes(self) -> int:
        saturated_bytes = 0 if self.saturated is None else self.saturated.nbytes
        return saturated_bytes + sum(each.nbytes for each in (self.all_in_focus, self.coc_px, self.target, self.weight))

    @property
    def place(self) -> Float32[np.ndarray, "height width 2"]:
        """Field positions: of every pixel's centre, right and down from the middle of the frame, in half diagonals."""
        return field_positions((self.coc_px.shape[0], self.coc_px.shape[1]), self.frame_px, self.origin_px)

    @property
    def dioptres(self) -> Float32[np.ndarray, "height width"]:
        """(H, W) 1 / depth; where the focus is tilted or curved, relative to a flat one."""
        return (self.focus_dioptres - self.coc_px / self.coc_px_per_dioptre).astype(np.float32)

    def cut(self, rows: slice, columns: slice) -> "Pair":
        """A part, which is a view. rows, columns: plain slices within this pair."""
        saturated = None if self.saturated is None else self.saturated[rows, columns]
        return replace(
            self,
            all_in_focus=self.all_in_focus[rows, columns],
            coc_px=self.coc_px[rows, columns],
            target=self.target[rows, columns],
            weight=self.weight[rows, columns],
            origin_px=(self.origin_px[0] + rows.start, self.origin_px[1] + columns.start),
            saturated=saturated,
        )

    def weighted(self, factor: Float32[np.ndarray, "height width"]) -> "Pair":
        """Pixels count by so much more or less."""
        return replace(self, weight=self.weight * factor)


def read_pair(
    stack: FocalStack, index: int, counting: Counting | None = None, rows: slice | None = None, shared: StackRows | None = None
) -> Pair:
    """rows: only these of the picture are read; None: all of them. shared: what the stack has in these rows, else it is read too."""
    counting, frame_px = counting or Counting(), slice_size_px(stack, index)
    read = read_slice_rows(stack, index, rows or slice(0, frame_px[0]), shared)
    lens = stack.lens_of(index)
    return Pair(
        all_in_focus=read.shared.all_in_focus,
        coc_px=_coc_px(stack, index, read.shared, frame_px),
        target=read.target,
        weight=pixel_weight(read, counting),
        f_number=lens.f_number,
        focal_length_mm=lens.focal_length_mm,
        coc_px_per_dioptre=stack.coc_px_per_dioptre(index, frame_px[1]),
        focus_dioptres=1.0 / lens.focus_distance_m,
        frame_px=frame_px,
        origin_px=(read.shared.rows.start, 0),
        saturated=read.saturated if counting.one_sided else None,
    )


def _coc_px(stack: FocalStack, index: int, read: StackRows, frame_px: tuple[int, int]) -> Float32[np.ndarray, "height width"]:
    """`FocalStack.coc_px` wants the whole picture where the focus is tilted or curved, for it then depends on the place."""
    lens = stack.lens_of(index)
    if lens.has_flat_focus or read.depth_m.shape == frame_px:
        return stack.coc_px(index, read.depth_m)
    in_focus = lens.focus_dioptres(frame_px[1], frame_px[0])[read.rows].astype(np.float32)
    return (stack.coc_px_per_dioptre(index, frame_px[1]) * (in_focus - 1.0 / read.depth_m)).astype(np.float32)

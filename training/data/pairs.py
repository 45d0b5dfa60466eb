"""Training pairs from FocalStack folders and blur pairs: (all-in-focus picture, circles of confusion) -> photographed slice.

Some rows of a slice and its stack can be read without decoding the rest. Pixels count if their depth and radiance are known and
nothing moved there. Blur pairs come whole, registered and in even light.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.images.camera_rgb import MASK_PREFIX, SATURATED, VALID
from mrbokeh.lens_measuring.fitting.blur_pairs import BlurPair
from mrbokeh.lens_measuring.fitting.pupil_picture import EXTENT
from mrbokeh.lens_measuring.fitting.stack_equations import from_frame_px
from mrbokeh.optics.camera import field_positions
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.errors import InputError
from training.data.exr_rows import exr_size_px, read_rows
from training.data.stacks import UNSTATED_LENS, Source, lens_of_slice
from training.fitting.settings import TrainSettings

Mask = Bool[np.ndarray, "height width"]

REASONS = ("moving", "border", "board", "low_confidence")
"""Masks of the stack that are read; its "saturated" means saturated in any slice, and each slice has a mask of its own."""
# Nobody knows what the network should give there, so neither loss nor score counts them.
# "saturated" of the exclusion masks means saturated in any slice; a light that is full where it is sharp is well measured in the discs
# of other slices, so each slice has its own mask. Saturated targets pull: counted as recorded they cost 7 to 8 dB on a traced still life
# with lights (gated form, held-out view against its unclipped truth), or with a modelled white of the sensor 2 dB or nothing. Leaving
# them out of all slices instead of their own is 0.1 to 0.5 dB worse where nothing is saturated, 0.7 to 0.9 dB better over all pixels.
_LOW_CONFIDENCE = "low_confidence"


@dataclass(frozen=True)
class StackRows:
    """Rows shared by all slices of a stack.

    rows: which of the picture. all_in_focus: (H, W, 3) linear Rec.709. confidence: of depth. exclusions: masks by reason.
    """

    rows: slice
    all_in_focus: Float32[np.ndarray, "height width 3"]
    depth_m: Float32[np.ndarray, "height width"]
    confidence: Float32[np.ndarray, "height width"]
    exclusions: dict[str, Mask]


@dataclass(frozen=True)
class SliceRows:
    """Rows of one slice. target: (H, W, 3) linear Rec.709."""

    shared: StackRows
    target: Float32[np.ndarray, "height width 3"]
    saturated: Mask
    valid: Mask


def slice_size_px(stack: Source, index: int) -> tuple[int, int]:
    """Return (height, width), from the header of its file."""
    if isinstance(stack, BlurPair):
        return stack.size[1], stack.size[0]
    return exr_size_px(stack.folder / stack.slices[index].path)


def read_stack_rows(stack: FocalStack, rows: slice) -> StackRows:
    """Read rows of a stack, a plain slice within the picture.

    Raises InputError if the stack is not merged and metric, or a file cannot be read.
    """
    if not (stack.merged and stack.is_metric):
        raise InputError(f"{stack.folder} has no all-in-focus picture with depth in metres: run `mrbokeh capture merge` on it")
    depth = read_rows(stack.depth_path, rows, ("Z", "confidence"))
    all_in_focus = stack.to_rec709(_stacked(read_rows(stack.all_in_focus_path, rows, "RGB")))
    return StackRows(
        rows=rows, all_in_focus=all_in_focus, depth_m=depth["Z"], confidence=depth["confidence"], exclusions=_exclusions(stack, rows)
    )


def read_slice_rows(stack: FocalStack, index: int, rows: slice, shared: StackRows | None = None) -> SliceRows:
    """Read rows of a slice. shared: these rows of the stack, if already read; raises as `read_stack_rows` does."""
    shared = read_stack_rows(stack, rows) if shared is None else shared
    photograph = read_rows(stack.folder / stack.slices[index].path, rows, "RGB", (SATURATED, VALID))
    saturated, valid = photograph.pop(SATURATED, None), photograph.pop(VALID, None)
    target = stack.to_rec709(_stacked(photograph))
    return SliceRows(
        shared,
        target,
        np.zeros(target.shape[:2], bool) if saturated is None else saturated > 0,
        np.ones(target.shape[:2], bool) if valid is None else valid > 0.5,
    )


def _exclusions(stack: FocalStack, rows: slice) -> dict[str, Mask]:
    if not stack.exclusion_path.is_file():
        return {}
    masks = read_rows(stack.exclusion_path, rows, optional=[MASK_PREFIX + reason for reason in REASONS])
    return {name.removeprefix(MASK_PREFIX): mask > 0.5 for name, mask in masks.items()}


def _stacked(channels: dict[str, Float32[np.ndarray, "height width"]]) -> Float32[np.ndarray, "height width 3"]:
    return np.stack([channels[name] for name in "RGB"], axis=-1)


@dataclass(frozen=True)
class Counting:
    """Rules that decide which pixels count.

    least_confidence: pixels with less trustworthy depth do not count, nor those of the mask low_confidence; 0 counts all.
    saturation: pixels of a slice at or above this radiance do not count; None sets no such limit.
    saturated: whether pixels count where the sensor was saturated.
    one_sided: they count, but only if the result is darker than the slice, since a full photosite states a lower bound.
    """

    least_confidence: float = 0.1
    saturation: float | None = None
    saturated: bool = False
    one_sided: bool = False


WHERE_TRUTH_IS_KNOWN = Counting(least_confidence=0.0, saturated=True)


def counting_of(settings: TrainSettings) -> Counting:
    """Return the rules of a training run."""
    return Counting(
        settings.least_confidence,
        settings.saturation,
        saturated=settings.sensor_white is not None,
        one_sided=settings.saturated == "one_sided",
    )


def pixel_weight(read: SliceRows, counting: Counting) -> Float32[np.ndarray, "height width"]:
    """Return (H, W): 1 where the pixel counts, else 0."""
    exclusions = read.shared.exclusions
    counted = (read.shared.confidence >= counting.least_confidence) & read.valid
    for reason in REASONS:
        if reason in exclusions and (reason != _LOW_CONFIDENCE or counting.least_confidence > 0):
            counted &= ~exclusions[reason]
    if not (counting.saturated or counting.one_sided):
        counted &= ~read.saturated
    if counting.saturation is not None:
        counted &= read.target.max(axis=2) < counting.saturation
    return counted.astype(np.float32)


@dataclass(frozen=True)
class Pair:
    """One slice, or a part of it, and its inputs.

    all_in_focus, target: (H, W, 3) linear radiance. coc_px: (H, W) signed diameters.
    weight: (H, W), 1 where the pixel counts, 0 where its depth or its radiance is not known or something moved.
    f_number, focal_length_mm: of the lens. coc_px_per_dioptre: growth of the blur; focus_dioptres: the focus on the axis.
    origin_px: (top, left) in the whole frame, of frame_px (height, width).
    saturated: (H, W) where the target is only a lower bound; None if no pixel is treated so.
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
        """Return the field positions of all pixel centres, right and down from the middle of the frame, in half diagonals."""
        return field_positions((self.coc_px.shape[0], self.coc_px.shape[1]), self.frame_px, self.origin_px)

    @property
    def dioptres(self) -> Float32[np.ndarray, "height width"]:
        """Return (H, W) 1 / depth; for a tilted or curved focus, relative to a flat one."""
        return (self.focus_dioptres - self.coc_px / self.coc_px_per_dioptre).astype(np.float32)

    def cut(self, rows: slice, columns: slice) -> "Pair":
        """Return a part, which is a view. rows, columns: plain slices within this pair."""
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
        """Return the pair with the weights of its pixels multiplied."""
        return replace(self, weight=self.weight * factor)


def read_pair(
    stack: Source, index: int, counting: Counting | None = None, rows: slice | None = None, shared: StackRows | None = None
) -> Pair:
    """Read a pair. rows: only these of the picture; None: all of them. shared: the stack's data of these rows, if already read."""
    counting, frame_px = counting or Counting(), slice_size_px(stack, index)
    if isinstance(stack, BlurPair):
        return _of_blur_pair(stack, frame_px).cut(rows or slice(0, frame_px[0]), slice(0, frame_px[1]))
    read = read_slice_rows(stack, index, rows or slice(0, frame_px[0]), shared)
    lens = lens_of_slice(stack, index)
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


def _of_blur_pair(pair: BlurPair, frame_px: tuple[int, int]) -> Pair:
    """Return the whole pair. Pixels count whose light all comes from known diameters within the frame."""
    view = pair.view
    counted = view.known & (from_frame_px(frame_px) > 0.5 * EXTENT * np.abs(view.coc_px) + 1.0)
    return Pair(
        all_in_focus=view.sharp,
        coc_px=view.coc_px,
        target=view.blurred,
        weight=counted.astype(np.float32),
        f_number=UNSTATED_LENS.f_number,
        focal_length_mm=UNSTATED_LENS.focal_length_mm,
        coc_px_per_dioptre=UNSTATED_LENS.coc_px_per_dioptre(frame_px[1]),
        focus_dioptres=1.0 / UNSTATED_LENS.focus_distance_m,
        frame_px=frame_px,
    )


def _coc_px(stack: FocalStack, index: int, read: StackRows, frame_px: tuple[int, int]) -> Float32[np.ndarray, "height width"]:
    """Return the circles of confusion of some rows; `FocalStack.coc_px` needs the whole picture for a tilted or curved focus."""
    lens = stack.lens_of(index)
    if lens.has_flat_focus or read.depth_m.shape == frame_px:
        return stack.coc_px(index, read.depth_m)
    in_focus = lens.focus_dioptres(frame_px[1], frame_px[0])[read.rows].astype(np.float32)
    return (stack.coc_px_per_dioptre(index, frame_px[1]) * (in_focus - 1.0 / read.depth_m)).astype(np.float32)

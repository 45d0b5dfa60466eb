"""Second pass over a merged stack: its all-in-focus picture made anew, guided by a depth that does not come from focus.

Depth from focus is misled where blur itself has structure: the discs of lights, the blurred rims of near objects. What it
picks there puts rings and halos into the picture. With another depth every pixel is taken from the slices in which its own
surface is sharp, and what nearer surfaces blurred over it is taken off.

Beside the edge of a near object, in the slice in which the far surface is sharp, the object's own blur lies over that surface:
    slice = near light + (1 - blocked share of the pupil) * far light.
With depth and a sharp picture of the near surface both terms are known, and the far light can be recovered (as layered
renderers composite, here solved for the layer behind).
"""

import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from capture.merging.restored_lights import known_opening, restored_lights, with_restored_lights
from mrbokeh.images.camera_rgb import read_camera_rgb
from mrbokeh.optics.aperture import Aperture
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.errors import InputError

KERNELS_PER_PX = 2
# A surface counts as nearer where its blur differs by this much: less is the slope of one surface.
LEAST_STEP_COC_PX = 0.5
# Gathering costs the square of the blur: from this diameter on the grid is coarser.
LARGEST_GATHERED_PX = 16.0
# Slices in which a surface is blurred by less than this are averaged, with weights that end here.
BLENDED_COC_PX = 1.5
# Slices blurred by more than this are candidates only where nothing else is left.
LARGEST_COC_PX = 12.0
# What is taken off a pixel is known to a share of itself; blocked by all of the pupil it costs as much as this blur.
BLOCKED_COST_PX = 6.0
LARGEST_BLOCKED_SHARE = 0.8
FIRST_PASS_FOLDER = "first_pass"

Plane = Float32[np.ndarray, "height width"]
Rgb = Float32[np.ndarray, "height width 3"]
Mask = Bool[np.ndarray, "height width"]


@dataclass(frozen=True)
class SliceOptics:
    """Focus of every registered slice, and the growth of its circle of confusion.

    focus_dioptres: 1 / metres, per slice. px_per_dioptre: growth of the circle of confusion, in pixels of a registered slice, for each
    dioptre away from the focus. aperture: the shape of that circle.
    """

    focus_dioptres: tuple[float, ...]
    px_per_dioptre: tuple[float, ...]
    aperture: Aperture

    @classmethod
    def of_slices(cls, focus_dioptres: Sequence[float], px_per_dioptre: Sequence[float], aperture: Aperture | None = None) -> "SliceOptics":
        """Check that there is one of each for every slice. Raises InputError."""
        if len(focus_dioptres) != len(px_per_dioptre) or len(focus_dioptres) == 0:
            raise InputError(
                f"expected a focus and a growth of blur for each slice, got {len(focus_dioptres)} and {len(px_per_dioptre)} of them"
            )
        return cls(tuple(map(float, focus_dioptres)), tuple(map(float, px_per_dioptre)), aperture or Aperture.disc())

    @classmethod
    def of_stack(cls, stack: FocalStack, width_px: int) -> "SliceOptics":
        """Take the focus distances and the growth of blur that the stack states."""
        lenses = [stack.lens_of(index) for index in range(len(stack))]
        growth = [stack.coc_px_per_dioptre(index, width_px) for index in range(len(stack))]
        return cls.of_slices([1.0 / lens.focus_distance_m for lens in lenses], growth, lenses[0].aperture)

    def __len__(self) -> int:
        return len(self.focus_dioptres)

    def reduced(self, shrink: int) -> "SliceOptics":
        """Return the optics for pictures `shrink` times smaller."""
        return replace(self, px_per_dioptre=tuple(growth / shrink for growth in self.px_per_dioptre))

    def coc_px(self, index: int, dioptres: Float[np.ndarray, "height width"]) -> Plane:
        """Return signed diameters in slice `index` of surfaces at these dioptres: + behind its focus."""
        return (self.px_per_dioptre[index] * (self.focus_dioptres[index] - dioptres)).astype(np.float32)


@dataclass(frozen=True)
class ForegroundOcclusion:
    """Blur of nearer surfaces over a slice.

    share (H, W): of the pupil, blocked by nearer surfaces, 0 to 1. light (H, W, 3): what they put there instead.
    """

    share: Plane
    light: Rgb


def second_pass(stack: FocalStack, depth_m: Float[np.ndarray, "height width"]) -> Rgb:
    """Return the all-in-focus picture of a merged stack in its camera RGB, guided by depth along the axis (metres, inf allowed).

    The stack must be metric.
    """
    if not stack.merged:
        raise InputError(f"{stack.folder} is not merged yet: run `mrbokeh capture merge` before its depth is found")
    first = read_camera_rgb(first_pass_path(stack, stack.all_in_focus_path))
    optics = SliceOptics.of_stack(stack, first.shape[1])

    def valid(index: int) -> Bool[np.ndarray, "height width"]:
        return stack.slice_masks(index).valid

    guided = all_in_focus_from_depth(stack.iter_camera_rgb, depth_m, optics, first, valid)
    return with_restored_lights(guided, restored_lights(stack.iter_camera_rgb, guided, guided=True, opening=known_opening(stack.lens))[1])


def keep_first_pass(stack: FocalStack) -> None:
    """Put all_in_focus.exr and depth.exr of the first pass into first_pass/, before a second pass writes its own."""
    for path in (stack.all_in_focus_path, stack.depth_path):
        kept = stack.folder / FIRST_PASS_FOLDER / path.name
        if not kept.is_file() and path.is_file():
            with atomic_path(kept) as temporary:
                shutil.copyfile(path, temporary)


def first_pass_path(stack: FocalStack, path: Path) -> Path:
    """Return where the first pass's version of a picture lies, whether or not a second pass was made."""
    kept = stack.folder / FIRST_PASS_FOLDER / path.name
    return kept if kept.is_file() else path


def all_in_focus_from_depth(
    slices: Callable[[], Iterable[Rgb]],
    depth_m: Float[np.ndarray, "height width"],
    optics: SliceOptics,
    sharp: Rgb,
    valid: Callable[[int], Mask] | None = None,
) -> Rgb:
    """Return the all-in-focus picture of registered slices, guided by depth along the axis in metres (inf allowed).

    slices: gives a fresh pass over them, one held at a time. sharp: first-pass all-in-focus picture: near surfaces are
    taken from it. valid: where slice i has data.
    """
    dioptres = (1.0 / np.asarray(depth_m, np.float64)).astype(np.float32)
    picture = _Picture.blank(dioptres.shape)
    for index, rgb in enumerate(slices()):
        coc_px = np.abs(optics.coc_px(index, dioptres))
        wanted = coc_px < LARGEST_COC_PX
        nearer = foreground_occlusion(index, dioptres, sharp, optics, wanted)
        blocked = np.minimum(nearer.share, LARGEST_BLOCKED_SHARE)[..., None]
        cost = coc_px + BLOCKED_COST_PX * nearer.share
        if valid is not None:
            cost = np.where(valid(index), cost, np.float32(1e3) + coc_px)
        picture.add(np.maximum(rgb - nearer.light, 0.0) / (1.0 - blocked), cost)
    return picture.result()


@dataclass
class _Picture:
    """Picture under construction: the mean of all good slices, and the best where none is good."""

    blended: Rgb
    weight: Plane
    best: Rgb
    least_cost: Plane

    @classmethod
    def blank(cls, shape: tuple[int, ...]) -> "_Picture":
        return cls(
            np.zeros((*shape, 3), np.float32),
            np.zeros(shape, np.float32),
            np.zeros((*shape, 3), np.float32),
            np.full(shape, np.inf, np.float32),
        )

    def add(self, rgb: Rgb, cost: Plane) -> None:
        weight = np.maximum(1.0 - cost / np.float32(BLENDED_COC_PX), 0.0)
        self.blended += weight[..., None] * rgb
        self.weight += weight
        better = cost < self.least_cost
        self.best[better] = rgb[better]
        self.least_cost[better] = cost[better]

    def result(self) -> Rgb:
        good = self.weight > 0.05
        return np.where(good[..., None], self.blended / np.maximum(self.weight, 0.05)[..., None], self.best)


def foreground_occlusion(
    index: int, dioptres: Plane, sharp: Rgb, optics: SliceOptics, wanted: Bool[np.ndarray, "height width"]
) -> ForegroundOcclusion:
    """Gather what nearer surfaces put over the wanted pixels of slice `index`; 0 elsewhere.

    sharp: the all-in-focus picture as far as it is known; only its near surfaces count. Large blur is smooth, so it is
    gathered on a coarser grid.
    """
    shrink = int(np.ceil(np.abs(optics.coc_px(index, dioptres)).max() / LARGEST_GATHERED_PX))
    if shrink <= 1:
        return _gathered(index, dioptres, sharp, optics, wanted)
    size, small = dioptres.shape[::-1], (-(-dioptres.shape[1] // shrink), -(-dioptres.shape[0] // shrink))
    coarse = _gathered(
        index,
        cv2.resize(dioptres, small, interpolation=cv2.INTER_NEAREST),
        cv2.resize(sharp, small, interpolation=cv2.INTER_AREA),
        optics.reduced(shrink),
        cv2.resize(wanted.astype(np.float32), small, interpolation=cv2.INTER_AREA) > 0,
    )
    share, light = (cv2.resize(each, size, interpolation=cv2.INTER_LINEAR) for each in (coarse.share, coarse.light))
    return ForegroundOcclusion(share * wanted, light * wanted[..., None])


def _gathered(
    index: int, dioptres: Plane, sharp: Rgb, optics: SliceOptics, wanted: Bool[np.ndarray, "height width"]
) -> ForegroundOcclusion:
    from capture.merging._foreground_occlusion_numba import gather_foreground

    coc_px, least_step = optics.coc_px(index, dioptres), LEAST_STEP_COC_PX / optics.px_per_dioptre[index]
    share, light = np.zeros(dioptres.shape, np.float32), np.zeros(sharp.shape, np.float32)
    reached = wanted & _reached(coc_px, dioptres, least_step)
    if reached.any():
        kernels = pupil_pictures(optics.aperture, int(np.ceil(np.abs(coc_px).max() * KERNELS_PER_PX)) + 1)
        focus, growth = optics.focus_dioptres[index], optics.px_per_dioptre[index]
        gather_foreground(dioptres, sharp, focus, growth, kernels, float(KERNELS_PER_PX), reached, least_step, share, light)
    return ForegroundOcclusion(np.minimum(share, 1.0), light)


def _reached(coc_px: Plane, dioptres: Plane, least_step: float) -> Bool[np.ndarray, "height width"]:
    """Return pixels that some nearer surface may reach: within the largest blur of anything, there is something nearer."""
    reach_px = int(np.ceil(0.5 * np.abs(coc_px).max())) + 1
    nearest = cv2.dilate(dioptres, np.ones((2 * reach_px + 1, 1), np.uint8))
    nearest = cv2.dilate(nearest, np.ones((1, 2 * reach_px + 1), np.uint8))
    return nearest > dioptres + np.float32(least_step)


@lru_cache(maxsize=4)
def pupil_pictures(aperture: Aperture, count: int) -> Float32[np.ndarray, "count size size"]:
    """Return the circle of confusion at diameters 0, 1, 2, ... / KERNELS_PER_PX pixels, each in the middle of a square and of sum 1."""
    pictures = [aperture.rasterize(index / KERNELS_PER_PX).kernel for index in range(count)]
    size = max(len(picture) for picture in pictures)
    stacked = np.zeros((count, size, size), np.float32)
    for result, picture in zip(stacked, pictures, strict=True):
        margin = (size - len(picture)) // 2
        result[margin : margin + len(picture), margin : margin + len(picture)] = picture
    return stacked

"""The Pixel 4 set (Xin et al., ICCV 2021): photographs, all-in-focus truth, maps of blur and measured kernels, as our renderers take them.

The photograph is the sum of the halves of its pixels (14 bits, linear, black 1024). The truths are its middle 1344x1008 pixels. Kernels
are published for the 8x6 parts of that, all behind the focus, for one amount of blur; a map is that amount times 187, as was measured:
for 22 of 25 surfaces of six scenes the kernel's scale that explains the photograph best is within 4 % of it, for the others within 8 %.
Kernels lie off the middle of their array by up to 4 px, the truths do not: each is centred.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt, label, map_coordinates

from mrbokeh.optics.psf_bank import Axis, PsfBank

SIZE = (1008, 1344)
BLACK = 1024
COLUMNS, ROWS = 8, 6
KERNEL_PX = 26.0
"""Diameter that the kernels as printed are taken to have: that of a disc of their area."""
GREY_OF_KERNEL = 187.0
LARGEST_PX, STEPS = 46.0, 23
_SAME_SURFACE = 8  # grey values
_HOLE_PX = 20_000
_RIM_PX = 5
_REACH = 1.1  # of the radius: where kernels have lost their light
_FINER = 4
_LEAST = 1e-3  # of a kernel's brightest pixel


@dataclass(frozen=True)
class Scene:
    """photograph, sharp: linear, as shares of the photograph's white. coc_px: diameters; unknown ones are those of the next surface.

    judged: pixels whose light all comes from known diameters of one surface, within the frame. known: those that the map knows. rims: they
    and what lies between surfaces, within the frame.
    white: brightness of the photograph that 0.1 % of its pixels exceed, over black.
    """

    name: str
    photograph: np.ndarray
    sharp: np.ndarray
    coc_px: np.ndarray
    judged: np.ndarray
    known: np.ndarray
    rims: np.ndarray
    white: float


def scenes(data: Path) -> list[str]:
    """Names of the scenes that have a photograph and both truths."""
    names = sorted(path.stem.removesuffix("_left") for path in (data / "DP_data_pixel_4").glob("*_left.png"))
    return [
        name for name in names if all((data / folder / f"{name}_gt.png").is_file() for folder in ("gt_all_in_focus_im", "gt_defocus_map"))
    ]


def read_scene(data: Path, name: str) -> Scene:
    halves = [_read(data / "DP_data_pixel_4" / f"{name}_{side}.png") - BLACK for side in ("left", "right")]
    photograph = _middle(halves[0] + halves[1])
    white = float(np.percentile(photograph, 99.9))
    grey = _without_rims(_read(data / "gt_defocus_map" / f"{name}_gt.png"))
    surface, holes = _filled(grey)
    coc_px = (surface * (KERNEL_PX / GREY_OF_KERNEL)).astype(np.float32)
    sharp = _read(data / "gt_all_in_focus_im" / f"{name}_gt.png") / 2.0  # its 16 bits stand for the 15 of the sum
    return Scene(
        name=name,
        photograph=(photograph / white).astype(np.float32),
        sharp=(sharp / white).astype(np.float32),
        coc_px=coc_px,
        judged=_judged(surface, (grey == 0) & ~holes, coc_px),
        known=grey > 0,
        rims=(grey > 0) & _within_reach(np.zeros_like(holes), coc_px),
        white=white,
    )


def _read(path: Path) -> np.ndarray:
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if picture is None or picture.ndim != 2:
        raise SystemExit(f"expected a grey picture at {path}")
    return picture.astype(np.float64)


def _middle(picture: np.ndarray) -> np.ndarray:
    top, left = ((whole - part) // 2 for whole, part in zip(picture.shape, SIZE, strict=True))
    return picture[top : top + SIZE[0], left : left + SIZE[1]]


def _without_rims(grey: np.ndarray) -> np.ndarray:
    """The map with 0 next to what is 0: there it was scaled, and its values are of no surface."""
    return np.where(cv2.erode((grey > 0).astype(np.uint8), np.ones((_RIM_PX, _RIM_PX), np.uint8)) > 0, grey, 0.0)


def _filled(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The map with the nearest known value where it is 0; and its holes, small and with one surface all around."""
    unknown = grey == 0
    rows, columns = distance_transform_edt(unknown, return_distances=False, return_indices=True)
    surface, holes = grey[rows, columns], np.zeros_like(unknown)
    regions, count = label(unknown)
    for number in np.flatnonzero(np.bincount(regions.ravel(), minlength=count + 1) < _HOLE_PX):
        mine = (regions == number) & unknown
        around = cv2.dilate(mine.astype(np.uint8), np.ones((7, 7), np.uint8)).astype(bool) & ~unknown
        if mine.any() and around.any() and np.ptp(np.percentile(grey[around], (5, 95))) <= _SAME_SURFACE:
            holes |= mine
    return surface, holes


def _judged(surface: np.ndarray, unknown: np.ndarray, coc_px: np.ndarray) -> np.ndarray:
    square = np.ones((3, 3), np.uint8)
    edges = cv2.dilate(surface, square) - cv2.erode(surface, square) > _SAME_SURFACE
    return _within_reach(unknown | edges, coc_px)


def _within_reach(bad: np.ndarray, coc_px: np.ndarray) -> np.ndarray:
    """Pixels to which no light comes from bad ones or from beyond the frame."""
    around = np.pad(bad, 1, constant_values=True)
    return distance_transform_edt(~around)[1:-1, 1:-1] > 0.5 * _REACH * coc_px + 3.0


def published_kernels(data: Path) -> np.ndarray:
    """The kernels of the whole pixel (48, 61, 61): the sum of its halves', each centred, row by row."""
    halves = [np.load(data / "calibration" / f"blur_kernels_{side}.npy").astype(np.float64) for side in ("left", "right")]
    return np.stack([centred(kernel) for kernel in halves[0] + halves[1]])


def centred(kernel: np.ndarray) -> np.ndarray:
    """A kernel moved so that its light is around its middle pixel, sum 1."""
    middle = len(kernel) // 2
    off = np.arange(len(kernel)) - middle
    share = kernel / kernel.sum()
    rows, columns = np.mgrid[: len(kernel), : len(kernel)].astype(np.float64)
    at = [rows + (share.sum(axis=1) * off).sum(), columns + (share.sum(axis=0) * off).sum()]
    moved = np.maximum(map_coordinates(share, at, order=1), 0.0)
    return moved / moved.sum()


def bank_of_kernels(kernels: np.ndarray, kernel_px: float = KERNEL_PX, largest_px: float = LARGEST_PX, steps: int = STEPS) -> PsfBank:
    """A bank over diameter and place from kernels of one diameter, 48 row by row or one for the whole frame."""
    half = np.array(SIZE[::-1]) / np.hypot(*SIZE)
    axes, counts = [Axis("diameter_px", 0.0, largest_px)], [steps]
    over_field = len(kernels) > 1
    if over_field:
        axes += [Axis(name, -end, end) for name, end in zip(("field_x", "field_y"), half.tolist(), strict=True)]
        counts += [COLUMNS, ROWS]
    order = [row * COLUMNS + column for column in range(COLUMNS) for row in range(ROWS)] if over_field else [0]
    made = [scaled(kernels[place], scale) for scale in _scales(kernel_px, largest_px, steps) for place in order]
    return PsfBank("published", tuple(axes), tuple(counts), tuple(made), nested=False)


def _scales(kernel_px: float, largest_px: float, steps: int) -> Iterator[float]:
    return ((step + 0.5) * largest_px / steps / kernel_px for step in range(steps))


def scaled(kernel: np.ndarray, scale: float) -> np.ndarray:
    """A kernel enlarged by a factor, each pixel the mean of 4x4 points in it; (K, K, 1) without its dark border."""
    middle = len(kernel) // 2
    radius = int(np.ceil(middle * scale)) + 1
    points = (np.arange((2 * radius + 1) * _FINER) + 0.5) / _FINER - radius - 0.5
    at = np.meshgrid(points / scale + middle, points / scale + middle, indexing="ij")
    fine = map_coordinates(kernel, at, order=1)
    drawn = fine.reshape(2 * radius + 1, _FINER, 2 * radius + 1, _FINER).mean(axis=(1, 3))
    drawn[drawn < _LEAST * drawn.max()] = 0.0
    reach = int(np.abs(np.argwhere(drawn) - radius).max())
    drawn = drawn[radius - reach : radius + reach + 1, radius - reach : radius + reach + 1]
    return (drawn / drawn.sum())[..., None].astype(np.float32)

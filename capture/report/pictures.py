"""Pictures of the report as JPEG in memory: slices, maps, and the worst places of a merged picture at 100 %."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from capture.report.gates import (
    GHOSTS,
    LARGEST_FLAT,
    LARGEST_LOST,
    LARGEST_PARALLAX,
    LARGEST_TOP,
    LARGEST_UNLIKE,
    LIGHT,
    PLACES,
    SEAMS,
    SHARP,
)
from capture.report.picture_sharpness import PictureLook, inner_blocks
from capture.report.registration_check import NeighbourDisplacement
from capture.report.stack_view import StackView
from capture.stacks.slice_looks import BLOCK_PX
from mrbokeh.figures.stack_pictures import depth_picture
from mrbokeh.images.color import display_rgb8
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.html_page import inline_figure

WIDEST_PX = 480
_QUALITY = 82
_DIFFERENCE_GAIN = 5.0
_DEPTH_SPAN_PX = 3.0
_CROP_QUALITY = 95
_MOST_CONTRAST = 8.0
_MARK = (255, 0, 200)
CROP_PX = 160
MOST_PLACES = 3

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]
Crop = Float32[np.ndarray, "crop_height crop_width 3"]


@dataclass(frozen=True)
class Shown:
    """Encoded picture and what it shows."""

    jpeg: bytes
    caption: str

    def html(self) -> str:
        return inline_figure(self.jpeg, "jpeg", self.caption)


@dataclass(frozen=True)
class Place:
    """Block to look at. gate: whose. at_px: x, y of its first pixel. text: what is wrong. slices: index, and what it is to the place."""

    gate: str
    at_px: tuple[int, int]
    text: str
    slices: tuple[tuple[int, str], ...]

    @property
    def caption(self) -> str:
        return f"x {self.at_px[0]}, y {self.at_px[1]}: {self.text}"


@dataclass(frozen=True)
class ShownPlace:
    """Place with its crops."""

    place: Place
    pictures: tuple[Shown, ...]


def shown(rgb: Rgb, caption: str) -> Shown:
    """Encode a picture. rgb: linear; shrunk to 480 px in linear light."""
    height, width = rgb.shape[:2]
    if width > WIDEST_PX:
        rgb = cv2.resize(rgb, (WIDEST_PX, round(height * WIDEST_PX / width)), interpolation=cv2.INTER_AREA)
    return Shown(_jpeg(display_rgb8(np.clip(rgb, 0.0, 1e4).astype(np.float32))), caption)


def slice_triple(index: int, rgb: Rgb, prediction: Rgb) -> list[Shown]:
    """Show a slice, its prediction, and their difference."""
    difference = np.clip(0.2 + _DIFFERENCE_GAIN * (rgb - prediction), 0.0, 1.0).astype(np.float32)
    return [
        shown(rgb, f"slice {index}"),
        shown(prediction, f"slice {index}, re-blurred from the all-in-focus picture"),
        shown(difference, f"slice {index}: slice minus re-blurred, {_DIFFERENCE_GAIN:g} times, grey is no difference"),
    ]


def stack_maps(view: StackView, moving: Mask | None, depth_off_px: Plane | None) -> list[Shown]:
    """Show the all-in-focus picture, depth, confidence; what moved and where slices contradict depth, if anybody knows."""
    pictures = [
        shown(view.all_in_focus, "all in focus"),
        shown(depth_picture(view.stack), "depth: near is red, far is blue, grey where it is a guess"),
        Shown(_coloured(view.confidence, cv2.COLORMAP_VIRIDIS), "confidence of depth: dark is none, yellow is full"),
    ]
    if moving is not None:
        tinted = np.where(moving[..., None], np.array([0.9, 0.05, 0.6]), 0.6 * view.all_in_focus).astype(np.float32)
        pictures.append(shown(tinted, f"what moved during the stack ({moving.mean():.2%})"))
    if depth_off_px is not None:
        level = 0.5 + depth_off_px / (2.0 * _DEPTH_SPAN_PX)
        caption = f"where slices contradict depth: red and blue are {_DEPTH_SPAN_PX:g} px of blur or more, green is none"
        pictures.append(Shown(_coloured(level.astype(np.float32), cv2.COLORMAP_JET), caption))
    return pictures


def crops_shown(crops: Sequence[tuple[str, Rgb]], block: tuple[int, int, int], *, enhance: bool, overlay: bool) -> list[Shown]:
    """Show crops at 100 %, each with its name; block: x, y and side of a square to be framed in all of them.

    enhance: raise the contrast of all alike, until what lies around the square in the first fills the range. overlay: add the last two
    crops in red and cyan.
    """
    levels = [display_rgb8(np.clip(rgb, 0.0, 1e4).astype(np.float32)).astype(np.float32) for _, rgb in crops]
    names, contrast = [name for name, _ in crops], 1.0
    if overlay:
        red, cyan = (each.mean(axis=2) for each in levels[-2:])
        levels.append(np.stack([red, cyan, cyan], axis=2))
        names.append(f"{names[-2]} in red, {names[-1]} in cyan")
    if enhance:
        x, y, side = block
        around = levels[0][max(y - side // 2, 0) : y + 3 * side // 2, max(x - side // 2, 0) : x + 3 * side // 2]
        middle = around.mean(axis=(0, 1))
        contrast = float(np.clip(110.0 / max(np.percentile(np.abs(around - middle), 99.0), 1e-3), 1.0, _MOST_CONTRAST))
        levels = [127.0 + contrast * (each - middle) for each in levels]
    suffix = f", contrast {contrast:.1f} times" if contrast > 1.0 else ""
    return [
        Shown(_framed_jpeg(np.clip(np.round(each), 0, 255).astype(np.uint8), block), name + suffix)
        for name, each in zip(names, levels, strict=True)
    ]


def worst_places(look: PictureLook, focus_index: Plane, pairs: Sequence[NeighbourDisplacement]) -> list[Place]:
    """Return up to three places for a gate that fails, one where none does. focus_index: in which slice each pixel is sharp."""
    return [
        *_lost(look),
        *_seams(look, focus_index),
        *_ghosts(look, focus_index),
        *_brightest(look),
        *_farthest_apart(pairs, focus_index.shape[1]),
    ]


def shown_places(stack: FocalStack, picture: Rgb, places: Sequence[Place]) -> list[ShownPlace]:
    """Cut crops of the all-in-focus picture and of the slices, each of which is read once."""
    cuts: dict[tuple[int, int], Crop] = {}
    for index in sorted({index for place in places for index, _ in place.slices}):
        rgb = stack.slice_rgb(index)
        for number, place in enumerate(places):
            cuts[number, index] = _cut(rgb, place.at_px)[0]
    shown = []
    for number, place in enumerate(places):
        crop, inside_px = _cut(picture, place.at_px)
        named = [("all in focus", crop), *((name, cuts[number, index]) for index, name in place.slices)]
        pictures = crops_shown(named, (*inside_px, BLOCK_PX), enhance=place.gate == SEAMS.name, overlay=place.gate == PLACES.name)
        shown.append(ShownPlace(place, tuple(pictures)))
    return shown


def _framed_jpeg(rgb8: np.ndarray, block: tuple[int, int, int]) -> bytes:
    """Encode without loss of colour, and with a frame that leaves the square itself free."""
    x, y, side = block
    framed = cv2.rectangle(np.ascontiguousarray(rgb8), (x - 1, y - 1), (x + side, y + side), _MARK, 1)
    return _jpeg(framed, _CROP_QUALITY)


def _coloured(level: Plane, colours: int) -> bytes:
    height, width = level.shape
    small = cv2.resize(level, (WIDEST_PX, round(height * WIDEST_PX / width)), interpolation=cv2.INTER_AREA) if width > WIDEST_PX else level
    bgr = cv2.applyColorMap(np.round(255.0 * np.clip(small, 0.0, 1.0)).astype(np.uint8), colours)
    return _jpeg(bgr[..., ::-1])


def _jpeg(rgb8: np.ndarray, quality: int = _QUALITY) -> bytes:
    sampling = cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444 if quality > _QUALITY else cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling]
    return cv2.imencode(".jpg", np.ascontiguousarray(rgb8[..., ::-1]), options)[1].tobytes()


def _lost(look: PictureLook) -> list[Place]:
    """Find blocks by the detail that is missing, lost ones first."""
    sharpness, sharpest = look.sharpness, look.sharpest
    if sharpness is None or not sharpest.textured.any():
        return []
    missing = np.where(sharpest.textured, sharpest.detail * (1.0 - sharpness.kept), -np.inf)
    places = []
    for row, column in _spread_out(np.where(sharpness.lost_blocks, missing + 1e3, missing), sharpness.lost > LARGEST_LOST):
        index, kept = int(sharpest.index[row, column]), float(sharpness.kept[row, column])
        slices = ((index, f"slice {index}, the sharpest here"),)
        places.append(Place(SHARP.name, look.corner_px(row, column), f"{kept:.0%} of the detail of slice {index}", slices))
    return places


def _seams(look: PictureLook, focus_index: Plane) -> list[Place]:
    """Find blocks by the detail that is too much."""
    sharpness, sharpest = look.sharpness, look.sharpest
    if sharpness is None or look.findings.flat is None:
        return []
    added = np.where(sharpest.flat, sharpest.detail * (sharpness.kept - 1.0), -np.inf)
    places = []
    for row, column in _spread_out(added, sharpness.flat > LARGEST_FLAT):
        at_px, index = look.corner_px(row, column), int(sharpest.index[row, column])
        slices = tuple((side, f"slice {side}, sharp here") for side in _sharp_in(focus_index, at_px))
        text = f"{float(sharpness.kept[row, column]):.2f} times the detail of slice {index}, the sharpest here"
        places.append(Place(SEAMS.name, at_px, text, slices))
    return places


def _ghosts(look: PictureLook, focus_index: Plane) -> list[Place]:
    """Find blocks by how unlike all slices they are."""
    unlike = inner_blocks(look.unlike).max(axis=(1, 3))
    places = []
    for row, column in _spread_out(unlike, look.findings.unlike > LARGEST_UNLIKE) if unlike.size else ():
        at_px = look.corner_px(row, column)
        slices = tuple((side, f"slice {side}, sharp here") for side in _sharp_in(focus_index, at_px))
        places.append(Place(GHOSTS.name, at_px, f"{float(unlike[row, column]):.0%} of white away from every slice", slices))
    return places


def _brightest(look: PictureLook) -> list[Place]:
    """Find the largest values of the picture, beside the slice that is brightest there."""
    too_bright = look.findings.top_ratio > LARGEST_TOP
    places = []
    for row, column in _spread_out(look.brightest, too_bright):
        value, of_slices = float(look.brightest[row, column]), float(look.slices_brightest[row, column])
        index = int(look.brightest_slice[row, column])
        slices = ((index, f"slice {index}, the brightest here"),)
        text = f"{value:.3g}, where the slices reach {of_slices:.3g}"
        places.append(Place(LIGHT.name, (BLOCK_PX * column, BLOCK_PX * row), text, slices))
    return places


def _farthest_apart(pairs: Sequence[NeighbourDisplacement], width_px: int) -> list[Place]:
    shifted = max(pairs, key=lambda each: each.parallax_px, default=None)
    if shifted is not None and shifted.parallax_px > LARGEST_PARALLAX * width_px:
        names = tuple((index, f"slice {index}") for index in (shifted.first, shifted.first + 1))
        x, y = (max(each - BLOCK_PX // 2, 0) for each in shifted.parallax_place_px)
        return [Place(PLACES.name, (x, y), f"up to {shifted.parallax_px:.0f} px apart: the camera moved sideways", names)]
    known = [each for each in pairs if each.off_px is not None]
    if not known:
        return []
    worst = max(known, key=NeighbourDisplacement.rank)
    names = tuple((index, f"slice {index}") for index in (worst.first, worst.first + 1))
    x, y = (max(each - BLOCK_PX // 2, 0) for each in worst.place_px)
    return [Place(PLACES.name, (x, y), f"slices {worst.first} and {worst.first + 1} lie {worst.off_px:.2f} px apart", names)]


def _spread_out(badness: Float32[np.ndarray, "rows columns"], failing: bool) -> list[tuple[int, int]]:
    """Return row and column of the worst blocks, no two of them in one crop: three where the gate fails, else one."""
    left, found = badness.astype(np.float64), []
    apart = CROP_PX // BLOCK_PX
    for _ in range(MOST_PLACES if failing else 1):
        row, column = (int(each) for each in np.unravel_index(int(left.argmax()), left.shape))
        if not left[row, column] > -np.inf:
            break
        found.append((row, column))
        left[max(row - apart, 0) : row + apart + 1, max(column - apart, 0) : column + apart + 1] = -np.inf
    return found


def _sharp_in(focus_index: Plane, at_px: tuple[int, int]) -> list[int]:
    """Return the two slices in which most of a block and what lies around it is sharp, or the one."""
    x, y = at_px
    around = focus_index[max(y - BLOCK_PX // 2, 0) : y + 3 * BLOCK_PX // 2, max(x - BLOCK_PX // 2, 0) : x + 3 * BLOCK_PX // 2]
    indices, counts = np.unique(np.round(around).astype(int), return_counts=True)
    return sorted(int(each) for each in indices[np.argsort(-counts, kind="stable")][:2])


def _cut(rgb: Rgb, at_px: tuple[int, int]) -> tuple[Crop, tuple[int, int]]:
    """Return CROP_PX around a block, inside the picture, and x, y of the block in it."""
    height, width = rgb.shape[:2]
    left, top = (
        int(np.clip(corner + BLOCK_PX // 2 - CROP_PX // 2, 0, max(size - CROP_PX, 0)))
        for corner, size in zip(at_px, (width, height), strict=True)
    )
    return rgb[top : top + CROP_PX, left : left + CROP_PX].copy(), (at_px[0] - left, at_px[1] - top)

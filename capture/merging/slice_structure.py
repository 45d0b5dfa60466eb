"""What registration compares: the detail of a slice, freed from exposure, vignetting and contrast, at several sizes."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

# Of the largest picture that corners are looked for in. Several hundred of them give a slice's place to a hundredth of its pixel; the
# last pixels of larger pictures are never quite sharp and cost most of the time.
_MOST_PIXELS = 1_500_000
# The shorter side of the smallest picture is at least this long.
_SMALLEST_SIDE_PX = 160
MOST_CORNERS = 1200
_WEAKEST_CORNER = 0.05  # of the strongest
_CORNER_BLOCK_PX = 7
_NOISE_SIGMA_PX = 1.0
_SURROUND_PX = 33
# Contrast (of log luminance) below which detail counts as noise: flat and strongly defocused areas fade to grey there.
_LEAST_CONTRAST = 0.1
_GREY, _GREY_PER_DEVIATION = 128.0, 45.0
# Saturated and missing pixels spoil the corners around them, whose outlines move with the focus.
_SPOILT_PX = 9

Plane = Float32[np.ndarray, "height width"]
Grey = UInt8[np.ndarray, "height width"]
Corners = Float32[np.ndarray, "corners 2"]


@dataclass(frozen=True)
class DetailLevel:
    """A slice 2^level times smaller.

    detail: band-passed log luminance over its local deviation; 128 is none.
    usable: 255 where the slice has data that is not saturated, nor near such, else 0.
    corners_px: (N, 2) where detail can be located in both directions, in pixels of this level, (0.5, 0.5) at the first centre.
    """

    level: int
    detail: Grey
    usable: Grey
    corners_px: Corners


@dataclass(frozen=True)
class SliceStructure:
    """One slice as registration sees it.

    size_px: (width, height) of the slice.
    levels: from small to large.
    coarse, coarse_usable: log luminance and its mask at the first of the levels.
    """

    size_px: tuple[int, int]
    levels: tuple[DetailLevel, ...]
    coarse: Plane
    coarse_usable: Grey


def structure_of(rgb: Float32[np.ndarray, "height width 3"], valid: Bool[np.ndarray, "height width"] | None = None) -> SliceStructure:
    """valid: where the slice has data that is not saturated; None is everywhere."""
    luminance = cv2.transform(rgb, np.array([[0.2126, 0.7152, 0.0722]], np.float32))
    finest = max(0, int(np.ceil(0.5 * np.log2(luminance.size / _MOST_PIXELS))))
    coarsest = max(finest, int(np.log2(max(1.0, min(luminance.shape) / _SMALLEST_SIDE_PX))))
    logarithm = _logarithm(shrunk(luminance, finest))
    usable = np.full(logarithm.shape, 255, np.uint8) if valid is None else shrunk_mask(np.where(valid, np.uint8(255), np.uint8(0)), finest)
    pictures = [
        (level, shrunk(logarithm, level - finest), shrunk_mask(usable, level - finest)) for level in range(coarsest, finest - 1, -1)
    ]
    levels = tuple(_detail_level(*each) for each in pictures)
    return SliceStructure((rgb.shape[1], rgb.shape[0]), levels, pictures[0][1], pictures[0][2])


def _logarithm(luminance: Plane) -> Plane:
    """In which a change of exposure or of light is an offset and bright lights do not outshout the rest."""
    return cv2.log(np.maximum(luminance, 0.0) + np.float32(0.02))


def shrunk(plane: Plane, level: int) -> Float32[np.ndarray, "small_height small_width"]:
    """Area-averaged by exactly 2^level; rows and columns that do not fill a pixel are left out."""
    if level == 0:
        return plane
    height, width = (max(1, side >> level) for side in plane.shape)
    return cv2.resize(plane[: height << level, : width << level], (width, height), interpolation=cv2.INTER_AREA)


def shrunk_mask(mask: Grey, level: int) -> UInt8[np.ndarray, "small_height small_width"]:
    """255 where the whole of a larger pixel is."""
    if level == 0:
        return mask
    return np.where(shrunk(mask.astype(np.float32), level) > 254.5, np.uint8(255), np.uint8(0))


def _detail_level(level: int, logarithm: Plane, usable: Grey) -> DetailLevel:
    detail = _normalised_detail(logarithm)
    unspoilt = cv2.erode(usable, np.ones((_SPOILT_PX, _SPOILT_PX), np.uint8))
    return DetailLevel(level, detail, unspoilt, _corners_px(detail, unspoilt))


def _normalised_detail(logarithm: Plane) -> Grey:
    """Local normalisation lets sharp and blurred versions of a texture look alike, and every part of the picture count."""
    box = (_SURROUND_PX, _SURROUND_PX)
    band = cv2.GaussianBlur(logarithm, (0, 0), _NOISE_SIGMA_PX) - cv2.boxFilter(logarithm, -1, box)
    deviation = cv2.sqrt(cv2.boxFilter(band * band, -1, box) + np.float32(_LEAST_CONTRAST**2))
    return np.clip(band / deviation * _GREY_PER_DEVIATION + _GREY, 0, 255).astype(np.uint8)


def _corners_px(detail: Grey, usable: Grey) -> Corners:
    """Shi and Tomasi 1994, spread over the picture by a least distance."""
    apart_px = max(6.0, 0.5 * float(np.sqrt(detail.size / MOST_CORNERS)))
    found = cv2.goodFeaturesToTrack(detail, MOST_CORNERS, _WEAKEST_CORNER, apart_px, mask=usable, blockSize=_CORNER_BLOCK_PX)
    return np.zeros((0, 2), np.float32) if found is None else found.reshape(-1, 2) + np.float32(0.5)

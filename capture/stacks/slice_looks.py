"""Looks of slices from afar: whether two are the same photograph, whether one shows nothing, and whether two show one scene.

Defocus, breathing, a tint and another exposure leave the light of large areas alike: on 90 photographed stacks neighbours correlate by 0.97
or more, those of other scenes by 0.9 at most. Where hands moved the camera far between two slices, features that match tell instead. Fine
detail, block by block, tells copies of a photograph; merging and the report use it to say how sharp a picture is beside its slices.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from capture.photos.raw import DecodedPhoto
from capture.stacks.exposure import LowFrequency, correlation, fit_gain, low_frequency
from mrbokeh.images.camera_rgb import Matrix3x3
from mrbokeh.images.color import convert, luminance

BLOCK_PX = 24
DETAIL_SIGMA_PX = 1.5
_LONG_SIDE_PX = 1000
_FEATURE_SIDE_PX = 480
_NOISE_CODES = 0.3
_SAME_LIGHT_CODES = 1.5
_SAME_BLOCK_CODES = 2.5
_SAME_DETAIL = 0.03
_ALIKE = 0.95
_UNLIKE = 0.9
_LARGEST_SHIFT = 0.35
_FEWEST_USABLE = 200
_BLUR_SIGMA_PX = 3.0
_MOST_FEATURES = 1000
_FEWEST_FEATURES = 40
_CLEARLY_BEST = 0.75
_MATCH_PX = 4.0
_FEWEST_MATCHES = 16
_LEAST_AGREEING = 0.35
_LARGEST_SCALE = 1.3

Plane = Float32[np.ndarray, "height width"]
Blocks = Float32[np.ndarray, "rows columns"]


@dataclass(frozen=True)
class SliceLook:
    """Look of a photograph before its exposure was evened out.

    light: its large areas; codes: its luminance to the power 1/2, 0 to 255. full: share of its photosites that were full.
    """

    light: LowFrequency
    codes: UInt8[np.ndarray, "height width"]
    full: float

    @cached_property
    def features(self) -> tuple[Float32[np.ndarray, "points 2"], Float32[np.ndarray, "points 128"]]:
        """Return points that SIFT finds, in pixels of a picture 480 px long, and their descriptors."""
        shrink = min(1.0, _FEATURE_SIDE_PX / max(self.codes.shape))
        small = cv2.resize(self.codes, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA) if shrink < 1.0 else self.codes
        points, described = cv2.SIFT.create(_MOST_FEATURES).detectAndCompute(small, None)
        if described is None:
            return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32)
        return np.array([each.pt for each in points], np.float32), described

    @property
    def brightest(self) -> float:
        """Return the linear light that 1 % of the picture exceeds."""
        return float(np.percentile(self.light.luminance, 99))


def look_of(decoded: DecodedPhoto) -> SliceLook:
    return look_at(decoded.rgb, decoded.saturated, decoded.rec709_from_camera, decoded.photosites.full_fraction)


def look_at(
    rgb: Float32[np.ndarray, "height width 3"],
    saturated: Float32[np.ndarray, "height width"] | Bool[np.ndarray, "height width"],
    rec709_from_camera: Matrix3x3 | None,
    full: float,
) -> SliceLook:
    """Reduce a picture to its look. rgb: in the RGB that rec709_from_camera leads from, None where it is Rec.709."""
    # A whole number, for which area averages take a third of the time.
    shrink = max(1, round(max(rgb.shape[:2]) / _LONG_SIDE_PX))
    size = max(1, rgb.shape[1] // shrink), max(1, rgb.shape[0] // shrink)
    small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA) if shrink > 1 else rgb
    light = luminance(small if rec709_from_camera is None else convert(small, np.array(rec709_from_camera)))
    codes = cv2.convertScaleAbs(np.sqrt(np.clip(light, 0.0, 1.0)), alpha=255.0)
    return SliceLook(low_frequency(small, saturated, rec709_from_camera), codes, full)


def same_photograph(first: SliceLook, second: SliceLook) -> bool:
    """Return whether two are identical, or all but (a copy that was compressed again): detail of blocks within 3 %, hardly any other codes.

    Neighbours of a finely stepped sweep differ more: where one sharpens by less, it adds nothing to the other.
    """
    if first.codes.shape != second.codes.shape:
        return False
    light = np.sqrt(first.light.luminance), np.sqrt(second.light.luminance)
    if float(np.abs(light[0] - light[1]).max()) * 255.0 > _SAME_LIGHT_CODES:
        return False
    difference = first.codes.astype(np.float32) - second.codes
    if not difference.any():
        return True
    details = [detail_of_blocks(each.codes.astype(np.float32)) for each in (first, second)]
    textured = np.maximum(*details) >= np.median(np.maximum(*details))
    ratio = np.abs(np.log((details[0] + _NOISE_CODES) / (details[1] + _NOISE_CODES)))[textured]
    blocks = np.sqrt(block_means(difference**2))
    return float(np.percentile(ratio, 95)) <= _SAME_DETAIL and float(np.percentile(blocks, 95)) <= _SAME_BLOCK_CODES


def one_scene(first: SliceLook, second: SliceLook) -> bool:
    """Return whether two photographs of one size may show the same thing; True where that cannot be told."""
    likeness = _likeness(first.light, second.light)
    if likeness >= _ALIKE:
        return True
    told = _features_agree(first, second)
    return likeness >= _UNLIKE if told is None else told


def detail_of_blocks(plane: Plane) -> Blocks:
    """Return the root mean square of what a Gaussian of DETAIL_SIGMA_PX takes from each block (see `block_means`)."""
    fine = cv2.subtract(plane, cv2.GaussianBlur(plane, (0, 0), DETAIL_SIGMA_PX))
    return np.sqrt(block_means(cv2.multiply(fine, fine)))


def block_means(plane: Plane) -> Blocks:
    """Return means over blocks of BLOCK_PX; what is left at the right and below is cut off, and a smaller plane is one block."""
    rows, columns = (max(side // BLOCK_PX, 1) for side in plane.shape)
    return cv2.resize(plane[: rows * BLOCK_PX, : columns * BLOCK_PX], (columns, rows), interpolation=cv2.INTER_AREA)


def _likeness(first: LowFrequency, second: LowFrequency) -> float:
    """Return the correlation of the logarithm of large areas, as they lie or after the best scale and shift."""
    as_it_lies = _correlation(first, second)
    if as_it_lies >= _ALIKE:
        return as_it_lies
    fit = fit_gain(first, second)
    return as_it_lies if fit is None or fit.shift > _LARGEST_SHIFT else max(as_it_lies, fit.likeness)


def _correlation(first: LowFrequency, second: LowFrequency) -> float:
    """Correlate what is usable in both, or all of it where that is too little."""
    both = first.usable & second.usable
    if np.count_nonzero(both) < _FEWEST_USABLE:
        both = np.ones_like(both)
    blurred = (cv2.GaussianBlur(np.log(each.luminance), (0, 0), _BLUR_SIGMA_PX)[both] for each in (first, second))
    return correlation(*(each.astype(np.float64) for each in blurred))


def _features_agree(first: SliceLook, second: SliceLook) -> bool | None:
    """Return whether enough SIFT features lie as one similarity has them; None where a picture has too few of them."""
    (points, described), (others, others_described) = first.features, second.features
    if min(len(points), len(others)) < _FEWEST_FEATURES:
        return None
    pairs = cv2.BFMatcher().knnMatch(described, others_described, k=2)
    good = [best for best, next_best in pairs if best.distance < _CLEARLY_BEST * next_best.distance]
    if len(good) < _FEWEST_MATCHES:
        return False
    here, there = points[[each.queryIdx for each in good]], others[[each.trainIdx for each in good]]
    similarity, agreeing = cv2.estimateAffinePartial2D(here, there, method=cv2.RANSAC, ransacReprojThreshold=_MATCH_PX)
    if similarity is None:
        return False
    scale, count = float(np.hypot(similarity[0, 0], similarity[1, 0])), int(agreeing.sum())
    return count >= max(_FEWEST_MATCHES, _LEAST_AGREEING * len(good)) and 1.0 / _LARGEST_SCALE <= scale <= _LARGEST_SCALE

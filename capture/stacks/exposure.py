"""Exposure differences within a focal stack and between the stacks of a scene, from what defocus leaves alone: the light of large areas.

Blur moves light around but conserves it, so that heavily blurred slices differ by focus breathing (a small scale and
shift) and by one gain. Both are fitted together, or breathing would pass for exposure: log R(A x + t) = log S(x) + log g,
Gauss-Newton with Tukey's weights on pictures 96 px long, over the centre only, since vignetting changes with focus and blur
brings in light from outside at the borders.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from capture.photos.photo_metadata import PhotoMetadata, StatedExposure
from capture.photos.raw import DecodedPhoto
from mrbokeh.images.camera_rgb import Matrix3x3, read_slice
from mrbokeh.images.color import convert, luminance
from mrbokeh.stacks.focal_stack import read_focal_stack
from mrbokeh.system.errors import InputError

LONG_SIDE_PX = 96
LARGEST_SCALE_CHANGE = 0.15
# Blur and the step that ends the search: the coarse one has only to come near.
_STAGES = ((6.0, 3e-3), (3.0, 1e-4))
_STEPS = 12
_CENTRE_RADIUS = 0.8
_LARGEST_SATURATED_SHARE = 0.01
_TUKEY = 4.685
_MAD_TO_SIGMA = 1.4826
_LEAST_SPREAD = 1e-3
_FEWEST_PIXELS = 200
_TINY = 1e-9
_PULL = (1e-4, 1e-4, 1e-4)
_DEAD_ZONE = 0.01
_RESIDUAL_LIMIT = 1.26
_UNSTATED_LIMIT = 2.0
_LARGEST_SPREAD = 0.08
_OVERLAP_DEAD_ZONE = 0.03


@dataclass(frozen=True)
class LowFrequency:
    """Slice reduced to large areas. luminance: (h, w) linear, positive; usable: (h, w) neither saturated nor black."""

    luminance: Float32[np.ndarray, "h w"]
    usable: Bool[np.ndarray, "h w"]


@dataclass(frozen=True)
class GainFit:
    """Fit of one gain between two pictures, with the scale and the shift between them.

    gain: brings the slice's light to the reference's. shift: a share of half the long side.
    spread: what is left of the difference, as the standard deviation (by the median) of the logarithm of light.
    likeness: correlation of the logarithms of both where they overlap, 1 for the same scene however bright.
    """

    gain: float
    log_scale: float
    spread: float
    shift: float
    likeness: float


@dataclass(frozen=True)
class ExposureGain:
    """Gain that brings a slice to the exposure of the session.

    session: brings the reference of the stack there, 1 where neither metadata nor pictures tell.
    The others bring the slice to that reference. session_from: what told: "metadata", "overlap" (pictures) or "nothing".
    stated: from exposure time, ISO and f-number, 1 where they are unknown or equal.
    residual: what was found in the pictures on top of that. measured: the same before limits, None where nothing could be.
    """

    stated: float = 1.0
    residual: float = 1.0
    measured: float | None = None
    session: float = 1.0
    session_from: str = "metadata"

    @property
    def total(self) -> float:
        return self.session * self.stated * self.residual

    @property
    def was_limited(self) -> bool:
        """Return whether more was measured than applied, by more than the error of measurement."""
        return self.measured is not None and abs(math.log(self.measured / self.residual)) > math.log1p(_DEAD_ZONE)


def gain_to_reference(reference: LowFrequency, slice_: LowFrequency, stated: float | None) -> ExposureGain:
    """Return the gain to apply. stated: the ratio of exposures according to metadata, or None where they do not tell.

    Of the measured rest, what lies within the error of measurement (1 %) is not applied; and no more than a third of
    a stop where metadata spoke, one stop where it did not: beyond that the pictures show different things.
    """
    start = stated or 1.0
    fit = fit_gain(reference, slice_)
    residual = None if fit is None else fit.gain / start
    limit = _RESIDUAL_LIMIT if stated else _UNSTATED_LIMIT
    if residual is None or abs(math.log(residual)) <= math.log1p(_DEAD_ZONE):
        return ExposureGain(start, 1.0, residual)
    return ExposureGain(start, min(max(residual, 1.0 / limit), limit), residual)


def overlap_gain(reference: LowFrequency, other: LowFrequency) -> float | None:
    """Return the gain between two viewpoints of a scene whose files state no exposure; None where they show too different things.

    Parallax is no blur: it is trusted only where little is left once gain, scale and shift are taken out. On traced views of
    equal exposure that is so in 6 of 10 pairs, off by 1 % at most; the other four would be off by 9 to 16 %.
    """
    fit = fit_gain(reference, other)
    if fit is None or fit.spread > _LARGEST_SPREAD or abs(fit.log_scale) > 0.99 * LARGEST_SCALE_CHANGE:
        return None
    return 1.0 if abs(math.log(fit.gain)) <= math.log1p(_OVERLAP_DEAD_ZONE) else fit.gain


def stated_gain(wanted: StatedExposure | None, metadata: PhotoMetadata) -> float | None:
    """Return the gain from a photograph's exposure to another according to metadata, None where they do not tell."""
    own = metadata.exposure
    return own.gain_to(wanted) if wanted and own else None


def gain_to_session(decoded: DecodedPhoto, light: LowFrequency, stated: float | None, scale_stack: Path | None) -> ExposureGain:
    """Return the gain for the reference of a stack. scale_stack: the stack that set the scale, None where it is this one.

    EXR and HDR that state nothing are left alone: their numbers are light already.
    """
    if stated is not None:
        return ExposureGain(session=stated)
    other = None if scale_stack is None or decoded.saturation_level is None else _light_of_stack(scale_stack)
    measured = None if other is None else overlap_gain(other, light)
    return ExposureGain(session_from="nothing") if measured is None else ExposureGain(session=measured, session_from="overlap")


def low_frequency(
    rgb: Float32[np.ndarray, "height width 3"],
    saturated: Float32[np.ndarray, "height width"] | Bool[np.ndarray, "height width"],
    rec709_from_camera: Matrix3x3 | None = None,
) -> LowFrequency:
    """Return area averages of a slice on a grid LONG_SIDE_PX long, and which of them are free of saturated photosites.

    rec709_from_camera: from the RGB of the slice, None where that is Rec.709.
    """
    scale = LONG_SIDE_PX / max(rgb.shape[:2])
    size = max(1, round(rgb.shape[1] * scale)), max(1, round(rgb.shape[0] * scale))
    small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    light = luminance(small if rec709_from_camera is None else convert(small, np.array(rec709_from_camera)))
    full = cv2.resize(saturated.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    # What is saturated here is spread over its neighbours in the other slices.
    full = cv2.dilate(full, np.ones((5, 5), np.uint8))
    floor = max(1e-3 * float(np.median(light)), 1e-7)
    return LowFrequency(np.maximum(light, floor), (full <= _LARGEST_SATURATED_SHARE) & (light > floor))


def fit_gain(reference: LowFrequency, slice_: LowFrequency) -> GainFit | None:
    """Fit the gain between two pictures; None where too little of both is usable."""
    if reference.luminance.shape != slice_.luminance.shape:
        return None
    parameters, spread, likeness = np.zeros(4), 0.0, 0.0
    for sigma_px, smallest_step in _STAGES:
        for _ in range(_STEPS):
            found = _gauss_newton_step(reference, slice_, parameters, sigma_px)
            if found is None:
                return None
            step, spread, likeness = found
            parameters = parameters + step
            parameters[1] = np.clip(parameters[1], -LARGEST_SCALE_CHANGE, LARGEST_SCALE_CHANGE)
            if np.abs(step).max() < smallest_step:
                break
    return GainFit(
        gain=float(np.exp(parameters[0])),
        log_scale=float(parameters[1]),
        spread=spread,
        shift=float(np.hypot(*parameters[2:])),
        likeness=likeness,
    )


def correlation(first: Float[np.ndarray, " n"], second: Float[np.ndarray, " n"]) -> float:
    """Return Pearson's correlation; 0 where one of them does not vary."""
    first, second = first - first.mean(), second - second.mean()
    scale = math.sqrt(float(first @ first) * float(second @ second))
    return float(first @ second) / scale if scale > _TINY else 0.0


def _gauss_newton_step(
    reference: LowFrequency, slice_: LowFrequency, parameters: Float64[np.ndarray, "4"], sigma_px: float
) -> tuple[Float64[np.ndarray, "4"], float, float] | None:
    """Return one weighted step for (log gain, log scale, shift x, shift y), and the spread and the likeness before it.

    Shifts are shares of half the long side.
    """
    light, usable, x, y = _breathed(reference, parameters)
    mask = (usable & slice_.usable).astype(np.float64)
    share = _blurred(mask, sigma_px)
    inside = (np.hypot(x / np.abs(x).max(), y / np.abs(y).max()) < _CENTRE_RADIUS) & (share > 0.5) & (mask > 0)
    if np.count_nonzero(inside) < _FEWEST_PIXELS:
        return None
    # Both are averaged over the same usable pixels, so that a saturated lamp in one is missing in both.
    reference_light, slice_light = (_blurred(each * mask, sigma_px) / np.maximum(share, 1e-6) for each in (light, slice_.luminance))
    reference_log, slice_log = np.log(np.maximum(reference_light, _TINY)), np.log(np.maximum(slice_light, _TINY))
    slope_y, slope_x = np.gradient(reference_log, y[1, 0] - y[0, 0], x[0, 1] - x[0, 0])
    jacobian = np.stack([np.full_like(x, -1.0), slope_x * x + slope_y * y, slope_x, slope_y], axis=-1)[inside]
    error = (reference_log - slice_log)[inside] - parameters[0]
    # Flare and a wrong black level matter most in the dark.
    trust = slice_light[inside] / (slice_light[inside] + 0.1 * np.median(slice_light[inside]))
    likeness = correlation(reference_log[inside], slice_log[inside])
    return _weighted_solution(jacobian, -error, trust * _tukey(error)), _spread(error), likeness


def _breathed(
    low: LowFrequency, parameters: Float64[np.ndarray, "4"]
) -> tuple[Float64[np.ndarray, "h w"], Bool[np.ndarray, "h w"], Float64[np.ndarray, "h w"], Float64[np.ndarray, "h w"]]:
    """Return (light, usable) scaled and shifted, and the grid (x, y) from the centre in units of half the long side."""
    height, width = low.luminance.shape
    half = max(height, width) / 2.0
    x, y = np.meshgrid((np.arange(width) + 0.5 - width / 2.0) / half, (np.arange(height) + 0.5 - height / 2.0) / half)
    scale = math.exp(parameters[1])
    map_x = ((x * scale + parameters[2]) * half + width / 2.0 - 0.5).astype(np.float32)
    map_y = ((y * scale + parameters[3]) * half + height / 2.0 - 0.5).astype(np.float32)
    light = cv2.remap(low.luminance, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    usable = cv2.remap(low.usable.astype(np.float32), map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return light.astype(np.float64), usable > 0.99, x, y


def _blurred(values: Float[np.ndarray, "h w"], sigma_px: float) -> Float64[np.ndarray, "h w"]:
    """Blur, with nothing outside. OpenCV takes a tenth of SciPy's time for pictures so small."""
    side = 2 * round(4.0 * sigma_px) + 1
    return cv2.GaussianBlur(np.asarray(values, np.float64), (side, side), sigma_px, borderType=cv2.BORDER_CONSTANT)


def _spread(error: Float64[np.ndarray, " n"]) -> float:
    return _MAD_TO_SIGMA * float(np.median(np.abs(error - np.median(error))))


def _tukey(error: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Return Tukey's biweight around the median: what lies far off (moving things, spread highlights) counts nothing."""
    spread = max(_spread(error), _LEAST_SPREAD)
    return np.clip(1.0 - ((error - np.median(error)) / (_TUKEY * spread)) ** 2, 0.0, None) ** 2


def _weighted_solution(
    jacobian: Float64[np.ndarray, "n 4"], target: Float64[np.ndarray, " n"], weights: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, "4"]:
    """Solve by least squares with a slight pull of scale and shift towards no change, for pictures without structure."""
    normal = jacobian.T @ (jacobian * weights[:, None])
    normal[np.diag_indices(4)] += weights.sum() * np.array([0.0, *_PULL])
    return np.linalg.solve(normal, jacobian.T @ (target * weights))


def _light_of_stack(folder: Path) -> LowFrequency | None:
    """Return the large areas of a stack's first slice; None where it is not there (any more)."""
    try:
        stack = read_focal_stack(folder)
        path = stack.folder / stack.slices[0].metadata.get("ingested", stack.slices[0].path)
        rgb, masks = read_slice(path)
        return low_frequency(rgb, masks.saturated, stack.rec709_from_camera)
    except InputError:
        return None

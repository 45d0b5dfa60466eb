"""Points of light out of focus: each is a picture of its own kernel. Found in frames made for it, dark but for a few lights."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.ndimage import binary_dilation, find_objects, label

from mrbokeh.lens_measuring.fitting.evidence import Equations, Knots, Pictures
from mrbokeh.lens_measuring.fitting.pupil_picture import EXTENT, PupilGrid
from mrbokeh.lens_measuring.fitting.stack_equations import LEAST_DIAMETER_PX, Rgb

_FAINTEST = 0.02  # of the brightest light's level
_NOISE_TIMES = 6.0
_OUTLINE = 0.25  # of a light's median level: where its outline is taken to be
_GAP_PX = 2  # parts nearer to one another are of one light
_REACH_PERCENT = 99.5
_DEVIATION, _DARK_SHARE = 0.25, 0.5  # a light's kernel is known to this share of its level; where it is dark, to half the variance
_SCALES = np.linspace(0.8, 1.25, 46)


@dataclass(frozen=True)
class PointLight:
    """Picture of a point of light out of focus.

    light: (S, S, 3) around it, background taken off, flux 1 per colour. centre_px: x, y within it (of its light, the
    origin of the pupil). diameter_px: signed circle of confusion. field_xy: its place in half diagonals.
    """

    light: Float64[np.ndarray, "height width 3"]
    centre_px: tuple[float, float]
    diameter_px: float
    field_xy: tuple[float, float]


def find_lights(frame: Rgb, in_front: bool) -> list[PointLight]:
    """Find the lights of a linear frame that stand apart from each other and from its border and are below 1 (not clipped).

    in_front: whether they lie in front of the focus. Diameters reach to where a light's outline is farthest from its middle.
    """
    lit = _lit(frame)
    numbers, _ = label(binary_dilation(lit, iterations=_GAP_PX))
    found = [_light_in(frame, numbers == i + 1, box, in_front) for i, box in enumerate(find_objects(numbers))]
    return [light for light in found if light is not None]


def _lit(frame: Rgb) -> Bool[np.ndarray, "height width"]:
    grey = frame.mean(axis=2)
    dark = float(np.median(grey))
    noise = 1.4826 * float(np.median(np.abs(grey - dark)))
    return np.asarray(grey - dark > max(_NOISE_TIMES * noise, _FAINTEST * float(np.percentile(grey, 99.9) - dark), 1e-6))


def _light_in(frame: Rgb, mine: Bool[np.ndarray, "height width"], box: tuple[slice, slice], in_front: bool) -> PointLight | None:
    """Return the light of one part of the frame; None if it touches the border, is clipped or too small."""
    height, width = frame.shape[:2]
    side = max(box[0].stop - box[0].start, box[1].stop - box[1].start)
    top = (box[0].start + box[0].stop - side) // 2
    left = (box[1].start + box[1].stop - side) // 2
    margin = side // 6 + 2
    top, left, side = top - margin, left - margin, side + 2 * margin
    if min(top, left) < 0 or top + side > height or left + side > width:
        return None
    part, inside = frame[top : top + side, left : left + side], mine[top : top + side, left : left + side]
    light = part.astype(np.float64) - np.median(frame, axis=(0, 1))
    grey = np.where(inside, light.mean(axis=2), 0.0)
    if float(part[inside].max()) >= 1.0 or float(grey.max()) <= 0.0:
        return None
    light = np.where(inside[..., None], light, 0.0)
    rows, columns = np.indices(grey.shape) + 0.5
    x, y = float((grey * columns).sum() / grey.sum()), float((grey * rows).sum() / grey.sum())
    bright = grey > _OUTLINE * float(np.median(grey[grey > 0.5 * _OUTLINE * grey.max()]))
    diameter_px = 2.0 * float(np.percentile(np.hypot(columns - x, rows - y)[bright], _REACH_PERCENT))
    if diameter_px < LEAST_DIAMETER_PX or (light.sum(axis=(0, 1)) <= 0.0).any():
        return None
    half_diagonal = 0.5 * float(np.hypot(width, height))
    place = ((left + x - 0.5 * width) / half_diagonal, (top + y - 0.5 * height) / half_diagonal)
    return PointLight(light / light.sum(axis=(0, 1)), (x, y), -diameter_px if in_front else diameter_px, place)


def equations_of_light(light: PointLight, grid: PupilGrid, knots: Knots, scale: float = 1.0) -> Equations:
    """Return the equations of a light's pixels within the reach of its kernel; scale: by how much it is larger than was measured.

    Their weights are final: a light that stands apart has no pixels to distrust, and those of its rim fit least before they are solved for.
    """
    diameter_px, place = scale * light.diameter_px, np.array([light.field_xy])
    cosine, sine = knots.turns(place)[0]
    turned = grid.places @ np.array([[cosine, sine], [-sine, cosine]])
    half, cell = 0.5 * diameter_px, 0.5 * abs(diameter_px) * grid.cell
    shares = [_overlaps(light.light.shape[1 - i], light.centre_px[i] + half * turned[:, i], cell) for i in (0, 1)]
    rows_columns = np.indices(light.light.shape[:2]) + 0.5
    near = np.hypot(rows_columns[1] - light.centre_px[0], rows_columns[0] - light.centre_px[1]) <= EXTENT * abs(half) + 1.0
    area = 0.25 * np.pi * diameter_px**2
    rows = (area * shares[1][:, None, :] * shares[0][None, :, :])[near].astype(np.float32)
    targets = area * light.light[near]
    weights = np.repeat(1.0 / (_DARK_SHARE + np.maximum(targets.mean(axis=1), 0.0)), 3).reshape(-1, 3) / _DEVIATION**2
    at = np.repeat(knots.at(np.array([diameter_px]), place), len(rows))
    return Equations(np.repeat(rows[:, None], 3, axis=1), targets, weights, at)


def _overlaps(pixels: int, middles: Float64[np.ndarray, " cells"], cell: float) -> Float64[np.ndarray, "pixels cells"]:
    """Return the share of each cell's width that falls into each pixel."""
    left = np.arange(pixels)[:, None]
    overlap = np.minimum(middles + 0.5 * cell, left + 1.0) - np.maximum(middles - 0.5 * cell, left)
    return np.asarray(np.maximum(overlap, 0.0) / cell)


def best_scale(light: PointLight, grid: PupilGrid, knots: Knots, pictures: Pictures) -> float:
    """Return how much larger than measured a light is if its kernel is the one that stacks tell, whose diameters are known."""
    errors = []
    for scale in _SCALES:
        area = (scale * light.diameter_px) ** 2
        equations = equations_of_light(light, grid, knots, float(scale))
        errors.append(float((equations.residuals(pictures) ** 2).sum()) / area)
    return float(_SCALES[int(np.argmin(errors))])


def light_count(lights: list[PointLight], knots: Knots) -> Int64[np.ndarray, " knots"]:
    """Return how many lights each knot has."""
    at = [int(knots.at(np.array([light.diameter_px]), np.array([light.field_xy]))[0]) for light in lights]
    return np.bincount(at, minlength=len(knots)).astype(np.int64)

"""Depth from focus: in which slice, and between which two, every pixel is sharp, and how sure that is.

Labels are aggregated semi-globally along eight directions (Hirschmueller 2008), row by row in NumPy: nothing compiles first.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int

from capture.merging.focus_volume import FocusVolume, Volume, share_above
from capture.merging.lights import Lights

# A jump of the depth by more than one slice costs as much as this many e-folds of focus energy.
SMALL_STEP_COST = 0.3
LARGE_STEP_COST = 3.0
LARGEST_COST = 4.0
# No path bears with what is not there.
_NO_DATA_COST = 100.0
# Detail has half its say in the labelling, and half its confidence, where its energy is this many times that of the noise.
LABELLING_NOISE_FLOORS = 30.0
CONFIDENCE_NOISE_FLOORS = 10.0
# Plain places follow the detail around them: windows this many times as wide, and more in larger pictures, speak where small ones do not.
# They end at edges of light (domain transform, Gastal and Oliveira 2011; light from 0 to 255): in Gaussian windows the detail of the ground
# overruled the tip of a plain leaf in front of it.
WIDER = (4, 16)
# Of the detail of the median block: below the first a block is plain, above the second it speaks for itself. (Where most of the
# picture is plain no block is: a share of its most textured blocks in place of the median lost 5 % of the blocks of a real stack.)
PLAIN = (0.4, 0.6)
WIDER_REACH = 4.0
WIDER_EDGE = 20.0
WIDER_NOISE_FLOORS = 10.0
WIDER_FROM_PX = 0.7e6
# Of two slices a place's own weak detail tells more: mean rank 2.5 of 36 methods on 20 pairs without windows, 4.6 with them.
FEWEST_SLICES_FOR_WIDER = 3
# At focus light stands still from slice to slice; the rim of a blurred edge comes with as much change of light as it has curvature (heat
# equation): energy may be that of a rim up to so many times the square of the change, in square roots of light per slice.
RIM_ENERGY = 1.0
# In fewer slices light changes with leaves in the wind or the exposure: it tells of rims in plain places only, and outlines are not asked.
FEWEST_SLICES_FOR_RIMS = 5
# Light is compared over a few pixels of the volume.
_LIGHT_SIGMA_PX = 3.0
# Fine texture that is seen through the blurred rim of a thing has more fine detail than the thing's outline. So within so many pixels of
# the volume of a jump by so many slices, detail of such sigmas has this share of the say: there the outline is sharp in its own slice.
# Things narrower than _THIN_PX, as threads and hairs, have no rim of their own: with them, the wall beside threads was blurred.
OUTLINE_REACH_PX = 10
OUTLINE_JUMP = 2.0
OUTLINE_SIGMAS_PX = (1.0, 2.0)
OUTLINE_SAY = 0.3
_THIN_PX = 11
# Clipped lights have outlines in all slices: none are asked so near to this light, of 255.
_LIT = 250
_LIT_REACH_PX = 4
# Pixels this near to one that is full see its clipped rim, not detail.
SATURATION_REACH_PX = 5
# Where the log energy bends by this much at its peak it tells depth as well as it can.
SHARP_CURVATURE = 0.2
# The window of the energy sees this far: beside a jump in depth it sees two surfaces.
WINDOW_REACH_PX = 6
# Neighbouring pixels whose depths differ by more slices than this belong to two surfaces.
SURFACE_STEP = 1.5

Costs = Float32[np.ndarray, "labels height width"]
Plane = Float32[np.ndarray, "height width"]
Labels = Int[np.ndarray, "height width"]


@dataclass(frozen=True)
class FocusMap:
    """Depth from focus, as slice indices.

    focus_index: (H, W) fractional index of the slice in which the surface is sharp.
    confidence: (H, W) in [0, 1], 0 where the index is a guess from the surroundings, and in the reach of lights.
    lit: (H, W) of lights, whose index is measured although they have no confidence; None without any.
    """

    focus_index: Plane
    confidence: Plane
    lit: Bool[np.ndarray, "height width"] | None = None


def focus_map(volume: FocusVolume, lights: Lights, saturated: Bool[np.ndarray, "height width"] | None = None) -> FocusMap:
    """Label log focus energies semi-globally (Hirschmueller 2008), then fit a parabola through each peak.

    Where there is no detail, that of the surroundings decides: beside a sharp edge every other slice shows light that the edge spreads.
    Energies within the reach of a light have no say, but the light's own pixels are known to be sharp in its sharpest slice.
    saturated: (H, W) full in some slice: no confidence there and beside it.
    """
    by_light = lights.slice_index()
    energies = volume.calmed()
    strongest = energies.max(axis=0)
    plain = _plainness(volume)
    detail = _without_rims(volume, energies, plain)
    sharp = _sharp_light(volume, detail)
    costs = _costs(detail, plain, sharp)
    _let_lights_decide(costs, volume.reduced(by_light), volume.reduced(lights.core))
    if volume.missing is not None:
        costs[volume.missing] = _NO_DATA_COST
    labels = aggregate_costs(costs, SMALL_STEP_COST, LARGE_STEP_COST).argmin(axis=0)
    if len(costs) >= FEWEST_SLICES_FOR_RIMS:
        beside = _outlines(labels)
        if beside.any():
            labels = aggregate_costs(_with_outlines(costs, volume, beside), SMALL_STEP_COST, LARGE_STEP_COST).argmin(axis=0)
    offset, _ = peak_parabola(np.log1p(energies, out=energies), labels)
    # In plain places the label is not the peak of the pixel's own energies.
    offset += plain * (peak_parabola(np.negative(costs, out=costs), labels)[0] - offset)
    if volume.missing is not None:  # a parabola needs both neighbours
        neighbours = (np.clip(labels + step, 0, len(costs) - 1) for step in (-1, 1))
        offset[np.logical_or.reduce([np.take_along_axis(volume.missing, each[None], axis=0)[0] for each in neighbours])] = 0.0
    index = volume.enlarged(np.where(volume.reduced(by_light) >= 0, labels, labels + offset).astype(np.float32), SURFACE_STEP)
    trust = share_above(strongest, CONFIDENCE_NOISE_FLOORS) * _confidence(volume, labels)
    trust = volume.enlarged(trust) * _share_of_one_surface(index)
    confidence = np.where(vetoed(by_light, saturated), 0.0, trust).astype(np.float32)
    index[lights.core] = lights.focus_index[lights.zone[lights.core] - 1]
    return FocusMap(index, confidence, lights.core if lights.core.any() else None)


def aggregate_costs(costs: Costs, small: float, large: float) -> Costs:
    """Return the sums over eight paths: a step by one label along a path costs `small`, any larger step `large`."""
    total = _swept(np.ascontiguousarray(costs.transpose(0, 2, 1)), (0,), small, large)
    return _swept(costs, (1, 0, -1), small, large, np.ascontiguousarray(total.transpose(0, 2, 1)))


def peak_parabola(log_energies: Volume, labels: np.ndarray) -> tuple[Plane, Plane]:
    """Return (offset in [-0.5, 0.5], curvature >= 0) of the parabola through each label and its two neighbours.

    The first and last slice have a neighbour on one side only: their offset is 0 and their curvature half the drop to it. Where the label
    is in a hollow its offset is 0.
    """
    last = log_energies.shape[0] - 1

    def at(index: np.ndarray) -> Plane:
        return np.take_along_axis(log_energies, np.clip(index, 0, last)[None], axis=0)[0]

    before, centre, after = at(labels - 1), at(labels), at(labels + 1)
    curvature = np.maximum(2 * centre - before - after, 0)
    interior = (labels > 0) & (labels < last)
    offset = np.where(interior & (curvature > 0), 0.5 * (after - before) / np.maximum(curvature, 1e-3), 0.0)
    return np.clip(offset, -0.5, 0.5).astype(np.float32), np.where(interior, curvature, 0.5 * curvature).astype(np.float32)


def vetoed(by_light: Labels, saturated: Bool[np.ndarray, "height width"] | None) -> Bool[np.ndarray, "height width"]:
    """Return where energy is that of rims: within the reach of lights (`by_light` >= 0) and beside pixels that are full."""
    if saturated is None or not saturated.any():
        return by_light >= 0
    size = 2 * SATURATION_REACH_PX + 1
    near = cv2.dilate(saturated.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))
    return (by_light >= 0) | (near > 0)


def _plainness(volume: FocusVolume) -> Plane:
    """Return 1 where blocks are plain beside the median block of the stack, 0 where they are textured, at the size of the volume."""
    sharpest = np.max(volume.details, axis=0)
    low, high = (share * float(np.median(sharpest)) for share in PLAIN)
    plain = np.clip((high - sharpest) / max(high - low, 1e-9), 0.0, 1.0).astype(np.float32)
    return cv2.resize(plain, volume.size[::-1], interpolation=cv2.INTER_LINEAR)


def _without_rims(volume: FocusVolume, energies: Volume, plain: Plane) -> Volume:
    """Return energies without those of the rims of blurred edges nearby."""
    share = np.float32(RIM_ENERGY / 255.0**2) / volume.noise
    if len(energies) < FEWEST_SLICES_FOR_RIMS:
        share *= plain

    result, last = np.empty_like(energies), len(energies) - 1
    for index, energy in enumerate(energies):
        before, after = max(index - 1, 0), min(index + 1, last)
        # A slice without data in a place tells of no change there.
        lights = (np.where(volume.energies[each] > 0, volume.lights[each], volume.lights[index]) for each in (before, after))
        change = cv2.GaussianBlur(np.subtract(*lights, dtype=np.float32), (0, 0), _LIGHT_SIGMA_PX) / np.float32(after - before)
        result[index] = energy * energy / (energy + share * change * change + np.float32(1e-9))
    return result


def _sharp_light(volume: FocusVolume, energies: Volume) -> Plane:
    """Return the mean light of all slices, each as far as its detail says that it is sharp."""
    total, light = (np.zeros(volume.size, np.float32) for _ in range(2))
    for energy, each in zip(energies, volume.lights, strict=True):
        say = energy * energy
        total += say
        light += say * each
    return light / np.maximum(total, np.float32(1e-9))


def _costs(energies: Volume, plain: Plane, sharp_light: Plane) -> Volume:
    """Return how many e-folds the energy of each slice is below the strongest, times the say of the pixel, then of wider windows."""
    wider = [_wider(energies, shrink, sharp_light) for shrink in WIDER] if len(energies) >= FEWEST_SLICES_FOR_WIDER else []
    say = share_above(energies.max(axis=0), LABELLING_NOISE_FLOORS)
    costs = _below_strongest(np.log1p(energies, out=energies))
    costs *= say
    left, size = plain * (1.0 - say), energies.shape[2:0:-1]
    for window in wider:
        say = left * cv2.resize(share_above(window.max(axis=0), WIDER_NOISE_FLOORS), size, interpolation=cv2.INTER_LINEAR)
        for cost, each in zip(costs, _below_strongest(np.log1p(window)), strict=True):
            cost += say * cv2.resize(each, size, interpolation=cv2.INTER_LINEAR)
        left -= say
    return costs


def _outlines(labels: Labels) -> Bool[np.ndarray, "height width"]:
    """Return what is beside jumps of the labels, but for thin things."""
    calm = cv2.medianBlur(np.minimum(labels, 255).astype(np.uint8), _THIN_PX).astype(np.float32)
    reach = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * OUTLINE_REACH_PX + 1,) * 2)
    return cv2.dilate(calm, reach) - cv2.erode(calm, reach) > OUTLINE_JUMP


def _with_outlines(costs: Volume, volume: FocusVolume, outlines: Bool[np.ndarray, "height width"]) -> Volume:
    """Return costs in which coarser detail has its say beside jumps of the labels."""
    lit_reach = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _LIT_REACH_PX + 1,) * 2)
    asked = outlines & (cv2.dilate(volume.lights.max(axis=0), lit_reach) < _LIT)
    mixed = np.stack([_coarse_detail(each.astype(np.float32)) for each in volume.lights])
    noise = float(np.percentile(mixed[:, ::3, ::3], 5.0)) + 1e-3
    say = np.float32(OUTLINE_SAY) * asked * share_above(mixed.max(axis=0), LABELLING_NOISE_FLOORS * noise)
    mixed /= np.float32(CONFIDENCE_NOISE_FLOORS * noise)
    mixed = _below_strongest(np.log1p(mixed, out=mixed))
    mixed -= costs
    mixed *= say
    mixed += costs
    return mixed


def _coarse_detail(light: Plane) -> Plane:
    fine, coarse = (cv2.GaussianBlur(light, (0, 0), sigma) for sigma in OUTLINE_SIGMAS_PX)
    return cv2.GaussianBlur(np.square(fine - coarse), (0, 0), OUTLINE_SIGMAS_PX[0])


def _wider(energies: Volume, shrink: int, sharp_light: Plane) -> Float32[np.ndarray, "slices rows columns"]:
    """Return energies averaged over wider windows that end at edges of light, smaller by `shrink` or more.

    Strong texture counts there no more than detail that speaks for itself, or it would reach over faint detail of another surface.
    """
    height, width = energies.shape[1:]
    step = max(1.0, np.sqrt(height * width / WIDER_FROM_PX)) * shrink
    size = tuple(max(1, int(np.ceil(each / step))) for each in (width, height))
    share = 1.0 - share_above(energies.max(axis=0), LABELLING_NOISE_FLOORS)
    guide, *small = (cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in (sharp_light, *(share * each for each in energies)))
    return np.stack([cv2.ximgproc.dtFilter(guide, each, WIDER_REACH, WIDER_EDGE) for each in small])


def _below_strongest(log_energies: Volume) -> Volume:
    costs = np.subtract(log_energies.max(axis=0), log_energies, out=log_energies)
    return np.minimum(costs, np.float32(LARGEST_COST), out=costs)


def _let_lights_decide(costs: Volume, by_light: Labels, core: Bool[np.ndarray, "height width"]) -> None:
    costs[:, by_light >= 0] = 0.0
    costs[:, core] = LARGEST_COST * (np.arange(len(costs))[:, None] != by_light[core])


def _confidence(volume: FocusVolume, labels: np.ndarray) -> Plane:
    """Return a confidence that is high where the energy has one sharp peak under the label, and 0 where all slices look alike.

    Energies are taken as they are: averaged over slices every peak is flatter.
    """
    log_energies = np.log1p(volume.energies)
    at_label = np.take_along_axis(log_energies, labels[None], axis=0)[0]
    off_peak = log_energies.max(axis=0) - at_label
    contrast = at_label - np.median(log_energies, axis=0)
    curvature = np.clip(peak_parabola(log_energies, labels)[1] / SHARP_CURVATURE, 0.0, 1.0)
    return (np.exp(-2.0 * off_peak) * (1.0 - np.exp(-np.maximum(contrast, 0.0))) * curvature).astype(np.float32)


def _share_of_one_surface(index: Plane) -> Plane:
    """Return 1 where the window of the energy sees one surface, down to 1/4 where it sees a jump of SURFACE_STEP slices or more."""
    box = np.ones((2 * WINDOW_REACH_PX + 1,) * 2, np.uint8)
    jump = cv2.dilate(index, box) - cv2.erode(index, box)
    return (1.0 - 0.75 * np.clip(jump / SURFACE_STEP - 0.5, 0.0, 1.0)).astype(np.float32)


def _swept(costs: Costs, moves: tuple[int, ...], small: float, large: float, total: Costs | None = None) -> Costs:
    """Return `total` with the path costs of both ways along the rows."""
    total = np.zeros_like(costs) if total is None else total
    for way in (slice(None), slice(None, None, -1)):
        _sweep(costs[:, way], moves, small, large, total[:, way])
    return total


def _sweep(costs: Costs, moves: tuple[int, ...], small: float, large: float, total: Costs) -> None:
    """Add the path costs from row to row, for paths that come from as many columns to the left as each of `moves` says."""
    labels, height, width = costs.shape
    # One column and one label more on either side: paths begin at 0 beyond the picture, and there are no labels beyond the last.
    before, path = (np.zeros((len(moves), labels + 2, width + 2), np.float32) for _ in range(2))
    for each in (before, path):
        each[:, [0, -1]] = np.inf
    stepped = np.empty((len(moves), labels, width), np.float32)
    for row in range(height):
        for index, move in enumerate(moves):
            came = before[index, :, 1 - move : 1 - move + width]
            goes = path[index, 1:-1, 1:-1]
            np.minimum(came[:-2], came[2:], out=stepped[index])
            stepped[index] += small
            np.minimum(stepped[index], came[1:-1], out=goes)
        inner = path[:, 1:-1, 1:-1]
        np.minimum(inner, large, out=inner)
        inner += costs[:, row]
        total[:, row] += inner.sum(axis=0)
        inner -= inner.min(axis=1, keepdims=True)
        before, path = path, before

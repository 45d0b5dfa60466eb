"""Depth from focus: in which slice, and between which two, every pixel is sharp, and how sure that is."""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32

from capture.merging.lights import Lights

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Volume = Float32[np.ndarray, "slices height width"]

# A jump of the depth by more than one slice costs as much as this many e-folds of focus energy.
SMALL_STEP_COST = 0.3
LARGE_STEP_COST = 3.0
LARGEST_COST = 4.0
# Detail has half its say in the labelling, and half its confidence, where its energy is this many times that of the noise.
LABELLING_NOISE_FLOORS = 100.0
CONFIDENCE_NOISE_FLOORS = 10.0


@dataclass(frozen=True)
class FocusMap:
    """focus_index (H, W): fractional index of the slice in which the surface is sharp: its depth.

    confidence: (H, W) in [0, 1], 0 where the index is a guess from the surroundings.
    merge_index: (H, W) the index to take the merged picture from: the same but around bright lights, where the slice is
    the one that has least of the light's spread.
    """

    focus_index: Plane
    confidence: Plane
    merge_index: Plane


def focus_energy(rgb: Rgb, window_px: float = 2.5) -> Plane:
    """Local energy of fine detail (sum of squared Laplacians), in the square root of light where shot noise is even."""
    encoded = cv2.GaussianBlur(np.sqrt(np.maximum(rgb, 0.0)), (0, 0), 0.7)
    detail = cv2.Laplacian(encoded, cv2.CV_32F, ksize=1)
    return cv2.GaussianBlur((detail * detail).sum(axis=2), (0, 0), window_px)


def depth_from_focus(registered: Iterable[Rgb], lights: Lights) -> FocusMap:
    """The focus map of registered slices in the order of their focus; slices are read once."""
    return focus_map(np.stack([focus_energy(rgb) for rgb in registered]), lights)


def focus_map(energies: Volume, lights: Lights) -> FocusMap:
    """Semi-global labelling (Hirschmueller 2008) of log focus energies, then a parabola through the peak.

    Energies within the reach of a light have no say, but the light's own pixels are known to be sharp in its sharpest slice.
    """
    from capture.merging._semi_global_numba import aggregate_costs

    floor = noise_floor(energies)
    log_energies = np.log(energies + floor)
    say = share_above(energies.max(axis=0), LABELLING_NOISE_FLOORS * floor)
    costs = say * np.minimum(log_energies.max(axis=0) - log_energies, np.float32(LARGEST_COST))
    by_light = lights.slice_index()
    costs[:, by_light >= 0] = 0.0
    costs[:, lights.core] = LARGEST_COST * (np.arange(len(energies))[:, None] != by_light[lights.core])
    labels = aggregate_costs(costs, SMALL_STEP_COST, LARGE_STEP_COST).argmin(axis=0)
    offset, curvature = peak_parabola(log_energies, labels)
    index = np.where(by_light >= 0, labels, labels + offset)
    index[lights.core] = lights.focus_index[lights.zone[lights.core] - 1]
    trusted = share_above(energies.max(axis=0), CONFIDENCE_NOISE_FLOORS * floor) * confidence_of(log_energies, labels, curvature)
    confidence = np.where(by_light >= 0, 0.0, trusted).astype(np.float32)
    return FocusMap(index.astype(np.float32), confidence, np.where(by_light >= 0, by_light, index).astype(np.float32))


def share_above(energy: Plane, half_at: float) -> Plane:
    """From 0 to 1 with the energy, one half at `half_at`."""
    return (energy / (energy + np.float32(half_at))).astype(np.float32)


def noise_floor(energies: Volume) -> float:
    """The focus energy that noise alone has: what the smoothest places of the least sharp slice show."""
    return float(np.percentile(energies.min(axis=0), 5)) + 1e-9


def peak_parabola(log_energies: Volume, labels: np.ndarray) -> tuple[Plane, Plane]:
    """(offset in [-0.5, 0.5], curvature >= 0) of the parabola through each label and its two neighbours.

    The first and last slice have a neighbour on one side only: their offset is 0 and their curvature half the drop to it.
    """
    last = log_energies.shape[0] - 1

    def at(index: np.ndarray) -> Plane:
        return np.take_along_axis(log_energies, np.clip(index, 0, last)[None], axis=0)[0]

    before, centre, after = at(labels - 1), at(labels), at(labels + 1)
    curvature = np.maximum(2 * centre - before - after, 0)
    interior = (labels > 0) & (labels < last)
    offset = np.where(interior, 0.5 * (after - before) / np.maximum(curvature, 1e-3), 0.0)
    return np.clip(offset, -0.5, 0.5).astype(np.float32), np.where(interior, curvature, 0.5 * curvature).astype(np.float32)


def confidence_of(log_energies: Volume, labels: np.ndarray, curvature: Plane) -> Plane:
    """High where the energy has one sharp peak and the label sits on it; 0 where all slices look alike."""
    at_label = np.take_along_axis(log_energies, labels[None], axis=0)[0]
    off_peak = log_energies.max(axis=0) - at_label
    contrast = at_label - np.median(log_energies, axis=0)
    agreement = np.exp(-2.0 * off_peak)
    return (agreement * (1.0 - np.exp(-np.maximum(contrast, 0.0))) * np.clip(curvature / 0.3, 0.0, 1.0)).astype(np.float32)

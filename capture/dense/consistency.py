"""Do the depths of several views tell of the same surfaces? A surface that one view has, the others must see or have hidden."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Int

from capture.poses.distortion import distorted_px
from capture.poses.sweep_view import SweepView, neighbour_from_reference, rays_of

Plane = Float32[np.ndarray, "height width"]
Count = Int[np.ndarray, "height width"]

_TRUSTED = 0.5
_BAND_ROWS = 64


@dataclass(frozen=True)
class ViewDepth:
    """A neighbour with its finished depth: dioptre (H, W), confidence (H, W) in [0, 1]."""

    view: SweepView
    dioptre: Plane
    confidence: Plane


@dataclass(frozen=True)
class Consistency:
    """supports (H, W): neighbours with the same surface; contradictions: those that see through it to something farther off.

    A neighbour with something nearer in the way has it hidden: neither of the two.
    """

    supports: Count
    contradictions: Count


def consistency(reference: SweepView, dioptre: Plane, neighbours: Sequence[ViewDepth], tolerance_dioptre: float) -> Consistency:
    """Compares 1 / depth along each neighbour's own axis; only confident pixels of a neighbour have a say."""
    supports, contradictions = np.zeros(dioptre.shape, np.int64), np.zeros(dioptre.shape, np.int64)
    rays = rays_of(reference)
    for first in range(0, len(rays), _BAND_ROWS):
        rows = np.s_[first : first + _BAND_ROWS]
        directions = np.concatenate([rays[rows], np.ones_like(rays[rows, :, :1])], axis=-1).astype(np.float64)
        for each in neighbours:
            there, expected = _seen_by(reference, directions / dioptre[rows, :, None], each)
            supports[rows] += np.abs(there - expected) <= tolerance_dioptre
            contradictions[rows] += there < expected - tolerance_dioptre
    return Consistency(supports, contradictions)


def _seen_by(reference: SweepView, points: np.ndarray, neighbour: ViewDepth) -> tuple[np.ndarray, np.ndarray]:
    """(dioptre that the neighbour has where it sees the points, NaN where it has none; dioptre that they have for it)."""
    camera = neighbour.view.camera
    pose = neighbour_from_reference(reference.camera, camera)
    in_camera = points @ pose[:3, :3].T + pose[:3, 3]
    depth = np.where(in_camera[..., 2] > 1e-6, in_camera[..., 2], np.nan)
    pinhole = in_camera[..., :2] / depth[..., None] * camera.focal_px + camera.principal_px
    samples = (distorted_px(camera, neighbour.view.distortion, pinhole) - 0.5).astype(np.float32)
    known = np.where(neighbour.confidence >= _TRUSTED, neighbour.dioptre, np.nan).astype(np.float32)
    x, y = np.nan_to_num(samples[..., 0], nan=-10.0), np.nan_to_num(samples[..., 1], nan=-10.0)
    return cv2.remap(known, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan")), 1.0 / depth

"""Depth of one view fused from the sweeps of many: what several of them agree on stays, what one alone has made up goes.

A scene at rest has one surface along each ray. Each sweep is first held against its neighbours (`vouched`), then all that are near are
carried into the view, and of the surfaces found along a ray the nearest is taken that has about as many votes as any (after Merrell et
al. 2007, "Real-time visibility-based fusion of depth maps"). So depth is steady over a clip: its frames share their sweeps.
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float32

from mrbokeh.depth.views.depth_priors import ViewDepth, consistency
from mrbokeh.depth.views.sweep_view import SweepView, packed_view, rays_of

Plane = Float32[np.ndarray, "height width"]

TOLERANCE = 0.015
"""Share of the range of dioptres within which two depths are of one surface."""
_CONTRADICTED = 0.2
_VOUCHED, _ALONE = 0.5, 0.3
_LEAST = 0.15
_MOST_OF_BEST = 0.5
_SPECK_PX = 40


def vouched(own: ViewDepth, neighbours: Sequence[ViewDepth], tolerance: float) -> ViewDepth:
    """Return the depth with the confidence that neighbours leave it: more where they have the same surface, less where they see through."""
    seen = consistency(own.view, own.dioptre, neighbours, tolerance)
    supported = 1.0 - (1.0 - own.confidence) * (1.0 - _VOUCHED) ** np.minimum(seen.supports, 2)
    trust = np.where(seen.supports > 0, supported, _ALONE * own.confidence)
    trust = np.where(seen.contradictions > seen.supports, _CONTRADICTED * trust, trust)
    return replace(own, confidence=trust.astype(np.float32))


def fused(view: SweepView, sources: Sequence[ViewDepth], tolerance: float) -> tuple[Plane, Plane]:
    """Return (dioptre, confidence) of a view, 0 where no source tells. tolerance: in dioptres, of one surface."""
    carried = [_carried(view, each) for each in sources]
    dioptres = np.stack([each[0] for each in carried])
    votes = np.stack([each[1] for each in carried])
    support = np.stack([(votes * (np.abs(dioptres - one) <= tolerance)).sum(axis=0) * (one > 0) for one in dioptres])
    best = support.max(axis=0)
    taken = np.where(support >= np.maximum(_MOST_OF_BEST * best, _LEAST), dioptres, 0.0).max(axis=0)
    agreeing = votes * ((np.abs(dioptres - taken) <= tolerance) & (taken > 0))
    weight = agreeing.sum(axis=0)
    mean = (agreeing * dioptres).sum(axis=0) / np.maximum(weight, 1e-9)
    trust = np.where(weight > 0, 1.0 - np.prod(1.0 - agreeing, axis=0), 0.0)
    dioptre = _without_specks(np.where(weight > 0, mean, 0.0).astype(np.float32), tolerance)
    return dioptre, np.where(dioptre > 0, trust, 0.0).astype(np.float32)


def _carried(view: SweepView, source: ViewDepth) -> tuple[Plane, Plane]:
    """Return (dioptre, confidence) of a source's trusted pixels in the view, the nearest where several fall into one; 0 where none."""
    from mrbokeh.depth.views._fused_numba import carry

    dioptre, confidence = (np.zeros(view.structure.shape, np.float32) for _ in range(2))
    carry(rays_of(source.view), source.dioptre, source.confidence, packed_view(source.view, view), np.float32(_LEAST), dioptre, confidence)
    return dioptre, confidence


def _without_specks(dioptre: Plane, tolerance: float) -> Plane:
    """Return the map without islands of a few pixels that no neighbour shares."""
    # Unknown pixels (level 0) lie far from the farthest surface, or specks beside them would count as parts of them.
    levels = np.where(dioptre > 0, np.clip(100.0 + np.round(dioptre * (8.0 / tolerance)), 100.0, 32000.0), 0.0).astype(np.int16)
    cv2.filterSpeckles(levels, 0, _SPECK_PX, 12)
    return np.where(levels > 0, dioptre, np.float32(0.0))

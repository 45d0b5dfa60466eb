"""Which other views tell most about the depth of one: those that share its points from places apart, but not too far."""

import numpy as np

from capture.poses.sparse_model import SparseModel, SparseView

_BEST_ANGLE_RAD = np.deg2rad(8.0)


def nearest_views(model: SparseModel, name: str, count: int) -> list[SparseView]:
    """At most `count` other views, best first.

    Each common point gives a vote that grows with the angle under which the two cameras see it up to 8 degrees and falls
    beyond (as COLMAP and MVSNet choose their sources): less is too little parallax, more changes what is seen.
    """
    reference, mine = model.view(name), model.points_of(name)
    votes = []
    for view in model.views:
        common = model.points[np.intersect1d(mine, model.points_of(view))] if view.name != name else np.zeros((0, 3))
        votes.append(float(_vote(common, reference, view).sum()))
    order = sorted(range(len(votes)), key=lambda index: -votes[index])
    return [model.views[index] for index in order[:count] if votes[index] > 0.0]


def _vote(points: np.ndarray, first: SparseView, second: SparseView) -> np.ndarray:
    to_first, to_second = first.centre - points, second.centre - points
    lengths = np.linalg.norm(to_first, axis=1) * np.linalg.norm(to_second, axis=1)
    angle = np.arccos(np.clip((to_first * to_second).sum(axis=1) / np.maximum(lengths, 1e-12), -1.0, 1.0))
    ratio = angle / _BEST_ANGLE_RAD
    return np.minimum(ratio, 1.0 / np.maximum(ratio, 1e-9))

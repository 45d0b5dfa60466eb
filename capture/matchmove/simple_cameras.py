"""The two simple explanations of a clip: a camera that only turns, and a flat scene; all views and points at once.

Points of a turning camera are directions, those of a flat scene lie on one plane; else both are alike: two numbers a point, a rotation a
view (and a place, before a plane), one focal length, one term of distortion. They are fitted by least squares with Cauchy's weights
(iteratively reweighted, Levenberg and Marquardt), so that what moves by itself counts little. The focal length starts from a guess that
stays in force as one soft observation: where the clip tells it, the clip wins.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.sparse import bsr_array, csr_array
from scipy.spatial.transform import Rotation

from capture.matchmove.clip_solve import FLAT, TURNING
from capture.matchmove.flow_tracks import FlowTracks

_OFF_PX = 1.0
"""Scale of Cauchy's weights, at a width of 1280."""

_SIGMAS, _LEAST_SIGMA_PX = 12.0, 0.3
"""Error of a feature over the median residual, and at least, for what the views know of the focal length: features drift together, and
rolling shutters bend all of them alike, so that an iPhone's chart told 15 % too much with 3."""

_DISTORTION_SIGMA = 0.02
"""Of the distance from the middle, in the corner."""
_MOST_POINTS = 300
"""So many of the longest tracks are taken, and as many of the others at random: the longest may all be on what moves."""
_STEPS, _TRIAL_STEPS, _TRIALS, _LEAST_GAIN, _LEAST_DAMPING = 60, 10, 6, 1e-5, 1e-6
_RESTS_SCALES, _SORTED_OUT = 1.5, 2
_NO_DAMPING = 1e-12
_FEWEST_COMMON = 8
_TILTS_DEG = (0.0, 20.0, 40.0, 60.0)
_TURNS = 8
_TRIED_VIEWS = 8
_BEST_TILTS, _FITTED = 2, 4
_FOCAL_STARTS = (1.0, 0.7, 1.45)
_FACE_ON_DEG, _BENT_SCALES = 10.0, 0.6
"""A plane seen face on is taken where it leaves hardly more than a tilted one, in scales of Cauchy's weights, squares added: rolling
shutters and distortion, which bend pictures by as much, pass for a tilt where a camera hardly turns. Of an old DSLR's chart, which is
seen face on, it leaves 0.42 px at a width of 640, one tilted by 33 degrees 0.32."""


@dataclass(frozen=True)
class Focal:
    """Prior knowledge of the focal length, before the clip is looked at. sigma: of its logarithm; 0 if it is known."""

    px: float
    sigma: float = 0.35


@dataclass(frozen=True)
class SimpleCamera:
    """A clip explained simply.

    kind: TURNING or FLAT. poses: camera_from_world of each view; without shift if it turns. points: directions, or places on the plane.
    across: two directions in which each point may move, square to it or along the plane. focal_sigma: relative.
    """

    kind: str
    focal_px: float
    k1: float
    poses: Float64[np.ndarray, "views 4 4"]
    points: Float64[np.ndarray, "points 3"]
    across: Float64[np.ndarray, "points 2 3"]
    focal_sigma: float = np.inf


@dataclass(frozen=True)
class Observed:
    """Observations of views and points by place in arrays. offsets_px: from the middle of the picture.

    scale_px: of Cauchy's weights. corner_px: from the middle to a corner. sigma_px: of an observation, if all were independent.
    """

    views: Int64[np.ndarray, " seen"]
    points: Int64[np.ndarray, " seen"]
    offsets_px: Float64[np.ndarray, "seen 2"]
    scale_px: float
    corner_px: float
    sigma_px: float = 1.0


def projected(camera: SimpleCamera, seen: Observed) -> tuple[Float64[np.ndarray, "seen 2"], Float64[np.ndarray, "seen 3"]]:
    """Return (offsets from the middle of the picture, places in camera axes)."""
    poses = camera.poses[seen.views]
    there = np.einsum("nij,nj->ni", poses[:, :3, :3], camera.points[seen.points]) + poses[:, :3, 3]
    plane = there[:, :2] / _ahead(there)
    return camera.focal_px * plane * (1.0 + camera.k1 * np.sum(plane**2, axis=1, keepdims=True)), there


def _ahead(there: np.ndarray) -> np.ndarray:
    return np.maximum(there[:, 2:], 1e-3 * np.linalg.norm(there, axis=1, keepdims=True))


def residuals_px(camera: SimpleCamera, seen: Observed) -> Float64[np.ndarray, " seen"]:
    return np.linalg.norm(projected(camera, seen)[0] - seen.offsets_px, axis=1)


def fitted(
    camera: SimpleCamera, seen: Observed, focal: Focal, steps: int = _STEPS, *, poses_only: bool = False
) -> tuple[SimpleCamera, float]:
    """Return (the best fit from this start, its cost)."""
    damping, cost = 1e-3, _cost(camera, seen, focal)
    for _ in range(steps):
        equations = _equations(camera, seen, focal, poses_only=poses_only)
        gained = 0.0
        for _ in range(_TRIALS):
            tried = _moved(camera, *equations.solved(damping))
            if (new := _cost(tried, seen, focal)) < cost:
                gained, camera, cost, damping = (cost - new) / cost, tried, new, max(damping / 5.0, _LEAST_DAMPING)
                break
            damping *= 5.0
        if gained < _LEAST_GAIN:
            break
    return camera, cost


def with_focal_sigma(camera: SimpleCamera, seen: Observed, focal: Focal) -> SimpleCamera:
    """Return the camera with how well its focal length is known, all else free."""
    equations = _equations(camera, seen, focal)
    reduced, _ = equations.reduced(_NO_DAMPING)
    first = np.zeros(len(reduced))
    first[0] = 1.0
    variance = seen.sigma_px**2 * float(np.linalg.lstsq(reduced, first, rcond=None)[0][0])
    return replace(camera, focal_sigma=float(np.sqrt(max(variance, 0.0))))


@dataclass(frozen=True)
class _Equations:
    """Normal equations: of the lens and the views, of the points (blocks of 2x2), and what both share; right sides last."""

    views: np.ndarray
    shared: csr_array
    points: Float64[np.ndarray, "points 2 2"]
    view_side: np.ndarray
    point_side: np.ndarray

    def reduced(self, damping: float) -> tuple[np.ndarray, csr_array]:
        """Return (the equations of lens and views without the points (Schur's complement), shared C^-1), all damped."""
        inverse = np.linalg.inv(self._damped_points(damping))
        count = len(inverse)
        blocks = bsr_array((inverse, np.arange(count), np.arange(count + 1)), shape=(2 * count, 2 * count))
        through = self.shared @ blocks
        views = self.views + np.diag(damping * np.diagonal(self.views) + _NO_DAMPING)
        return views - (through @ self.shared.T).toarray(), through

    def solved(self, damping: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the steps of lens and views, and those of the points."""
        matrix, through = self.reduced(damping)
        of_views = np.linalg.solve(matrix, self.view_side - through @ self.point_side)
        rest = (self.point_side - self.shared.T @ of_views).reshape(-1, 2, 1)
        return of_views, np.linalg.solve(self._damped_points(damping), rest)[:, :, 0]

    def _damped_points(self, damping: float) -> np.ndarray:
        return self.points + (damping * np.einsum("nii->ni", self.points) + _NO_DAMPING)[:, :, None] * np.eye(2)


def _cost(camera: SimpleCamera, seen: Observed, focal: Focal) -> float:
    squares = (residuals_px(camera, seen) / seen.scale_px) ** 2
    lens = np.array([np.log(camera.focal_px / focal.px), camera.k1])
    return float(np.sum(np.log1p(squares)) + _told(camera, seen, focal) @ lens**2 / seen.scale_px**2)


def _told(camera: SimpleCamera, seen: Observed, focal: Focal) -> Float64[np.ndarray, "2"]:
    """Return the weights, as of pixels, of what is known of log f and k1 beforehand."""
    in_corner = (seen.corner_px / camera.focal_px) ** 2
    return (seen.sigma_px * np.array([1.0 / max(focal.sigma, 1e-4), in_corner / _DISTORTION_SIGMA])) ** 2


def _equations(camera: SimpleCamera, seen: Observed, focal: Focal, *, poses_only: bool = False) -> _Equations:
    """Return J'WJ and J'W(observed - projected); unknowns are log f, k1, 3 or 6 of each view, 2 of each point."""
    offsets, there = projected(camera, seen)
    z = _ahead(there)
    plane = there[:, :2] / z
    r2 = np.sum(plane**2, axis=1)
    bent = 1.0 + camera.k1 * r2
    by_plane = camera.focal_px * (bent[:, None, None] * np.eye(2) + 2.0 * camera.k1 * plane[:, :, None] * plane[:, None, :])
    by_place = np.concatenate([by_plane, -(by_plane @ plane[:, :, None])], axis=2) / z[:, :, None]
    by_turn = -by_place @ _cross(there - camera.poses[seen.views, :3, 3])
    by_pose = np.concatenate([by_turn, by_place], axis=2) if camera.kind == FLAT else by_turn
    by_point = by_place @ np.einsum("nij,nkj->nik", camera.poses[seen.views, :3, :3], camera.across[seen.points])
    by_lens = np.stack([offsets, camera.focal_px * r2[:, None] * plane], axis=2)
    if poses_only:
        by_lens, by_point = np.zeros_like(by_lens), np.zeros_like(by_point)
    off = seen.offsets_px - offsets
    weights = 1.0 / (1.0 + np.sum(off**2, axis=1) / seen.scale_px**2)
    of_view = np.concatenate([by_lens, by_pose], axis=2)
    weighted, side = of_view * weights[:, None, None], off[:, :, None]
    per_view, views, points = by_pose.shape[2], len(camera.poses), len(camera.points)
    places = np.concatenate(
        [np.broadcast_to(np.arange(2), (len(off), 2)), 2 + per_view * seen.views[:, None] + np.arange(per_view)], axis=1
    )
    count = 2 + per_view * views
    squares, shares = weighted.transpose(0, 2, 1) @ of_view, weighted.transpose(0, 2, 1) @ by_point
    flat = count * places[:, :, None] + places[:, None, :]
    matrix = np.bincount(flat.ravel(), squares.ravel(), count * count).reshape(count, count)
    columns = 2 * seen.points[:, None] + np.arange(2)
    values, rows, across = np.broadcast_arrays(shares, places[:, :, None], columns[:, None, :])
    shared = csr_array((values.ravel(), (rows.ravel(), across.ravel())), shape=(count, 2 * points))
    of_points = np.zeros((points, 2, 2))
    np.add.at(of_points, seen.points, weights[:, None, None] * by_point.transpose(0, 2, 1) @ by_point)
    view_side = np.bincount(places.ravel(), (weighted.transpose(0, 2, 1) @ side).ravel(), count)
    point_side = np.bincount(columns.ravel(), (weights[:, None, None] * by_point.transpose(0, 2, 1) @ side).ravel(), 2 * points)
    told = _told(camera, seen, focal)
    matrix[[0, 1], [0, 1]] += told
    if not poses_only:
        view_side[:2] -= told * np.array([np.log(camera.focal_px / focal.px), camera.k1])
    return _Equations(views=matrix, shared=shared, points=of_points, view_side=view_side, point_side=point_side)


def _moved(camera: SimpleCamera, of_views: np.ndarray, of_points: np.ndarray) -> SimpleCamera:
    views = of_views[2:].reshape(len(camera.poses), -1)
    poses = camera.poses.copy()
    poses[:, :3, :3] = Rotation.from_rotvec(views[:, :3]).as_matrix() @ camera.poses[:, :3, :3]
    if camera.kind == FLAT:
        poses[:, :3, 3] += views[:, 3:]
    points = camera.points + np.einsum("nk,nki->ni", of_points, camera.across)
    if camera.kind == TURNING:
        points = points / np.linalg.norm(points, axis=1, keepdims=True)
    return replace(
        camera,
        focal_px=camera.focal_px * float(np.exp(np.clip(of_views[0], -0.3, 0.3))),
        k1=camera.k1 + float(np.clip(of_views[1], -0.1, 0.1)),
        poses=poses,
        points=points,
        across=across_of(points) if camera.kind == TURNING else camera.across,
    )


def _cross(vectors: np.ndarray) -> Float64[np.ndarray, "n 3 3"]:
    x, y, z = vectors.T
    nothing = np.zeros_like(x)
    return np.stack([np.stack(row, axis=1) for row in ((nothing, -z, y), (z, nothing, -x), (-y, x, nothing))], axis=1)


def across_of(directions: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 2 3"]:
    """Return two directions square to each."""
    helper = np.where(np.abs(directions[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    one = np.cross(helper, directions)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    return np.stack([one, np.cross(directions, one)], axis=1)


def observed(tracks: FlowTracks) -> tuple[Observed, np.ndarray, np.ndarray]:
    """Return the observations, and which frame each view and which feature each point is."""
    frames, views = np.unique(tracks.frames, return_inverse=True)
    features, points = np.unique(tracks.features, return_inverse=True)
    middle = np.array(tracks.size_px) / 2.0
    scale_px = max(0.5, _OFF_PX * tracks.size_px[0] / 1280)
    seen = Observed(
        views=views.astype(np.int64),
        points=points.astype(np.int64),
        offsets_px=tracks.xy_px - middle,
        scale_px=scale_px,
        corner_px=float(np.hypot(*middle)),
    )
    return seen, frames, features


def homographies(tracks: FlowTracks, frames: np.ndarray) -> list[np.ndarray] | None:
    """Return the homographies to each frame from the middle one, chained; offsets from the middle of the picture. None if a link breaks."""
    middle_px, wrong_px = np.array(tracks.size_px) / 2.0, max(1.0, 2.0 * tracks.size_px[0] / 1280)
    steps = []
    for one, other in pairwise(frames):
        there = [each - middle_px for each in tracks.common(int(one), int(other))]
        if len(there[0]) < _FEWEST_COMMON:
            return None
        cv2.setRNGSeed(0)
        found, _ = cv2.findHomography(there[0], there[1], cv2.USAC_MAGSAC, wrong_px)
        if found is None or not np.isfinite(found).all():
            return None
        steps.append(found)
    whole = [np.eye(3)]
    for step in steps:
        whole.append(step @ whole[-1] / (step @ whole[-1])[2, 2])
    from_middle = np.linalg.inv(whole[len(whole) // 2])
    return [each @ from_middle for each in whole]


def explained(tracks: FlowTracks, kind: str, focal: Focal) -> tuple[SimpleCamera, Observed] | None:
    """Explain tracks of some frames; None if neighbouring frames have too little in common."""
    tracks = _fewer(tracks)
    seen, frames, _ = observed(tracks)
    chain = homographies(tracks, frames)
    if chain is None:
        return None
    starts = _FOCAL_STARTS if focal.sigma > 0.0 else (1.0,)
    places = _in_the_middle_frame(seen, chain)
    begun = [each for start in starts for each in _started(seen, chain, places, kind, focal.px * start)]
    begun.sort(key=lambda each: _median_px(each, seen))
    tried = [fitted(start, seen, focal, _TRIAL_STEPS) for start in begun[:_FITTED]]
    if not tried:
        return None
    best = min(tried, key=lambda each: each[1])[0]
    seen = replace(seen, sigma_px=max(_LEAST_SIGMA_PX, _SIGMAS * _median_px(best, seen)))
    best, _ = fitted(best, seen, focal)
    face_on = [each for each in tried if kind == FLAT and _tilt_deg(each[0]) < _FACE_ON_DEG]
    if not face_on or _tilt_deg(best) < _FACE_ON_DEG:
        return best, seen
    plain, _ = fitted(min(face_on, key=lambda each: each[1])[0], seen, focal)
    as_well = _median_px(plain, seen) < np.hypot(_median_px(best, seen), _BENT_SCALES * seen.scale_px)
    return (plain if as_well and _tilt_deg(plain) < _FACE_ON_DEG else best), seen


def _median_px(camera: SimpleCamera, seen: Observed) -> float:
    return float(np.median(residuals_px(camera, seen)))


def _tilt_deg(camera: SimpleCamera) -> float:
    """Return by how much the middle view looks at the plane aslant."""
    middle = camera.poses[len(camera.poses) // 2]
    return float(np.degrees(np.arccos(min(1.0, abs(middle[2, :3] @ np.cross(*camera.across[0]))))))


def sorted_out(camera: SimpleCamera, seen: Observed, focal: Focal) -> SimpleCamera:
    """Return the camera fitted to what rests alone, with how well its focal length is known."""
    for _ in range(_SORTED_OUT):
        resting = _only(seen, rests(camera, seen)[seen.points])
        camera, _ = fitted(camera, resting, focal)
    return with_focal_sigma(camera, seen, focal)


def rests(camera: SimpleCamera, seen: Observed) -> Bool[np.ndarray, " points"]:
    """Return which points do not move by themselves, by their median residuals; points that nobody sees do."""
    medians_px = np.full(len(camera.points), np.inf)
    medians_px[np.unique(seen.points)] = medians_of(residuals_px(camera, seen), seen.points)
    return medians_px < _RESTS_SCALES * seen.scale_px


def medians_of(values: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the median of each point's values, for points in their order."""
    order = np.argsort(points, kind="stable")
    groups = np.split(values[order], np.flatnonzero(np.diff(points[order])) + 1)
    return np.array([np.median(each, axis=0) for each in groups])


def _fewer(tracks: FlowTracks) -> FlowTracks:
    often = np.bincount(tracks.features)
    order = np.argsort(-often, kind="stable")[: np.count_nonzero(often)]
    others = np.random.default_rng(0).permutation(order[_MOST_POINTS:])[:_MOST_POINTS]
    return tracks.only(np.isin(tracks.features, np.concatenate([order[:_MOST_POINTS], others])))


def _in_the_middle_frame(seen: Observed, chain: list[np.ndarray]) -> Float64[np.ndarray, "points 2"]:
    """Return the mean place of each point, as the homographies take it to the middle frame."""
    back = np.linalg.inv(np.array(chain))[seen.views]
    there = np.einsum("nij,nj->ni", back, np.column_stack([seen.offsets_px, np.ones(len(seen.views))]))
    xy = there[:, :2] / there[:, 2:]
    count = np.bincount(seen.points)
    return np.stack([np.bincount(seen.points, xy[:, axis]) / count for axis in (0, 1)], axis=1)


def _started(seen: Observed, chain: list[np.ndarray], places: np.ndarray, kind: str, focal_px: float) -> list[SimpleCamera]:
    rays = np.column_stack([places / focal_px, np.ones(len(places))])
    if kind == TURNING:
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        lens = np.diag([focal_px, focal_px, 1.0])
        turns = [_nearest_turn(np.linalg.inv(lens) @ each @ lens) for each in chain]
        poses = np.tile(np.eye(4), (len(chain), 1, 1))
        poses[:, :3, :3] = turns
        return [SimpleCamera(kind=kind, focal_px=focal_px, k1=0.0, poses=poses, points=rays, across=across_of(rays))]
    found = []
    for normal in _normals():
        ahead = rays @ normal
        if (ahead < 0.05).any():
            continue
        points = rays / ahead[:, None]
        views = np.unique(np.linspace(0, len(chain) - 1, _TRIED_VIEWS).round().astype(int))
        start = _posed_before_plane(seen, points, normal, focal_px, len(chain), views)
        if start is not None:
            off = residuals_px(start, _only(seen, np.isin(seen.views, views)))
            found.append((float(np.median(off)), normal, points))
    best = sorted(found, key=lambda each: each[0])[:_BEST_TILTS]
    made = [_posed_before_plane(seen, points, normal, focal_px, len(chain), np.arange(len(chain))) for _, normal, points in best]
    return [each for each in made if each is not None]


def _nearest_turn(matrix: np.ndarray) -> np.ndarray:
    u, _, vt = np.linalg.svd(matrix / np.cbrt(np.linalg.det(matrix)))
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def _normals() -> list[np.ndarray]:
    """Return directions that the plane may face, in the axes of the middle view."""
    turned = [(tilt, turn) for tilt in np.radians(_TILTS_DEG) for turn in np.arange(_TURNS if tilt else 1) * 2.0 * np.pi / _TURNS]
    return [np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)]) for tilt, turn in turned]


def _posed_before_plane(
    seen: Observed, points: np.ndarray, normal: np.ndarray, focal_px: float, count: int, views: np.ndarray
) -> SimpleCamera | None:
    matrix, poses = np.diag([focal_px, focal_px, 1.0]), np.tile(np.eye(4), (count, 1, 1))
    for view in views:
        rows = seen.views == view
        if np.count_nonzero(rows) < _FEWEST_COMMON:
            return None
        start = np.zeros(3), np.zeros(3)
        _, turn, shift = cv2.solvePnP(points[seen.points[rows]], seen.offsets_px[rows], matrix, None, *start, True)
        poses[view, :3, :3], poses[view, :3, 3] = cv2.Rodrigues(turn)[0], np.ravel(shift)
    across = np.broadcast_to(across_of(normal[None])[0], (len(points), 2, 3))
    return SimpleCamera(kind=FLAT, focal_px=focal_px, k1=0.0, poses=poses, points=points, across=across)


def _only(seen: Observed, rows: Bool[np.ndarray, " seen"]) -> Observed:
    return replace(seen, views=seen.views[rows], points=seen.points[rows], offsets_px=seen.offsets_px[rows])

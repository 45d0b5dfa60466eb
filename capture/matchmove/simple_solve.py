"""Every frame of a clip by a simple explanation: keyframes at once, then each frame against their points; which of the two it is.

Features that move by themselves (water, leaves, animals) fit no camera; they are told by their median residual and left out. Where most do,
the camera is taken to turn: what moves makes any richer explanation fit better.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64

from capture.matchmove.clip_solve import FLAT, TURNING, ClipSolve, FrameFit
from capture.matchmove.flow_tracks import FlowTracks
from capture.matchmove.keyframes import view_name
from capture.matchmove.simple_cameras import (
    Focal,
    Observed,
    SimpleCamera,
    across_of,
    explained,
    fitted,
    medians_of,
    observed,
    residuals_px,
    rests,
    sorted_out,
)
from capture.poses.sparse_model import SparseModel, SparseView, undistorted_px
from mrbokeh.optics.camera import Camera

_FEWEST_VIEWS, _FEWEST_POINTS = 3, 8
_FITS_SCALES = 3.0
"""An observation fits up to so many times the scale of Cauchy's weights: 3 px at a width of 1280."""

_MOVES_BY_ITSELF = 0.6
_INDEPENDENT = 0.2
_AT_ONCE = 32
_LOST_SHARE = 0.1
_EXPLAINED_SHARE = {TURNING: 0.9, FLAT: 0.95}
"""Share of the observations that fit, from which on nothing richer is tried: 0.88 of a room that is mostly one wall, 0.94 and 0.96 of
charts."""

_TOLD_SIGMA = 0.1
FAR = 1e6
"""Distance of points that are directions."""


@dataclass(frozen=True)
class SimpleSolve:
    """A clip explained simply.

    explains: whether it does so well that nothing richer is needed. usable: whether it may serve where nothing richer is found.
    """

    solve: ClipSolve
    explains: bool
    usable: bool


def simple_solve(tracks: FlowTracks, keyframes: Sequence[int], focal: Focal, times_s: Sequence[float]) -> SimpleSolve | None:
    """Explain a clip by the simpler camera that its features bear out; None if they do not reach from keyframe to keyframe."""
    among = tracks.among(np.array(keyframes), _FEWEST_VIEWS)
    found = {kind: each for kind in (TURNING, FLAT) if (each := explained(among, kind, focal)) is not None}
    if not found:
        return None
    medians_px = {kind: float(np.median(residuals_px(*each))) for kind, each in found.items()}
    shares = {kind: _share(*each) for kind, each in found.items()}
    kind = _chosen(medians_px, shares, next(iter(found.values()))[1])
    camera = sorted_out(*found[kind], focal)
    model, fits = _of_all_frames(tracks, among, camera)
    if not fits:
        return None
    resting = float(np.median([each.fitting for each in fits.values()]))
    solve = ClipSolve(
        kind=kind,
        model=model,
        times_s=tuple(times_s),
        keyframes=tuple(int(each) for each in keyframes),
        fits=fits,
        why=_why(kind, medians_px) + _focal_told(camera, focal),
        warnings=_warnings(resting, len(model.left_out), len(times_s)),
    )
    good = solve.residual_px < among.size_px[0] / 1280 and len(model.left_out) <= 0.1 * len(times_s)
    return SimpleSolve(solve, good and shares[kind] > _EXPLAINED_SHARE[kind], good)


def _share(camera: SimpleCamera, seen: Observed) -> float:
    return float(np.mean(residuals_px(camera, seen) < _FITS_SCALES * seen.scale_px))


def _chosen(medians_px: dict[str, float], shares: dict[str, float], seen: Observed) -> str:
    """Choose by Schwarz's criterion; a plane has 3 numbers more for each view, and its tilt."""
    if len(medians_px) == 1:
        return next(iter(medians_px))
    if shares[FLAT] < _MOVES_BY_ITSELF:
        return TURNING
    count = 2 * _INDEPENDENT * len(seen.views)
    more = 3 * int(seen.views.max()) + 2
    gain = count * 2.0 * np.log(max(medians_px[TURNING], 1e-3) / max(medians_px[FLAT], 1e-3))
    return FLAT if gain > more * np.log(count) else TURNING


def _why(kind: str, medians_px: dict[str, float]) -> str:
    told = {TURNING: "a camera that only turns", FLAT: "a camera before a flat scene"}
    rival = next((f", where {told[name]} leaves {px:.2f}" for name, px in medians_px.items() if name != kind), "")
    return f"{told[kind]}: it leaves {medians_px[kind]:.2f} px of all features{rival}"


def _focal_told(camera: SimpleCamera, focal: Focal) -> str:
    if focal.sigma == 0.0:
        return f"; focal length {camera.focal_px:.0f} px, as stated"
    spread = f"{camera.focal_px:.0f} px +- {100 * camera.focal_sigma:.0f} %"
    guessed = "hardly told by the clip and in part guessed (--focal-length MM)"
    return f"; focal length {spread}, {'solved' if camera.focal_sigma < _TOLD_SIGMA else guessed}"


def _warnings(resting: float, lost: int, count: int) -> tuple[str, ...]:
    told = (
        (resting < _MOVES_BY_ITSELF, f"{100 * (1 - resting):.0f} % of the features move by themselves and were left out"),
        (lost > 0, f"{lost} of {count} frames could not be solved"),
    )
    return tuple(text for doubtful, text in told if doubtful)


def _of_all_frames(tracks: FlowTracks, among: FlowTracks, camera: SimpleCamera) -> tuple[SparseModel, dict[int, FrameFit]]:
    """Return the model with a view for every solved frame, and how each fits."""
    seen, frames, features = observed(among)
    points = _placed(camera, seen)
    start = replace(camera, points=points, across=_across(camera, points))
    resting = rests(start, seen)
    numbered = np.full(int(tracks.features.max()) + 1, -1)
    numbered[features] = np.arange(len(features))
    poses: dict[int, Float64[np.ndarray, "4 4"]] = {}
    fits: dict[int, FrameFit] = {}
    for first in range(0, tracks.frame_count, _AT_ONCE):
        part = tracks.only((tracks.frames >= first) & (tracks.frames < first + _AT_ONCE) & (numbered[tracks.features] >= 0))
        solved, found = _posed(part, numbered, resting, start, frames)
        poses, fits = poses | solved, fits | found
    places = {number: index for index, number in enumerate(sorted(poses))}
    kept = among.only(np.isin(among.frames, list(places)) & resting[numbered[among.features]])
    rows = np.array([places[each] for each in kept.frames.tolist()], np.int64)
    (width_px, height_px), far = tracks.size_px, FAR if camera.kind == TURNING else 1.0
    lens = Camera(width_px, height_px, (camera.focal_px,) * 2, (width_px / 2.0, height_px / 2.0))
    model = SparseModel(
        views=tuple(SparseView(view_name(n), replace(lens, camera_from_world=poses[n]), (camera.k1, 0.0)) for n in sorted(poses)),
        points=far * points,
        errors_px=medians_of(residuals_px(start, seen), seen.points),
        observations=np.stack([rows, numbered[kept.features]], axis=1),
        observed_xy_px=kept.xy_px,
        left_out=tuple(view_name(number) for number in range(tracks.frame_count) if number not in places),
    )
    return model, fits


def _posed(
    part: FlowTracks, numbered: np.ndarray, at_rest: Bool[np.ndarray, " points"], start: SimpleCamera, frames: np.ndarray
) -> tuple[dict[int, Float64[np.ndarray, "4 4"]], dict[int, FrameFit]]:
    """Solve some frames against the points at rest, from the poses of the keyframes nearest to them."""
    resting = part.only(at_rest[numbered[part.features]])
    enough = np.flatnonzero(np.bincount(resting.frames, minlength=part.frame_count) >= _FEWEST_POINTS)
    resting = resting.only(np.isin(resting.frames, enough))
    if not len(resting.frames):
        return {}, {}
    rows, numbers, _ = observed(resting)
    rows = replace(rows, points=numbered[resting.features])
    nearest = np.abs(frames[None] - numbers[:, None]).argmin(axis=1)
    solved, _ = fitted(replace(start, poses=start.poses[nearest]), rows, Focal(start.focal_px), poses_only=True)
    off_px = residuals_px(solved, rows)
    poses: dict[int, Float64[np.ndarray, "4 4"]] = {}
    fits: dict[int, FrameFit] = {}
    for view, number in enumerate(numbers.tolist()):
        mine = off_px[rows.views == view]
        fit = FrameFit(
            float(np.median(mine)), float(np.count_nonzero(mine < _FITS_SCALES * rows.scale_px) / np.count_nonzero(part.frames == number))
        )
        if fit.fitting >= _LOST_SHARE:
            poses[number], fits[number] = solved.poses[view], fit
    return poses, fits


def _across(camera: SimpleCamera, points: np.ndarray) -> Float64[np.ndarray, "points 2 3"]:
    return across_of(points) if camera.kind == TURNING else np.broadcast_to(camera.across[0], (len(points), 2, 3))


def _placed(camera: SimpleCamera, seen: Observed) -> Float64[np.ndarray, "points 3"]:
    """Return the median place (or direction) of each point, as the solved views see it; also of those that were not fitted."""
    pinhole = Camera(1, 1, (camera.focal_px,) * 2, (0.0, 0.0))
    straight = np.nan_to_num(undistorted_px(pinhole, (camera.k1, 0.0), seen.offsets_px))
    poses = camera.poses[seen.views]
    rays = np.einsum("nji,nj->ni", poses[:, :3, :3], np.column_stack([straight / camera.focal_px, np.ones(len(straight))]))
    if camera.kind == TURNING:
        directions = medians_of(rays / np.linalg.norm(rays, axis=1, keepdims=True), seen.points)
        return directions / np.linalg.norm(directions, axis=1, keepdims=True)
    normal = np.cross(*camera.across[0])
    centres = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    along = (camera.points[0] @ normal - centres @ normal) / (rays @ normal)
    return medians_of(centres + along[:, None] * rays, seen.points)

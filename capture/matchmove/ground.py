"""The world of a match-move: a ground of y = 0 with y down, an origin on it, and the length of a metre.

The ground is a plane through points of the model around picked pixels; the flat scene itself; or, under a camera that only turns, the level
plane that its horizon tells.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float64

from capture.matchmove.clip_solve import ClipSolve
from capture.matchmove.keyframes import view_name
from capture.poses.sparse_model import SparseModel, SparseView
from mrbokeh.system.errors import InputError

_FEWEST_POINTS = 12
_TRIALS = 500
_ON_PLANE = 0.01
"""Of the distance to the camera: points nearer than that to a plane lie on it."""

_FEWEST_SHARE = 0.5


@dataclass(frozen=True)
class GroundPicks:
    """Three or more pixels of one frame with the ground between them; x runs from the first to the second."""

    frame: int
    xy_px: Float64[np.ndarray, "picks 2"]


@dataclass(frozen=True)
class Horizon:
    """Two pixels of one frame, in it or beyond its edges, in which level directions are seen."""

    frame: int
    xy_px: Float64[np.ndarray, "2 2"]


@dataclass(frozen=True)
class Ruler:
    """Two pixels of one frame on the ground, and their distance there."""

    frame: int
    xy_px: Float64[np.ndarray, "2 2"]
    metres: float


def on_ground(model: SparseModel, view: SparseView, picks: GroundPicks) -> SparseModel:
    """Move the model to a world with y down and 0 on the ground, the origin at the first pick, x towards the second; lengths stay.

    Raises InputError if too few points of the model lie between the picks, or no plane holds half of them.
    """
    points = _points_between(model, view, picks)
    return _moved_to(model, view, picks.xy_px[:2], *_plane(points, view.centre, picks))


def on_own_plane(solve: ClipSolve, picks: GroundPicks | None = None) -> SparseModel:
    """Move a flat scene to a world with y down whose ground it is.

    The origin is at the first pick, x towards the second; without picks it is in the middle of the first frame, x to the right there, and
    the unit the distance to it from there.
    """
    model = solve.model
    normal, offset = _through(model.points.astype(np.float64), model.views[0].centre)
    if picks is not None:
        return _moved_to(model, model.view(view_name(picks.frame)), picks.xy_px[:2], normal, offset)
    view = model.view(view_name(min(solve.fits)))
    middle_px = np.array(view.camera.principal_px)
    origin = _on_plane(view, middle_px, normal, offset)
    moved = _moved_to(model, view, middle_px + np.array([[0.0, 0.0], [0.1 * view.camera.width_px, 0.0]]), normal, offset)
    return replace(moved.times(1.0 / float(np.linalg.norm(origin - view.centre))), metres_per_unit=None)


_TALL_M, _LOOKS_DOWN_DEG = 1.5, 10.0
_AHEAD_SHARE = 0.75


def upright(
    solve: ClipSolve, horizon: Horizon | None, picks: GroundPicks | None, height_m: float | None
) -> tuple[SparseModel, tuple[str, ...]]:
    """Stand a camera that only turns over level ground; returns what was guessed, too, in words.

    The origin is at the first pick, x towards the second; without picks it is before the middle of the first frame, x to the right.
    """
    model, first = solve.model, solve.model.view(view_name(min(solve.fits)))
    assumed = []
    if horizon is None:
        down = _looking_down(first)
        assumed.append(f"the first frame to be level and to look down by {_LOOKS_DOWN_DEG:g} degrees (--horizon FRAME:X,Y/X,Y)")
    else:
        down = _below(model.view(view_name(horizon.frame)), horizon)
    if height_m is None:
        assumed.append(f"the camera to be {_TALL_M:g} m above the ground (--camera-height METRES)")
    height = height_m or _TALL_M
    view, ends_px = first, np.array([[0.5, _AHEAD_SHARE], [0.6, _AHEAD_SHARE]]) * (first.camera.width_px, first.camera.height_px)
    if picks is not None:
        view, ends_px = model.view(view_name(picks.frame)), picks.xy_px[:2]
    moved = _moved_to(model, view, ends_px, -down, -height)
    return replace(moved, metres_per_unit=None if height_m is None else 1.0), tuple(assumed)


def _looking_down(view: SparseView) -> Float64[np.ndarray, "3"]:
    """Return what is down, in the world, if a view is level and looks down a little."""
    angle = np.radians(_LOOKS_DOWN_DEG)
    return view.camera.camera_from_world[:3, :3].T @ np.array([0.0, np.cos(angle), np.sin(angle)])


def _below(view: SparseView, horizon: Horizon) -> Float64[np.ndarray, "3"]:
    rays = view.unproject(horizon.xy_px, np.ones(2)) - view.centre
    down = np.cross(rays[0], rays[1])
    if not np.linalg.norm(down) > 0.0:
        raise InputError("--horizon: its two pixels must differ")
    return down / np.linalg.norm(down) * np.sign(down @ view.camera.camera_from_world[1, :3] or 1.0)


def _moved_to(model: SparseModel, view: SparseView, ends_px: np.ndarray, normal: np.ndarray, offset: float) -> SparseModel:
    """Move the model to where a plane is y = 0, the origin at the first of two pixels of a view, x towards the second."""
    origin, along = (_on_plane(view, xy_px, normal, offset) for xy_px in ends_px)
    x = along - origin
    if np.linalg.norm(x) == 0.0:
        raise InputError("--ground: the first two pixels must differ, they say where x points")
    x /= np.linalg.norm(x)
    turn = np.stack([x, -normal, np.cross(x, -normal)])
    moved = np.eye(4)
    moved[:3, :3], moved[:3, 3] = turn, -turn @ origin
    return model.moved(moved)


def ruler_scale(view: SparseView, ruler: Ruler) -> float:
    """Return metres per unit of a model whose ground is y = 0; view: of the ruler's frame."""
    if not 0.0 < ruler.metres < float("inf"):
        raise InputError(f"--ruler: expected a positive number of metres, got {ruler.metres:g}")
    one, other = (_on_plane(view, xy_px, np.array([0.0, -1.0, 0.0]), 0.0) for xy_px in ruler.xy_px)
    units = float(np.linalg.norm(one - other))
    if units == 0.0:
        raise InputError("--ruler: its two pixels must differ")
    return ruler.metres / units


def _points_between(model: SparseModel, view: SparseView, picks: GroundPicks) -> Float64[np.ndarray, "points 3"]:
    xy_px, depth = view.project(model.points.astype(np.float64))
    outline = cv2.convexHull(picks.xy_px.astype(np.float32))
    inside = [d > 0 and cv2.pointPolygonTest(outline, (float(x), float(y)), False) >= 0 for (x, y), d in zip(xy_px, depth, strict=True)]
    if np.count_nonzero(inside) < _FEWEST_POINTS:
        raise InputError(
            f"--ground: {np.count_nonzero(inside)} points of the model lie between the pixels of frame {picks.frame}, "
            f"at least {_FEWEST_POINTS} are needed: pick a larger part of the ground with more texture"
        )
    return model.points[inside].astype(np.float64)


def _plane(points: Float64[np.ndarray, "points 3"], centre: np.ndarray, picks: GroundPicks) -> tuple[Float64[np.ndarray, "3"], float]:
    """Return (normal towards the camera, offset) of normal . x = offset: RANSAC, then least squares over the best plane's points."""
    rng, near = np.random.default_rng(0), _ON_PLANE * np.median(np.linalg.norm(points - centre, axis=1))
    corners = points[np.argsort(rng.random((_TRIALS, len(points))), axis=1)[:, :3]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals, corners = normals[lengths > 0] / lengths[lengths > 0, None], corners[lengths > 0]
    off = np.abs(points @ normals.T - np.sum(normals * corners[:, 0], axis=1))
    kept = (off < near)[:, np.argmax((off < near).sum(axis=0))]
    if kept.mean() < _FEWEST_SHARE:
        raise InputError(
            f"--ground: only {100 * kept.mean():.0f} % of the model's points between the pixels of frame {picks.frame} lie on one plane: "
            f"pick pixels with nothing but flat ground between them"
        )
    return _through(points[kept], centre)


def _through(points: Float64[np.ndarray, "points 3"], centre: np.ndarray) -> tuple[Float64[np.ndarray, "3"], float]:
    """Return (normal towards the camera, offset) of the plane through points, by least squares."""
    middle = points.mean(axis=0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
    normal = normal if normal @ (centre - middle) > 0 else -normal
    return normal, float(normal @ middle)


def _on_plane(view: SparseView, xy_px: np.ndarray, normal: np.ndarray, offset: float) -> Float64[np.ndarray, "3"]:
    ray = view.unproject(xy_px[None].astype(np.float64), np.ones(1))[0] - view.centre
    along = (offset - normal @ view.centre) / (normal @ ray)
    if not 0.0 < along < float("inf"):
        raise InputError(f"the pixel {xy_px[0]:g},{xy_px[1]:g} looks above the horizon of the ground: pick one on the ground")
    return view.centre + along * ray


def parse_ground(text: str) -> GroundPicks:
    """Parse FRAME:X,Y/X,Y/X,Y, three pixels or more."""
    expected = "--ground must be FRAME:X,Y/X,Y/X,Y, three pixels or more with ground between them, such as 0:300,900/1500,900/900,700"
    try:
        frame, pixels = text.split(":")
        picks = GroundPicks(int(frame), np.array([_pixel(each) for each in pixels.split("/")], np.float64))
    except ValueError:
        raise InputError(f"{expected}, got {text!r}") from None
    if len(picks.xy_px) < 3 or picks.frame < 0:
        raise InputError(f"{expected}, got {text!r}")
    return picks


def parse_horizon(text: str) -> Horizon:
    """Parse FRAME:X,Y/X,Y."""
    try:
        frame, ends = text.split(":")
        one, other = ends.split("/")
        return Horizon(int(frame), np.array([_pixel(one), _pixel(other)], np.float64))
    except ValueError:
        raise InputError(f"--horizon must be FRAME:X,Y/X,Y such as 0:0,300/1900,320, got {text!r}") from None


def parse_ruler(text: str) -> Ruler:
    """Parse FRAME:X,Y/X,Y/METRES."""
    try:
        frame, rest = text.split(":")
        one, other, metres = rest.split("/")
        return Ruler(int(frame), np.array([_pixel(one), _pixel(other)], np.float64), float(metres))
    except ValueError:
        raise InputError(f"--ruler must be FRAME:X,Y/X,Y/METRES such as 0:300,900/1500,900/2.4, got {text!r}") from None


def parse_frame_distance(text: str) -> tuple[int, int, float]:
    """Parse FRAME_A,FRAME_B,METRES."""
    try:
        one, other, metres = text.split(",")
        return int(one), int(other), float(metres)
    except ValueError:
        raise InputError(f"--distance must be FRAME,FRAME,METRES such as 0,120,1.5, got {text!r}") from None


def _pixel(text: str) -> tuple[float, float]:
    x, y = text.split(",")
    return float(x), float(y)

"""Vanishing points of three orthogonal directions: the turn of the camera and its focal length from straight segments.

1. Many pairs of segments meet in a point. Points where many others meet too are kept, each once: candidates.
2. Two candidates that can be orthogonal are a frame with its third direction, for the focal length that makes them so, or for each of
   a row of focal lengths where they do not tell it.
3. A frame's score is the log-likelihood of all segments, of which each points to one of three vanishing points or anywhere, and of
   how people hold cameras.
4. The best frames are refined by least squares over their segments with a robust loss, then weighted by how far off these are: long lines
   of a good lens tell much more than its short ones, bent ones of a cheap lens do not. That decides between frames, and the covariance is
   that of the last step.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int
from scipy.optimize import least_squares

from mrbokeh.solving.line_segments import BENDING_RAD, POINT_NOISE, Segments

USUAL_FOCAL = 0.8
"""Focal length in long sides of the picture: 29 mm on full frame."""
_FOCAL_SPREAD = 0.6
"""Standard deviation of the logarithm of focal lengths."""
SHORTEST_FOCAL, LONGEST_FOCAL = 0.35, 8.0
_ROLL_RAD, _PITCH_RAD = np.radians(4.0), np.radians(22.0)
_WORST_PRIOR = 18.0
_BENDING, _MOST_BENDING = 0.02, 0.6
"""Standard deviation of radial distortion, 0.7 % in the corners, and the most that is tried."""
_TEMPER = 0.3
"""Segments are not independent: each counts as this part of one."""
_PAIRS, _CANDIDATES, _REFINED, _POLISHED = 4000, 36, 10, 6
_ORTHOGONAL_RAD = np.radians(5.0)
_ANY, _EACH = 0.4, 0.2
"""Shares of segments that point anywhere, and to each of three directions."""
_ALIKE = 2.0
"""How much larger variances are than those of segments that are independent: both sides of a bar lie in one line."""
NEAR = 3.0
"""A segment is of a direction within so many standard deviations."""
NOBODY = -1
_STEP = float(np.sqrt(np.finfo(np.float64).eps))
"""Of differences, as scipy takes it."""
_LEAST_GAIN, _CHANCE_GAIN = 12.0, 0.1
"""Nats that a direction has to gain, and nats for each segment that the other directions leave: pictures of leaves reach as much."""

Directions = Float64[np.ndarray, "3 3"]
Axes = Int[np.ndarray, " segments"]


@dataclass(frozen=True)
class Frame:
    """Three orthogonal directions seen by a camera.

    directions: (3, 3), columns are the world's right, down and forward in camera axes. focal: in long sides of the picture.
    axes: for each segment 0, 1 or 2 by its direction, or -1. score: in nats, against segments that point anywhere; evidence: the same with
    the noise that the frame's own segments show. found: which directions have more segments than chance gives. bending: radial distortion
    (`Segments.straightened`). covariance: (5, 5) of a turn about the camera's axes in radians, of the bending and of the logarithm of the
    focal length; None before it is refined.
    """

    directions: Directions
    focal: float
    axes: Axes
    score: float
    found: tuple[bool, ...] = (True, True, True)
    evidence: float = -np.inf
    bending: float = 0.0
    covariance: Float64[np.ndarray, "5 5"] | None = None

    @property
    def down(self) -> Float64[np.ndarray, "3"]:
        return self.directions[:, 1]

    def count(self, axis: int) -> int:
        return int((self.axes == axis).sum())


def angles_to(segments: Segments, points: Float64[np.ndarray, "*points 3"]) -> Float64[np.ndarray, "*points segments"]:
    """Return the angles in radians, at most pi / 2, between segments and the ways from their middles to homogeneous points."""
    x, y, w = (points[..., i, None] for i in range(3))
    right, down = x - w * segments.middle[:, 0], y - w * segments.middle[:, 1]
    aside = np.abs(segments.along[:, 0] * down - segments.along[:, 1] * right)
    return np.arctan2(aside, np.abs(segments.along[:, 0] * right + segments.along[:, 1] * down))


def vanishing_points(directions: Float64[np.ndarray, "*frames 3 3"], focal: np.ndarray | float) -> Float64[np.ndarray, "*frames 3 3"]:
    """Return the homogeneous vanishing points, one a row, of directions in columns."""
    rows = np.swapaxes(directions, -1, -2).copy()
    rows[..., :2] *= np.asarray(focal, np.float64)[..., None, None]
    return rows


def _gains(
    segments: Segments, points: Float64[np.ndarray, "*points 3"], sigma: np.ndarray | None = None
) -> Float64[np.ndarray, "*points segments"]:
    """Return how much likelier than anywhere each segment is if it is of each point: a ratio of densities."""
    sigma = segments.sigma_rad if sigma is None else sigma
    return np.sqrt(np.pi / 2.0) / sigma * np.exp(-0.5 * (angles_to(segments, points) / sigma) ** 2)


def candidates(segments: Segments, rng: np.random.Generator) -> Float64[np.ndarray, "points 3"]:
    """Return homogeneous points in which many segments meet, the best first, no two of the same segments."""
    shares = segments.length / segments.length.sum()
    first, second = rng.choice(len(segments), _PAIRS, p=shares), rng.choice(len(segments), _PAIRS, p=shares)
    points = np.cross(segments.lines[first], segments.lines[second])
    norm = np.linalg.norm(points, axis=1)
    points = points[norm > 1e-6] / norm[norm > 1e-6, None]
    gains = np.concatenate([np.log(_ANY + _EACH * _gains(segments, each)) for each in np.array_split(points, 8)])
    order = np.argsort(-gains.sum(axis=1))
    near, found = gains > 0.0, list[int]()
    for index in order:
        weight = np.where(near[index], segments.length, 0.0)
        overlaps = near[found] @ weight
        if weight.sum() > 0.0 and not (overlaps > 0.5 * weight.sum()).any():
            found.append(int(index))
        if len(found) == _CANDIDATES:
            break
    return np.array([_met(segments, points[index]) for index in found]).reshape(-1, 3)


def _met(segments: Segments, point: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
    """Return the point nearest to the lines of the segments that point to it, which may lie far outside."""
    for _ in range(2):
        near = angles_to(segments, point) < NEAR * segments.sigma_rad
        if near.sum() < 3:
            return point
        chosen = segments.chosen(near)
        away = np.hypot(*(point[:2, None] - point[2] * chosen.middle.T)) + 1e-9
        weighted = chosen.lines / (chosen.sigma_rad * away)[:, None]
        point = np.linalg.svd(weighted, full_matrices=False)[2][-1]
    return point


def best_frames(segments: Segments, points: Float64[np.ndarray, "points 3"], focal: float | None = None) -> list[Frame]:
    """Return refined frames of candidates, the best first. focal: if it is known."""
    rough = frames_of(segments, points, points, focal)
    refined, fitted = list[Frame](), dict[bytes, int]()
    for start, each in enumerate(rough):
        frame = _refined(segments, each, focal, fitted, start)
        if frame is not None and not any(_is_same(frame, other) for other in refined):
            refined.append(frame)
        if len(refined) == _REFINED:
            break
    refined.sort(key=lambda each: -each.score)
    return sorted((polished(segments, each, focal) for each in refined[:_POLISHED]), key=lambda each: -each.evidence)


def frames_of(
    segments: Segments, firsts: Float64[np.ndarray, "firsts 3"], points: Float64[np.ndarray, "points 3"], focal: float | None
) -> list[Frame]:
    """Return frames of two points each that can be orthogonal, the best first."""
    one, other = (index.ravel() for index in np.meshgrid(np.arange(len(firsts)), np.arange(len(points)), indexing="ij"))
    a, b = firsts[one], points[other]
    row = np.geomspace(0.5, 3.0, 9) if focal is None else np.array([focal])
    tried = np.broadcast_to(row, (len(a), len(row)))
    if focal is None:
        with np.errstate(divide="ignore", invalid="ignore"):
            theirs = np.sqrt(-(a[:, :2] * b[:, :2]).sum(axis=1) / (a[:, 2] * b[:, 2]))
        tried = np.concatenate([tried, np.clip(np.nan_to_num(theirs, nan=1.0), SHORTEST_FOCAL, LONGEST_FOCAL)[:, None]], axis=1)
    a, b = _rays(a, tried), _rays(b, tried)
    fits = np.abs((a * b).sum(axis=-1)) < np.sin(_ORTHOGONAL_RAD)
    a, b, focals = a[fits], b[fits], tried[fits]
    if not len(a):
        return []
    b = b - (a * b).sum(axis=-1, keepdims=True) * a
    b /= np.linalg.norm(b, axis=-1, keepdims=True)
    directions = ordered(np.stack([a, b, np.cross(a, b)], axis=-1))
    gains = np.concatenate(
        [_gains(segments, part).max(axis=1) for part in np.array_split(vanishing_points(directions, focals), 1 + len(a) // 500)]
    )
    scores = _TEMPER * np.log(_ANY + _EACH * gains).sum(axis=1) - priors(directions, focals, focal is not None)
    best = np.argsort(-scores)[: 4 * _REFINED]
    nobody = np.full(len(segments), NOBODY)
    return [Frame(directions[i], float(focals[i]), nobody, float(scores[i])) for i in best]


def _rays(points: Float64[np.ndarray, "pairs 3"], focals: Float64[np.ndarray, "pairs tries"]) -> Float64[np.ndarray, "pairs tries 3"]:
    rays = np.repeat(points[:, None, :], focals.shape[1], axis=1)
    rays[..., :2] /= focals[..., None]
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def ordered(directions: Float64[np.ndarray, "*frames 3 3"]) -> Float64[np.ndarray, "*frames 3 3"]:
    """Return frames with the direction that is most upright in the picture as down, and the more level one of the others as right."""
    upright = np.abs(directions[..., 1, :]).argmax(axis=-1)
    level = np.abs(directions[..., 0, :])
    np.put_along_axis(level, upright[..., None], -1.0, axis=-1)
    sideways = level.argmax(axis=-1)
    down = np.take_along_axis(directions, upright[..., None, None], axis=-1)[..., 0]
    right = np.take_along_axis(directions, sideways[..., None, None], axis=-1)[..., 0]
    down = down * np.where(down[..., 1:2] < 0.0, -1.0, 1.0)
    right = right * np.where(right[..., 0:1] < 0.0, -1.0, 1.0)
    return np.stack([right, down, np.cross(right, down)], axis=-1)


def roll_rad(directions: Float64[np.ndarray, "*frames 3 3"]) -> Float64[np.ndarray, "*frames"] | float:
    """Return how far the camera is turned clockwise about its axis: what is level in the world then falls to the left in the picture."""
    return np.arctan2(directions[..., 0, 1], directions[..., 1, 1])  # type: ignore[no-any-return]


def pitch_rad(directions: Float64[np.ndarray, "*frames 3 3"]) -> Float64[np.ndarray, "*frames"] | float:
    """Return how far the camera looks up."""
    return -np.arcsin(np.clip(directions[..., 2, 1], -1.0, 1.0))


def priors(
    directions: Float64[np.ndarray, "*frames 3 3"], focals: np.ndarray | float, known: bool
) -> Float64[np.ndarray, "*frames"] | float:
    """Return nats against a frame: cameras are held nearly level, look nearly ahead, and have usual focal lengths."""
    held = 0.5 * (roll_rad(directions) / _ROLL_RAD) ** 2 + 0.5 * (pitch_rad(directions) / _PITCH_RAD) ** 2
    lens = 0.0 if known else 0.5 * (np.log(np.asarray(focals) / USUAL_FOCAL) / _FOCAL_SPREAD) ** 2
    return np.minimum(held, _WORST_PRIOR) + lens


def scored(segments: Segments, frame: Frame, known: bool) -> Frame:
    """Return the frame with its segments and its score, without directions that chance may have made."""
    segments = segments.straightened(frame.bending)
    points = vanishing_points(frame.directions, frame.focal)
    off, gains = angles_to(segments, points) / segments.sigma_rad, np.log(_ANY + _EACH * _gains(segments, points))
    axes = np.where(off.min(axis=0) < NEAR, off.argmin(axis=0), NOBODY)
    found = np.array([_is_found(gains[axis], axes, axis) for axis in range(3)])
    off[~found], gains[~found] = np.inf, np.log(_ANY)
    axes = np.where(off.min(axis=0) < NEAR, off.argmin(axis=0), NOBODY)
    score = _TEMPER * gains.max(axis=0).sum() - priors(frame.directions, frame.focal, known)
    return replace(frame, axes=axes, score=float(score), found=tuple(bool(each) for each in found))


def _is_found(gains: Float64[np.ndarray, " segments"], axes: Axes, axis: int) -> bool:
    """Return whether a direction gains more than the best of random ones does, which grows with the segments of no other direction."""
    left = np.isin(axes, (axis, NOBODY)).sum()
    return bool(gains[axes == axis].sum() > _LEAST_GAIN + _CHANCE_GAIN * left)


def _refined(segments: Segments, frame: Frame, focal: float | None, fitted: dict[bytes, int], start: int) -> Frame | None:
    """Return the frame by least squares over its segments; None where an earlier start was fitted to the same, and most likely ended alike.

    focal: held if known. fitted: from the axes of segments to the start that was fitted to them first. (A third of the fits is saved. Of 88
    photographs of strangers every camera is the same; in 4 of 80 runs on drawn places the best frame differs: two better, one worse.)
    """
    frame = scored(segments, frame, focal is not None)
    for _ in range(3):
        axes = frame.axes
        if (axes != NOBODY).sum() < 3:
            break
        if fitted.setdefault(axes.tobytes(), start) != start:
            return None
        found = fit(segments, frame, focal)
        frame = scored(segments, replace(found, directions=ordered(found.directions)), focal is not None)
        if np.array_equal(frame.axes, axes):
            break
    return frame


def polished(segments: Segments, frame: Frame, focal: float | None = None) -> Frame:
    """Return the frame fitted again to its segments, weighted by how far off they are, with the covariance and evidence of that."""
    noise = (POINT_NOISE, BENDING_RAD)
    for _ in range(2):
        used = frame.axes != NOBODY
        if used.sum() < 3:
            return frame
        straight = segments.straightened(frame.bending)
        off = angles_to(straight, vanishing_points(frame.directions, frame.focal))[frame.axes[used], np.flatnonzero(used)]
        noise = _noise(off, segments.length[used])
        frame = fit(segments, frame, focal, noise)
    straight, found = segments.straightened(frame.bending), np.flatnonzero(frame.found)
    sigma = np.hypot(2.0 * noise[0] / segments.length, noise[1])
    gains = _gains(straight, vanishing_points(frame.directions, frame.focal)[found], sigma).max(axis=0, initial=0.0)
    evidence = _TEMPER * np.log(_ANY + _EACH * gains).sum() - priors(frame.directions, frame.focal, focal is not None)
    return replace(frame, evidence=float(evidence))


def _noise(off_rad: Float64[np.ndarray, " used"], length: Float64[np.ndarray, " used"]) -> tuple[float, float]:
    """Return the likeliest noise of ends and bending of segments that are off by these angles."""
    both = [(ends * POINT_NOISE, bent * BENDING_RAD) for ends in (0.15, 0.3, 0.6, 1.2) for bent in (0.1, 0.25, 0.5, 1.0, 2.0)]

    def unlikelihood(noise: tuple[float, float]) -> float:
        sigma = np.hypot(2.0 * noise[0] / length, noise[1])
        return float((np.log(sigma) + np.log1p(0.5 * (off_rad / sigma) ** 2)).sum())

    return min(both, key=unlikelihood)


def fit(segments: Segments, frame: Frame, focal: float | None, noise: tuple[float, float] = (POINT_NOISE, BENDING_RAD)) -> Frame:
    """Return the frame with directions, focal length, bending and covariance fitted to the segments that its axes name.

    noise: of the ends of segments, and of their directions in radians.
    """
    used = frame.axes != NOBODY
    chosen, axes, start = segments.chosen(used), frame.axes[used], np.zeros(4 if focal is not None else 5)
    sigma = np.hypot(2.0 * noise[0] / chosen.length, noise[1])

    start[3] = frame.bending

    def turned(values: Float64[np.ndarray, "tries values"]) -> tuple[Float64[np.ndarray, "tries 3 3"], Float64[np.ndarray, " tries"]]:
        directions = turns(values[:, :3]) @ frame.directions
        return directions, (frame.focal * np.exp(values[:, 4]) if focal is None else np.full(len(values), focal))

    def residuals(values: Float64[np.ndarray, "tries values"]) -> Float64[np.ndarray, "tries residuals"]:
        directions, length = turned(values)
        begin, end = chosen.straight(values[:, 3])
        off = _signed_sines(begin, end, vanishing_points(directions, length)[:, axes]) / sigma
        # Weak priors keep what the segments do not tell at what is usual.
        held = [roll_rad(directions) / _ROLL_RAD, pitch_rad(directions) / _PITCH_RAD, values[:, 3] / _BENDING]
        held += [] if focal is not None else [np.log(length / USUAL_FOCAL) / _FOCAL_SPREAD]
        return np.concatenate([off, np.stack(held, axis=1)], axis=1)

    def slopes(values: Float64[np.ndarray, " values"]) -> Float64[np.ndarray, "residuals values"]:
        """Return differences along all values at once: one call in place of one for each."""
        steps = _STEP * np.where(values < 0.0, -1.0, 1.0) * np.maximum(1.0, np.abs(values))
        at, *beside = residuals(values + np.concatenate([np.zeros((1, len(values))), np.diag(steps)]))
        return (np.stack(beside, axis=1) - at[:, None]) / steps

    low, high = np.full(len(start), -np.inf), np.full(len(start), np.inf)
    low[3], high[3] = -_MOST_BENDING, _MOST_BENDING
    if focal is None:
        low[4], high[4] = min(np.log(SHORTEST_FOCAL / frame.focal), -1e-3), max(np.log(LONGEST_FOCAL / frame.focal), 1e-3)
    found = least_squares(lambda values: residuals(values[None])[0], start, slopes, bounds=(low, high), loss="soft_l1", max_nfev=30)
    directions, length = (each[0] for each in turned(found.x[None]))
    spread = max(1.0, float(np.median(np.abs(found.fun[: len(chosen)])) / 0.6745)) ** 2
    covariance = np.zeros((5, 5))
    covariance[: len(start), : len(start)] = np.linalg.inv(found.jac.T @ found.jac + 1e-9 * np.eye(len(start))) * spread
    return replace(frame, directions=directions, focal=float(length), bending=float(found.x[3]), covariance=covariance * _ALIKE)


def turns(vectors: Float64[np.ndarray, "*turns 3"]) -> Float64[np.ndarray, "*turns 3 3"]:
    """Return the matrices of turns about vectors, by their length in radians (Rodrigues): for a few, in a tenth of Rotation's time."""
    x, y, z = (vectors[..., i] for i in range(3))
    none = np.zeros_like(x)
    cross = np.stack([none, -z, y, z, none, -x, -y, x, none], axis=-1).reshape(*x.shape, 3, 3)
    angle = np.sqrt(x * x + y * y + z * z)[..., None, None]
    return np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2 * (cross @ cross)


def _signed_sines(
    start: Float64[np.ndarray, "*tries segments 2"],
    end: Float64[np.ndarray, "*tries segments 2"],
    points: Float64[np.ndarray, "*tries segments 3"],
) -> Float64[np.ndarray, "*tries segments"]:
    """Return the sine of the angle from each segment to the way from its middle to its own point."""
    along, way = end - start, points[..., :2] - points[..., 2:] * (0.5 * (start + end))
    aside = along[..., 0] * way[..., 1] - along[..., 1] * way[..., 0]
    return aside / np.maximum(np.hypot(along[..., 0], along[..., 1]) * np.hypot(way[..., 0], way[..., 1]), 1e-12)


def _is_same(frame: Frame, other: Frame) -> bool:
    cosines = np.abs(frame.directions.T @ other.directions)
    return bool(cosines.diagonal().min() > np.cos(np.radians(1.5)) and abs(np.log(frame.focal / other.focal)) < 0.08)

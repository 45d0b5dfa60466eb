"""The camera of one picture, or one sentence why it does not tell."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
from jaxtyping import Float32, Float64

from mrbokeh.solving.line_segments import Segments, find_segments, segments_from_pixels, working_copy
from mrbokeh.solving.solved_camera import FAIR, GUESSED, HIGH, KNOWN, LOW, SOLVED, SolvedCamera
from mrbokeh.solving.vanishing_points import (
    NOBODY,
    USUAL_FOCAL,
    Frame,
    angles_to,
    best_frames,
    candidates,
    fit,
    frames_of,
    scored,
    vanishing_points,
)
from mrbokeh.system.errors import InputError

AXES, HORIZON = ("x", "y", "z"), "h"
_ADVICE = "give --line X1,Y1,X2,Y2,x|y|z|h for edges that are straight and level (x, z) or upright (y) in the world, or for the horizon (h)"
_WIDEST = 2.4
_FEWEST, _REFUSED, _LITTLE, _MUCH = 8, 25.0, 50.0, 90.0
"""Segments, and evidence in nats, below which a camera is refused, doubtful, and not sure."""
_MOST_ROLL_DEG, _MOST_SD_DEG, _LOW_SD_DEG, _HIGH_SD_DEG = 20.0, 4.0, 1.5, 0.7
_TRIED, _ALONE, _POINTED_PX = 8, 2, 3.0
_TOLD = 0.2
"""Standard deviation of the logarithm of a focal length beyond which segments do not tell it."""
_SHORT_FOCAL, _LONG_FOCAL, _LONGEST_TOLD = 0.45, 1.9, 3.0
"""Focal lengths in long sides, 16, 68 and 108 mm on full frame: below the first and above the second lines alone are doubted, above the
third not believed: they hardly run together any more, and a wall seen from the front looks alike."""
_MOST_DISTORTION, _TOLD_DISTORTION = 7.0, 1.0
"""Distortion in the corners, in percent, that only fisheyes have, and that is said."""


@dataclass(frozen=True)
class Line:
    """Edge told by hand. ends_px: x1, y1, x2, y2 in pixels of the picture. axis: "x" or "z" if it is level in the world, "y" if upright;
    "h" is the horizon itself.
    """

    ends_px: tuple[float, float, float, float]
    axis: str

    def __post_init__(self) -> None:
        if self.axis not in (*AXES, HORIZON):
            raise InputError(f"expected x, y, z or h (the horizon) as the direction of a line, got {self.axis!r}")
        if not np.isfinite(self.ends_px).all() or np.hypot(self.ends_px[2] - self.ends_px[0], self.ends_px[3] - self.ends_px[1]) < 1.0:
            raise InputError(f"expected a line between two pixels, got {self.ends_px}: give two ends")


def solve_camera(
    rgb: Float32[np.ndarray, "height width 3"], focal_length_px: float | None = None, lines: Sequence[Line] = (), *, seed: int = 0
) -> SolvedCamera:
    """Solve the camera of a scene-linear picture, which nobody cropped.

    focal_length_px: if it is known. lines: edges told by hand, which decide over what is found. Three orthogonal directions are looked for,
    of which one is vertical (Manhattan world; Coughlan and Yuille, 1999). Raises InputError if the picture does not tell.
    """
    height_px, width_px = rgb.shape[:2]
    side_px = max(width_px, height_px)
    if max(width_px, height_px) > _WIDEST * min(width_px, height_px):
        raise InputError(
            f"expected a picture as a lens takes it, but {width_px}x{height_px} px is a panorama or was cropped, so that its middle is not "
            f"the lens's: give the whole picture"
        )
    known = None if focal_length_px is None else _usable(focal_length_px / side_px)
    if horizons := [each for each in lines if each.axis == HORIZON]:
        return _from_horizon(horizons[-1], known, (width_px, height_px), alone=len(lines) == 1)
    segments = find_segments(working_copy(rgb))
    if lines:
        return _from_lines(lines, segments, known, (width_px, height_px))
    if len(segments) < _FEWEST:
        raise InputError(f"expected straight edges, but this picture shows {len(segments)} of them: {_ADVICE}")
    points = candidates(segments, np.random.default_rng(seed))
    free = best_frames(segments, points)
    frames = free if known is None else best_frames(segments, points, known)
    if not frames or frames[0].evidence < _REFUSED:
        raise InputError(f"the {len(segments)} straight edges of this picture agree on no upright world: {_ADVICE}")
    best = frames[0]
    guessed = known is None and (_sd(best, 4) > _TOLD or best.focal > _LONGEST_TOLD)
    if guessed:
        frames = best_frames(segments, points, USUAL_FOCAL) or frames
        best = frames[0]
    found = _solved(best, (width_px, height_px), segments, source=GUESSED if guessed else SOLVED if known is None else KNOWN)
    if abs(found.distortion_percent) > _MOST_DISTORTION and abs(best.bending) > 4.0 * _sd(best, 3):
        raise InputError(
            f"straight lines bend in this picture, by {abs(found.distortion_percent):.0f} % in its corners, as by a fisheye, but a "
            f"solved camera is a pinhole: undistort the picture first"
        )
    found = _with_doubts(found, best, frames)
    return _compared(found, best, free[0] if free else None)


def _usable(focal: float) -> float:
    if not 0.2 < focal < 40.0:
        raise InputError(
            f"expected a focal length between 0.2 and 40 times the longer side of the picture, got {focal:.3g} times: check --focal-length "
            f"and --sensor-width"
        )
    return focal


def _sd(frame: Frame, index: int) -> float:
    return float("inf") if frame.covariance is None else float(np.sqrt(max(frame.covariance[index, index], 0.0)))


def _held_sd_deg(frame: Frame) -> tuple[float, float]:
    """Return the standard deviations of roll and pitch in degrees; a turn about the upright changes neither."""
    if frame.covariance is None:
        return float("inf"), float("inf")
    right, down = frame.down[:2]
    across = np.cross(np.eye(3), frame.down).T
    spread = across @ frame.covariance[:3, :3] @ across.T
    level = max(right**2 + down**2, 1e-9)
    of_roll = np.array([down, -right, 0.0]) / level
    roll, pitch = float(of_roll @ spread @ of_roll), float(spread[2, 2]) / level
    return float(np.degrees(np.sqrt(max(roll, 0.0)))), float(np.degrees(np.sqrt(max(pitch, 0.0))))


def _solved(frame: Frame, size_px: tuple[int, int], segments: Segments, source: str) -> SolvedCamera:
    focal_px = frame.focal * max(size_px)
    told, (roll_sd_deg, pitch_sd_deg) = source == SOLVED, _held_sd_deg(frame)
    distortion_percent = 25.0 * (1.0 + (min(size_px) / max(size_px)) ** 2) * frame.bending
    return SolvedCamera(
        width_px=size_px[0],
        height_px=size_px[1],
        focal_length_px=focal_px,
        focal_length_source=source,
        camera_from_world=frame.directions,
        focal_length_sd_px=focal_px * _sd(frame, 4) if told else 0.0,
        roll_sd_deg=roll_sd_deg,
        pitch_sd_deg=pitch_sd_deg,
        solved_focal_length_px=focal_px if told else None,
        solved_focal_length_sd_px=focal_px * _sd(frame, 4) if told else None,
        segments_by_direction={name: frame.count(index) for index, name in enumerate(AXES)},
        distortion_percent=distortion_percent,
        assumed=_assumed(frame, source, distortion_percent),
        segments_px=segments.in_pixels(*size_px),
        axes=frame.axes,
    )


def _assumed(frame: Frame, source: str, distortion_percent: float) -> tuple[str, ...]:
    said = []
    if abs(distortion_percent) > _TOLD_DISTORTION:
        said.append(f"left out: the lens's distortion of {distortion_percent:+.1f} % in the corners; the camera is a pinhole")
    if source == GUESSED:
        said.append("guessed: the focal length of 29 mm on full frame (--focal-length MM --sensor-width MM), as the lines do not tell it")
    if not frame.count(1):
        said.append("assumed: no upright lines were found, so upright is what is square to the level ones, and the camera nearly level")
    if not frame.count(0) and not frame.count(2):
        said.append("assumed: no level lines were found, so which way the grid runs on the ground is arbitrary")
    return tuple(said)


def _with_doubts(found: SolvedCamera, best: Frame, frames: Sequence[Frame]) -> SolvedCamera:
    """Return the camera with the doubt that other frames leave, or refuse it."""
    weights = np.exp([max(-50.0, each.evidence - frames[0].evidence) for each in frames])
    apart = np.array([_apart_deg(frames[0], each) for each in frames])
    doubt_deg = float(np.sqrt((weights * apart**2).sum() / weights.sum()))
    spread = float(np.sqrt((weights * np.log([each.focal / frames[0].focal for each in frames]) ** 2).sum() / weights.sum()))
    found = replace(found, pitch_sd_deg=float(np.hypot(found.pitch_sd_deg, doubt_deg)))
    if found.focal_length_source == SOLVED:
        sd_px = float(np.hypot(found.focal_length_sd_px, spread * found.focal_length_px))
        found = replace(found, focal_length_sd_px=sd_px, solved_focal_length_sd_px=sd_px)
    sd_deg = float(np.hypot(found.pitch_sd_deg, found.roll_sd_deg))
    if abs(found.roll_deg) > _MOST_ROLL_DEG:
        raise InputError(
            f"the lines say that the camera was rolled by {found.roll_deg:.0f} degrees, which few are: turn the picture upright, or "
            f"{_ADVICE}"
        )
    if sd_deg > _MOST_SD_DEG or (not best.count(1) and frames[0].evidence < _LITTLE):
        counts = ", ".join(f"{count} along {name}" for name, count in found.segments_by_direction.items())
        raise InputError(f"the straight edges of this picture ({counts}) do not tell where its horizon is: {_ADVICE}")
    is_long = found.focal_length_source == SOLVED and best.focal > _LONG_FOCAL
    is_doubtful = is_long or found.focal_length_source == GUESSED or best.focal < _SHORT_FOCAL
    if is_doubtful or frames[0].evidence < _LITTLE or sd_deg > _LOW_SD_DEG or not best.count(1):
        return replace(found, confidence=LOW)
    is_sure = frames[0].evidence > _MUCH and sd_deg < _HIGH_SD_DEG
    return replace(found, confidence=HIGH if is_sure else FAIR)


def _apart_deg(one: Frame, other: Frame) -> float:
    return float(np.degrees(np.arccos(np.clip(one.down @ other.down, -1.0, 1.0))))


def _compared(found: SolvedCamera, best: Frame, free: Frame | None) -> SolvedCamera:
    """Return the camera with what the segments alone say beside a known focal length; what disagrees is doubtful."""
    if found.focal_length_source != KNOWN or free is None:
        return found
    side_px = max(found.width_px, found.height_px)
    if _sd(free, 4) < _TOLD:
        found = replace(found, solved_focal_length_px=free.focal * side_px, solved_focal_length_sd_px=free.focal * side_px * _sd(free, 4))
    sd_deg = float(np.hypot(*_held_sd_deg(free)))
    agrees = _apart_deg(best, free) < 2.0 + 2.0 * min(sd_deg, 2.0) or _sd(free, 4) > _TOLD
    return found if agrees else replace(found, confidence=LOW)


def _from_horizon(line: Line, known: float | None, size_px: tuple[int, int], *, alone: bool) -> SolvedCamera:
    """Return the camera that sees the horizon along a line: up is square to the plane of its rays. alone: no other lines were told."""
    focal_px = (known or USUAL_FOCAL) * max(size_px)
    x1, y1, x2, y2 = line.ends_px
    one, other = (np.array([x - size_px[0] / 2, y - size_px[1] / 2, focal_px]) for x, y in ((x1, y1), (x2, y2)))
    down = np.cross(one, other)
    down *= (1.0 if down[1] > 0.0 else -1.0) / np.linalg.norm(down)
    ahead = np.array([0.0, 0.0, 1.0]) - down[2] * down
    ahead /= np.linalg.norm(ahead)
    guessed = "guessed: the focal length of 29 mm on full frame (--focal-length MM --sensor-width MM), as a horizon does not tell it"
    assumed = ((guessed,) if known is None else ()) + (() if alone else ("left out: the other lines, as the horizon is told",))
    return SolvedCamera(
        width_px=size_px[0],
        height_px=size_px[1],
        focal_length_px=focal_px,
        focal_length_source=GUESSED if known is None else KNOWN,
        camera_from_world=np.stack([np.cross(down, ahead), down, ahead], axis=1),
        roll_sd_deg=float(np.degrees(_POINTED_PX * np.sqrt(2.0) / np.hypot(x2 - x1, y2 - y1))),
        pitch_sd_deg=float(np.degrees(_POINTED_PX / focal_px)),
        confidence=FAIR if known is None else HIGH,
        assumed=assumed,
        segments_px=np.array([line.ends_px], np.float64),
        axes=np.array([0]),
    )


def _from_lines(lines: Sequence[Line], segments: Segments, known: float | None, size_px: tuple[int, int]) -> SolvedCamera:
    told = segments_from_pixels(np.array([each.ends_px for each in lines], np.float64), *size_px)
    axes = np.array([AXES.index(each.axis) for each in lines])
    everything = told.joined(segments)
    frames = [each for focal in ([known] if known else [None, USUAL_FOCAL]) for each in _candidates(told, axes, segments, focal)]
    frames = sorted((_named(each, told, axes) for each in frames), key=lambda each: _misfit(each, told, axes) - each.score)[:_TRIED]
    fitted = [_fitted_to_lines(everything, each, axes, known) for each in frames]
    if not fitted:
        few = f"{len(lines)} lines are" if len(lines) > 1 else "one line is"
        raise InputError(f"{few} too little for a camera: give two of one direction, and one or two of another")
    best = max(fitted, key=lambda each: each.score)
    guessed = known is None and _sd(best, 4) > _TOLD
    if guessed:
        best = _fitted_to_lines(everything, replace(best, focal=USUAL_FOCAL), axes, USUAL_FOCAL)
    off_rad = angles_to(told.straightened(best.bending), vanishing_points(best.directions, best.focal))[axes, np.arange(len(axes))]
    worst = float(np.degrees(off_rad.max()))
    source = GUESSED if guessed else SOLVED if known is None else KNOWN
    found = _solved(best, size_px, everything, source)
    sd_deg = float(np.hypot(found.pitch_sd_deg, found.roll_sd_deg))
    if worst > 5.0 or sd_deg > _MOST_SD_DEG:
        why = f"one is off by {worst:.1f} degrees" if worst > 5.0 else f"the horizon is uncertain by {sd_deg:.0f} degrees"
        raise InputError(f"the lines given fit no camera: {why}; check their ends and directions, give more of them, or --focal-length")
    if worst < 1.0 and sd_deg < _HIGH_SD_DEG:
        return replace(found, confidence=HIGH)
    return replace(found, confidence=FAIR if worst < 2.0 and sd_deg < _LOW_SD_DEG else LOW)


def _candidates(told: Segments, axes: np.ndarray, segments: Segments, focal: float | None) -> list[Frame]:
    """Return frames with a vanishing point that two lines tell, and others of lines, of segments, or level and upright ones."""
    points = [np.linalg.svd(told.chosen(axes == axis).lines)[2][-1] for axis in range(3) if (axes == axis).sum() > 1]
    if not points:
        return []
    length = focal or USUAL_FOCAL
    rays = [each / [length, length, 1.0] for each in points]
    planes = [*(told.lines * [length, length, 1.0]), np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])]
    square = [np.cross(ray, plane) for ray in rays for plane in planes]
    others = [each * [length, length, 1.0] for each in square if np.linalg.norm(each) > 1e-6]
    if len(segments) >= _FEWEST:
        others += list(candidates(segments, np.random.default_rng(0)))
    return frames_of(told.joined(segments), np.array(points), np.array([*points, *others]), focal)


def _misfit(frame: Frame, told: Segments, axes: np.ndarray) -> float:
    """Return how far told lines miss the vanishing points of their directions: squares of standard deviations."""
    straight = told.straightened(frame.bending)
    off = angles_to(straight, vanishing_points(frame.directions, frame.focal))[axes, np.arange(len(axes))] / told.sigma_rad
    return float(np.minimum(off**2, 1e4).sum())


def _named(frame: Frame, told: Segments, axes: np.ndarray) -> Frame:
    """Return the frame with its directions in the order that fits the lines told."""
    orders = [replace(frame, directions=_upright(frame.directions[:, list(order)])) for order in permutations(range(3))]
    return min(orders, key=lambda each: _misfit(each, told, axes))


def _fitted_to_lines(segments: Segments, frame: Frame, axes: np.ndarray, focal: float | None) -> Frame:
    """Return the frame fitted to the first segments, whose directions are told, and to others that agree, first of the directions left."""
    count = len(axes)
    for turn in range(5):
        seen = scored(segments, frame, focal is not None).axes
        if turn < _ALONE:
            seen[np.isin(seen, axes)] = NOBODY
        seen[:count] = axes
        frame = fit(segments, replace(frame, axes=seen), focal)
    return replace(frame, score=scored(segments, frame, focal is not None).score - _misfit(frame, segments.chosen(np.arange(count)), axes))


def _upright(directions: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
    """Return a right-handed frame whose second direction points down in the picture, and the third ahead or the first right."""
    _, down, ahead = directions.T
    down, ahead = down * (1.0 if down[1] >= 0.0 else -1.0), ahead * (1.0 if ahead[2] >= 0.0 else -1.0)
    return np.stack([np.cross(down, ahead), down, ahead], axis=1)

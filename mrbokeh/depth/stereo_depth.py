"""Depth of a photograph from a second one, taken beside it with the same camera.

How the hand-held camera moved is found from what both show; its length stays unknown. Points are found by SIFT (Lowe 2004), the movement by
the five-point method (Nister 2004) with robust votes, then by least squares of where points should be, in front of both cameras.

Both photographs are turned until the camera moves along their rows, in whatever direction it went. OpenCV's semi-global matching
(Hirschmueller 2008) finds each pixel's shift, and drops what the two directions of matching do not agree on: what one picture hides, and
what moved.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from mrbokeh.depth.depth_filters import interpolate
from mrbokeh.depth.depth_map import DepthMap
from mrbokeh.depth.open_depth import at_size_of
from mrbokeh.images.color import luminance
from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError

Points = Float[np.ndarray, "points 2"]
Rays = Float[np.ndarray, "points 3"]
Turn = Float[np.ndarray, "3 3"]
Way = Float[np.ndarray, " 3"]

LEAST_NEARNESS = 0.01
"""Least movement as a share of the distance of the nearest things: below it a disparity off by a quarter of a pixel is 3 % of depth."""
_MOST_FEATURES, _FAINTEST, _BEST_BY = 5000, 0.02, 0.8
_LEAST_POINTS, _LEAST_SHARE = 40, 0.3
_WITHIN_PX, _ROUNDS = 1.0, 2
_SHIFTS = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 1.0, 0.0), (1.0, -1.0, 0.0), (0.0, 0.0, 1.0))
_LEAST_PARALLAX_PX = 2.0
_MOST_AHEAD = 0.4
_NEAREST_PERCENT = 95.0
Rgb = Float32[np.ndarray, "height width 3"]
Grey = UInt8[np.ndarray, "height width"]
Plane = Float32[np.ndarray, "rows columns"]

LONG_SIDE_PX = 1280
"""Pictures are matched at this size; edges are then sharpened along the photograph at its own."""
_MOST_SHIFT_PX = 256
_BRIGHTEST = 1.2
_QUANTILES = 65
_WINDOW_PX, _STEP_COST, _JUMP_COST, _UNIQUE_PERCENT = 3, 8, 32, 15
_SPECKLE_PX, _STEPS_PER_PX = 200, 16
_SPILL_PX, _MEDIAN_PX, _FILL_PX, _CONTRAST = 6, 5, 40.0, 0.03
_LEAST_MEASURED, _MOST_WIDER = 0.3, 2.0


@dataclass(frozen=True)
class Movement:
    """Movement of a camera.

    turn: (3, 3) brings directions from the axes of the first camera into those of the second. way: (3,) of length 1, from the first
    place to the second in the first's axes. nearness: of each point that both show, the length of the way over its depth.
    """

    turn: Turn
    way: Way
    nearness: Float[np.ndarray, " points"]


def camera_movement(first: Grey, second: Grey, camera: Camera, told: str) -> Movement:
    """Return how the camera moved. camera: of both, without pose. told: the two photographs, in words.

    Raises InputError where they show too little that is common, or show no parallax, or where the camera went ahead or zoomed.
    """
    focal_px, middle_px = camera.focal_px[0], np.asarray(camera.principal_px)
    here, there = (_rays((each - middle_px) / focal_px) for each in _common_points(first, second))
    pair, good = _likeliest(here, there, _WITHIN_PX / focal_px)
    if good.sum() < max(_LEAST_POINTS, _LEAST_SHARE * len(good)):
        raise InputError(
            f"{told} have too little in common for depth, {good.sum()} of {len(good)} points: expected one still scene, "
            f"photographed twice from places a hand's breadth apart"
        )
    here, there = here[good], there[good]
    movement = Movement(pair.turn, -pair.turn.T @ pair.shift, pair.nearness(here, there))
    parallax_px = focal_px * np.percentile(np.linalg.norm(here @ _best_turn(here, there).T - there, axis=1), _NEAREST_PERCENT)
    if parallax_px < _LEAST_PARALLAX_PX or np.percentile(movement.nearness, _NEAREST_PERCENT) < LEAST_NEARNESS:
        raise InputError(
            f"between {told} the camera turned or zoomed but hardly moved, which shows no depth: expected places apart by more than "
            f"{100 * LEAST_NEARNESS:g} % of the distance of the nearest things, best by a hand's breadth"
        )
    if abs(movement.way[2]) > _MOST_AHEAD:
        raise InputError(
            f"between {told} the camera moved along its view or zoomed: expected one that moved sideways or up, by a hand's breadth"
        )
    return movement


def _common_points(first: Grey, second: Grey) -> tuple[Points, Points]:
    """Return where both pictures show the same points, in pixels."""
    sift = cv2.SIFT.create(nfeatures=_MOST_FEATURES, contrastThreshold=_FAINTEST)
    (here, ours), (there, theirs) = (sift.detectAndCompute(each, None) for each in (first, second))
    if min(len(here), len(there)) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    pairs = cv2.BFMatcher().knnMatch(ours, theirs, k=2)
    best = [pair[0] for pair in pairs if len(pair) == 2 and pair[0].distance < _BEST_BY * pair[1].distance]
    at = [(here[each.queryIdx].pt, there[each.trainIdx].pt) for each in best]
    points_px = np.array(at, np.float64).reshape(-1, 2, 2) + 0.5  # OpenCV counts from the centre of the first pixel
    return points_px[:, 0], points_px[:, 1]


def _rays(plane: Points) -> Rays:
    return np.concatenate([plane, np.ones_like(plane[:, :1])], axis=1)


@dataclass(frozen=True)
class _Pair:
    """Pose of the second camera: a point here lies there along turn here + nearness shift."""

    turn: Turn
    shift: Way

    def nearness(self, here: Rays, there: Rays) -> Float[np.ndarray, " points"]:
        off, along = np.cross(there, here @ self.turn.T), np.cross(there, self.shift)
        return -(off * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), 1e-12)

    def apart(self, here: Rays, there: Rays) -> Points:
        """Return how far points there are from where they should be at their best depth in front of the camera, on the plane of rays."""
        expected = here @ self.turn.T + np.maximum(self.nearness(here, there), 0.0)[:, None] * self.shift
        return expected[:, :2] / np.maximum(expected[:, 2:], 1e-6) - there[:, :2]

    def explained(self, here: Rays, there: Rays, within: float) -> Bool[np.ndarray, " points"]:
        """Mark points that are where they should be."""
        return np.linalg.norm(self.apart(here, there), axis=1) < within


def _likeliest(here: Rays, there: Rays, within: float) -> tuple[_Pair, Bool[np.ndarray, " points"]]:
    """Return the pose that explains most points, and which.

    Votes count points near their lines; where a plane fills the picture, another movement brings them there as well, but sees half of
    them behind the cameras. So movements in plain directions are refined beside the elected one, by where points are in front.
    """
    best, good = _Pair(np.eye(3), np.array(_SHIFTS[0])), np.zeros(len(here), bool)
    if len(here) < _LEAST_POINTS:
        return best, good
    here_2, there_2 = (np.ascontiguousarray(each[:, :2]) for each in (here, there))
    essential, mask = cv2.findEssentialMat(here_2, there_2, np.eye(3), method=cv2.USAC_MAGSAC, prob=0.9999, threshold=within)
    if essential is None or mask is None or not mask.any():
        return best, good
    voted = mask.ravel() > 0
    _, turn, shift, _ = cv2.recoverPose(essential[:3], here_2[voted], there_2[voted], np.eye(3))
    turned = _best_turn(here[voted], there[voted])
    plain = [side * np.array(each) / np.linalg.norm(each) for each in _SHIFTS for side in (1.0, -1.0)]
    for start in (_Pair(turn, shift.ravel()), *(_Pair(turned, each) for each in plain)):
        pair, chosen = start, voted
        for _ in range(_ROUNDS):
            pair = _refined(pair, here[chosen], there[chosen], 0.5 * within)
            chosen = pair.explained(here, there, within)
            if chosen.sum() < _LEAST_POINTS:
                break
        if chosen.sum() > good.sum():
            best, good = pair, chosen
    return best, good


def _refined(start: _Pair, here: Rays, there: Rays, soft: float) -> _Pair:
    """Return the pose near a first one that brings points closest to where they should be."""
    from scipy.optimize import least_squares

    across = np.linalg.svd(start.shift[None])[2][1:]

    def moved(by: np.ndarray) -> _Pair:
        shift = start.shift + by[3:] @ across
        return _Pair(cv2.Rodrigues(by[:3])[0] @ start.turn, shift / np.linalg.norm(shift))

    def errors(by: np.ndarray) -> np.ndarray:
        return moved(by).apart(here, there).ravel()

    return moved(least_squares(errors, np.zeros(5), loss="soft_l1", f_scale=soft, x_scale="jac").x)


def _best_turn(here: Rays, there: Rays) -> Turn:
    """Return the rotation that brings rays closest to others (Kabsch 1976)."""
    left, _, right = np.linalg.svd(there.T @ here)
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right


def stereo_depth(
    first_rgb: Rgb, second_rgb: Float32[np.ndarray, "rows columns 3"], camera: Camera, baseline_m: float, photos: tuple[Path, Path]
) -> DepthMap:
    """Return the depth of the first photograph at its size. camera: of both, without pose. baseline_m: how far it moved.

    Raises InputError for pictures of differing sizes or scenes, and where the camera did not move sideways.
    """
    if first_rgb.shape != second_rgb.shape:
        sizes = " and ".join(f"{each.shape[1]}x{each.shape[0]}" for each in (first_rgb, second_rgb))
        raise InputError(f"{photos[0]} and {photos[1]} are of {sizes} px: expected two photographs of one camera, turned the same way")
    told = f"{photos[0]} and {photos[1]}"
    small = _resized(camera, LONG_SIDE_PX / max(first_rgb.shape[:2]))
    movement = camera_movement(*_alike(first_rgb, second_rgb, small), small, told)
    nearest = float(np.percentile(movement.nearness, 99.5))
    small = _resized(small, _MOST_SHIFT_PX / (nearest * small.focal_px[0]))
    matched = _matched(*_alike(first_rgb, second_rgb, small), small, movement, told)
    share = float(matched.measured.mean())
    if share < _LEAST_MEASURED:
        raise InputError(
            f"{told} agree on only {100 * share:.0f} % of the picture: expected a still scene with structure, photographed from places "
            f"that are closer to one another"
        )
    dioptres = _filled(matched, first_rgb) / np.float32(baseline_m)
    return at_size_of(DepthMap.of_dioptres(dioptres, matched.measured, f"stereo with {photos[1].name}"), first_rgb, refine=True)


def _resized(camera: Camera, scale: float) -> Camera:
    """Return the camera with fewer pixels, for a scale below 1."""
    return camera if scale >= 1.0 else camera.resized(round(camera.width_px * scale), round(camera.height_px * scale))


def _alike(first_rgb: Rgb, second_rgb: Rgb, camera: Camera) -> tuple[Grey, Grey]:
    """Return both as grey codes at the camera's size; the second takes the first's distribution, so that exposures may differ."""
    first, second = (_grey(each, camera) for each in (first_rgb, second_rgb))
    shares = np.linspace(0.0, 1.0, _QUANTILES)
    second = np.interp(second, np.quantile(second, shares), np.quantile(first, shares))
    return (255.0 * first + 0.5).astype(np.uint8), (255.0 * second + 0.5).astype(np.uint8)


def _grey(rgb: Rgb, camera: Camera) -> Plane:
    light = luminance(cv2.resize(rgb, (camera.width_px, camera.height_px), interpolation=cv2.INTER_AREA))
    return np.sqrt(np.clip(light, 0.0, _BRIGHTEST) / _BRIGHTEST).astype(np.float32)


@dataclass(frozen=True)
class Rows:
    """View turned until the camera moves to the right along its rows.

    first, second: (3, 3) bring pixels of the photographs into it, by OpenCV's count. size_px: width and height. along: direction in
    the first camera's axes, of length 1, in which depth counts there.
    """

    first: Float[np.ndarray, "3 3"]
    second: Float[np.ndarray, "3 3"]
    size_px: tuple[int, int]
    along: Float[np.ndarray, " 3"]


def _rows(camera: Camera, movement: Movement, margin_px: int, told: str) -> Rows:
    """Return the view along whose rows the camera moves, as little turned as can be. margin_px: beyond both ends of the picture.

    Raises InputError where it would be turned so far that the picture is drawn out. told: names the photographs.
    """
    right = movement.way
    down = np.cross([0.0, 0.0, 1.0], right)
    down /= np.linalg.norm(down)
    turn = np.stack([right, down, np.cross(right, down)])
    focal_px, middle_px = camera.focal_px[0], np.asarray(camera.principal_px) - 0.5
    lens = np.array([[focal_px, 0.0, middle_px[0]], [0.0, focal_px, middle_px[1]], [0.0, 0.0, 1.0]])
    corners = np.array([[x, y, 1.0] for x in (0, camera.width_px - 1) for y in (0, camera.height_px - 1)]) @ np.linalg.inv(lens).T @ turn.T
    seen_px = focal_px * corners[:, :2] / np.maximum(corners[:, 2:], 1e-3)
    least, most = np.floor(seen_px.min(axis=0)), np.ceil(seen_px.max(axis=0))
    if (most - least > _MOST_WIDER * np.array([camera.width_px, camera.height_px])).any():
        raise InputError(f"between {told} the camera moved along its view: expected one that moved sideways or up, by a hand's breadth")
    placed = np.array([[focal_px, 0.0, margin_px - least[0]], [0.0, focal_px, -least[1]], [0.0, 0.0, 1.0]]) @ turn
    size_px = (int(most[0] - least[0]) + 1 + 2 * margin_px, int(most[1] - least[1]) + 1)
    return Rows(placed @ np.linalg.inv(lens), placed @ movement.turn.T @ np.linalg.inv(lens), size_px, turn[2])


def _matched(first: Grey, second: Grey, camera: Camera, movement: Movement, told: str) -> "_Matched":
    """Return the way over depth of each pixel of the first picture, where both agree."""
    focal_px = camera.focal_px[0]
    farthest, nearest = (float(each) * focal_px for each in np.percentile(movement.nearness, [0.5, 99.5]))
    least = max(int(0.6 * farthest) - 4, -4)
    shifts = 16 * int(np.ceil((1.25 * nearest + 4 - least) / 16))
    rows = _rows(camera, movement, max(shifts + least, 0), told)
    turned = [
        cv2.warpPerspective(each, by, rows.size_px, flags=cv2.INTER_CUBIC) for each, by in ((first, rows.first), (second, rows.second))
    ]
    matcher = cv2.StereoSGBM.create(
        minDisparity=least,
        numDisparities=shifts,
        blockSize=_WINDOW_PX,
        P1=_STEP_COST * _WINDOW_PX**2,
        P2=_JUMP_COST * _WINDOW_PX**2,
        disp12MaxDiff=1,
        preFilterCap=31,
        uniquenessRatio=_UNIQUE_PERCENT,
        speckleWindowSize=_SPECKLE_PX,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    shift_px = matcher.compute(*turned).astype(np.float32) / _STEPS_PER_PX
    seen = cv2.warpPerspective(np.ones_like(second), rows.second, rows.size_px, flags=cv2.INTER_NEAREST)
    across, down = np.meshgrid(np.arange(rows.size_px[0], dtype=np.float32), np.arange(rows.size_px[1], dtype=np.float32))
    known = shift_px >= least
    for by_px in (shift_px, np.full_like(shift_px, np.median(shift_px[known]) if known.any() else 0.0)):
        known &= cv2.remap(seen, across - by_px, down, cv2.INTER_NEAREST) > 0
    filled = _behind(np.where(known, shift_px, np.nan).astype(np.float32))
    plane = (camera.pixel_centres_px() - camera.principal_px) / focal_px
    per_px = ((plane @ rows.along[:2] + rows.along[2]) / focal_px).astype(np.float32)
    back = [
        cv2.warpPerspective(each, rows.first, first.shape[::-1], flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP, borderValue=0)
        for each in (np.nan_to_num(filled), np.isfinite(filled).astype(np.uint8), known.astype(np.uint8))
    ]
    return _Matched(back[0] * per_px, back[1] > 0, back[2] > 0)


@dataclass(frozen=True)
class _Matched:
    """Way over depth of each pixel; where it is known, in part from both sides of a hole; and where it was measured."""

    nearness: Float32[np.ndarray, "height width"]
    known: Bool[np.ndarray, "height width"]
    measured: Bool[np.ndarray, "height width"]


def _behind(shift_px: Plane) -> Plane:
    """Fill holes of a row that are as wide as one picture hides, by the lower shift of both sides: what is hidden lies behind."""
    columns, known = np.arange(shift_px.shape[1]), np.isfinite(shift_px)
    before = np.maximum.accumulate(np.where(known, columns, 0), axis=1)
    after = np.minimum.accumulate(np.where(known, columns, columns[-1])[:, ::-1], axis=1)[:, ::-1]
    left, right = (np.take_along_axis(shift_px, each, axis=1) for each in (before, after))
    hidden = after - before <= np.abs(right - left) + _SPILL_PX
    return np.where(known, shift_px, np.where(hidden, np.minimum(left, right), np.nan)).astype(np.float32)


def _filled(matched: _Matched, first_rgb: Rgb) -> Plane:
    """Return the nearness with holes filled from their surroundings, up to edges of the photograph."""
    known = matched.known
    # Beside holes, which count as 0, the median may be one of them.
    median = cv2.medianBlur(matched.nearness, _MEDIAN_PX)
    steady = np.where(known, np.where(median > 0.0, median, matched.nearness), 0.0)
    guide = np.sqrt(np.clip(cv2.resize(first_rgb, known.shape[::-1], interpolation=cv2.INTER_AREA), 0.0, 1.0))
    around = interpolate(steady, known.astype(np.float32), guide, _FILL_PX**2, _CONTRAST)
    return np.where(known, steady, around).astype(np.float32)

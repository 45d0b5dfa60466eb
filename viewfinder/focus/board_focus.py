"""BlurOfBoardFocus: the focus of a lens that does not report it, solved about once a second from how blurred the tracked board is.

FollowingOptics gives it the lens and the f-number that the page was told last. Solved is c = k |1/d_f - 1/z| (Lens.coc_px) over many
edges of known depth. One depth leaves two answers, one nearer and one farther than it. Edges at several depths tell them apart: towards
the focus plane the blur shrinks. How surely is the difference of what the two leave unexplained; `settled` chooses.
"""

import logging
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from threading import Event, Lock, Thread
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Float64
from scipy.optimize import minimize_scalar

from mrbokeh.images.color import srgb_to_linear
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import MM_PER_M, Lens
from mrbokeh.tracking.charuco.board import CharucoBoard
from viewfinder.focus.edge_blur import EdgeBlurs, board_edges, edge_blurs
from viewfinder.frames import CameraFrame, LensState, Newest
from viewfinder.tracking.tracker import TrackedPose

FEWEST_EDGES = 8

_STEP_PX = 0.2
_CLOSEST_FOCAL_LENGTHS = 4.0
_MOST_STEPS = 4000
_CAUCHY = 2.385
_APART_PX = 0.5


@dataclass(frozen=True)
class FocusCandidate:
    """Focus that explains the blurs.

    cost: half the squares that are left, robust and in units of their variance. sigma_dioptres: standard deviation.
    """

    dioptres: float
    cost: float
    sigma_dioptres: float

    @property
    def focus_distance_m(self) -> float:
        return 1.0 / self.dioptres if self.dioptres > 0.0 else float("inf")


def focus_candidates(blurs: EdgeBlurs, lens: Lens, width_px: int) -> tuple[FocusCandidate, ...]:
    """Return the best answer, then the best one on the other side of the board, where there is one; none with too few edges.

    lens: its focus distance is not looked at. width_px: of the picture in which the blurs were measured.
    """
    if len(blurs) < FEWEST_EDGES:
        return ()
    steps = _dioptres(lens, width_px)
    costs = np.array([blur_cost(blurs, lens, width_px, each) for each in steps])
    low = np.flatnonzero((np.r_[np.inf, costs[:-1]] >= costs) & (costs < np.r_[costs[1:], np.inf]))
    found = sorted((_refined(blurs, lens, width_px, steps, int(index)) for index in low), key=lambda each: each.cost)
    if not found:
        return ()
    best, middle = found[0], float(np.median(1.0 / blurs.depth_m))
    apart = _APART_PX / lens.coc_px_per_dioptre(width_px)
    others = [
        each
        for each in found[1:]
        if (each.dioptres - middle) * (best.dioptres - middle) <= 0 and abs(each.dioptres - best.dioptres) > apart
    ]
    return best, *others[:1]


def blur_cost(blurs: EdgeBlurs, lens: Lens, width_px: int, dioptres: float) -> float:
    """Cauchy's loss (95 % efficient for normal errors, Holland and Welsch 1977) of what a focus leaves unexplained."""
    return float(_losses(blurs, lens, width_px, dioptres).sum())


def total_cost(history: Sequence[EdgeBlurs], lens: Lens, width_px: int, dioptres: float) -> float:
    return sum(blur_cost(blurs, lens, width_px, dioptres) for blurs in history)


def _losses(blurs: EdgeBlurs, lens: Lens, width_px: int, dioptres: float) -> Float64[np.ndarray, " edges"]:
    focused = lens.focused_at(1.0 / dioptres if dioptres > 0.0 else np.inf)
    off = (np.abs(focused.coc_px(blurs.depth_m, width_px)) - blurs.diameter_px) / blurs.sigma_px
    return 0.5 * _CAUCHY**2 * np.log1p((off / _CAUCHY) ** 2)


def _dioptres(lens: Lens, width_px: int) -> Float64[np.ndarray, " steps"]:
    """Return steps from infinity to four focal lengths, finely enough for a fifth of a pixel."""
    nearest = MM_PER_M / (_CLOSEST_FOCAL_LENGTHS * lens.focal_length_mm)
    per_dioptre = lens.focused_at(np.inf).coc_px_per_dioptre(width_px)
    return np.linspace(0.0, nearest, int(np.clip(nearest * per_dioptre / _STEP_PX, 50, _MOST_STEPS)))


def _refined(blurs: EdgeBlurs, lens: Lens, width_px: int, steps: Float64[np.ndarray, " steps"], index: int) -> FocusCandidate:
    between = (steps[max(index - 1, 0)], steps[min(index + 1, len(steps) - 1)])
    found = minimize_scalar(lambda each: blur_cost(blurs, lens, width_px, float(each)), bounds=between, method="bounded")
    dioptres, cost = float(found.x), float(found.fun)
    # The error of one edge is sigma / k; of all together, where they err on their own.
    per_dioptre = lens.focused_at(1.0 / dioptres if dioptres > 0 else np.inf).coc_px_per_dioptre(width_px)
    spread = max(1.0, 2.0 * cost / len(blurs)) ** 0.5
    return FocusCandidate(dioptres, cost, spread / (per_dioptre * float(np.sqrt(np.sum(blurs.sigma_px**-2.0)))))


# Half the squares by which one answer must fit better, in units of their variance: a likelihood ratio of e^10.
_CLEARLY_BETTER = 10.0
_SAME_PX = 2.0


@dataclass(frozen=True)
class FocusEvidence:
    """Blurs by which two answers are told apart.

    now: the blurs of this frame, before: those of earlier ones with this focus, from which the camera may have moved.

    settled_dioptres: the last answer. width_px: of the pictures.
    """

    now: EdgeBlurs
    before: Sequence[EdgeBlurs]
    lens: Lens
    width_px: int
    settled_dioptres: float | None = None


def settled(candidates: Sequence[FocusCandidate], evidence: FocusEvidence) -> FocusCandidate | None:
    """Choose by this frame's depths, else by earlier frames, else by the answer before; None if nothing tells.

    Two answers within a pixel of the board's own depth need not be told apart: their middle is as good.
    """
    if len(candidates) < 2:
        return candidates[0] if candidates else None
    best, other = candidates
    lens, width_px = evidence.lens, evidence.width_px
    if abs(best.dioptres - other.dioptres) * lens.coc_px_per_dioptre(width_px) < _SAME_PX:
        apart = abs(best.dioptres - other.dioptres)
        return replace(best, dioptres=(best.dioptres + other.dioptres) / 2.0, sigma_dioptres=best.sigma_dioptres + apart / 2.0)
    # Where the model itself fits badly, differences count for less.
    needed = _CLEARLY_BETTER * max(1.0, 2.0 * best.cost / len(evidence.now))
    if other.cost - best.cost > needed:
        return best
    lead = sum(
        sign * total_cost([evidence.now, *evidence.before], lens, width_px, each.dioptres) for sign, each in ((1, other), (-1, best))
    )
    if abs(lead) > needed:
        return best if lead > 0 else other
    before = evidence.settled_dioptres
    return None if before is None else min(candidates, key=lambda each: abs(each.dioptres - before))


_POLL_S = 0.1
_LEAVE_S = 3.0
_REMEMBERED = 6
_REMEMBERED_S = 5.0
_GREEN = 1

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class BlurSettings:
    """Settings of BlurOfBoardFocus.

    every_s: between two answers. hold_s: an answer holds so long without a new one. sharpest_px: sigma of the blur that this camera
    leaves at its best focus, in the pixels of its frames. least_quality: poses below it are not used.
    """

    every_s: float = 0.7
    hold_s: float = 5.0
    sharpest_px: float = 0.5
    least_quality: float = 0.3


class BlurOfBoardFocus:
    """FocusSource. lens: the focal length, f-number and sensor; its focus is what is looked for. `follow` tells when one changes.

    intrinsics: of the camera, in any size of its frames. answer: the last one, with its standard deviation; candidates: what it was
    chosen from (both sides of the board, where its tilt does not tell them apart).
    """

    name = "blur of the board"

    def __init__(self, board: CharucoBoard, lens: Lens, intrinsics: Camera, settings: BlurSettings | None = None) -> None:
        self.lens, self._intrinsics, self._settings = lens, intrinsics, settings or BlurSettings()
        self._changing = Lock()
        self._edges = board_edges(board)
        self.answer: FocusCandidate | None = None
        self.candidates: tuple[FocusCandidate, ...] = ()
        self._answered_s, self._asked_s = -np.inf, -np.inf
        self._before: deque[tuple[float, EdgeBlurs]] = deque(maxlen=_REMEMBERED)
        self._frames: Newest[tuple[CameraFrame, TrackedPose]] = Newest()
        self._stopping = Event()
        self._thread = Thread(target=self._run, name="focus from blur", daemon=True)
        self._thread.start()

    def follow(self, lens: Lens, intrinsics: Camera) -> None:
        """Take the lens and the camera as they are now. What was learned with others is forgotten: their blurs mean another focus."""
        if _optics(lens, intrinsics) == _optics(self.lens, self._intrinsics):
            return
        with self._changing:
            self.lens, self._intrinsics = lens, intrinsics
            self.answer, self._answered_s, self._asked_s = None, -np.inf, -np.inf
            self._before.clear()

    def state(self, frame: CameraFrame, pose: TrackedPose | None) -> LensState:
        """Hand the frame to the thread now and then; return what it found last."""
        usable = pose is not None and pose.captured_s == frame.captured_s and pose.quality >= self._settings.least_quality
        if pose is not None and usable and frame.captured_s - self._asked_s >= self._settings.every_s:
            self._asked_s = frame.captured_s
            self._frames.put((frame, pose))
        answer, age_s = self.answer, frame.captured_s - self._answered_s
        return LensState(answer.focus_distance_m if answer is not None and age_s <= self._settings.hold_s else None)

    def solve(self, frame: CameraFrame, pose: TrackedPose) -> FocusCandidate | None:
        """Solve the focus from one frame and those before, while the caller waits; the thread does the same."""
        height_px, width_px = frame.bgr.shape[:2]
        with self._changing:
            lens, intrinsics, before = self.lens, self._intrinsics, tuple(self._before)
            last = self.answer.dioptres if self.answer is not None and frame.captured_s - self._answered_s <= _REMEMBERED_S else None
        resized = intrinsics.resized(width_px, height_px)
        camera = Camera(
            width_px=width_px,
            height_px=height_px,
            focal_px=resized.focal_px,
            principal_px=resized.principal_px,
            camera_from_world=pose.camera_from_world,
        )
        blurs = edge_blurs(_linear_green(frame.bgr), camera, self._edges, self._settings.sharpest_px)
        self.candidates = focus_candidates(blurs, lens, width_px)
        if not self.candidates:
            return None
        recent = [each for when_s, each in before if 0.0 <= frame.captured_s - when_s <= _REMEMBERED_S]
        found = settled(self.candidates, FocusEvidence(now=blurs, before=recent, lens=lens, width_px=width_px, settled_dioptres=last))
        with self._changing:
            if self.lens is not lens:
                return None
            self._before.append((frame.captured_s, blurs))
            if found is not None:
                self.answer, self._answered_s = found, frame.captured_s
        return found

    def close(self) -> None:
        self._stopping.set()
        self._thread.join(_LEAVE_S)

    def _run(self) -> None:
        while not self._stopping.is_set():
            waiting: Any = self._frames.take(_POLL_S)
            if waiting is None:
                continue
            try:
                self.solve(*waiting)
            except Exception:
                # One odd frame must not end this for good.
                log.exception("the focus could not be solved from the blur of the board")


def _optics(lens: Lens, intrinsics: Camera) -> tuple[float, ...]:
    """Return what the size of a blur at a known focus depends on, whatever the size of the frames."""
    (fx, fy), (cx, cy) = intrinsics.focal_px, intrinsics.principal_px
    width, height = intrinsics.width_px, intrinsics.height_px
    of_camera = (round(each, 6) for each in (fx / width, fy / height, cx / width, cy / height))
    return lens.focal_length_mm, lens.f_number, lens.sensor_width_mm, *of_camera


def _linear_green(bgr: np.ndarray) -> Float32[np.ndarray, "height width"]:
    """Return linear green: one colour, because colours are focused and placed a little apart; green is most of what is seen."""
    return cv2.LUT(np.ascontiguousarray(bgr[..., _GREEN]), _LINEAR_OF_CODE).reshape(bgr.shape[:2])


_LINEAR_OF_CODE = srgb_to_linear(np.arange(256, dtype=np.float32) / 255.0)


class FollowingOptics:
    """FocusSource of the blur of the board with the lens that the page was told last; optics: None before the first picture."""

    def __init__(self, blur: BlurOfBoardFocus, optics: Callable[[], tuple[Lens, Camera] | None]) -> None:
        self.blur, self.name, self._optics = blur, blur.name, optics

    def state(self, frame: CameraFrame, pose: TrackedPose | None) -> LensState:
        now = self._optics()
        if now is None:
            return LensState()
        self.blur.follow(*now)
        return self.blur.state(frame, pose)

    def close(self) -> None:
        self.blur.close()

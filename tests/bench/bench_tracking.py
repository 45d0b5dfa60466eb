"""How exact and how fast a board is tracked: `python -m tests.bench.bench_tracking [FRAMES]`.

A traced, hand-held clip of 1280x720 (30 frames unless told otherwise) of the board of two scales at 0.6 m, in focus (f/8) and out
of focus (f/1.8 focused at 0.8 m): error of the pose against the exact one, and of points 5 to 15 cm above the board in the picture.
Peer: a search in every frame, as OpenCV's samples do it. Then a real, dark, hand-held clip where it lies beside the checkout.
Times are of the processor, one thread of OpenCV.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.tracking.charuco.board import CharucoBoard, CharucoGrid
from mrbokeh.tracking.charuco.board_alignment import AlignedDetector, aligned_corners
from mrbokeh.tracking.charuco.detector import CharucoDetector, Grey, flow
from mrbokeh.tracking.charuco.pose_from_points import poses_from_plane
from mrbokeh.video.clip import read_display_frames
from tests.bench.machine import tell
from tests.support.told_parts import ImmediateDetections
from tests.support.traced_board_clip import BOARD, LENS, PoseError, camera_frames, clip_of, pose_error
from viewfinder.frames import CameraFrame
from viewfinder.tracking.charuco_tracker import CharucoTracker, Detector
from viewfinder.tracking.tracker import TrackedPose

FRAMES = 30
REAL_CLIP = Path(__file__).resolve().parents[3] / "shared" / "data" / "video" / "charuco_handheld.mp4"
REAL_BOARD = CharucoBoard((CharucoGrid((5, 5), 28.8, 21.6),))
REAL_FOCAL_PX = 300.0

Frames = list[tuple[CameraFrame, Camera]]


def main() -> None:
    cv2.setNumThreads(1)
    frames = int(sys.argv[1]) if len(sys.argv) > 1 else FRAMES
    for name, lens in (("in focus", LENS), ("out of focus", replace(LENS, f_number=1.8, focus_distance_m=0.8))):
        _traced(name, lens, frames)
    if REAL_CLIP.is_file():
        _real()
    tell()


def _traced(name: str, lens: Lens, frames: int) -> None:
    clip = list(camera_frames(clip_of(1280, 720, frames, lens)))
    blurs_px = [abs(float(lens.coc_px(true.project(BOARD.corners_m.mean(axis=0))[1], 1280))) for _, true in clip]
    print(f"{frames} traced frames of 1280x720, {name}: blur in the middle of the board {min(blurs_px):.1f} to {max(blurs_px):.1f} px")
    _errors("corners as read, a search in every frame", clip, CharucoDetector(BOARD), 1)
    each = _errors("aligned, a search in every frame", clip, AlignedDetector(BOARD), 1)
    fourth = _errors("aligned, a search in every 4th frame, flow between", clip, AlignedDetector(BOARD), 4)
    _errors("aligned, a search in the first frame only", clip, AlignedDetector(BOARD), frames)
    print(f"  against a search in every frame: {fourth / each:.2f} of the time")
    _stages(clip)
    _live(clip)


def _live(clip: Frames) -> None:
    """The clip at its 30 frames per second, there and back, with searches in their thread."""
    tracker = CharucoTracker(BOARD)
    there_and_back = [*clip, *clip[::-1]] * max(1, 60 // len(clip))
    took_ms, fresh, started_s = [], [], time.monotonic()
    for number, (frame, true) in enumerate(there_and_back):
        time.sleep(max(0.0, started_s + number / 30.0 - time.monotonic()))
        now = replace(frame, sequence=number, captured_s=number / 30.0)
        called_s = time.perf_counter()
        pose = tracker.track(now, true)
        took_ms.append(1000.0 * (time.perf_counter() - called_s))
        fresh += [(pose, true)] if pose is not None and _is_of(pose, now) else []
    tracker.close()
    middle, slow = np.percentile(took_ms, (50, 95))
    print(f"  live, searches in their thread: {len(fresh)} of {len(there_and_back)} frames tracked, ", end="")
    print(f"{middle:.1f} ms a frame (95 %: {slow:.1f}); {_worst(fresh)}")


def _errors(what: str, clip: Frames, detector: Detector, every: int) -> float:
    """Prints a line; milliseconds per frame."""
    tracker = CharucoTracker(BOARD, ImmediateDetections(detector, every))
    started_s = time.process_time()
    poses = [tracker.track(frame, true) for frame, true in clip]
    took_ms = 1000.0 * (time.process_time() - started_s) / len(clip)
    fresh = [(pose, true) for pose, (frame, true) in zip(poses, clip, strict=True) if pose is not None and _is_of(pose, frame)]
    print(f"  {what}: {len(fresh)} of {len(clip)} frames tracked, {took_ms:.1f} ms a frame; {_worst(fresh)}")
    return took_ms


def _is_of(pose: TrackedPose, frame: CameraFrame) -> bool:
    return pose.captured_s == frame.captured_s


def _worst(fresh: list[tuple[TrackedPose, Camera]]) -> str:
    if not fresh:
        return "no pose"
    errors = [pose_error(pose.camera_from_world, true) for pose, true in fresh]
    parts: tuple[tuple[str, str, Callable[[PoseError], float]], ...] = (
        ("turn", "degrees", lambda error: error.turn_deg),
        ("place", "mm", lambda error: error.place_mm),
        ("object", "px", lambda error: error.object_px),
    )
    words = [f"{what} {np.mean([of(e) for e in errors]):.3f} (worst {max(of(e) for e in errors):.3f}) {unit}" for what, unit, of in parts]
    points, quality = (np.mean([getattr(pose, name) for pose, _ in fresh]) for name in ("points", "quality"))
    return f"{', '.join(words)}; {points:.0f} corners, quality {quality:.2f}"


def _stages(clip: Frames) -> None:
    greys = [_grey(frame) for frame, _ in clip]
    detector = CharucoDetector(BOARD)
    found = [detector.detect(grey) for grey in greys[:10]]
    stages = (
        ("grey", lambda: [_grey(frame) for frame, _ in clip], len(clip)),
        ("search", lambda: [detector.detect(grey) for grey in greys[:10]], len(found)),
        ("alignment", lambda: [aligned_corners(BOARD, grey, read) for grey, read in zip(greys, found, strict=False)], len(found)),
        ("flow", lambda: [flow(a, b, at.xy_px) for a, b, at in zip(greys, greys[1:], found, strict=False)], len(found)),
        ("pose", lambda: [poses_from_plane(BOARD.corners_m[at.ids], at.xy_px, clip[0][1]) for at in found], len(found)),
    )
    times = []
    for name, work, count in stages:
        started_s = time.process_time()
        work()
        times.append(f"{name} {1000.0 * (time.process_time() - started_s) / count:.2f}")
    print(f"  ms a frame: {', '.join(times)}")


def _grey(frame: CameraFrame) -> Grey:
    return cv2.cvtColor(frame.bgr, cv2.COLOR_BGR2GRAY)


def _real() -> None:
    pictures = [frame.bgr for frame in read_display_frames(REAL_CLIP, 320, 180)]
    camera = Camera(320, 180, (REAL_FOCAL_PX, REAL_FOCAL_PX), (160.0, 90.0))
    for every in (1, 6):
        tracker = CharucoTracker(REAL_BOARD, ImmediateDetections(AlignedDetector(REAL_BOARD), every))
        started_s = time.process_time()
        poses = [tracker.track(CameraFrame(bgr, number / 60.0, number), camera) for number, bgr in enumerate(pictures)]
        took_ms = 1000.0 * (time.process_time() - started_s) / len(pictures)
        fresh = [pose for number, pose in enumerate(poses) if pose is not None and pose.captured_s == number / 60.0]
        residuals = [pose.residual_px for pose in fresh]
        print(
            f"{REAL_CLIP.name}, a search every {every}: {len(fresh) / len(pictures):.0%} of {len(pictures)} frames tracked, "
            f"{took_ms:.1f} ms a frame, residual {np.mean(residuals):.2f} px (95 %: {np.percentile(residuals, 95):.2f})"
        )


if __name__ == "__main__":
    main()

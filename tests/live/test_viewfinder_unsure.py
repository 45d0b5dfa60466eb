"""A pose that is not certain: the object goes away, the page is told, nothing is captured or measured by it."""

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.compositing.overlay import Overlay
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.system.errors import InputError
from tests.scenes.layer_viewfinder import HEIGHT, LENS, WIDTH, bright_square
from tests.scenes.stage_scenes import LENS as SCENE_LENS
from tests.scenes.stage_scenes import ONE_CARD, backend, camera, scene_file
from tests.scenes.told_parts import ToldTracker
from viewfinder.app.live_compositor import LiveCompositor
from viewfinder.app.live_controls import Captures
from viewfinder.app.opening import LensBook, Parts
from viewfinder.focus.sources import ManualFocus
from viewfinder.frames import CameraFrame, frame_header
from viewfinder.options import ViewfinderOptions
from viewfinder.sources.playback import PatternSource
from viewfinder.stage.stage import FADE_S, Stage
from viewfinder.stage.static_layer import StaticLayer
from viewfinder.tracking.smoothing import SmoothedTracker
from viewfinder.tracking.tracker import TrackedPose


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    with_stage = Stage(scene_file(tmp_path, ONE_CARD), backend())
    yield with_stage
    with_stage.close()


def shown(stage: Stage, is_certain: bool, time_s: float) -> Overlay:
    pose = TrackedPose(camera().camera_from_world, 0.2, time_s, is_certain=is_certain)
    return stage.overlay(pose, camera(), SCENE_LENS, time_s)


def test_an_unsure_pose_shows_nothing_at_first_and_fades_what_was_there(stage: Stage) -> None:
    """Before any certain pose nothing appears; after one, the object is gone within the half second of a lost track, and comes back."""
    assert shown(stage, False, 0.0).shines_through.size == 0
    frames = iter(range(1, 6000))
    while stage.status.layer_age_ms is None:
        shown(stage, True, next(frames) / 30.0)
        time.sleep(0.01)
    time_s = next(frames) / 30.0 + 1.0
    assert shown(stage, True, time_s).shines_through.min() < 0.1
    assert shown(stage, False, time_s + 0.5 * FADE_S).shines_through.min() == pytest.approx(0.5, abs=0.06)
    assert shown(stage, False, time_s + FADE_S).shines_through.size == 0
    assert shown(stage, True, time_s + 2.5 * FADE_S).shines_through.min() < 0.1


def test_the_page_is_told_and_nothing_is_captured(tmp_path: Path) -> None:
    tracker = ToldTracker(lambda frame: TrackedPose(np.eye(4), 0.2, frame.captured_s, is_certain=frame.sequence == 0))
    lenses = LensBook({"test": LENS})
    still = StaticLayer(bright_square(), LENS, ScatterReference(), "scatter")
    parts = Parts(ViewfinderOptions("test"), PatternSource(WIDTH, HEIGHT), still, lenses, {"scatter": ScatterReference})
    compositor = LiveCompositor(parts, ManualFocus(), tracker)
    captures = Captures(tmp_path, compositor, "scatter")
    plate = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    try:
        certain = compositor(CameraFrame(plate, 1.0, 0), 0)
        unsure = compositor(CameraFrame(plate, 2.0, 1), 0)
        with pytest.raises(InputError, match="pose is not known now"):
            captures.capture()
    finally:
        compositor.close()
    headers = [frame_header(each) for each in (certain, unsure)]
    assert [(each["tracking"], each["tracking_unsure"]) for each in headers] == [(0.2, False), (0.2, True)]
    assert compositor.last_tracked is not None and compositor.last_tracked.frame.sequence == 0


def test_smoothing_does_not_glide_from_a_wrong_pose_to_the_right_one() -> None:
    """An unsure pose is given as it comes, and the next certain one, too."""
    wrong, right = np.eye(4), np.eye(4)
    wrong[:3, 3], right[:3, 3] = (0.0, 0.0, 1.0), (0.1, 0.0, 1.0)
    poses = [wrong, wrong, right]
    inner = ToldTracker(lambda frame: TrackedPose(poses[frame.sequence], 0.2, frame.captured_s, is_certain=frame.sequence == 2))
    smoothed = SmoothedTracker(inner, smoothing=True)
    for number, pose in enumerate(poses):
        given = smoothed.track(CameraFrame(np.zeros((4, 4, 3), np.uint8), number / 30.0, number), camera())
        np.testing.assert_allclose(given.camera_from_world, pose, atol=1e-12)

"""Captures: as large as the camera can, of the newest picture whose pose is known."""

from pathlib import Path

import numpy as np
import pytest

from mrbokeh.compositing.overlay import Overlay
from mrbokeh.images.layer import Layer, clear
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.capture_bundle import read_bundle
from mrbokeh.system.errors import InputError
from viewfinder.app.live_compositor import CompositedFrame, LiveCompositor
from viewfinder.app.live_controls import Captures
from viewfinder.frames import CameraFrame, FrameStatus, OutputFrame
from viewfinder.tracking.tracker import TrackedPose

LENS = Lens(50.0, 2.0, 2.0, 36.0)
SMALL, LARGE = Camera(40, 30, (50.0, 52.0), (20.0, 15.0)), Camera(160, 120, (200.0, 208.0), (80.0, 60.0))


class OverlaySource:
    def sharp_layers(self, camera: Camera) -> list[Layer]:
        self.camera = camera
        return [clear(camera.height_px, camera.width_px)]


class Compositor(LiveCompositor):
    """Only what captures ask of one."""

    transfer = "srgb"  # type: ignore[assignment]

    def __init__(self) -> None:
        self.overlays = OverlaySource()  # type: ignore[assignment]
        self.last = self.last_tracked = None


def moment(captured_s: float, tracked: bool, value: int) -> CompositedFrame:
    """A picture of 40x30 px, of which the camera has 160x120 in another grey."""
    bgr, full = np.full((30, 40, 3), value, np.uint8), np.full((120, 160, 3), value + 1, np.uint8)
    frame = CameraFrame(bgr, captured_s, int(10 * captured_s), full_picture=lambda: full)
    output = OutputFrame(bgr, captured_s, frame.sequence, FrameStatus(2.0, 2.0))
    pose = TrackedPose(np.eye(4), 0.8, captured_s) if tracked else None
    return CompositedFrame(frame, output, Overlay.of(clear(30, 40)), SMALL, LENS, pose)


@pytest.fixture
def compositor() -> Compositor:
    return Compositor()


def test_the_plate_is_as_large_as_the_camera_can(compositor: Compositor, tmp_path: Path) -> None:
    compositor.last = compositor.last_tracked = moment(1.0, True, 100)
    bundle = read_bundle(tmp_path / Captures(tmp_path, compositor, "polygon").capture())
    assert bundle.plate_rgb.shape == (120, 160, 3)
    assert (bundle.camera.focal_px, bundle.camera.principal_px) == (LARGE.focal_px, LARGE.principal_px), "intrinsics follow the size"


def test_a_track_that_was_lost_just_now_does_not_cost_the_picture(compositor: Compositor, tmp_path: Path) -> None:
    compositor.last, compositor.last_tracked = moment(1.3, False, 50), moment(1.0, True, 100)
    captures = Captures(tmp_path, compositor, "polygon")
    assert read_bundle(tmp_path / captures.capture()).facts["sequence"] == 10
    compositor.last = moment(2.5, False, 50)
    with pytest.raises(InputError, match="pose is not known now"):
        captures.capture()


def test_before_the_first_picture_there_is_nothing(compositor: Compositor, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nothing to capture yet"):
        Captures(tmp_path, compositor, "polygon").capture()
    assert not list(tmp_path.iterdir())

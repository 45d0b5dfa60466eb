"""Captures: as large as the camera can, of the newest picture whose pose is known; bundles come back and composite like their parts."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mrbokeh.compositing.open_plate import bundle_plate
from mrbokeh.compositing.over import OverPhotograph
from mrbokeh.compositing.overlay import Overlay
from mrbokeh.images.color import linear_to_srgb
from mrbokeh.images.image_io import read_image
from mrbokeh.images.layer import Layer, clear
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from mrbokeh.stacks.capture_bundle import is_bundle, read_bundle, write_bundle
from mrbokeh.system.errors import InputError
from tests.support.command_line import mrbokeh
from tests.support.refusals import refused
from viewfinder.app.live_compositor import CompositedFrame, LiveCompositor
from viewfinder.app.live_controls import Captures
from viewfinder.frames import CameraFrame, FrameStatus, OutputFrame
from viewfinder.tracking.tracker import TrackedPose

SIZE = (48, 64)
LENS = Lens(50.0, 2.0, 2.0, 12.0)
CAMERA = Camera(64, 48, (270.0, 270.0), (32.0, 24.0), np.array([[1, 0, 0, 0.1], [0, 1, 0, 0.2], [0, 0, 1, 1.5], [0, 0, 0, 1.0]]))


def sharp_square() -> Layer:
    alpha = np.zeros(SIZE, np.float32)
    alpha[16:30, 20:40] = 1.0
    return Layer(np.repeat(0.5 * alpha[..., None], 3, axis=2), alpha, np.where(alpha > 0, np.float32(1.6), np.float32(np.inf)))


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    ramp = np.repeat(np.linspace(20, 220, 64)[None, :, None], 48, axis=0).repeat(3, axis=2).astype(np.uint8)
    png, jpg = (cv2.imencode(suffix, ramp)[1].tobytes() for suffix in (".png", ".jpg"))
    folder = tmp_path / "captures" / "one"
    write_bundle(folder, png, jpg, [sharp_square()], LENS, CAMERA, "polygon", {"sequence": 7})
    return folder


def test_what_was_captured_comes_back(bundle: Path) -> None:
    assert is_bundle(bundle) and not is_bundle(bundle.parent)
    found = read_bundle(bundle)
    np.testing.assert_allclose(found.camera.camera_from_world, CAMERA.camera_from_world)
    assert replace(found.lens, aperture=LENS.aperture) == LENS and found.renderer == "polygon" and found.facts["sequence"] == 7
    np.testing.assert_allclose(linear_to_srgb(found.plate_rgb)[0, [0, -1], 0] * 255.0, [20.0, 220.0], atol=0.01)
    np.testing.assert_array_equal(found.layers[0].depth_m, sharp_square().depth_m)


def test_a_bundle_composites_like_its_parts(bundle: Path, tmp_path: Path) -> None:
    done = mrbokeh("composite", bundle, "--out", tmp_path / "out.exr")
    assert done.returncode == 0, done.stderr
    plate = bundle_plate(read_bundle(bundle))
    expected = OverPhotograph().insert(plate, [sharp_square()], PolygonDifferences()).rgb
    np.testing.assert_allclose(read_image(tmp_path / "out.exr"), expected, atol=1e-3, rtol=1e-3)  # half precision


def test_a_folder_appears_whole_or_not_at_all(bundle: Path) -> None:
    refused("exists already", write_bundle, bundle, b"", b"", [], LENS, CAMERA, "polygon", {})
    with pytest.raises(TypeError):
        write_bundle(bundle.parent / "two", b"", b"", [], LENS, CAMERA, "polygon", {"not JSON": object()})
    assert [path.name for path in bundle.parent.iterdir()] == ["one"]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"version": 2}, "capture again"),
        ({"plate": "../plate.png"}, "names of files beside it"),
        ({"camera": {}}, "expected width_px"),
        ({"layers": ["layer_9.exr"]}, "layer_9.exr"),
    ],
)
def test_broken_bundles_are_refused(bundle: Path, change: dict[str, object], sentence: str) -> None:
    path = bundle / "bundle.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    refused(sentence, read_bundle, bundle)


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
    refused("pose is not known now", captures.capture)


def test_before_the_first_picture_there_is_nothing(compositor: Compositor, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nothing to capture yet"):
        Captures(tmp_path, compositor, "polygon").capture()
    assert not list(tmp_path.iterdir())

"""What other programs get: OBS the virtual layer as colour above alpha, and any of them a virtual webcam."""

import sys
import threading
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mrbokeh.compositing.overlay import Overlay, code_tables
from mrbokeh.images.image_io import write_layer
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.video.color import code_from_linear
from tests.support.layer_viewfinder import HEIGHT, LENS, WIDTH, bright_square, write_plate
from tests.support.refusals import refused
from tests.support.streaming_viewers import ignore, output, streaming, taken
from tests.support.waiting import wait_until
from viewfinder.app.running import opened as serving
from viewfinder.frames import FrameStatus, OutputFrame
from viewfinder.options import ViewfinderOptions
from viewfinder.server.access import Access
from viewfinder.streaming.other_programs import AlphaStream, VirtualWebcam, color_over_alpha, fitted


def overlay(light: list[float], alpha: float, rows: int = 4, top_px: int = 2) -> Overlay:
    rgb = np.broadcast_to(np.array(light, np.float32), (rows, 6, 3)).copy()
    return Overlay(top_px, 1, rgb, np.full((rows, 6), 1 - alpha, np.float32))


@pytest.mark.parametrize(
    ("light", "alpha", "surface", "glow"),
    [
        # An opaque surface shows its own code; half covered, half of that; light without coverage adds its own code.
        ([0.5, 0.2, 0.1], 1.0, [0.5, 0.2, 0.1], [0, 0, 0]),
        ([0.25, 0.1, 0.05], 0.5, [0.5, 0.2, 0.1], [0, 0, 0]),
        ([0.3, 0.0, 0.2], 0.0, [0, 0, 0], [0.3, 0.0, 0.2]),
        # 0.6 on half coverage: as white as the surface can be, and 0.1 of glow.
        ([0.6, 0.1, 0.0], 0.5, [1.0, 0.2, 0.0], [0.1, 0, 0]),
    ],
)
def test_halves_hold_premultiplied_codes_and_alpha(light: list[float], alpha: float, surface: list[float], glow: list[float]) -> None:
    picture = color_over_alpha(overlay(light, alpha), 10, 8, "srgb")
    assert picture.shape == (16, 10, 3)
    codes = alpha * code_from_linear(np.array(surface, np.float32), "srgb") + code_from_linear(np.array(glow, np.float32), "srgb")
    np.testing.assert_allclose(picture[3, 3, ::-1], np.minimum(255 * codes, 255), atol=0.51)
    assert picture[8 + 3, 3].tolist() == [round(255 * alpha)] * 3
    # Nothing lies outside the box of the overlay, in neither half.
    outside = np.ones((8, 10), bool)
    outside[2:6, 1:7] = False
    assert not picture[:8][outside].any() and not picture[8:][outside].any()


def test_over_a_camera_it_gives_what_our_own_composite_gives_where_alpha_is_whole() -> None:
    plate, layer = np.full((8, 10, 3), 90, np.uint8), overlay([0.5, 0.2, 0.1], 1.0)
    picture = color_over_alpha(layer, 10, 8, "srgb").astype(int)
    composite = np.rint(picture[:8] + plate * (1 - picture[8:] / 255))
    np.testing.assert_allclose(composite, layer.over_codes(plate, code_tables("srgb")), atol=1)


def test_an_odd_height_and_an_empty_overlay_are_no_trouble() -> None:
    picture = color_over_alpha(overlay([0.5, 0.5, 0.5], 1.0, rows=4, top_px=5), 10, 9, "srgb")
    # The ninth row is left out, so that the seam lies between two rows of chroma.
    assert picture.shape == (16, 10, 3) and picture[5:8, 1:7].all() and picture[8 + 5 : 16, 1:7].all() and not picture[8 : 8 + 5].any()
    empty = Overlay(0, 0, np.zeros((0, 0, 3), np.float32), np.zeros((0, 0), np.float32))
    assert not color_over_alpha(empty, 10, 8, "srgb").any()


def test_pictures_go_to_a_stream_of_their_own_with_the_times_of_the_camera() -> None:
    with streaming() as stream:
        alpha = AlphaStream(stream, "srgb")
        assert not alpha.wants_frame
        viewer = stream.watch("H264", ignore)
        assert alpha.wants_frame
        alpha.show(overlay([0.5, 0.5, 0.5], 1.0), output(np.zeros((90, 160, 3), np.uint8), 7, 12.5))
        wait_until(lambda: viewer.waiting)
        (frame,) = taken(viewer)
        assert (frame.captured_s, frame.header["sequence"]) == (12.5, 7)
        assert stream._encoders["H264"].size_px == (160, 180)
        alpha.fail("the camera was unplugged")
        assert viewer.failure == "the camera was unplugged"
        alpha.close()
    assert not any(thread.name in ("alpha", "encode") for thread in threading.enumerate())


@dataclass
class FakeCamera:
    """pyvirtualcam.Camera as version 0.15 has it: positional size and rate, a fixed size, frames copied at once."""

    width: int
    height: int
    fps: float
    fmt: Any
    device: Any
    sent: list[np.ndarray] = field(default_factory=list)
    closed: bool = False

    def send(self, frame: np.ndarray) -> None:
        assert not self.closed and frame.shape == (self.height, self.width, 3) and frame.dtype == np.uint8 and frame.flags.c_contiguous
        self.sent.append(frame.copy())

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[FakeCamera]:
    """What was opened at the library's border, in order."""
    devices: list[FakeCamera] = []

    def camera(width: int, height: int, fps: float, *, fmt: Any, device: str | None = None) -> FakeCamera:
        assert all(each.closed for each in devices), "a device is opened by one at a time"
        devices.append(FakeCamera(width, height, fps, fmt, device or "/dev/video9"))
        return devices[-1]

    monkeypatch.setitem(sys.modules, "pyvirtualcam", SimpleNamespace(Camera=camera, PixelFormat=SimpleNamespace(BGR="bgr")))
    return devices


def picture(width_px: int, height_px: int, code: int) -> OutputFrame:
    return OutputFrame(np.full((height_px, width_px, 3), (code, 0, 7), np.uint8), 0.0, 0, FrameStatus(1.0, 2.0))


def test_pictures_arrive_in_the_size_of_the_first(opened: list[FakeCamera]) -> None:
    """160x90 first; then 80x90, which fits into it with 40 black columns at either side. Blue stays first."""
    webcam = VirtualWebcam()
    assert (webcam.name, opened[0].closed) == ("/dev/video9", True)
    webcam.show(picture(160, 90, 200))
    wait_until(lambda: len(opened) == 2 and opened[1].sent)
    webcam.show(picture(80, 90, 100))
    wait_until(lambda: len(opened[1].sent) == 2)
    webcam.close()
    wide, device = fitted(np.full((10, 40, 3), 9, np.uint8), 20, 20), opened[1]
    assert wide.shape == (20, 20, 3) and not wide[:7].any() and (wide[8:12] == 9).all() and not wide[13:].any()
    assert (device.width, device.height, device.fmt, device.device, device.closed) == (160, 90, "bgr", "/dev/video9", True)
    np.testing.assert_array_equal(device.sent[0], np.full((90, 160, 3), (200, 0, 7), np.uint8))
    assert not device.sent[1][:, :40].any() and not device.sent[1][:, 120:].any()
    np.testing.assert_array_equal(device.sent[1][:, 40:120], np.full((90, 80, 3), (100, 0, 7), np.uint8))


def test_a_device_that_is_unplugged_ends_it_with_a_sentence(opened: list[FakeCamera], caplog: pytest.LogCaptureFixture) -> None:
    webcam = VirtualWebcam("/dev/video7")
    webcam.show(picture(16, 8, 1))
    wait_until(lambda: len(opened) == 2 and opened[1].sent)
    opened[1].send = lambda _frame: (_ for _ in ()).throw(OSError("no such device"))  # type: ignore[method-assign,assignment]
    webcam.show(picture(16, 8, 2))
    wait_until(lambda: webcam.failure)
    assert webcam.failure == "the virtual webcam /dev/video7 takes no more pictures: no such device" and not webcam.wants_frame
    webcam.close()
    assert opened[1].closed and "the virtual webcam failed" in caplog.text


def test_without_the_package_it_says_how_to_get_it_and_without_a_device_what_to_load(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyvirtualcam", None)
    refused("pip install pyvirtualcam", VirtualWebcam)
    # Nothing is faked here: pyvirtualcam itself looks for the device.
    monkeypatch.undo()
    pytest.importorskip("pyvirtualcam")
    refused(r"the virtual webcam no-such-device could not be opened .*: on Linux load one with", VirtualWebcam, "no-such-device")


def test_the_webcam_shows_what_the_viewfinder_composites(opened: list[FakeCamera], tmp_path: Path) -> None:
    """A whole viewfinder that nobody watches: the plate comes out at its border, the red square in its middle."""
    clip, plate_bgr = write_plate(tmp_path)
    write_layer(tmp_path / "layer.exr", bright_square())
    write_lens(tmp_path / "lens.json", LENS)
    options = ViewfinderOptions(str(clip), layer=tmp_path / "layer.exr", lenses=(tmp_path / "lens.json",), captures=tmp_path, webcam="auto")
    with serving(options, Access()) as viewfinder:
        assert viewfinder.webcam is not None and viewfinder.webcam.name == "/dev/video9"
        wait_until(lambda: len(opened) == 2 and len(opened[1].sent) > 3)
    shown = opened[1].sent[-1]
    assert opened[1].closed and shown.shape == (HEIGHT, WIDTH, 3)
    np.testing.assert_allclose(shown[5, 5], plate_bgr[5, 5], atol=3)
    # Light of 0.9, 0.1 and 0.05 in focus: red codes above 230.
    assert shown[45, 80, 2] > 230 > 120 > shown[45, 80, 0]

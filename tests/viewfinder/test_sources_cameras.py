"""Cameras on a cable that are pulled out and plugged in: a real OpenCV capture of a file in a webcam's place, libgphoto2's virtual
camera as far as it goes (it has no live view), a stand-in for its live view, and the pauses between attempts."""

import json
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event, Thread
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from mrbokeh.system.errors import InputError
from mrbokeh.video.color import linear_from_code
from tests.support.refusals import refused
from tests.support.video_files import filmed
from tests.tether.test_gphoto2 import StandIn, Widget, gp, in_own_interpreter
from viewfinder.frames import LensState
from viewfinder.sources.attached_camera import Gphoto2PreviewSource, WebcamSource
from viewfinder.sources.frame_source import CameraAwayError, SizeLimit, reconnecting
from viewfinder.sources.playback import newest_of

WIDTH, HEIGHT = 160, 112


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    return filmed(tmp_path / "clip.mkv", (linear_from_code(np.full((HEIGHT, WIDTH, 3), code), "bt709") for code in (0.2, 0.4, 0.6)))


def test_a_webcam_is_pulled_out_and_plugged_in_again(clip: Path) -> None:
    """The file ends after 3 frames as a camera does that is pulled out; twice there is nothing; then it is there again."""
    opened: list[Any] = []

    def plug(_index: int) -> Any:
        opened.append(cv2.VideoCapture(str(clip)) if len(opened) not in (1, 2) else None)
        return opened[-1]

    source, stopping = WebcamSource(3, SizeLimit(80), open_camera=plug), Event()
    assert source.status is None
    frames = source.frames(stopping)
    before = [next(frames) for _ in range(3)]
    with noted(source) as sentences:
        after = next(frames)
    assert [each.sequence for each in [*before, after]] == [0, 1, 2, 3]
    assert all(each.bgr.shape == (56, 80, 3) for each in [*before, after])
    assert {"camera 3 stopped giving pictures: plug it in again", "camera 3 is unplugged or in use: waiting for it"} <= set(sentences)
    assert source.status is None and len(opened) == 4
    np.testing.assert_array_equal(after.bgr, before[0].bgr)
    frames.close()  # type: ignore[attr-defined]
    assert not opened[0].isOpened() and not opened[3].isOpened()


def test_pauses_grow_and_start_again_after_success() -> None:
    waits: list[float] = []
    sessions = iter(["away", "away", "away", "there", "away", "away"])
    told: list[str | None] = []

    class Stopping(Event):
        def wait(self, timeout: float | None = None) -> bool:
            waits.append(timeout or 0.0)
            return False

    def session() -> Generator[int, None, None]:
        what = next(sessions, None)
        if what is None:
            stopping.set()
        elif what == "there":
            yield 1
        raise CameraAwayError("away")

    stopping = Stopping()
    assert list(reconnecting(session, stopping, told.append, first_pause_s=1.0)) == [1]
    # 1, 2, 4 s; the camera gives something, after which it is 1 s again.
    assert waits == [1.0, 2.0, 4.0, 1.0, 2.0, 4.0, 4.0][: len(waits)] and len(waits) == 7
    assert told == ["away"] * 3 + [None] + ["away"] * 4


def test_a_thread_hands_over_the_newest_and_its_failure() -> None:
    went_on = Event()

    def produce(_leaving: Event) -> Generator[int, None, None]:
        yield from range(100)
        went_on.set()
        time.sleep(0.2)
        yield 100
        raise InputError("broken")

    items = newest_of(produce, Event(), name="test drain")
    first = next(items)
    assert went_on.wait(5)
    got = [first]

    refused("broken", got.extend, items)
    # The last of the hundred comes, few of those before it do.
    assert got[-2:] == [99, 100] and got == sorted(got) and len(got) < 20


def test_the_thread_ends_when_nobody_asks_any_more() -> None:
    ended = Event()

    def produce(leaving: Event) -> Generator[int, None, None]:
        try:
            while not leaving.wait(0.01):
                yield 1
        finally:
            ended.set()

    items = newest_of(produce, Event(), name="test drain")
    assert next(items) == 1
    items.close()  # type: ignore[attr-defined]
    assert ended.wait(5)


SCRIPT = """
import json, sys, threading, warnings
warnings.simplefilter("error")
from mrbokeh.system.errors import InputError
from viewfinder.sources.choose import open_source
from viewfinder.sources.attached_camera import lens_state

def sentence(what):
    try:
        what()
    except InputError as error:
        return str(error)

source = open_source("gphoto2")
lens = lens_state(source._opened)
print(json.dumps({
    "lens": [lens.focus_distance_m, lens.f_number, lens.focal_length_mm],
    "preview": sentence(lambda: next(source.frames(threading.Event()))),
    "again": sentence(lambda: next(open_source("gphoto2:usb:001,001").frames(threading.Event()))),
    "port": sentence(lambda: open_source("gphoto2:usb:009,009")),
}))
"""


def test_the_virtual_camera_is_opened_and_tells_its_f_number(tmp_path: Path) -> None:
    """It sets out at some f-number above 1, has no focus distance, and refuses a live view, which is no reason to wait."""
    cv2.imwrite(str(tmp_path / "GPH_0001.JPG"), np.zeros((48, 64, 3), np.uint8))
    done = in_own_interpreter(SCRIPT, VCAMERADIR=str(tmp_path))
    if "no camera found" in done.stderr:
        pytest.skip("this build of libgphoto2 has no virtual camera (vusb)")
    assert done.returncode == 0, done.stderr
    answers = json.loads(done.stdout)
    assert answers["lens"][0] is None and answers["lens"][1] > 1 and answers["lens"][2] is None
    # The second time shows that the first one let go of the camera.
    assert "gives no live view" in answers["preview"] and "gives no live view" in answers["again"]
    assert "no camera at usb:009,009, only at Nikon DSC D750 at usb:001,001" in answers["port"]


@dataclass
class LiveCamera(StandIn):
    """`script` says what each look at it brings: a picture, or an error of libgphoto2."""

    script: list[Any] = field(default_factory=list)

    def capture_preview(self) -> Any:
        step = self.script.pop(0)
        if isinstance(step, int):
            raise gp.GPhoto2Error(step)
        return SimpleNamespace(get_data_and_size=lambda: step)


def jpeg(level: int) -> bytes:
    return cv2.imencode(".jpg", np.full((HEIGHT, WIDTH, 3), level, np.uint8))[1].tobytes()


def test_live_view_brings_pictures_and_the_lens() -> None:
    """Property 5009 of PTP is in mm, 5008 in 1/100 mm; busy (-110) and an empty picture are passed over; the mirror goes down again."""
    settings = {"viewfinder": 0, "f-number": "f/5.6", "5008": "3500", "5009": "1250"}
    camera = LiveCamera({name: Widget(value) for name, value in settings.items()}, script=[-110, b"", jpeg(40), jpeg(90)])
    source, stopping = Gphoto2PreviewSource(limit=SizeLimit(80), open_camera=lambda _port: camera), Event()
    frames = source.frames(stopping)
    first, second = next(frames), next(frames)
    assert first.lens == second.lens == LensState(1.25, 5.6, 35.0)
    assert first.bgr.shape == (56, 80, 3) and abs(int(first.bgr[5, 5, 0]) - 40) < 3 and abs(int(second.bgr[5, 5, 0]) - 90) < 3
    frames.close()
    assert camera.set_log == [("viewfinder", 1), ("viewfinder", 0)] and camera.exited


def test_a_tethered_camera_is_switched_off_and_on_again() -> None:
    """-52: the USB device is gone. While it is away opening fails; then it is there, focused at infinity."""
    away, at_infinity = CameraAwayError("no camera is found"), {"5009": Widget("65535")}
    cameras = [LiveCamera(at_infinity, script=[jpeg(40), -52]), away, LiveCamera(at_infinity, script=[jpeg(90), jpeg(90)])]

    def open_next(_port: str | None) -> Any:
        camera = cameras.pop(0)
        if isinstance(camera, CameraAwayError):
            raise camera
        return camera

    source, stopping = Gphoto2PreviewSource(open_camera=open_next), Event()
    frames = source.frames(stopping)
    assert next(frames).lens == LensState(focus_distance_m=float("inf"))
    with noted(source) as seen:
        after = next(frames)
    assert abs(int(after.bgr[5, 5, 0]) - 90) < 3 and after.sequence == 1 and source.status is None
    assert any("is away" in str(each) and "check the cable" in str(each) for each in seen) and "no camera is found" in seen
    frames.close()


@contextmanager
def noted(source: Any) -> Iterator[list[str | None]]:
    """What its status says meanwhile."""
    seen, ended = list[str | None](), Event()
    thread = Thread(target=lambda: [seen.append(source.status) for _ in iter(lambda: ended.wait(0.005), True)])
    thread.start()
    try:
        yield seen
    finally:
        ended.set()
        thread.join()


def test_no_camera_at_the_start_is_refused() -> None:
    refused(r"no camera found.*switch it on", Gphoto2PreviewSource)

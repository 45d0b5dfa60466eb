"""A phone on the hot shoe from end to end: calibrated by the command, then tracking a camera that sees nothing of the board; calibrated
from pairs of poses, applied to any tracker's poses."""

import asyncio
import re
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from threading import Event, Thread
from threading import enumerate as threads
from typing import Any

import av
import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mrbokeh.images.image_io import write_layer
from mrbokeh.images.layer import clear
from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import Channel
from tests.support.browser_sender import Canvas, sending
from tests.support.command_line import printed_by
from tests.support.phone_on_camera import CAMERA_FROM_PHONE, PHONE, VIEWS, camera_at, phone_at, picture, rig_error, view, write_files
from tests.support.refusals import refused
from tests.support.told_parts import ToldCamera, ToldTracker
from tests.support.traced_board_clip import pose_error
from tests.support.waiting import wait_until
from viewfinder.app.opening import browser_cameras, open_tracker
from viewfinder.app.running import Viewfinder, opened
from viewfinder.cli import calibrate_phone_command
from viewfinder.frames import CameraFrame, Pose
from viewfinder.options import ListeningOptions, PhoneOptions, TrackingOptions, ViewfinderOptions
from viewfinder.server.access import Access, needed_role
from viewfinder.server.endpoint import serving_site
from viewfinder.server.sessions import Role
from viewfinder.sources.browser_camera import BrowserCameraSource
from viewfinder.sources.playback import PatternSource
from viewfinder.tracking.phone_rig import PhoneRig, PosePair, angle_deg, calibrate_rig, read_phone_rig, rigid_of, write_phone_rig
from viewfinder.tracking.phone_tracker import Calibration, PhoneTracker, StillPairs
from viewfinder.tracking.tracker import TrackedPose


def calibrate(folder: Path, *extra: str, source: str = "test", phone: str = "0", **with_files: str) -> str:
    files = {"--phone-camera": "phone.json", "--board": "board.json", "--lens": "lens.json", "--out": "rig.json"}
    files |= {f"--{name.replace('_', '-')}": value for name, value in with_files.items()}
    words = [word for name, value in files.items() for word in (name, folder / value)]
    return printed_by(calibrate_phone_command, "--source", source, "--phone", phone, *words, *extra)


class Hands:
    """A person who takes camera and phone from view to view: photographs come into two folders, the next when a pair was found.

    In between the camera sees no board, so that no machine is so slow that the two could show different views for long.
    """

    def __init__(self, folder: Path, said: list[str]) -> None:
        self.folder, self.said, self.written = folder, said, 0
        for name in ("camera", "phone"):
            (folder / name).mkdir()

    def show(self, name: str, bgr: np.ndarray) -> None:
        """Whole from the beginning, under a name of its own."""
        self.written += 1
        hidden = self.folder / f"{self.written}.png"
        cv2.imwrite(str(hidden), bgr)
        hidden.rename(self.folder / name / hidden.name)
        time.sleep(0.35)

    def work(self) -> None:
        grey = np.full((270, 480, 3), 90, np.uint8)
        for number in range(VIEWS):
            self.show("camera", grey)
            self.show("phone", picture(phone_at(number)))
            self.show("camera", picture(camera_at(number)))
            wait_until(lambda pair=f"pair {number + 1} of": any(pair in each or each.startswith("wrote") for each in self.said))
            if any(each.startswith("wrote") for each in self.said):
                return


@pytest.mark.slow
def test_calibration_by_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Traced pictures of both, detected and solved in real threads; the issue's bounds for a pose are 0.3 degrees and 3 mm."""
    write_files(tmp_path)
    said, log = list[str](), Channel.said
    monkeypatch.setattr(Channel, "said", lambda channel, text: (said.append(text), log(channel, text)))
    hands, before = Hands(tmp_path, said), set(threads())
    person = Thread(target=hands.work)
    person.start()
    told = calibrate(tmp_path, "--pairs", "5", source=f"folder:{tmp_path / 'camera'}", phone=f"folder:{tmp_path / 'phone'}")
    person.join()
    assert "pair 1 of 5: move the camera" in told and "pair 5 of 5: phone and camera agree within" in told
    rig = read_phone_rig(tmp_path / "rig.json")
    degrees, millimetres = rig_error(rig.camera_from_phone)
    assert degrees < 0.3 and millimetres < 3.0 and rig.pairs == 5 and rig.residual_deg < 0.3 and rig.residual_mm < 3.0
    assert set(threads()) <= before
    refused("--overwrite", calibrate, tmp_path)


def tracking_by(folder: Path, phone: str) -> TrackingOptions:
    """By a phone that was calibrated; its files and those of the camera are in the folder."""
    write_files(folder)
    write_phone_rig(folder / "rig.json", PhoneRig(CAMERA_FROM_PHONE, 0.1, 1.0, 9))
    options = PhoneOptions(phone, folder / "phone.json", folder / "rig.json")
    return TrackingOptions(board=folder / "board.json", phone=options, delay_ms=80.0)


@contextmanager
def viewfinder_by(folder: Path, phone: str) -> Iterator[Viewfinder]:
    write_layer(folder / "layer.exr", clear(90, 160))
    tracking, lenses = tracking_by(folder, phone), (folder / "lens.json",)
    options = ViewfinderOptions("test", layer=folder / "layer.exr", lenses=lenses, tracking=tracking, captures=folder)
    with opened(options, Access()) as running:
        yield running


def phone_folder(folder: Path, bgr: np.ndarray) -> str:
    """The word for a phone whose photographs come into a folder, where one lies."""
    (folder / "phone").mkdir()
    cv2.imwrite(str(folder / "phone" / "one.png"), bgr)
    return f"folder:{folder / 'phone'}"


def test_a_camera_that_sees_no_board_is_where_its_phone_is(tmp_path: Path) -> None:
    """The pose that the compositor got, against the traced truth, and the phone closed at the end."""
    before = set(threads())
    with viewfinder_by(tmp_path, phone_folder(tmp_path, picture(phone_at(2)))) as running:
        tracked = posed(running.compositor)
        assert running.site.controls.state()["failure"] is None
    error = pose_error(tracked.camera_from_world, camera_at(2))
    assert error.turn_deg < 0.3 and error.place_mm < 3.0 and tracked.quality > 0.0 and tracked.points > 20
    assert set(threads()) <= before


class BoardCanvas(Canvas):
    """The phone's picture of a view, as a browser would send it."""

    def __init__(self, number: int) -> None:
        super().__init__((0, 0, 0))
        self.picture = picture(phone_at(number))

    async def recv(self) -> av.VideoFrame:
        blank = await super().recv()
        frame = av.VideoFrame.from_ndarray(self.picture, "bgr24").reformat(format="yuv420p", dst_colorspace=5, dst_color_range=1)
        frame.pts, frame.time_base = blank.pts, blank.time_base
        return frame


async def test_a_phone_sends_its_camera_through_whip(tmp_path: Path) -> None:
    """Over a real connection; the codec (VP8) may move corners by some tenths of a pixel."""
    with viewfinder_by(tmp_path, "whip") as running:
        async with serving_site(running.site, "127.0.0.1", 0) as url:
            assert "waiting for a browser camera" in str(running.site.controls.state()["failure"])
            async with sending(url.rstrip("/"), BoardCanvas(4)):
                tracked = await asyncio.to_thread(posed, running.compositor, 30.0)
    error = pose_error(tracked.camera_from_world, camera_at(4))
    assert error.turn_deg < 0.5 and error.place_mm < 5.0


def posed(compositor: Any, limit_s: float = 20.0) -> TrackedPose:
    """Of the first empty picture of the camera for which a pose is known. No viewer waits, so that nobody else composites."""
    deadline_s, number = time.monotonic() + limit_s, 0
    while time.monotonic() < deadline_s:
        compositor(CameraFrame(np.zeros((90, 160, 3), np.uint8), time.monotonic(), number := number + 1), 0)
        if compositor.last.pose is not None:
            return compositor.last.pose
        time.sleep(0.02)
    raise AssertionError("the phone was never tracked")


def steps(views: int, held: int, late_s: float = 0.0) -> ToldCamera:
    """A camera that stands at one view after another for `held` frames, 0.1 s apart; its frames carry the view's number in their pixels."""
    pictures = [np.full((4, 6, 3), number // held, np.uint8) for number in range(views * held)]
    return ToldCamera(lambda _: (CameraFrame(bgr, 0.1 * number + late_s, number) for number, bgr in enumerate(pictures)))


def known(poses: list[Pose], wrong_deg: float = 0.0) -> ToldTracker:
    """A tracker that reads the view from the pixels. wrong_deg: a turn by which each pose errs, to and fro."""

    def pose_of(frame: CameraFrame) -> TrackedPose:
        number = int(frame.bgr[0, 0, 0])
        wrong = rigid_of(np.array([0.0, np.radians(wrong_deg) * (-1) ** number, 0.0, 0.0, 0.0, 0.0]))
        return TrackedPose(wrong @ poses[number], 1.0, frame.captured_s)

    return ToldTracker(pose_of)


CAMERA_POSES = [view(number) for number in range(VIEWS)]
PHONE_POSES = [phone_at(number).camera_from_world for number in range(VIEWS)]


def calibrated(views: int, held: int, wrong_deg: float = 0.0, late_s: float = 0.0) -> tuple[PhoneRig, list[str]]:
    """All of the phone's frames are there before the camera's first."""
    small, said = Camera(6, 4, (6.0, 6.0), (3.0, 2.0)), list[str]()
    with closing(PhoneTracker(steps(views, held, late_s), known(PHONE_POSES), small, None)) as phone:
        phone._thread.join()
        camera, by_board = steps(views, held), known(CAMERA_POSES, wrong_deg)
        return Calibration(camera, by_board, lambda *_: small, phone, said.append, pairs=VIEWS).run(Event()), said


@pytest.mark.parametrize("late_s", [0.0, 0.35])
def test_exact_poses_give_the_rig_back_though_one_stream_is_late(late_s: float) -> None:
    rig, said = calibrated(VIEWS, 16, late_s=late_s)
    assert rig_error(rig.camera_from_phone) == (pytest.approx(0.0, abs=1e-3), pytest.approx(0.0, abs=0.01))
    assert rig.pairs >= VIEWS - 1 and sum("agree within 0.00 degrees" in each for each in said) >= 2


def test_too_few_and_contradicting_views_are_refused() -> None:
    refused("needs 5 pairs of poses or more, got 3", calibrated, 3, 16)
    refused("disagree by", calibrated, VIEWS, 16, wrong_deg=6.0)
    # Nobody stands still: each view lasts 0.3 s.
    refused("got 0: show both the board for longer", calibrated, VIEWS, 3)


def test_a_moment_ends_where_the_board_is_lost() -> None:
    found = StillPairs(lambda _: PHONE_POSES[0])
    for step in range(6):
        assert not found.take(0.1 * step, CAMERA_POSES[0])
    assert not found.take(0.6, None)
    for step in range(7, 13):
        assert not found.take(0.1 * step, CAMERA_POSES[0]), step
    assert found.take(1.3, CAMERA_POSES[0])
    assert not any(found.take(0.1 * step, CAMERA_POSES[0]) for step in range(14, 40)), "the same view again is no other pair"


def test_poses_of_the_phone_that_never_come_end_the_moment() -> None:
    known_until_s = 0.4
    found = StillPairs(lambda time_s: PHONE_POSES[0] if time_s <= known_until_s else None)
    assert not any(found.take(0.1 * step, CAMERA_POSES[0]) for step in range(30))
    assert len(found._waiting) <= 11, "a second of waiting, and no more"


def test_bad_files_are_refused_before_a_camera_is_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_files(tmp_path)
    monkeypatch.setattr("viewfinder.app.calibrating.open_source", lambda *_: pytest.fail("the camera was opened"))
    for name, file, sentence in (
        ("phone_camera", "none.json", "no such file"), ("board", "lens.json", "expected a ChArUco board"), ("lens", "board.json", "lens"),
        ("out", "nowhere/rig.json", "there is no"),
    ):  # fmt: skip
        refused(re.escape(sentence), calibrate, tmp_path, **{name: file})


def test_cameras_that_are_not_there(tmp_path: Path) -> None:
    write_files(tmp_path)
    before = set(threads())
    for source, phone, more, sentence in (
        ("other.mkv", "other.mkv", [], "are both other.mkv"), ("other.mkv", "test", [], "--source: expected"),
        ("test", "none.mkv", [], "--phone: expected"), ("test", "folder:none", [], "--phone folder: expected"),
        ("test", "folder:none", ["--camera", "a.json"], "either --camera CAMERA.json or --lens"),
        ("test", "folder:none", ["--tls-key", "a.pem"], "--tls-key is for --tls"),
    ):  # fmt: skip
        refused(re.escape(sentence), calibrate, tmp_path, *more, source=source, phone=phone)
    assert set(threads()) <= before and not (tmp_path / "rig.json").exists()


def test_where_browsers_send_their_cameras() -> None:
    """The camera page sends to /whip; only where both come from browsers the phone has an address of its own. Both need control."""
    pattern, first, second = PatternSource(16, 16), BrowserCameraSource(), BrowserCameraSource()
    assert browser_cameras(pattern, None) == {} == browser_cameras(pattern, pattern)
    assert browser_cameras(pattern, second) == {"whip": second}
    both = browser_cameras(first, second)
    assert both["whip"] is first
    assert {route.path for route in both["phone-whip"].routes()} == {"/phone-whip", "/phone-whip/{token}"}
    assert needed_role("/phone-whip") is Role.CONTROL


def test_a_frame_that_is_still_looked_at_is_not_one_in_which_nothing_was_seen() -> None:
    """Searching a frame may take longer than a pose is held."""
    looking, made, remarks = Event(), Event(), list[str | None]()

    def slowly(frame: CameraFrame) -> TrackedPose:
        assert made.wait(10.0)
        if tracker._history.newest_s is not None:
            remarks.append(tracker.remark)
            looking.set()
        return TrackedPose(PHONE_POSES[0], 1.0, frame.captured_s)

    with closing(PhoneTracker(PatternSource(480, 270, fps=5.0), ToldTracker(slowly), PHONE, None)) as tracker:
        made.set()
        assert looking.wait(10.0)
    assert remarks[0] is None, "the frame before is 0.2 s old, and this one is not done"


def test_the_phone_tells_what_is_wrong(tmp_path: Path) -> None:
    grey = phone_folder(tmp_path, np.full((270, 480, 3), 90, np.uint8))
    with closing(open_tracker(tracking_by(tmp_path, grey), ListeningOptions())) as tracker:
        assert isinstance(tracker, PhoneTracker) and tracker.video_delay_s == 0.08
        wait_until(lambda: tracker._looked_s != 0.0)
        assert tracker.remark == "the phone on the camera does not see what it tracks", "grey is no board"
    with closing(PhoneTracker(PatternSource(36, 64), known(PHONE_POSES), PHONE, None)) as turned:
        wait_until(lambda: turned._wrong_size is not None)
        assert "its pictures are 36x64 px, those of its camera file 480x270 px" in str(turned.remark)


INTRINSICS = Camera(64, 48, (60.0, 60.0), (32.0, 24.0))


def shaken(pose: np.ndarray, rng: np.random.Generator, turn_deg: float, shift_m: float) -> np.ndarray:
    """With an error of so much in each of three axes."""
    return rigid_of(np.concatenate([np.radians(rng.normal(0, turn_deg, 3)), rng.normal(0, shift_m, 3)])) @ pose


def pairs(count: int, rng: np.random.Generator, turn_deg: float = 0.0, shift_m: float = 0.0) -> list[PosePair]:
    """Views of a board from about 0.7 m, turned by up to 30 degrees."""
    result = []
    for _ in range(count):
        turn = np.radians(rng.uniform(-30, 30, 3))
        phone = rigid_of(np.concatenate([turn, [*rng.uniform(-0.2, 0.2, 2), rng.uniform(0.5, 0.9)]]))
        camera = CAMERA_FROM_PHONE @ phone
        result.append(PosePair(shaken(phone, rng, turn_deg, shift_m), shaken(camera, rng, turn_deg, shift_m)))
    return result


def test_exact_pairs_give_the_rig_back() -> None:
    rig = calibrate_rig(pairs(8, np.random.default_rng(0)))
    assert rig_error(rig.camera_from_phone) == (pytest.approx(0.0, abs=1e-4), pytest.approx(0.0, abs=1e-3))
    assert rig.residual_deg < 1e-3 and rig.residual_mm < 1e-2 and rig.pairs == 8


def test_noise_averages_out_and_is_stated() -> None:
    """0.2 degrees and 2 mm in each axis of both poses: 40 pairs leave about 0.2 sqrt(2 * 3 / 40) = 0.08 degrees.

    A phone that turns by 0.2 degrees 0.7 m before the board moves what it says of itself by 2.4 mm; with both poses and three axes
    the residual is near sqrt(3 * 2) (0.2 degrees; and 2 mm with what turns of the pose do to a place that far away).
    """
    rig = calibrate_rig(pairs(40, np.random.default_rng(1), 0.2, 0.002))
    degrees, millimetres = rig_error(rig.camera_from_phone)
    assert degrees < 0.16 and millimetres < 2.5 and rig.residual_deg == pytest.approx(0.2 * np.sqrt(6), rel=0.25)


def test_one_wrong_pair_does_little() -> None:
    good = pairs(20, np.random.default_rng(2), 0.05, 0.0005)
    wrong = PosePair(good[0].phone_from_world, rigid_of(np.array([0.1, 0.0, 0.0, 0.02, 0.0, 0.0])) @ good[0].camera_from_world)
    degrees, millimetres = rig_error(calibrate_rig([*good, wrong]).camera_from_phone)
    # The plain mean would be off by 5.7 / 21 degrees.
    assert degrees < 0.1 and millimetres < 2.0


def test_calibrations_that_cannot_be() -> None:
    rng = np.random.default_rng(3)
    refused("5 pairs of poses or more, got 4", calibrate_rig, pairs(4, rng))
    refused("disagree by", calibrate_rig, pairs(10, rng, 10.0, 0.05))


def test_rig_file(tmp_path: Path) -> None:
    rig = PhoneRig(CAMERA_FROM_PHONE, 0.1, 1.5, 20)
    write_phone_rig(tmp_path / "rig.json", rig)
    back = read_phone_rig(tmp_path / "rig.json")
    assert back.camera_from_phone == pytest.approx(CAMERA_FROM_PHONE, abs=1e-15) and (back.residual_mm, back.pairs) == (1.5, 20)
    text = (tmp_path / "rig.json").read_text()
    for wrong in (text.replace("mrbokeh-phone-rig", "other"), "[]", text.replace(str(CAMERA_FROM_PHONE[0, 0]), "7.0"), '{"format": 1}'):
        (tmp_path / "wrong.json").write_text(wrong)
        refused("not a phone rig", read_phone_rig, tmp_path / "wrong.json")


def slid_at(time_s: float) -> np.ndarray:
    return rigid_of(np.array([0.0, 0.0, 0.0, -time_s, 0.0, 1.0]))


def slides(frame: CameraFrame) -> TrackedPose | None:
    """A phone that moves 1 m to the right each second, and loses itself after 2 s."""
    return TrackedPose(slid_at(frame.captured_s), 0.8, frame.captured_s, 0.5, 20) if frame.captured_s <= 2.0 else None


def test_tracker_of_the_phone() -> None:
    shown, by_board = Event(), ToldTracker(slides)

    def frames(stopping: Event) -> Iterator[CameraFrame]:
        for number in range(40):
            yield CameraFrame(np.zeros((48, 64, 3), np.uint8), 0.1 * number, number)
        shown.set()
        stopping.wait(10.0)

    def at(time_s: float) -> TrackedPose | None:
        return tracker.track(CameraFrame(np.zeros((4, 4, 3), np.uint8), time_s, 0), INTRINSICS)

    rig = PhoneRig(CAMERA_FROM_PHONE, 0.1, 1.0, 9)
    with closing(PhoneTracker(ToldCamera(frames), by_board, INTRINSICS.resized(640, 480), rig, hold_s=0.2)) as tracker:
        assert shown.wait(10.0)
        found = at(1.234)
        assert found.quality == 0.8 and found.captured_s == 1.234
        assert found.camera_from_world == pytest.approx(CAMERA_FROM_PHONE @ slid_at(1.234))
        tracker.video_delay_s = 0.1
        assert at(1.234).camera_from_world == pytest.approx(CAMERA_FROM_PHONE @ slid_at(1.134))
        assert tracker.phone_pose(1.234) == pytest.approx(slid_at(1.134))
        tracker.video_delay_s = 0.0
        assert at(2.1).quality == pytest.approx(0.4, abs=0.01)  # 0.1 of 0.2 s after the last pose
        assert at(2.21) is None and tracker.phone_pose(2.1) is None
        tracker.rig = None
        assert at(1.0) is None
    assert by_board.closed and by_board.sizes == {(64, 48)} and not tracker._thread.is_alive()


def test_a_phone_that_fails_says_so() -> None:
    def unplugged(_: Event) -> Iterator[CameraFrame]:
        yield from ()
        raise InputError("the phone went away")

    with closing(PhoneTracker(ToldCamera(unplugged), ToldTracker(slides), INTRINSICS, None)) as tracker:
        wait_until(lambda: tracker.failure is not None)
    assert tracker.failure == "the phone went away"


def test_turning_motions() -> None:
    turn = Rotation.from_euler("xyz", [10, 20, 30], degrees=True)
    assert angle_deg(rigid_of(np.r_[turn.as_rotvec(), 1, 2, 3])) == pytest.approx(np.degrees(turn.magnitude()))

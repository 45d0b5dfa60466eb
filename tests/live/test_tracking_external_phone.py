"""A phone on the camera: calibrated from pairs of poses, applied to any tracker's poses."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError
from tests.scenes.phone_on_camera import CAMERA_FROM_PHONE, rig_error
from tests.scenes.told_parts import ToldCamera, ToldTracker
from tests.scenes.waiting import wait_until
from viewfinder.frames import CameraFrame
from viewfinder.tracking.phone_rig import PhoneRig, PosePair, angle_deg, calibrate_rig, read_phone_rig, rigid_of, write_phone_rig
from viewfinder.tracking.phone_tracker import PhoneTracker
from viewfinder.tracking.tracker import TrackedPose

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
    assert degrees < 0.16 and millimetres < 2.5
    assert rig.residual_deg == pytest.approx(0.2 * np.sqrt(6), rel=0.25)


def test_one_wrong_pair_does_little() -> None:
    good = pairs(20, np.random.default_rng(2), 0.05, 0.0005)
    wrong = PosePair(good[0].phone_from_world, rigid_of(np.array([0.1, 0.0, 0.0, 0.02, 0.0, 0.0])) @ good[0].camera_from_world)
    degrees, millimetres = rig_error(calibrate_rig([*good, wrong]).camera_from_phone)
    # The plain mean would be off by 5.7 / 21 degrees.
    assert degrees < 0.1 and millimetres < 2.0


def test_calibrations_that_cannot_be() -> None:
    rng = np.random.default_rng(3)
    with pytest.raises(InputError, match="5 pairs of poses or more, got 4"):
        calibrate_rig(pairs(4, rng))
    with pytest.raises(InputError, match="disagree by"):
        calibrate_rig(pairs(10, rng, 10.0, 0.05))


def test_rig_file(tmp_path: Path) -> None:
    rig = PhoneRig(CAMERA_FROM_PHONE, 0.1, 1.5, 20)
    write_phone_rig(tmp_path / "rig.json", rig)
    back = read_phone_rig(tmp_path / "rig.json")
    assert back.camera_from_phone == pytest.approx(CAMERA_FROM_PHONE, abs=1e-15) and (back.residual_mm, back.pairs) == (1.5, 20)
    text = (tmp_path / "rig.json").read_text()
    for wrong in (text.replace("mrbokeh-phone-rig", "other"), "[]", text.replace(str(CAMERA_FROM_PHONE[0, 0]), "7.0"), '{"format": 1}'):
        (tmp_path / "wrong.json").write_text(wrong)
        with pytest.raises(InputError, match="not a phone rig"):
            read_phone_rig(tmp_path / "wrong.json")


def phone_at(time_s: float) -> np.ndarray:
    return rigid_of(np.array([0.0, 0.0, 0.0, -time_s, 0.0, 1.0]))


def slides(frame: CameraFrame) -> TrackedPose | None:
    """A phone that moves 1 m to the right each second, and loses itself after 2 s."""
    return TrackedPose(phone_at(frame.captured_s), 0.8, frame.captured_s, 0.5, 20) if frame.captured_s <= 2.0 else None


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
        assert found.camera_from_world == pytest.approx(CAMERA_FROM_PHONE @ phone_at(1.234))
        tracker.video_delay_s = 0.1
        assert at(1.234).camera_from_world == pytest.approx(CAMERA_FROM_PHONE @ phone_at(1.134))
        assert tracker.phone_pose(1.234) == pytest.approx(phone_at(1.134))
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

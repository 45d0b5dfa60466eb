"""Tracking over real UDP sockets on loopback: poses at the time of the frame, silence, junk, several segments, multicast."""

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import numpy as np
import pytest

from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError
from tests.scenes.tracking_senders import encode_opentrackio, freed_message, opentrackio_document, packets, write_freed
from tests.scenes.waiting import wait_until
from viewfinder.focus.sources import TrackedLensFocus
from viewfinder.frames import CameraFrame, LensState
from viewfinder.tracking.freed import FreeDMessage, FreeDReading
from viewfinder.tracking.phone_rig import rigid_of
from viewfinder.tracking.pose_history import PoseHistory, SenderClock, TrackingSample
from viewfinder.tracking.socket_tracker import CBOR, JSON, Decoder, SocketTracker, TrackingAddress, freed_decoder, opentrackio_decoder

CAMERA = Camera(64, 48, (60.0, 60.0), (32.0, 24.0))
PATIENCE_S = 5.0


def pose_at(x_m: float) -> np.ndarray:
    return rigid_of(np.array([0.0, 0.0, 0.0, -x_m, 0.0, 2.0]))


def frame_at(captured_s: float) -> CameraFrame:
    return CameraFrame(np.zeros((48, 64, 3), np.uint8), captured_s, 0)


def datagrams(sample: TrackingSample, encoding: int = JSON, number: int = 0, segment_bytes: int = 1400) -> list[bytes]:
    return list(packets(encode_opentrackio(opentrackio_document(sample), encoding), encoding, number, segment_bytes))


@contextmanager
def listening(decode: Decoder, **settings: float) -> Iterator[tuple[SocketTracker, Callable[..., None]]]:
    """(a tracker on a free port, what sends datagrams to it)."""
    tracker = SocketTracker(TrackingAddress(0), decode, **settings)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:

        def send(*contents: bytes) -> None:
            for content in contents:
                sender.sendto(content, ("127.0.0.1", tracker.port))

        try:
            yield tracker, send
        finally:
            tracker.close()
    assert not tracker._thread.is_alive()


@pytest.mark.parametrize("encoding", [JSON, CBOR])
def test_poses_between_two_samples(encoding: int) -> None:
    """The sender's clock is a day ahead; at 40 % of the way between two samples the camera is at 40 % of its way."""
    day = 86400.0
    with listening(opentrackio_decoder(), hold_s=100.0) as (tracker, send):
        for number, x_m in enumerate((0.0, 1.0)):
            sample = TrackingSample(pose_at(x_m), LensState(2.0, 2.8, 50.0), day + time.monotonic())
            send(*datagrams(sample, encoding, number, segment_bytes=100))
            wait_until(lambda number=number: len(tracker._history._times) == number + 1)
            time.sleep(0.05)
        first_s, second_s = tracker._history._times
        assert 0.03 < second_s - first_s < PATIENCE_S
        moment_s = first_s + 0.4 * (second_s - first_s)
        found = tracker.track(frame_at(moment_s), CAMERA)
        assert found is not None and found.quality == 1.0
        assert found.camera_from_world == pytest.approx(pose_at(0.4), abs=1e-5)
        tracker.video_delay_s = 0.2 * (second_s - first_s)
        delayed = tracker.track(frame_at(moment_s), CAMERA)
        assert delayed is not None and delayed.camera_from_world == pytest.approx(pose_at(0.2), abs=1e-5)
        assert TrackedLensFocus(tracker).state(frame_at(moment_s), found).focus_distance_m == pytest.approx(2.0)


def test_silence_is_a_lost_track() -> None:
    with listening(opentrackio_decoder(), hold_s=0.05) as (tracker, send):
        assert tracker.track(frame_at(time.monotonic()), CAMERA) is None
        assert "have come" in str(tracker.remark)
        send(*datagrams(TrackingSample(pose_at(1.0), LensState(2.0))))
        wait_until(lambda: tracker._history.newest_s)
        newest_s = tracker._history.newest_s
        close = tracker.track(frame_at(newest_s + 0.01), CAMERA)
        assert close is not None and close.quality == pytest.approx(0.8)  # 10 of 50 ms
        assert tracker.track(frame_at(newest_s + 0.06), CAMERA) is None
        assert tracker.lens(frame_at(newest_s + 0.06)) == LensState()
        wait_until(lambda: "silent for" in str(tracker.remark))
        send(*datagrams(TrackingSample(pose_at(2.0)), number=1))
        wait_until(lambda: tracker._history.newest_s != newest_s)


def test_junk_is_counted_and_does_no_harm() -> None:
    rng = np.random.default_rng(0)
    (good,) = datagrams(TrackingSample(pose_at(1.0)))
    with listening(opentrackio_decoder(), hold_s=100.0) as (tracker, send):
        junk = [rng.bytes(40), b"", b"OTrk", good[:-1], good[:30] + b"x" + good[31:], *packets(b"{}", JSON, 3), *packets(b"\xff", CBOR, 4)]
        send(*junk)
        wait_until(lambda: tracker.malformed == len(junk))
        assert "not understood" in str(tracker.remark)
        send(good)
        wait_until(lambda: tracker._history.newest_s)
        assert tracker.remark is None and tracker.malformed == len(junk)


def test_freed_of_one_camera() -> None:
    # Arrival is their time: FreeD carries none.
    pose = rigid_of(np.array([1.2, 0.1, 0.0, 0.0, 0.0, 2.0]))
    message = freed_message(TrackingSample(pose), camera=2)
    other = FreeDMessage(1, (0.0, 0.0, 0.0), (9.0, 9.0, 9.0), 0, 0)
    with listening(freed_decoder(FreeDReading(), camera=2), hold_s=100.0) as (tracker, send):
        send(write_freed(other), write_freed(message), write_freed(other), b"junk")
        wait_until(lambda: tracker.malformed)
        assert len(tracker._history._times) == 1
        found = tracker.track(frame_at(time.monotonic()), CAMERA)
        assert found is not None and found.camera_from_world == pytest.approx(pose, abs=3e-5)
        assert tracker.ignored == {"zoom and focus counts (no lens table)"}


def test_history_is_bounded() -> None:
    history = PoseHistory(longest=10)
    for time_s in range(1000):
        history.add(float(time_s), TrackingSample(pose_at(time_s)))
    assert len(history._times) == len(history._samples) == 10
    assert history.at(989.0) is None
    history.add(998.5, TrackingSample(pose_at(0.0)))  # late
    late = history.at(998.5)
    assert late is not None and late.camera_from_world == pytest.approx(pose_at(0.0))


def test_sender_clock_takes_the_least_delayed() -> None:
    """Packets every 20 ms that are 0 to 15 ms late: the times become even, and right to the least delay there was."""
    rng = np.random.default_rng(5)
    clock = SenderClock()
    late_s = rng.uniform(0.0, 0.015, 100)
    ours_s = np.array([clock.ours_s(1000.0 + 0.02 * i, 50.0 + 0.02 * i + late) for i, late in enumerate(late_s)])
    true_s = 50.0 + 0.02 * np.arange(100)
    assert np.abs(ours_s - true_s)[50:].max() == pytest.approx(late_s[:51].min(), abs=1e-3)
    assert clock.ours_s(None, 77.0) == 77.0


def test_taken_ports() -> None:
    with listening(freed_decoder()) as (tracker, _), pytest.raises(InputError, match="cannot listen for tracking"):
        SocketTracker(TrackingAddress(tracker.port), freed_decoder())


def test_multicast_on_loopback() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    try:
        tracker = SocketTracker(TrackingAddress(port, group="239.135.1.7"), opentrackio_decoder(), hold_s=100.0)
    except InputError as error:
        pytest.skip(f"no multicast here: {error}")
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
            sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
            (packet,) = datagrams(TrackingSample(pose_at(1.0)))
            deadline = time.monotonic() + 1.0
            while tracker._history.newest_s is None and time.monotonic() < deadline:
                with suppress(OSError):
                    sender.sendto(packet, ("239.135.1.7", port))
                time.sleep(0.02)
        if tracker._history.newest_s is None:
            pytest.skip("multicast does not come back over loopback on this machine")
        found = tracker.track(frame_at(time.monotonic()), CAMERA)
        assert found is not None and found.camera_from_world == pytest.approx(pose_at(1.0), abs=1e-6)
    finally:
        tracker.close()

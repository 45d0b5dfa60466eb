"""OpenTrackIO and FreeD: bytes, checksums, segments, axes and lens tables; then over real UDP sockets on loopback: poses at the time of the
frame, silence, junk, several segments, multicast."""

import csv
import itertools
import json
import math
import socket
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.track import pose_between
from mrbokeh.tracking.world_axes import inverted, pan_tilt_roll_deg, rigid
from tests.support.refusals import refused
from tests.support.tracking_senders import encode_opentrackio, freed_message, opentrackio_document, packets, write_freed
from tests.support.waiting import wait_until
from viewfinder.focus.sources import TrackedLensFocus
from viewfinder.frames import CameraFrame, LensState
from viewfinder.tracking.freed import FreeDMessage, FreeDReading, freed_sample, read_encoder_table, read_freed
from viewfinder.tracking.phone_rig import rigid_of
from viewfinder.tracking.pose_history import MalformedMessageError, PoseHistory, SenderClock, TrackingSample, lens_between
from viewfinder.tracking.socket_tracker import (
    CBOR,
    JSON,
    Decoder,
    Reassembly,
    SocketTracker,
    StageReading,
    TrackingAddress,
    decode_opentrackio,
    fletcher16,
    freed_decoder,
    opentrackio_decoder,
    read_packet,
)

IDENTITY = {"pan": 0.0, "tilt": 0.0, "roll": 0.0}


def document(translation: tuple[float, float, float], rotation: dict[str, float] | None = None, **lens: object) -> dict[str, object]:
    """A sample as a sender writes it."""
    place = dict(zip("xyz", translation, strict=True))
    return {
        "protocol": {"name": "OpenTrackIO", "version": [1, 0, 1]},
        "transforms": [{"translation": place, "rotation": rotation or IDENTITY}],
        "lens": lens,
    }


def decoded(content: object, reading: StageReading | None = None) -> TrackingSample:
    return decode_opentrackio(json.dumps(content).encode(), JSON, reading)


def seen_at(sample: TrackingSample, stage_m: tuple[float, float, float]) -> np.ndarray:
    """A point of the stage in camera axes. Ours: the stage's ground with y and z turned round (tracking/stage_axes)."""
    world = np.array([stage_m[0], -stage_m[1], -stage_m[2], 1.0])
    return (sample.camera_from_world @ world)[:3]


# Where a point must be seen follows from the words: X right, Y forward, Z up; ours is x right, y down, z forward.
@pytest.mark.parametrize(
    ("rotation", "point", "expected"),
    [
        (IDENTITY, (0.5, 5.0, 1.2), (0.5, 0.3, 5.0)),  # 0.5 m to the right, 0.3 m below the camera at 1.5 m, 5 m in front
        (IDENTITY | {"pan": 90.0}, (-4.0, 0.0, 1.5), (0.0, 0.0, 4.0)),  # right-handed about up: looks to the left, along -X
        (IDENTITY | {"tilt": 90.0}, (0.0, 0.0, 3.5), (0.0, 0.0, 2.0)),  # looks up
        (IDENTITY | {"roll": 90.0}, (0.0, 5.0, 2.5), (-1.0, 0.0, 5.0)),  # its head to the right: what is above it lies on its left
        ({"pan": 90.0, "tilt": 90.0, "roll": 0.0}, (0.0, 0.0, 2.5), (0.0, 0.0, 1.0)),  # intrinsic: tilts about its own right side
    ],
)
def test_opentrackio_axes(rotation: dict[str, float], point: tuple[float, float, float], expected: tuple[float, float, float]) -> None:
    assert seen_at(decoded(document((0.0, 0.0, 1.5), rotation)), point) == pytest.approx(expected, abs=1e-12)


def test_transforms_are_composed_and_the_pupil_lies_before_the_sensor() -> None:
    dolly = {"translation": {"x": 2.0, "y": 0.0, "z": 0.0}, "rotation": IDENTITY | {"pan": 90.0}}
    head = {"translation": {"x": 0.0, "y": 1.0, "z": 1.5}, "rotation": IDENTITY}
    content = document((0.0, 0.0, 0.0), entrancePupilOffset=0.1) | {"transforms": [dolly, head]}
    # The head stands 1 m along the dolly's forward, which is the stage's -X: at X = 1; the pupil 0.1 m farther.
    assert seen_at(decoded(content), (0.0, 0.0, 1.5)) == pytest.approx((0.0, 0.0, 1.0), abs=1e-12)
    at_sensor = decoded(content, StageReading(pose_at_sensor=True))
    assert seen_at(at_sensor, (0.0, 0.0, 1.5)) == pytest.approx((0.0, 0.0, 0.9), abs=1e-12)


@pytest.mark.parametrize("encoding", [JSON, CBOR])
def test_opentrackio_round_trip(encoding: int) -> None:
    pose = rigid_of(np.array([0.3, -1.2, 0.7, 0.4, -0.1, 3.0]))
    sample = TrackingSample(pose, LensState(2.5, 2.8, 35.0), 1234567.25)
    back = decode_opentrackio(encode_opentrackio(opentrackio_document(sample), encoding), encoding)
    assert back.camera_from_world == pytest.approx(pose, abs=1e-9)
    assert back.lens == sample.lens and back.sender_s == pytest.approx(1234567.25, abs=1e-6)


def test_angles_of_steep_cameras() -> None:
    for tilt_deg in (-90.0, -89.0, 0.0, 30.0, 90.0):
        turn = Rotation.from_euler("ZXY", [40.0, tilt_deg, 20.0], degrees=True).as_matrix()
        again = Rotation.from_euler("ZXY", pan_tilt_roll_deg(turn), degrees=True).as_matrix()
        assert again == pytest.approx(turn, abs=1e-12)


def test_opentrackio_says_what_it_leaves_out() -> None:
    sample = decoded(document((0, 0, 0), distortion=[{"model": "Brown-Conrady D-U", "radial": [0.1]}], tStop=3.1, focusDistance=0))
    assert sample.ignored == {"lens.distortion", "lens.tStop"} and sample.lens == LensState()


def test_malformed_samples() -> None:
    good = document((0, 0, 0))
    for wrong in (
        [], {}, {"protocol": {"name": "other"}}, good | {"transforms": []}, document((0, 0, math.nan)), good | {"lens": [1]},
        good | {"transforms": [{"translation": {"x": "1", "y": 0, "z": 0}}]}, document((0, 0, 0), fStop="wide open"),
    ):  # fmt: skip
        for payload, encoding in ((json.dumps(wrong).encode(), JSON), (encode_opentrackio({"a": wrong}, CBOR), CBOR), (b"\xff{[", JSON)):
            with pytest.raises(MalformedMessageError):
                decode_opentrackio(payload, encoding)


def test_random_bytes_are_malformed_and_nothing_worse() -> None:
    rng = np.random.default_rng(3)
    payloads = [(rng.bytes(size), encoding) for size in rng.integers(0, 60, 300) for encoding in (JSON, CBOR)]
    for payload, encoding in (*payloads, (b"[" * 100_000, JSON), (b"\x81" * 100_000, CBOR)):
        with pytest.raises(MalformedMessageError):
            decode_opentrackio(payload, encoding)


def fletcher_plainly(data: bytes) -> int:
    sums = list(itertools.accumulate(data))
    return sum(sums) % 256 << 8 | sums[-1] % 256


def test_fletcher() -> None:
    """OpenTrackIO sums modulo 256: "abcde" gives 97, 195, 38, 138, 239 and 97, 36, 74, 212, 195; modulo 255 it would be 0xC8F0."""
    assert fletcher16(b"abcde") == 0xC3EF
    # By hand: 1, 1+2, 1+2+3 = 6; second 1+3+6 = 10.
    assert fletcher16(b"\x01\x02\x03") == 10 << 8 | 6
    data = np.random.default_rng(1).bytes(70_000)
    assert fletcher16(data) == fletcher_plainly(data)


def test_header_bytes() -> None:
    (packet,) = packets(b"{}", JSON, 0x1234)
    assert packet[:14] == b"OTrk\x00\x01\x12\x34\x00\x00\x00\x00\x80\x02"
    assert struct.unpack(">H", packet[14:16])[0] == fletcher_plainly(packet[:14] + b"{}") and packet[16:] == b"{}"


def test_segments_in_any_order() -> None:
    payload = np.random.default_rng(2).bytes(5000)
    sent = [read_packet(each) for each in packets(payload, CBOR, 7)]
    assert [len(each.content) for each in sent] == [1400, 1400, 1400, 800]
    reassembly = Reassembly()
    assert [reassembly.add("a", sent[i]) for i in (3, 1, 0)] == [None] * 3
    assert reassembly.add("b", sent[2]) is None  # of another sender: not the missing part
    assert reassembly.add("a", sent[2]) == payload


def test_unfinished_payloads_are_bounded_and_overlaps_refused() -> None:
    reassembly = Reassembly()
    for number in range(1000):
        first, _ = (read_packet(each) for each in packets(bytes(2000), JSON, number))
        assert reassembly.add("a", first) is None
    assert len(reassembly._unfinished) <= 8
    lying = read_packet(next(packets(bytes(10), JSON, 5000)))
    assert reassembly.add("a", type(lying)(JSON, 5000, 5, True, bytes(10))) is None
    with pytest.raises(MalformedMessageError, match="overlap"):
        reassembly.add("a", type(lying)(JSON, 5000, 0, False, bytes(10)))


def test_every_flipped_byte_is_noticed() -> None:
    (packet,) = packets(b'{"a": 1}', JSON, 9)
    for place in (*range(4), *range(5, len(packet))):
        wrong = packet[:place] + bytes([packet[place] ^ 0x10]) + packet[place + 1 :]
        with pytest.raises(MalformedMessageError):
            read_packet(wrong)


def test_freed_bytes() -> None:
    """The example is put together by hand: 1 degree is 32768 = 0x008000, 1 m is 64000 = 0x00FA00, -1 degree 0xFF8000."""
    body = bytes.fromhex("D1 01 008000 FF8000 000000 00FA00 FF0600 01F400 000010 00ABCD 0000")
    datagram = body + bytes([(0x40 - sum(body)) % 256])
    message = read_freed(datagram)
    assert message == FreeDMessage(1, (1.0, -1.0, 0.0), (1.0, -1.0, 2.0), 0x10, 0xABCD)
    assert write_freed(message) == datagram
    for wrong in (datagram[:-1], datagram + b"\0", b"\xd2" + datagram[1:], datagram[:5] + b"\x77" + datagram[6:]):
        with pytest.raises(MalformedMessageError):
            read_freed(wrong)


def test_freed_axes() -> None:
    message = FreeDMessage(1, (90.0, 0.0, 0.0), (0.0, 0.0, 1.5), 0, 0)
    assert seen_at(freed_sample(message, FreeDReading()), (4.0, 0.0, 1.5)) == pytest.approx((0.0, 0.0, 4.0), abs=1e-9)
    turned = freed_sample(message, FreeDReading(signs=(-1, 1, 1, 1, 1, 1), pupil_before_m=0.2))
    assert seen_at(turned, (-4.0, 0.0, 1.5)) == pytest.approx((0.0, 0.0, 3.8), abs=1e-9)
    pose = rigid_of(np.array([1.2, -0.2, 0.1, 0.4, -0.1, 3.0]))
    back = freed_sample(read_freed(write_freed(freed_message(TrackingSample(pose)))), FreeDReading())
    # Half a step of 1/32768 degree and of 1/64 mm in each number.
    assert back.camera_from_world == pytest.approx(pose, abs=3e-5)


def write_table(path: Path, *rows: str) -> Path:
    path.write_text("\n".join(("axis,count,value", *rows)) + "\n")
    return path


def test_lens_table(tmp_path: Path) -> None:
    table = read_encoder_table(write_table(tmp_path / "lens.csv", "focus_m,0,inf", "focus_m,100,1.0", "f_number,0,2", "f_number,10,8"))
    # Half way from 0 to 1 dioptre; half way between f/2 and f/8 in stops.
    half = table.lens(focus=50, iris=5)
    assert half.focus_distance_m == 2.0 and half.f_number == pytest.approx(4.0) and half.focal_length_mm is None
    assert table.lens(focus=-5).focus_distance_m == math.inf and table.lens(focus=500).focus_distance_m == 1.0


def test_wrong_lens_tables(tmp_path: Path) -> None:
    for rows, said in (
        (["focus_m,0,1.0", "focus_m,0,2.0"], "line 3: the count 0 of focus_m"), (["zoom_mm,0,inf"], "line 2: expected one of"),
        (["focus_m,0,1.0", "focus_m,10,2.0", "focus_m,20,1.5"], "turns between 10 and 20"), (["iris,0,2"], "line 2: expected one of"),
        (["focus_m,zero,2"], "line 2: expected one of"), (["focus_m,0,-2"], "line 2: expected one of"), ([], "found none"),
    ):  # fmt: skip
        refused(said, read_encoder_table, write_table(tmp_path / "lens.csv", *rows))
    refused("cannot read it", read_encoder_table, tmp_path / "none.csv")
    (tmp_path / "head.csv").write_text("count,value\n1,2\n")
    refused("first line axis,count,value", read_encoder_table, tmp_path / "head.csv")


def test_real_focus_pull_through_a_table(shared_data: Path, tmp_path: Path) -> None:
    """A pull of a Sony Venice: its distances as counts of a 16-bit encoder that turns with the square root of dioptres, and back.

    The table knows 17 places. The error is that of interpolating d = g^2 linearly in g: (step / 2)^2 = (g_max / 32)^2 dioptres,
    and half a count, g_max^2 / 65535 at most.
    """
    with (shared_data / "lens" / "metadata" / "sony_venice_focus_pull.csv").open() as file:
        pulled_m = np.array([float(row["Focus Distance (ft)"]) * 0.3048 for row in csv.DictReader(file)])
    assert len(pulled_m) == 588 and np.ptp(1 / pulled_m) > 0.05
    largest = math.sqrt(1 / pulled_m.min())
    counts = np.round(65535 * np.sqrt(1 / pulled_m) / largest)
    places = np.linspace(0, 65535, 17)
    with np.errstate(divide="ignore"):
        rows = [f"focus_m,{count},{value}" for count, value in zip(places, (65535 / (places * largest)) ** 2, strict=True)]
    table = read_encoder_table(write_table(tmp_path / "venice.csv", *rows))
    read_m = np.array([table.lens(focus=count).focus_distance_m for count in counts])
    assert np.abs(1 / read_m - 1 / pulled_m).max() < (largest / 32) ** 2 + largest**2 / 65535


def test_between_two_poses() -> None:
    """A camera that turns on its tripod stays on it; half way of a turn of 90 degrees are 45."""
    place = np.array([1.0, 2.0, 3.0])
    turn = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    a, b = inverted(rigid(np.eye(3), place)), inverted(rigid(turn, place))
    half = inverted(pose_between(a, b, 0.5))
    assert half[:3, 3] == pytest.approx(place)
    assert half[:3, :3] == pytest.approx(Rotation.from_euler("y", 45, degrees=True).as_matrix())
    assert pose_between(a, b, 0.0) == pytest.approx(a) and pose_between(a, b, 1.0) == pytest.approx(b)


def test_between_two_lenses() -> None:
    # 1/1 and 0 dioptres: half way 0.5. f/2 and f/8: f/4. What one of them does not know comes from the other.
    half = lens_between(LensState(1.0, 2.0, None), LensState(math.inf, 8.0, 50.0), 0.5)
    assert half.focus_distance_m == 2.0 and half.f_number == pytest.approx(4.0) and half.focal_length_mm == 50.0
    assert lens_between(LensState(math.inf), LensState(math.inf), 0.5).focus_distance_m == math.inf
    assert lens_between(LensState(), LensState(), 0.5) == LensState()


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
            time.sleep(0.04)
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
        assert tracker.track(frame_at(time.monotonic()), CAMERA) is None and "have come" in str(tracker.remark)
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
    assert len(history._times) == len(history._samples) == 10 and history.at(989.0) is None
    history.add(998.5, TrackingSample(pose_at(0.0)))  # late
    late = history.at(998.5)
    assert late is not None and late.camera_from_world == pytest.approx(pose_at(0.0))


def test_sender_clock_takes_the_least_delayed() -> None:
    """Packets every 20 ms that are 0 to 15 ms late: the times become even, and right to the least delay there was."""
    rng, clock = np.random.default_rng(5), SenderClock()
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

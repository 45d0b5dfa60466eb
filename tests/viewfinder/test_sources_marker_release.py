"""The jitter buffer that releases a frame on its marker bit: order, loss, wrap-around, padding, and the delay that it saves."""

import random
from collections.abc import Iterable
from queue import Queue
from typing import Any

import pytest
from aiortc.jitterbuffer import JitterBuffer
from aiortc.rtp import RtpPacket

from viewfinder.sources import marker_buffer
from viewfinder.sources.marker_buffer import PATIENCE_S, BurstQueue, MarkerJitterBuffer, is_key_start, release_on_marker

KEY_START = b"\0\0\0\1\x67"


def packet(number: int, timestamp: int, data: bytes, *, marker: bool) -> Any:
    made: Any = RtpPacket(sequence_number=number % 65536, timestamp=timestamp, marker=int(marker))
    made._data = data
    return made


def stream(frames: int, per_frame: int, first: int = 65500) -> list[Any]:
    """Packets of `per_frame` to a frame, whose data say which they are; frame 0 begins as a key frame of H264 does. Numbers wrap."""
    made = []
    for index in range(frames * per_frame):
        frame, part = divmod(index, per_frame)
        data = (KEY_START if index == 0 else b"") + f"<{frame}.{part}>".encode()
        made.append(packet(first + index, 3000 * frame, data, marker=part == per_frame - 1))
    return made


def whole(frame: int, per_frame: int) -> bytes:
    return (KEY_START if frame == 0 else b"") + b"".join(f"<{frame}.{part}>".encode() for part in range(per_frame))


def buffer(capacity: int = 64) -> Any:
    """A clock that stands still, so that only the capacity ends the wait for what is lost."""
    return MarkerJitterBuffer(capacity, lambda: 0.0)


def given(into: Any, packets: Iterable[Any]) -> tuple[list[tuple[int, bytes]], int]:
    """((number of the frame, its bytes) of all frames that came out, how often a key frame was asked for)."""
    out, asked = [], 0
    for each in packets:
        lost, frame = into.add(each)
        asked += lost
        if frame is not None:
            out += [(each.timestamp // 3000, each.data) for each in (frame, *getattr(frame, "followers", ()))]
    return out, asked


@pytest.mark.parametrize("per_frame", [1, 2, 7])
def test_each_frame_comes_with_its_own_last_packet(per_frame: int) -> None:
    """Stock gives frame n with the first packet of frame n + 1: one frame later."""
    ours, stock = buffer(), JitterBuffer(capacity=64, is_video=True)
    for index, each in enumerate(stream(20, per_frame)):
        frame, part = divmod(index, per_frame)
        mine, theirs = ours.add(each)[1], stock.add(each)[1]
        assert (mine is not None) == (part == per_frame - 1) and (theirs is not None) == (part == 0 and frame > 0)
        if mine is not None:
            assert (mine.timestamp // 3000, mine.data) == (frame, whole(frame, per_frame))
        if theirs is not None:
            assert theirs.timestamp // 3000 == frame - 1


@pytest.mark.parametrize("seed", range(4))
def test_reordered_packets_make_the_same_frames_in_order(seed: int) -> None:
    """Each packet arrives up to 6 places late; nothing is lost."""
    draw, packets = random.Random(seed), stream(60, 4)
    order = sorted(range(1, len(packets)), key=lambda index: index + draw.uniform(0, 6))
    out, asked = given(buffer(), [packets[0], *(packets[index] for index in order)])
    assert [frame for frame, _ in out] == list(range(60)) and all(data == whole(frame, 4) for frame, data in out)
    assert asked == 0


@pytest.mark.parametrize("seed", range(4))
def test_lost_packets_cost_whole_frames_and_never_tear_one(seed: int) -> None:
    """5 % lost, duplicates and reordering besides: what comes out is complete, in order, and what was lost is asked for again."""
    draw, packets = random.Random(seed), stream(200, 5)
    order = sorted(range(1, len(packets)), key=lambda index: index + draw.uniform(0, 4))
    arriving = [packets[0], *(packets[index] for index in order if draw.random() > 0.05)]
    arriving = [each for one in arriving for each in ([one, one] if draw.random() < 0.05 else [one])]
    out, asked = given(buffer(), arriving)
    numbers = [frame for frame, _ in out]
    assert numbers == sorted(set(numbers)) and all(data == whole(frame, 5) for frame, data in out)
    arrived = {id(each) for each in arriving}
    intact = {frame for frame in range(200) if all(id(each) in arrived for each in packets[5 * frame : 5 * frame + 5])}
    assert set(numbers) <= intact and len(numbers) > 20 and asked > 0


def test_stock_tears_frames_where_ours_does_not() -> None:
    """A frame that lost its first packet: stock gives away the rest of it as a frame."""
    packets = [each for index, each in enumerate(stream(60, 4)) if index not in (7, 8)]
    for make, torn in ((lambda: JitterBuffer(capacity=32, is_video=True), True), (lambda: buffer(32), False)):
        out, asked = given(make(), packets)
        assert any(data != whole(frame, 4) for frame, data in out) == torn and asked > 0 and len(out) > 40


def test_the_first_frame_counts_only_from_its_key_start() -> None:
    """Packets that were sent before the connection stood are lost: the rest of that frame is dropped, the next ones come."""
    out, asked = given(buffer(), stream(4, 3)[1:])
    assert out == [(frame, whole(frame, 3)) for frame in (1, 2, 3)] and asked == 1


def test_padding_between_frames_is_no_frame() -> None:
    """Packets without data after the marker carry the old timestamp; an empty packet would flush the decoder."""
    first, second = stream(2, 1, first=10)
    second.sequence_number = 13
    padding = [packet(number, 0, b"", marker=False) for number in (11, 12)]
    out, asked = given(buffer(), [first, *padding, second])
    assert out == [(0, whole(0, 1)), (1, whole(1, 1))] and asked == 0


def test_without_markers_frames_come_as_in_stock() -> None:
    packets = stream(30, 3)
    for each in packets:
        each.marker = 0
    ours, stock = given(buffer(), packets), given(JitterBuffer(capacity=64, is_video=True), packets)
    assert ours == stock and len(ours[0]) == 29


def test_heads_of_key_frames_are_known() -> None:
    """NAL types 7 and 1 of H264; the start code of VP8 behind its three bytes of frame tag, whose lowest bit is 0 in key frames."""
    assert is_key_start(b"\0\0\0\1\x67abc") and not is_key_start(b"\0\0\0\1\x41abc") and not is_key_start(b"")
    assert is_key_start(b"\x10\x02\x00\x9d\x01\x2a\x80\x02") and not is_key_start(b"\x11\x02\x00\x9d\x01\x2a\x80\x02")


def test_frames_that_were_held_up_come_together() -> None:
    """Frames of one packet each: stock gives one frame per packet, and would stay two frames late from here on."""
    packets, order = stream(12, 1), [0, 1, 3, 4, 2, *range(5, 12)]
    ours = buffer()
    sizes = [len(given(ours, [packets[index]])[0]) for index in order]
    assert sizes == [1, 1, 0, 0, 3, *[1] * 7]
    stock = given(JitterBuffer(capacity=64, is_video=True), [packets[index] for index in order])[0]
    assert [frame for frame, _ in stock] == list(range(9))


def test_a_lost_packet_is_waited_for_so_long_and_no_longer() -> None:
    """One frame of two packets every 40 ms, one of frame 5 lost: 6 frames pass until 0.25 s are over, which then come at once."""
    now_s = [0.0]
    ours = MarkerJitterBuffer(512, lambda: now_s[0])
    came: dict[int, float] = {}
    asked = 0
    for index, each in enumerate(stream(20, 2)):
        now_s[0] = 0.04 * (index // 2)
        if index != 10:
            out, lost = given(ours, [each])
            asked += lost
            came |= {frame: now_s[0] for frame, _ in out}
    assert sorted(came) == [frame for frame in range(20) if frame != 5] and asked == 1
    late_s = {frame: came[frame] - 0.04 * frame for frame in came}
    assert max(late_s.values()) <= PATIENCE_S + 0.041
    assert all(late_s[frame] < 1e-9 for frame in (*range(5), *range(12, 20)))


def test_the_decoder_gets_followers_with_their_own_times() -> None:
    """Timestamps wrap at 2^32, of which the receiver takes care for the first frame: it maps 2^32 - 3000 to 6000, say."""
    ours = buffer()
    ours.add(packet(0, (1 << 32) - 6000, KEY_START, marker=True))
    assert ours.add(packet(2, 0, b"b", marker=True))[1] is None
    frame = ours.add(packet(1, (1 << 32) - 3000, b"a", marker=True))[1]
    frame.timestamp = 6000
    queue = BurstQueue()
    for item in (("codec", frame), None):
        queue.put(item)
    first, second, end = (queue.get_nowait() for _ in range(3))
    assert end is None and queue.empty() and first[0] == second[0] == "codec"
    assert [(each.timestamp, each.data) for each in (first[1], second[1])] == [(6000, b"a"), (9000, b"b")]


def test_another_aiortc_keeps_its_own_buffer(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", logger=marker_buffer.__name__)

    class Receiver:
        def __init__(self, stock: Any, waiting: Any) -> None:
            self._RTCRtpReceiver__jitter_buffer, self._RTCRtpReceiver__decoder_queue = stock, waiting
            self._RTCRtpReceiver__decoder_thread = None

    fresh, used = (JitterBuffer(capacity=64, is_video=True) for _ in range(2))
    used.add(packet(1, 1, b"x", marker=True))
    for receiver in (object(), Receiver(object(), Queue()), Receiver(used, Queue()), Receiver(fresh, object())):
        assert not release_on_marker(receiver)
    good = Receiver(fresh, Queue())
    monkeypatch.setattr(marker_buffer, "works", lambda: False)
    assert not release_on_marker(good)
    assert type(good._RTCRtpReceiver__jitter_buffer) is JitterBuffer and type(good._RTCRtpReceiver__decoder_queue) is Queue
    assert len(caplog.records) == 5
    monkeypatch.undo()
    assert release_on_marker(good) and good._RTCRtpReceiver__jitter_buffer.capacity == 64


@pytest.mark.parametrize("change", ["_remove_frame", "remove", "add"])
def test_a_stock_buffer_that_works_otherwise_fails_the_trial(monkeypatch: pytest.MonkeyPatch, change: str) -> None:
    """The installed aiortc passes. One that calls other methods, or gives other answers, does not."""
    try:
        marker_buffer.works.cache_clear()
        assert marker_buffer.works()
        marker_buffer.works.cache_clear()
        owner = MarkerJitterBuffer if change == "_remove_frame" else JitterBuffer
        monkeypatch.setattr(owner, change, lambda *_: None)
        assert not marker_buffer.works()
    finally:
        marker_buffer.works.cache_clear()

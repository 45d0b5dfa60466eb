"""EncodedStream: one encoding for all, the newest picture first, and viewers who fall behind."""

import threading
import time
from typing import Any

import av
import pytest

from tests.scenes.streaming_viewers import bars, ignore, noise, output, streaming, taken
from tests.scenes.waiting import wait_until
from viewfinder.streaming import encoded_stream
from viewfinder.streaming.encoded_stream import EncodedFrame, EncodedStream


def push(stream: EncodedStream, *sequences: int, codec: str = "H264", captured_s: float | None = None) -> None:
    """Show pictures one by one and wait until each is encoded."""
    for sequence in sequences:
        before = stream.encoded[codec]
        stream.show(output(noise(sequence), sequence, captured_s if captured_s is not None else sequence / 30))
        wait_until(lambda before=before: stream.encoded[codec] > before)


def sequences(frames: list[EncodedFrame]) -> list[int]:
    return [frame.header["sequence"] for frame in frames]


def test_pictures_are_wanted_while_somebody_watches() -> None:
    with streaming() as stream:
        assert not stream.wants_frame
        viewer = stream.watch("H264", ignore)
        assert stream.wants_frame
        stream.leave(viewer)
        stream.leave(viewer)
        assert not stream.wants_frame
        stream.show(output(bars()))
        time.sleep(0.05)
        assert sum(stream.encoded.values()) == 0


def test_three_viewers_get_the_packets_of_one_encoding() -> None:
    with streaming() as stream:
        viewers = [stream.watch("H264", ignore) for _ in range(3)]
        push(stream, *range(5))
        wait_until(lambda: all(viewer.waiting == 5 for viewer in viewers))
        first, second, third = (taken(viewer) for viewer in viewers)
        assert stream.encoded == {"H264": 5}
        assert sequences(first) == [0, 1, 2, 3, 4]
        assert all(a.packet is b.packet is c.packet for a, b, c in zip(first, second, third, strict=True))
        assert [frame.is_keyframe for frame in first] == [True, False, False, False, False]


def test_each_codec_is_encoded_once_while_it_has_viewers() -> None:
    with streaming() as stream:
        h264, vp8 = stream.watch("H264", ignore), stream.watch("VP8", ignore)
        push(stream, *range(3), codec="VP8")
        wait_until(lambda: h264.waiting == vp8.waiting == 3)
        assert stream.encoded == {"H264": 3, "VP8": 3}
        assert sequences(taken(h264)) == sequences(taken(vp8)) == [0, 1, 2]
        stream.leave(vp8)
        push(stream, 3)
        assert stream.encoded == {"H264": 4, "VP8": 3}
        wait_until(lambda: set(stream._encoders) == {"H264"})


def test_pictures_that_wait_are_replaced_before_they_are_encoded(monkeypatch: pytest.MonkeyPatch) -> None:
    gate, entered = threading.Event(), threading.Event()
    convert = encoded_stream.i420_frame

    def gated(bgr: Any) -> Any:
        entered.set()
        assert gate.wait(10)
        return convert(bgr)

    with streaming() as stream:
        viewer = stream.watch("H264", ignore)
        push(stream, 0)
        monkeypatch.setattr(encoded_stream, "i420_frame", gated)
        for i in range(1, 10):
            stream.show(output(bars(), i, i / 30))
            assert entered.wait(10)
        gate.set()
        wait_until(lambda: stream.encoded["H264"] == 3)
        # 1 was in work while the others came and went; 9 is the newest of them.
        wait_until(lambda: viewer.waiting == 3)
        assert sequences(taken(viewer)) == [0, 1, 9]


def test_a_viewer_who_falls_behind_loses_all_and_comes_back_with_a_keyframe() -> None:
    with streaming(capacity=4, keyframe_gap_s=0.0) as stream:
        quick, slow = stream.watch("H264", ignore), stream.watch("H264", ignore)
        seen = []
        for i in range(10):
            push(stream, i)
            wait_until(lambda: quick.waiting)
            seen += taken(quick)
        # Four fitted; the fifth emptied the queue, and nobody made keyframes for a viewer who does not look.
        assert (slow.waiting, slow.dropped, slow.wants_frames) == (0, 10, False)
        assert stream.keyframes["H264"] == 1
        assert slow.take() is None
        assert slow.wants_frames
        for i in range(10, 13):
            push(stream, i)
            wait_until(lambda: quick.waiting)
            seen += taken(quick)
        back = taken(slow)
        assert sequences(back) == [10, 11, 12]
        assert [frame.is_keyframe for frame in back] == [True, False, False]
        # The quick one missed nothing, and its pictures can all be decoded.
        assert sequences(seen) == list(range(13))
        decoder: Any = av.CodecContext.create("h264", "r")
        assert sum(len(decoder.decode(av.Packet(bytes(frame.packet)))) for frame in seen) + len(decoder.decode(None)) == 13


def test_nothing_is_encoded_for_viewers_who_all_stopped_looking() -> None:
    with streaming(capacity=2) as stream:
        viewer = stream.watch("H264", ignore)
        push(stream, *range(3))
        wait_until(lambda: not stream.wants_frame)
        stream.show(output(bars(), 3))
        time.sleep(0.05)
        assert stream.encoded["H264"] == 3
        assert viewer.take() is None
        assert stream.wants_frame


def test_keyframes_asked_for_come_so_far_apart() -> None:
    with streaming(keyframe_gap_s=3600.0) as stream:
        viewer = stream.watch("H264", ignore)
        push(stream, 0)
        viewer.ask_keyframe()
        push(stream, 1, 2, 3)
        assert stream.keyframes["H264"] == 1
        stream._keyframe_gap_s = 0.0
        push(stream, 4, 5, 6)
        # One request, one keyframe.
        assert stream.keyframes["H264"] == 2
        wait_until(lambda: viewer.waiting == 7)
        assert [frame.is_keyframe for frame in taken(viewer)] == [True, False, False, False, True, False, False]
        # A newcomer begins with one; receivers that cannot ask get them at intervals.
        newcomer = stream.watch("H264", ignore)
        push(stream, 7)
        wait_until(lambda: newcomer.waiting)
        assert [(frame.header["sequence"], frame.is_keyframe) for frame in taken(newcomer)] == [(7, True)]
    with streaming(keyframe_every_s=0.0) as stream:
        stream.watch("H264", ignore)
        push(stream, 0, 1, 2)
        assert stream.keyframes["H264"] == 3


def test_a_change_of_size_goes_on_with_a_keyframe_of_the_new_size() -> None:
    with streaming() as stream:
        viewer = stream.watch("H264", ignore)
        for i, size in enumerate([(320, 180), (320, 180), (161, 113), (161, 113)]):
            stream.show(output(bars(*size), i, i / 30))
            wait_until(lambda i=i: stream.encoded["H264"] == i + 1)
        wait_until(lambda: viewer.waiting == 4)
        frames = taken(viewer)
        assert [frame.is_keyframe for frame in frames] == [True, False, True, False]
        decoder: Any = av.CodecContext.create("h264", "r")
        shown = [picture for frame in frames for picture in decoder.decode(av.Packet(bytes(frame.packet)))] + decoder.decode(None)
        # A last odd column and row are left out.
        assert [(picture.width, picture.height) for picture in shown] == [(320, 180)] * 2 + [(160, 112)] * 2


def test_capture_times_are_those_of_the_packets() -> None:
    times_s = [100.0, 100.04, 100.04, 100.1, 100.05, 100.2]
    with streaming() as stream:
        viewer = stream.watch("H264", ignore)
        for i, captured_s in enumerate(times_s):
            push(stream, i, captured_s=captured_s)
        wait_until(lambda: viewer.waiting == 6)
        frames = taken(viewer)
    assert [frame.captured_s for frame in frames] == times_s
    # 90 kHz from the first one on; what is shown twice or steps back comes one tick later than what was before it.
    assert [frame.packet.pts for frame in frames] == [0, 3600, 3601, 9000, 9001, 18000]
    assert all(frame.header["stages_ms"]["h264"] > 0 and frame.header["stages_ms"]["overlay"] == 1.5 for frame in frames)


def test_the_failure_of_the_camera_is_told_until_it_is_back() -> None:
    told = []
    with streaming() as stream:
        viewer = stream.watch("H264", lambda: told.append(viewer.failure))
        stream.fail("the camera was unplugged")
        assert told == ["the camera was unplugged"]
        assert stream.watch("H264", ignore).failure == "the camera was unplugged"
        push(stream, 0)
        assert stream.failure is None
        assert told[1] is None


def test_a_picture_that_cannot_be_encoded_does_not_end_the_stream(monkeypatch: pytest.MonkeyPatch) -> None:
    with streaming() as stream:
        viewer = stream.watch("H264", ignore)
        push(stream, 0)
        broken = stream._encoders["H264"]
        monkeypatch.setattr(broken, "encode", lambda *_: 1 / 0)
        stream.show(output(bars(), 1, 1.0))
        wait_until(lambda: stream._encoders.get("H264") is not broken)
        push(stream, 2, captured_s=2.0)
        wait_until(lambda: viewer.waiting == 2)
        assert [(frame.header["sequence"], frame.is_keyframe) for frame in taken(viewer)] == [(0, True), (2, True)]


def test_an_unknown_codec_is_refused_and_the_thread_ends() -> None:
    with streaming() as stream:
        with pytest.raises(ValueError, match="H264"):
            stream.watch("AV1", ignore)
        assert "encode" in {thread.name for thread in threading.enumerate()}
    assert "encode" not in {thread.name for thread in threading.enumerate()}

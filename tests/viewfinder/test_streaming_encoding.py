"""From pictures to packets and files: luma and chroma by H.273, what H.264 and VP8 make of them. The decoder is FFmpeg's.
EncodedStream: one encoding for all, the newest picture first, and viewers who fall behind."""

import threading
import time
from typing import Any

import av
import numpy as np
import pytest

from mrbokeh.video.color import BT709, LIMITED, VideoColor
from mrbokeh.video.frames import display_bgr
from tests.support.streaming_viewers import BARS, HEIGHT, WIDTH, bar_centres, bars, ignore, noise, output, streaming, taken
from tests.support.waiting import wait_until
from viewfinder.streaming import encoded_stream
from viewfinder.streaming.encoded_stream import EncodedFrame, EncodedStream
from viewfinder.streaming.encoders import STREAM_COLOR, StreamQuality, VideoEncoder, h264_encoder, i420_frame, vp8_encoder

FULL_709 = VideoColor(matrix=1, code_range=2, transfer=1, primaries=1)
MAKERS = {"h264": h264_encoder, "libvpx": vp8_encoder}


def plain_i420(bgr: np.ndarray, color: VideoColor) -> list[np.ndarray]:
    """H.273, 8.3 as it is printed, in floating point: luma of each pixel, colour differences of the mean of 2x2."""
    red, blue = color.luma_weights
    bgr = bgr[: bgr.shape[0] & ~1, : bgr.shape[1] & ~1].astype(float) / 255

    def luma(picture: np.ndarray) -> np.ndarray:
        return picture @ np.array([blue, 1 - red - blue, red])

    quarter = bgr.reshape(bgr.shape[0] // 2, 2, bgr.shape[1] // 2, 2, 3).mean(axis=(1, 3))
    differences = [(quarter[..., 0] - luma(quarter)) / (2 * (1 - blue)), (quarter[..., 2] - luma(quarter)) / (2 * (1 - red))]
    limited = color.code_range == LIMITED
    planes = [16 + 219 * luma(bgr) if limited else 255 * luma(bgr), *(128 + (224 if limited else 255) * each for each in differences)]
    return [np.clip(plane, 0, 255) for plane in planes]


def planes_of(frame: Any) -> list[np.ndarray]:
    return [np.frombuffer(each, np.uint8).reshape(each.height, each.line_size)[:, : each.width] for each in frame.planes]


def nal_types(packet: Any) -> list[int]:
    """Types of the units of an H.264 packet: 1 refers to others, 5 stands alone (IDR), 7 and 8 are parameter sets, 6 is a remark."""
    return [part[0] & 31 for part in bytes(packet).replace(b"\0\0\0\1", b"\0\0\1").split(b"\0\0\1")[1:]]


def decoded(codec: str, packets: list[Any]) -> list[Any]:
    decoder: Any = av.CodecContext.create(codec, "r")
    return [frame for packet in packets for frame in decoder.decode(av.Packet(bytes(packet)))] + decoder.decode(None)


def encode(encoder: VideoEncoder, pictures: list[np.ndarray]) -> list[Any]:
    return [encoder.encode(i420_frame(picture), 3000 * i) for i, picture in enumerate(pictures)]


@pytest.mark.parametrize("color", [STREAM_COLOR, BT709, FULL_709])
@pytest.mark.parametrize("size", [(64, 48), (31, 17)])
def test_the_conversion_agrees_with_the_formula(color: VideoColor, size: tuple[int, int]) -> None:
    bgr = np.random.default_rng(0).integers(0, 256, (size[1], size[0], 3), np.uint8)
    for ours, plain in zip(planes_of(i420_frame(bgr, color)), plain_i420(bgr, color), strict=True):
        # Rounded to nearest: never further than half a code, and a trace for the integers of 2**-16.
        np.testing.assert_allclose(ours, plain, atol=0.51)


def test_bars_have_the_codes_of_bt601() -> None:
    """Studio codes of BT.601 at 100 %: white 235, black 16, red 81/90/240, green 145/54/34, blue 41/240/110; grey 128 is 125.9."""
    y, u, v = (bar_centres(plane[..., None])[:, 0] for plane in planes_of(i420_frame(bars(), STREAM_COLOR)))
    np.testing.assert_array_equal(y[:6], [16, 235, 81, 145, 41, 126])
    np.testing.assert_array_equal(u[:6], [128, 128, 90, 54, 240, 128])
    np.testing.assert_array_equal(v[:6], [128, 128, 240, 34, 110, 128])


@pytest.mark.parametrize("codec", MAKERS)
def test_colours_survive_encoding_and_the_stream_says_what_they_are(codec: str) -> None:
    encoder, started_s = MAKERS[codec](WIDTH, HEIGHT), time.perf_counter()
    frames = decoded(codec, encode(encoder, [bars()] * 10))
    assert len(frames) == 10 and 0 < encoder.encode_ms <= 1000 * (time.perf_counter() - started_s)
    shown = display_bgr(frames[-1], STREAM_COLOR, (WIDTH, HEIGHT))
    # Limited range has 219 steps for 255 codes, which alone costs up to 1; the quantiser of a flat area little more.
    np.testing.assert_allclose(bar_centres(shown), BARS.astype(int), atol=3)
    if codec == "h264":
        # H.273: matrix 6 is BT.601, range 1 is limited, transfer and primaries 1 are BT.709.
        assert (frames[0].colorspace, frames[0].color_range, frames[0].color_trc, frames[0].color_primaries) == (6, 1, 1, 1)


def test_h264_is_constrained_baseline_at_the_level_that_fits() -> None:
    """SPS: profile 66, constraint flags 0 and 1 set; level 1.3 has 396 macroblocks and 11880/s, 320x180 at 30 needs 240 and 7200/s.

    1280x720 at 30 needs 3600 and 108000/s, the limits of level 3.1. The bitrate is below the limits of both (768 kb/s, 14 Mb/s).
    """
    for size, bits_per_s, level in (((320, 180), 700_000, 13), ((1280, 720), 4_000_000, 31)):
        packet = encode(h264_encoder(*size, StreamQuality(bitrate_bps=bits_per_s)), [np.zeros((size[1], size[0], 3), np.uint8)])[0]
        assert nal_types(packet)[:2] == [7, 8]
        profile, constraints, found = bytes(packet)[5:8]
        assert (profile, constraints & 0xC0, found) == (66, 0xC0, level)


def test_each_picture_gives_its_packet_at_once_and_in_order() -> None:
    packets = encode(h264_encoder(WIDTH, HEIGHT), [noise(i) for i in range(12)])
    assert [packet.pts for packet in packets] == [3000 * i for i in range(12)] == [packet.dts for packet in packets]
    assert [set(nal_types(packet)) & {1, 5, 7, 8} for packet in packets] == [{5, 7, 8}] + [{1}] * 11


@pytest.mark.parametrize("codec", MAKERS)
def test_a_decoder_can_begin_at_a_forced_keyframe(codec: str) -> None:
    encoder = MAKERS[codec](WIDTH, HEIGHT)
    packets = encode(encoder, [noise(i) for i in range(5)])
    encoder.force_keyframe()
    packets += [encoder.encode(i420_frame(bars()), 3000 * i) for i in range(5, 9)]
    assert [bool(packet.is_keyframe) for packet in packets] == [i in (0, 5) for i in range(9)]
    if codec == "h264":
        assert set(nal_types(packets[5])) >= {5, 7, 8}
    whole, late = decoded(codec, packets), decoded(codec, packets[5:])
    assert len(late) == 4
    for a, b in zip(planes_of(whole[-1]), planes_of(late[-1]), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("codec", MAKERS)
def test_the_bitrate_is_kept_and_no_picture_left_out(codec: str) -> None:
    """Two seconds of fresh noise, which nothing compresses, at 2 Mb/s."""
    packets = encode(MAKERS[codec](WIDTH, HEIGHT, StreamQuality(bitrate_bps=2_000_000)), [noise(i) for i in range(60)])
    bits = 8 * sum(packet.size for packet in packets)
    # The buffer (half a second, a second for VP8) may be spent besides.
    assert 2_000_000 < bits < 6_000_000 and len(decoded(codec, packets)) == 60


def test_the_bitrate_follows_the_size_within_bounds() -> None:
    assert StreamQuality().bits_per_s(1280, 720) == round(0.2 * 1280 * 720 * 30)
    assert StreamQuality().bits_per_s(320, 180) == 1_500_000 and StreamQuality().bits_per_s(3840, 2160) == 12_000_000
    assert StreamQuality(bitrate_bps=800_000).bits_per_s(1280, 720) == 800_000


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
        assert stream.encoded == {"H264": 5} and sequences(first) == [0, 1, 2, 3, 4]
        assert all(a.packet is b.packet is c.packet for a, b, c in zip(first, second, third, strict=True))
        assert [frame.is_keyframe for frame in first] == [True, False, False, False, False]


def test_each_codec_is_encoded_once_while_it_has_viewers() -> None:
    with streaming() as stream:
        h264, vp8 = stream.watch("H264", ignore), stream.watch("VP8", ignore)
        push(stream, *range(3), codec="VP8")
        wait_until(lambda: h264.waiting == vp8.waiting == 3)
        assert stream.encoded == {"H264": 3, "VP8": 3} and sequences(taken(h264)) == sequences(taken(vp8)) == [0, 1, 2]
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
        assert (slow.waiting, slow.dropped, slow.wants_frames) == (0, 10, False) and stream.keyframes["H264"] == 1
        assert slow.take() is None and slow.wants_frames
        for i in range(10, 13):
            push(stream, i)
            wait_until(lambda: quick.waiting)
            seen += taken(quick)
        back = taken(slow)
        assert sequences(back) == [10, 11, 12] and [frame.is_keyframe for frame in back] == [True, False, False]
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
        assert stream.encoded["H264"] == 3 and viewer.take() is None and stream.wants_frame


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
        stream.fail("/dev/bus/the camera was unplugged")
        assert told == ["the camera was unplugged"]
        assert stream.watch("H264", ignore).failure == "the camera was unplugged"
        push(stream, 0)
        assert stream.failure is None and told[1] is None


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

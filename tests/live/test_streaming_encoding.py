"""From pictures to packets: luma and chroma by H.273, and what H.264 and VP8 make of them. The decoder is FFmpeg's."""

import time
from typing import Any

import av
import numpy as np
import pytest

from mrbokeh.video.color import BT709, LIMITED, VideoColor
from mrbokeh.video.frames import display_bgr
from tests.scenes.streaming_viewers import BARS, HEIGHT, WIDTH, bar_centres, bars, noise
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
def test_colours_survive_encoding(codec: str) -> None:
    frames = decoded(codec, encode(MAKERS[codec](WIDTH, HEIGHT), [bars()] * 10))
    assert len(frames) == 10
    shown = display_bgr(frames[-1], STREAM_COLOR, (WIDTH, HEIGHT))
    # Limited range has 219 steps for 255 codes, which alone costs up to 1; the quantiser of a flat area little more.
    np.testing.assert_allclose(bar_centres(shown), BARS.astype(int), atol=3)


def test_the_stream_itself_says_what_its_colours_are() -> None:
    frame = decoded("h264", encode(h264_encoder(WIDTH, HEIGHT), [bars()]))[0]
    # H.273: matrix 6 is BT.601, range 1 is limited, transfer and primaries 1 are BT.709.
    assert (frame.colorspace, frame.color_range, frame.color_trc, frame.color_primaries) == (6, 1, 1, 1)


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
    assert 2_000_000 < bits < 6_000_000
    assert len(decoded(codec, packets)) == 60


def test_the_bitrate_follows_the_size_within_bounds() -> None:
    assert StreamQuality().bits_per_s(1280, 720) == round(0.2 * 1280 * 720 * 30)
    assert StreamQuality().bits_per_s(320, 180) == 1_500_000
    assert StreamQuality().bits_per_s(3840, 2160) == 12_000_000
    assert StreamQuality(bitrate_bps=800_000).bits_per_s(1280, 720) == 800_000


def test_the_time_of_encoding_is_measured() -> None:
    encoder = h264_encoder(WIDTH, HEIGHT)
    started_s = time.perf_counter()
    encode(encoder, [noise(0)])
    assert 0 < encoder.encode_ms <= 1000 * (time.perf_counter() - started_s)

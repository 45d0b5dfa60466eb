"""Encoders of the stream: finished pictures to I420 with an explicit matrix and range, and H.264 or VP8 of them, a packet for each at once.

H.264 is x264's constrained baseline as every browser takes it: no delay, parameter sets with every IDR, colour tags in the stream. VP8 is
for browsers that cannot play it (Chromium without proprietary codecs); it has no colour tags: BT.601 limited is what it means.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Int64, UInt8

from mrbokeh.video._frames_numba import SHIFT, i420_from_bgr
from mrbokeh.video.color import LIMITED, VideoColor
from viewfinder.frames import Bgr

# The clock of video over RTP (RFC 3551).
TICKS_PER_S = 90_000
TIME_BASE = Fraction(1, TICKS_PER_S)
# What keeps a panned textured picture at about 40 dB; more on a large picture, but never so little that a small one falls apart.
_BITS_PER_PIXEL, _LEAST_BPS, _MOST_BPS = 0.2, 1_500_000, 12_000_000


@dataclass(frozen=True)
class StreamQuality:
    """Quality of a stream.

    fps: what the rate control expects; frames may come at any time. bitrate_bps: None follows the size of the picture.
    """

    fps: float = 30.0
    bitrate_bps: int | None = None

    def bits_per_s(self, width_px: int, height_px: int) -> int:
        by_size = round(_BITS_PER_PIXEL * width_px * height_px * self.fps)
        return self.bitrate_bps or min(max(by_size, _LEAST_BPS), _MOST_BPS)


# A PyAV codec context for (width_px, height_px, quality).
OpenContext = Callable[[int, int, StreamQuality], Any]


class VideoEncoder:
    """Encoder of PyAV frames of one size (see `i420_frame`); `keyframes` and `encode_ms` (of the last frame) are measured.

    The first packet is a picture that stands alone (IDR), and so is the next one after `force_keyframe`; all others refer to
    the one before, so that none may be left out.
    """

    def __init__(self, open_context: OpenContext, width_px: int, height_px: int, quality: StreamQuality) -> None:
        self.size_px = (width_px, height_px)
        self._context = open_context(width_px, height_px, quality)
        self._forced = True
        self.encode_ms = 0.0

    def force_keyframe(self) -> None:
        self._forced = True

    def encode(self, frame: Any, ticks: int) -> Any:
        """Return the packet (`av.Packet`) of a frame. ticks: its time in units of TIME_BASE; must grow."""
        from av.video.frame import PictureType

        started_s = time.perf_counter()
        frame.pts, frame.time_base = ticks, TIME_BASE
        frame.pict_type = PictureType.I if self._forced else PictureType.NONE
        self._forced = False
        (packet,) = self._context.encode(frame)
        self.encode_ms = 1000 * (time.perf_counter() - started_s)
        return packet

    def close(self) -> None:
        """Let the codec go; what it still holds is of no use to anybody."""
        self._context = None


def tagged_context(codec: str, width_px: int, height_px: int, quality: StreamQuality) -> Any:
    """Return a PyAV encoder of that name for frames of `i420_frame`, with nothing but size, rate and colour set."""
    import av

    context: Any = av.CodecContext.create(codec, "w")
    context.width, context.height, context.pix_fmt = width_px, height_px, "yuv420p"
    context.time_base, context.framerate = TIME_BASE, Fraction(quality.fps).limit_denominator(1001)
    context.bit_rate = quality.bits_per_s(width_px, height_px)
    context.colorspace, context.color_range = STREAM_COLOR.matrix, STREAM_COLOR.code_range
    context.color_trc, context.color_primaries = STREAM_COLOR.transfer, STREAM_COLOR.primaries
    context.max_b_frames = 0
    # Only who asks for a keyframe gets one: they are ten times as large as the others and arrive late.
    context.gop_size = 1_000_000
    # The compositor needs the other cores; superfast x264 takes 10 ms for 720p on one.
    context.thread_count = 1
    return context


# BT.601 at every size: browsers take VP8 for nothing else, and show H.264 that is tagged so within 2 codes. One conversion serves both.
STREAM_COLOR = VideoColor(matrix=6, code_range=LIMITED, transfer=1, primaries=1)


def even_size(bgr: Bgr) -> tuple[int, int]:
    """Return (width, height) in px of the stream of a picture; a last odd column or row is left out, for chroma is halved."""
    return bgr.shape[1] & ~1, bgr.shape[0] & ~1


def i420_frame(bgr: Bgr, color: VideoColor = STREAM_COLOR) -> Any:
    """Return a tagged PyAV frame (yuv420p) of 8-bit display codes. Chroma belongs to the middle of 2x2 pixels, as browsers show it.

    FFmpeg's own conversion is half a code too dark in the mean (see mrbokeh.video.frames); OpenCV's takes the chroma of one pixel
    in four, so that coloured edges flicker.
    """
    import av

    width, height = even_size(bgr)
    frame = av.VideoFrame(width, height, "yuv420p")
    y, u, v = (_lines(plane) for plane in frame.planes)
    i420_from_bgr(np.ascontiguousarray(bgr), y, u, v, coefficients(color), 16 if color.code_range == LIMITED else 0)
    frame.colorspace, frame.color_range = color.matrix, color.code_range
    frame.color_trc, frame.color_primaries = color.transfer, color.primaries
    return frame


def _lines(plane: Any) -> UInt8[np.ndarray, "rows columns"]:
    """Return the numbers of a plane, padded lines whole; they live as long as the frame."""
    return np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)


@lru_cache(maxsize=8)
def coefficients(color: VideoColor) -> Int64[np.ndarray, "3 3"]:
    """Return rows y, u, v; columns blue, green, red; in units of 2**-16 (H.273, 8.3). Grey has no chroma, and white is exact."""
    red, blue = color.luma_weights
    green = 1.0 - red - blue
    luma_span, chroma_span = (219 / 255, 224 / 255) if color.code_range == LIMITED else (1.0, 1.0)
    y = np.array([blue, green, red])
    u = (np.array([1.0, 0.0, 0.0]) - y) / (2 * (1 - blue)) * chroma_span
    v = (np.array([0.0, 0.0, 1.0]) - y) / (2 * (1 - red)) * chroma_span
    rounded = np.rint(np.stack([y * luma_span, u, v]) * (1 << SHIFT)).astype(np.int64)
    rounded[:, 1] = np.array([round(luma_span * (1 << SHIFT)), 0, 0]) - rounded[:, 0] - rounded[:, 2]
    return rounded


# How much of a second a burst (an IDR) may take of the line; smaller gives later and uglier keyframes.
_BUFFER_S = 0.5


def h264_encoder(width_px: int, height_px: int, quality: StreamQuality | None = None) -> VideoEncoder:
    """Make an encoder of H.264 for even sizes. Its level is the lowest that fits size, rate and bitrate (x264 finds it)."""
    return VideoEncoder(_h264_context, width_px, height_px, quality or StreamQuality())


def _h264_context(width_px: int, height_px: int, quality: StreamQuality) -> Any:
    context = tagged_context("libx264", width_px, height_px, quality)
    kilobits = quality.bits_per_s(width_px, height_px) // 1000
    context.options = {
        "preset": "superfast",
        "tune": "zerolatency",
        "profile": "baseline",
        # chromaloc 1: in the middle of 2x2 pixels. Scene cuts would be keyframes that nobody asked for.
        "x264-params": f"repeat-headers=1:scenecut=0:chromaloc=1:vbv-maxrate={kilobits}:vbv-bufsize={round(kilobits * _BUFFER_S)}",
    }
    return context


def vp8_encoder(width_px: int, height_px: int, quality: StreamQuality | None = None) -> VideoEncoder:
    return VideoEncoder(_vp8_context, width_px, height_px, quality or StreamQuality())


def _vp8_context(width_px: int, height_px: int, quality: StreamQuality) -> Any:
    context = tagged_context("libvpx", width_px, height_px, quality)
    bits_per_s = str(quality.bits_per_s(width_px, height_px))
    context.qmin, context.qmax = 2, 56
    # Equal bounds give a constant rate; libvpx may not leave out frames, for each carries its capture time.
    context.options = {
        "deadline": "realtime",
        "cpu-used": "-6",
        "lag-in-frames": "0",
        "auto-alt-ref": "0",
        "drop-threshold": "0",
        "minrate": bits_per_s,
        "maxrate": bits_per_s,
        "bufsize": bits_per_s,
        "undershoot-pct": "100",
        "overshoot-pct": "15",
        "static-thresh": "1",
    }
    return context


# In the order in which they are preferred.
ENCODERS: dict[str, Callable[[int, int, StreamQuality], VideoEncoder]] = {"H264": h264_encoder, "VP8": vp8_encoder}


class RtpClock:
    """Clock of capture times in RTP's ticks; it grows also where a picture is shown twice or a camera's clock steps back."""

    def __init__(self) -> None:
        self._origin_s: float | None = None
        self._last_ticks = -1

    def ticks(self, captured_s: float) -> int:
        """Return the time since the first picture in units of TIME_BASE."""
        if self._origin_s is None:
            self._origin_s = captured_s
        self._last_ticks = max(self._last_ticks + 1, round((captured_s - self._origin_s) * TICKS_PER_S))
        return self._last_ticks

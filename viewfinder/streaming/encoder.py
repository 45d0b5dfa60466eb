"""VideoEncoder: pictures in, one packet for each out, at once; what H.264 and VP8 have in common."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

# The clock of video over RTP (RFC 3551).
TICKS_PER_S = 90_000
TIME_BASE = Fraction(1, TICKS_PER_S)
# What keeps a panned textured picture at about 40 dB; more on a large picture, but never so little that a small one falls apart.
_BITS_PER_PIXEL, _LEAST_BPS, _MOST_BPS = 0.2, 1_500_000, 12_000_000


@dataclass(frozen=True)
class StreamQuality:
    """fps: what the rate control expects; frames may come at any time. bitrate_bps: None follows the size of the picture."""

    fps: float = 30.0
    bitrate_bps: int | None = None

    def bits_per_s(self, width_px: int, height_px: int) -> int:
        by_size = round(_BITS_PER_PIXEL * width_px * height_px * self.fps)
        return self.bitrate_bps or min(max(by_size, _LEAST_BPS), _MOST_BPS)


# A PyAV codec context for (width_px, height_px, quality).
OpenContext = Callable[[int, int, StreamQuality], Any]


class VideoEncoder:
    """Encodes PyAV frames of one size (see `i420_frame`); `keyframes` and `encode_ms` (of the last frame) are measured.

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
        """The packet (`av.Packet`) of a frame. ticks: its time in units of TIME_BASE; must grow."""
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
    """A PyAV encoder of that name for frames of `i420_frame`, with nothing but size, rate and colour set."""
    import av

    from viewfinder.streaming.i420 import STREAM_COLOR

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

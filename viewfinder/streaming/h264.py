"""H.264 as every browser takes it: x264, constrained baseline, no delay, parameter sets with every IDR, colour tags in the stream."""

from typing import Any

from viewfinder.streaming.encoder import StreamQuality, VideoEncoder, tagged_context

# How much of a second a burst (an IDR) may take of the line; smaller gives later and uglier keyframes.
_BUFFER_S = 0.5


def h264_encoder(width_px: int, height_px: int, quality: StreamQuality | None = None) -> VideoEncoder:
    """Even sizes. The level in the stream is the lowest that fits size, rate and bitrate (x264 finds it)."""
    return VideoEncoder(_context, width_px, height_px, quality or StreamQuality())


def _context(width_px: int, height_px: int, quality: StreamQuality) -> Any:
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

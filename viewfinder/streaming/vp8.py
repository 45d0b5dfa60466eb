"""VP8 for browsers that cannot play H.264 (Chromium without proprietary codecs). It has no colour tags: BT.601 limited is what it means."""

from typing import Any

from viewfinder.streaming.encoder import StreamQuality, VideoEncoder, tagged_context


def vp8_encoder(width_px: int, height_px: int, quality: StreamQuality | None = None) -> VideoEncoder:
    return VideoEncoder(_context, width_px, height_px, quality or StreamQuality())


def _context(width_px: int, height_px: int, quality: StreamQuality) -> Any:
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

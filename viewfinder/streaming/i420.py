"""From finished pictures to what video encoders take: luma, and chroma at half the resolution, of an explicit matrix and range."""

from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Int64, UInt8

from mrbokeh.video.color import LIMITED, VideoColor
from viewfinder.flow.frames import Bgr
from viewfinder.streaming._i420_numba import SHIFT, i420_from_bgr

# BT.601 at every size: browsers take VP8 for nothing else, and show H.264 that is tagged so within 2 codes. One conversion serves both.
STREAM_COLOR = VideoColor(matrix=6, code_range=LIMITED, transfer=1, primaries=1)


def even_size(bgr: Bgr) -> tuple[int, int]:
    """(width, height) in px of the stream of a picture; a last odd column or row is left out, for chroma is halved."""
    return bgr.shape[1] & ~1, bgr.shape[0] & ~1


def i420_frame(bgr: Bgr, color: VideoColor = STREAM_COLOR) -> Any:
    """A tagged PyAV frame (yuv420p) of 8-bit display codes. Chroma belongs to the middle of 2x2 pixels, as browsers show it.

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
    """The numbers of a plane, padded lines whole; they live as long as the frame."""
    return np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)


@lru_cache(maxsize=8)
def coefficients(color: VideoColor) -> Int64[np.ndarray, "3 3"]:
    """Rows y, u, v; columns blue, green, red; in units of 2**-16 (H.273, 8.3). Grey has no chroma, and white is exact."""
    red, blue = color.luma_weights
    green = 1.0 - red - blue
    luma_span, chroma_span = (219 / 255, 224 / 255) if color.code_range == LIMITED else (1.0, 1.0)
    y = np.array([blue, green, red])
    u = (np.array([1.0, 0.0, 0.0]) - y) / (2 * (1 - blue)) * chroma_span
    v = (np.array([0.0, 0.0, 1.0]) - y) / (2 * (1 - red)) * chroma_span
    rounded = np.rint(np.stack([y * luma_span, u, v]) * (1 << SHIFT)).astype(np.int64)
    rounded[:, 1] = np.array([round(luma_span * (1 << SHIFT)), 0, 0]) - rounded[:, 0] - rounded[:, 2]
    return rounded

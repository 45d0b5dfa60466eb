"""A decoded PyAV frame as the upright picture that the viewfinder shows."""

from typing import Any

import numpy as np

from mrbokeh.video.color import VideoColor
from mrbokeh.video.frames import display_bgr
from viewfinder.flow.frames import Bgr
from viewfinder.sources.size_limit import SizeLimit


def upright_bgr(frame: Any, color: VideoColor, limit: SizeLimit) -> Bgr:
    """(H, W, 3) display codes, blue first, turned as the stream says (to the nearest quarter turn), within the limit."""
    turns = round(frame.rotation / 90) % 4
    if turns % 2:
        height_px, width_px = limit.fit(frame.height, frame.width)
    else:
        width_px, height_px = limit.fit(frame.width, frame.height)
    return np.ascontiguousarray(np.rot90(display_bgr(frame, color, (width_px, height_px)), turns))

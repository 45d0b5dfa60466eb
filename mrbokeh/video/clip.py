"""Videos to and from scene-linear Rec.709 pictures with their times. Colour tags are explicit both ways (see `video_color`)."""

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from mrbokeh.system.errors import InputError
from mrbokeh.video.alpha import has_alpha, stored_alpha
from mrbokeh.video.color import VideoColor, color_of
from mrbokeh.video.decoding import decoded, frame_rate, opened, quarter_turns
from mrbokeh.video.frames import display_bgr, linear_rgb
from mrbokeh.video.writer import VideoWriter as VideoWriter


@dataclass(frozen=True)
class Frame:
    """rgb: (H, W, 3) linear Rec.709, upright. time_s: from the start of the video, as it is written in the file.

    alpha: (H, W) in [0, 1], by which rgb is multiplied; None is opaque.
    """

    rgb: Float32[np.ndarray, "height width 3"]
    time_s: float
    alpha: Float32[np.ndarray, "height width"] | None = None


@dataclass(frozen=True)
class DisplayFrame:
    """bgr: (H, W, 3) the video's own code values in 8 bit, blue first, upright, for a preview."""

    bgr: UInt8[np.ndarray, "height width 3"]
    time_s: float


@dataclass(frozen=True)
class VideoInfo:
    """What a video's header and first frame say. Sizes are those of the upright picture; frame_count is None where unknown.

    rotation_deg: counter-clockwise, that brings the stored picture upright. has_alpha: whether frames hold coverage, be they opaque.
    """

    width_px: int
    height_px: int
    frame_rate: Fraction
    time_base: Fraction
    frame_count: int | None
    color: VideoColor
    rotation_deg: int
    has_alpha: bool = False

    @property
    def quarter_turns(self) -> int:
        """Counter-clockwise, that bring the stored picture upright."""
        return self.rotation_deg // 90 % 4


def probe(path: Path, *, as_codes: bool = False) -> VideoInfo:
    """Header and first frame of a video; refuses what `read_frames` would refuse. as_codes: as of `upright_frame`."""
    with opened(path) as (container, stream):
        frame = next(container.decode(stream), None)
        if frame is None:
            raise InputError(f"{path} holds no picture that can be decoded: it is damaged or cut off")
        width_px, height_px = (frame.height, frame.width) if quarter_turns(frame, path) % 2 else (frame.width, frame.height)
        color = color_of(frame, str(path), as_codes=as_codes)
        count, turned = stream.frames or None, frame.rotation
        return VideoInfo(width_px, height_px, frame_rate(stream), stream.time_base, count, color, turned, has_alpha(frame))


def read_frames(path: Path, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
    """Frames `start` to `stop` (excluded) of a video as linear light, one at a time; times are kept, also variable ones.

    Coverage is left out: colour is as it is stored, straight (`mrbokeh.video.picture_sources` has both).
    """
    for stored, time_s in decoded(path, start, stop):
        yield upright_frame(stored, time_s, path)


def upright_frame(stored: Any, time_s: float, path: Path, *, as_codes: bool = False) -> Frame:
    """A decoded PyAV frame as linear light, turned as it is to be shown.

    as_codes: the code values of red, green and blue instead (0 black, 1 white), for a curve and primaries that the file does not say.
    """
    rgb = linear_rgb(stored, color_of(stored, str(path), as_codes=as_codes))
    return Frame(np.ascontiguousarray(np.rot90(rgb, quarter_turns(stored, path))), time_s)


def upright_alpha(stored: Any, path: Path) -> Float32[np.ndarray, "height width"]:
    """The coverage of a decoded PyAV frame that has some, in [0, 1], turned as it is to be shown."""
    return np.ascontiguousarray(np.rot90(stored_alpha(stored), quarter_turns(stored, path)))


def has_alpha_apart(path: Path) -> bool:
    """Whether a video keeps coverage apart from its pictures, as VP8 and VP9 do, where FFmpeg's own decoders do not read it."""
    with opened(path) as (_, stream):
        return bool(stream.metadata.get("alpha_mode") == "1")


def read_display_frames(path: Path, width_px: int, height_px: int) -> Iterator[DisplayFrame]:
    """All frames scaled to a size as 8-bit code values; quicker than `read_frames`, for previews. Primaries stay as they are."""
    for stored, time_s in decoded(path, 0, None):
        turns = quarter_turns(stored, path)
        size = (height_px, width_px) if turns % 2 else (width_px, height_px)
        yield DisplayFrame(np.ascontiguousarray(np.rot90(display_bgr(stored, color_of(stored, str(path)), size), turns)), time_s)

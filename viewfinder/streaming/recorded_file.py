"""The file of one recording: pictures in, each at the time at which it was captured, until they end or change their size."""

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from mrbokeh.compositing.overlay import CodeTables
from mrbokeh.system.errors import InputError
from mrbokeh.video.clip import VideoWriter
from mrbokeh.video.frames import encoding_for
from viewfinder.flow.frames import Bgr, OutputFrame
from viewfinder.streaming.encoder import TIME_BASE
from viewfinder.streaming.i420 import even_size

# The compositor must not starve: the quality of files that are made at leisure in half of the time, at 2.5 times the size.
_LIVE_H264 = {"crf": "14", "preset": "superfast"}


@dataclass(frozen=True)
class FileForm:
    """tables: of the codes of the pictures. encoding: of mrbokeh.video.frames, None goes by the suffix."""

    tables: CodeTables
    frame_rate: Fraction
    encoding: str | None = None


@dataclass(frozen=True)
class Written:
    """note: why the file ended before the pictures did, None where it did not."""

    frame_count: int
    duration_s: float
    note: str | None = None


def write_recording(path: Path, frames: Iterator[OutputFrame], form: FileForm) -> Written:
    """The file appears whole at the end. InputError where there is no picture."""
    first = next(frames, None)
    if first is None:
        raise InputError(f"{path}: expected at least one picture, got none; the video was not written")
    height, width = _stored(path, first.bgr, form).shape[:2]
    last_s = first.captured_s
    with _writer(path, width, height, form) as writer:
        _write(writer, _stored(path, first.bgr, form), 0.0, form)
        for frame in frames:
            stored = _stored(path, frame.bgr, form)
            if stored.shape[:2] != (height, width):
                note = f"the size of the picture changed from {width}x{height} px: the recording ended there"
                return Written(writer.frame_count, last_s - first.captured_s, note)
            # A picture that is shown twice, or that a camera's clock set back, has no time of its own.
            if frame.captured_s - last_s >= float(TIME_BASE):
                _write(writer, stored, frame.captured_s - first.captured_s, form)
                last_s = frame.captured_s
    return Written(writer.frame_count, last_s - first.captured_s)


def _writer(path: Path, width_px: int, height_px: int, form: FileForm) -> VideoWriter:
    writer = VideoWriter(path, width_px, height_px, form.frame_rate, TIME_BASE, encoding=form.encoding)
    if writer.encoding.codec == "libx264":
        writer.encoding = writer.encoding._replace(options=_LIVE_H264)
    return writer


def _write(writer: VideoWriter, bgr: UInt8[np.ndarray, "rows columns 3"], time_s: float, form: FileForm) -> None:
    writer.write(form.tables.linear_from_code[bgr[..., ::-1]], time_s)


def _stored(path: Path, bgr: Bgr, form: FileForm) -> UInt8[np.ndarray, "rows columns 3"]:
    """Without a last odd row and column where chroma is halved."""
    if "420" not in encoding_for(path, form.encoding).pixel_format:
        return bgr
    width, height = even_size(bgr)
    return bgr[:height, :width]

"""Video files for tests, written by the code under test and past it, and the command that they are for."""

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

from mrbokeh.commands.video import app
from mrbokeh.video.writer import VideoWriter
from tests.support.command_line import printed_by


def filmed(path: Path, pictures: Iterable[np.ndarray], rate: int = 25, **settings: Any) -> Path:
    """Linear pictures, one after the other; settings: of VideoWriter."""
    first, *more = pictures
    with VideoWriter(path, first.shape[1], first.shape[0], Fraction(rate), **settings) as writer:
        for index, rgb in enumerate((first, *more)):
            writer.write(rgb, index / rate)
    return path


def turned_clip(clip: Path, out: Path, turn_deg: int) -> Path:
    """A QuickTime file that says that its pictures are to be turned counter-clockwise, as phones write it."""
    with av.open(str(clip)) as source, av.open(str(out), "w") as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        stream.set_display_rotation(turn_deg)
        for packet in source.demux(source.streams.video[0]):
            if packet.size:
                packet.stream = stream
                target.mux(packet)
    return out


def encoded(
    path: Path, codec: str, pixels: str, *frames: av.VideoFrame, turn_deg: int = 0, options: dict[str, str] | None = None, **tags: int
) -> Path:
    """A video of 25 frames per second; tags: of its colour, by the names that PyAV gives them."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25, options=options or {})
        stream.width, stream.height, stream.pix_fmt = frames[0].width, frames[0].height, pixels
        if turn_deg:
            stream.set_display_rotation(turn_deg)
        for number, frame in enumerate(frames):
            frame.pts = number
            for name, value in tags.items():
                setattr(frame, name, value)
                setattr(stream.codec_context, name, value)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def video(*arguments: object) -> str:
    """What `mrbokeh video` prints; its errors are raised here. One process, unless told otherwise."""
    alone = () if "--workers" in arguments else ("--workers", "1")
    return printed_by(app, *arguments, *alone)

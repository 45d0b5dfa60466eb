"""Whether a clip has alpha of its own, which the frames that are made from it do not keep."""

from mrbokeh.picture_sources.base import PictureSource
from mrbokeh.plate_alpha import read_alpha
from mrbokeh.video_decoding import opened


def has_alpha(source: PictureSource, frame: int = 0) -> bool:
    """Of numbered pictures as one of them tells, of a video as its format of pixels does."""
    path = source.file_of(frame)
    if path is not None:
        return read_alpha(path) is not None
    with opened(source.path) as (_, stream):
        return any(component.is_alpha for component in stream.codec_context.format.components)

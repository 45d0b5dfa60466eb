"""VideoSource: a video whose frames are counted once and then read from anywhere."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from mrbokeh.images.color_management import NamedSpace
from mrbokeh.system.errors import InputError
from mrbokeh.video.clip import Frame, VideoInfo, probe, upright_alpha, upright_frame
from mrbokeh.video.decoding import chroma_placement, opened, told_as_damage
from mrbokeh.video.picture_sources.frame_index import FrameIndex


@dataclass(frozen=True, eq=False)
class VideoSource:
    """A PictureSource. Decoding begins at the keyframe before, and goes by the times of the frames, not by counting from there."""

    path: Path
    info: VideoInfo
    index: FrameIndex
    space: NamedSpace | None = None

    @classmethod
    def open(cls, path: Path, space: NamedSpace | None = None) -> "VideoSource":
        info, index = probe(path, as_codes=space is not None), FrameIndex.of(path)
        return cls(path, replace(info, frame_count=len(index.shown)), index, space)

    @property
    def times_s(self) -> Float64[np.ndarray, " frames"]:
        return self.index.times_s

    @property
    def first_number(self) -> int:
        return 0

    def file_of(self, index: int) -> Path | None:  # noqa: ARG002
        return None

    def frames(self, start: int, stop: int, threads: int = 0) -> Iterator[Frame]:
        with opened(self.path, threads) as (container, stream), told_as_damage(self.path):
            placed, expected = chroma_placement(stream), start
            for number, stored in self._numbered_from(start, container, stream):
                if expected >= stop:
                    return
                if number < start:
                    continue
                if number != expected:
                    break
                time_s = float(self.index.shown[number].item() * self.index.time_base)
                yield self._frame(placed(stored), time_s)
                expected += 1
        if expected < stop:
            raise InputError(f"{self.path}: frame {expected} cannot be decoded; the file is damaged or cut off there")

    def _frame(self, stored: Any, time_s: float) -> Frame:
        """Colour is stored straight, and multiplied by alpha once it is light."""
        frame = upright_frame(stored, time_s, self.path, as_codes=self.space is not None)
        rgb = frame.rgb if self.space is None else self.space.to_rec709(frame.rgb)
        if not self.info.has_alpha:
            return replace(frame, rgb=rgb)
        alpha = upright_alpha(stored, self.path)
        return replace(frame, rgb=rgb * alpha[..., None], alpha=alpha)

    def _numbered_from(self, start: int, container: Any, stream: Any) -> Iterator[tuple[int, Any]]:
        """(number, PyAV frame) from a keyframe on; the first is not after `start`."""
        if not self.index.has_times:
            yield from enumerate(container.decode(stream))
            return
        for key in self.index.keys_before(start) or [0]:
            if key > 0 or start > 0:
                container.seek(int(self.index.decoded[key]), stream=stream, backward=True)
            numbered = ((self.index.number_of(frame.pts), frame) for frame in container.decode(stream))
            counted = ((number, frame) for number, frame in numbered if number is not None)
            first = next(counted, None)
            if first is not None and (first[0] <= start or key == 0):
                yield first
                yield from counted
                return

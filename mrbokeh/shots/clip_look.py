"""ClipLook: what makes virtual light look as if the clip's camera had taken it, measured in the first frames."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mrbokeh.compositing.base import Inserted
from mrbokeh.compositing.plate import Plate
from mrbokeh.compositing.plate_look.colour_match import ColourMatch, triple_of
from mrbokeh.compositing.plate_look.finishing import Finishing, finished
from mrbokeh.compositing.plate_look.look_options import LookOptions, finishing_of
from mrbokeh.compositing.plate_look.stated_exposure import stated_exposure
from mrbokeh.images.color_management import NamedSpace
from mrbokeh.shots.hooks import Finisher
from mrbokeh.video.picture_sources.base import PictureSource
from mrbokeh.video.picture_sources.choose import open_source


@dataclass(frozen=True)
class ClipLook:
    """Description of a Finisher: options as typed, and the clip whose frames `start` and the next are measured, by every worker alike.

    Exposures are those that numbered pictures state, each its own: a camera that steps its exposure from frame to frame takes the
    virtual light with it. One that the user states is that of all frames. first_number: of the clip's frame 0. space: of its numbers.
    """

    options: LookOptions
    clip: Path
    rate: str | None
    start: int
    first_number: int = 0
    space: NamedSpace | None = None

    @property
    def files(self) -> tuple[Path, ...]:
        texts = (self.options.grain, self.options.vignetting, self.options.match_exposure)
        return tuple(path for path in (Path(text) for text in texts if text) if path.is_file())

    def opened(self, threads: int) -> Finisher:
        source = open_source(self.clip, self.rate, self.space)
        stop = min(self.start + 2, len(source.times_s))
        first, *rest = (frame.rgb for frame in source.frames(self.start, stop, threads))
        finishing = finishing_of(self.options, first, source.file_of(self.start), rest[0] if rest else None)
        if self.options.match_exposure is None or self.options.plate_exposure is not None:
            return _Look(finishing)
        return _ExposedLook(finishing, self._exposures(source))

    def _exposures(self, source: PictureSource) -> Callable[[int], float]:
        """How much brighter a frame shows the same light than the frame `start`, by the frame's number."""

        def brightness(index: int) -> float:
            path = source.file_of(index)
            assert path is not None  # or the Finishing would have been refused
            return stated_exposure(path).brightness

        measured = brightness(self.start)
        return lambda number: brightness(number - self.first_number) / measured


class _Look:
    def __init__(self, finishing: Finishing) -> None:
        self._finishing = finishing

    def finished(self, inserted: Inserted, plate: Plate, number: int) -> Inserted:
        return finished(inserted, plate, self._finishing, number)


class _ExposedLook:
    """With a gain for every frame."""

    def __init__(self, finishing: Finishing, change: Callable[[int], float]) -> None:
        self._finishing, self._change = finishing, change

    def finished(self, inserted: Inserted, plate: Plate, number: int) -> Inserted:
        colour = self._finishing.colour or ColourMatch()
        gained = replace(colour, gain=triple_of(np.array(colour.gain) * self._change(number)))
        return finished(inserted, plate, replace(self._finishing, colour=gained), number)

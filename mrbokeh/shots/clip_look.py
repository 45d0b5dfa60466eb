"""ClipLook: what makes virtual light look as if the clip's camera had taken it, measured in the first frames."""

from dataclasses import dataclass
from pathlib import Path

from mrbokeh.compositing.base import Inserted
from mrbokeh.picture_sources.choose import open_source
from mrbokeh.plate import Plate
from mrbokeh.plate_look.finishing import Finishing, finished
from mrbokeh.plate_look.look_options import LookOptions, finishing_of
from mrbokeh.shots.hooks import Finisher


@dataclass(frozen=True)
class ClipLook:
    """Description of a Finisher: options as typed, and the clip whose frames `start` and the next are measured, by every worker alike."""

    options: LookOptions
    clip: Path
    rate: str | None
    start: int

    @property
    def files(self) -> tuple[Path, ...]:
        texts = (self.options.grain, self.options.vignetting)
        return tuple(path for path in (Path(text) for text in texts if text) if path.is_file())

    def opened(self, threads: int) -> Finisher:
        source = open_source(self.clip, self.rate)
        stop = min(self.start + 2, len(source.times_s))
        first, *rest = (frame.rgb for frame in source.frames(self.start, stop, threads))
        return _Look(finishing_of(self.options, first, None, rest[0] if rest else None))


class _Look:
    def __init__(self, finishing: Finishing) -> None:
        self._finishing = finishing

    def finished(self, inserted: Inserted, plate: Plate, number: int) -> Inserted:
        return finished(inserted, plate, self._finishing, number)

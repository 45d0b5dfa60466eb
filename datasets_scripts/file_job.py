"""What a data set still lacks, piece by piece, so that an interrupted run goes on where it stopped."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Job:
    """Files that are made together."""

    paths: tuple[Path, ...]
    make: Callable[[], None]

    @property
    def done(self) -> bool:
        return all(path.is_file() for path in self.paths)

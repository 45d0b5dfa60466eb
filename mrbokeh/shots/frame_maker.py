"""What makes the frames of a shot: a recipe that travels to the workers, and the maker that each worker builds from it once."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.layer import Layer


@dataclass(frozen=True)
class Rgba:
    """A finished picture that does not cover everything. rgb: (H, W, 3) linear light, multiplied by alpha (H, W)."""

    rgb: Float32[np.ndarray, "height width 3"]
    alpha: Float32[np.ndarray, "height width"]


Picture = Float32[np.ndarray, "height width 3"] | Rgba | Layer
"""What is written: a finished picture of linear light, opaque or not, or a virtual layer alone."""


@runtime_checkable
class FrameMaker(Protocol):
    """Makes one frame of the result out of one of the clip. What it keeps from frame to frame may only save time."""

    def make(
        self,
        index: int,
        rgb: Float32[np.ndarray, "height width 3"],
        time_s: float,
        alpha: Float32[np.ndarray, "height width"] | None = None,
    ) -> Picture:
        """index: of the frame within the clip. rgb: (H, W, 3) linear Rec.709, not to be changed. time_s: within the clip.

        alpha: (H, W), the clip's own, by which rgb is multiplied; None is opaque, and so is the result then.
        """
        ...


@runtime_checkable
class MakerRecipe(Protocol):
    """A frozen dataclass of names, numbers and absolute paths, which can be pickled and says all that the result depends on."""

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file that is read, patterns of sequences too: when one changes, parts made before do not fit any more."""
        ...

    def build(self, threads: int) -> FrameMaker:
        """threads: how many cores it may use, 0 for all."""
        ...

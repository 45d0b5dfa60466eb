"""What a frame is made of, each behind a protocol, so that any of them can be exchanged.

Descriptions travel to the workers: frozen dataclasses of absolute paths, names and numbers, which say what files they read and are
opened there once. What they open is asked frame by frame, by the number of the frame. Whatever gives the very same object for two
frames says that nothing changed between them; what was made from it is then kept.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float32

from mrbokeh.compositing.base import Inserted
from mrbokeh.compositing.plate import Plate
from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import Camera

Opened = TypeVar("Opened", covariant=True)


@dataclass(frozen=True)
class Moment:
    """number: of the frame, by which files name it. time_s: within the clip. size_px: (width, height) of the plate."""

    number: int
    time_s: float
    size_px: tuple[int, int]


@runtime_checkable
class Description(Protocol[Opened]):
    @property
    def files(self) -> tuple[Path, ...]: ...

    def opened(self, threads: int) -> Opened: ...


@runtime_checkable
class LayerSource(Protocol):
    def layers_at(self, moment: Moment, cameras: "CameraSource | None") -> Sequence[Layer]:
        """Sharp layers of the plate's size, front first. cameras: of the clip, where they are given."""
        ...


@runtime_checkable
class CameraSource(Protocol):
    def camera_at(self, moment: Moment, after_s: float = 0.0) -> Camera:
        """With its pose in the world of the scene; after_s: so much later, or earlier, while the shutter is open."""
        ...


@runtime_checkable
class FocusSource(Protocol):
    def at(self, frame: float | int) -> float:
        """The focus distance in metres at a frame's number (mrbokeh.tracking.camera_track.FocusPull is one)."""
        ...


@runtime_checkable
class DepthSource(Protocol):
    def depth_m_at(self, moment: Moment) -> Float32[np.ndarray, "height width"]:
        """Depth of the photographed scene along the axis in metres."""
        ...


@runtime_checkable
class MatteSource(Protocol):
    def near_alpha_at(self, moment: Moment) -> Float32[np.ndarray, "height width"]:
        """What of the photographed scene stands in front of the virtual objects: its coverage, sharp, 0 to 1."""
        ...


@runtime_checkable
class Finisher(Protocol):
    """What makes virtual light look photographed (mrbokeh.compositing.plate_look)."""

    def finished(self, inserted: Inserted, plate: Plate, number: int) -> Inserted:
        """Whole frames; the photograph's own pixels stay as they are."""
        ...

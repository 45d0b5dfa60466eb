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

from mrbokeh.camera import Camera
from mrbokeh.compositing.base import Inserted
from mrbokeh.layer import Layer
from mrbokeh.plate import Plate

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
    def layers_at(self, moment: Moment, camera: Camera | None) -> Sequence[Layer]:
        """Sharp layers of the plate's size, front first. camera: of that frame, where one is given."""
        ...


@runtime_checkable
class CameraSource(Protocol):
    def camera_at(self, moment: Moment) -> Camera:
        """With its pose in the world of the scene."""
        ...


@runtime_checkable
class FocusSource(Protocol):
    def at(self, frame: float | int) -> float:
        """The focus distance in metres at a frame's number (mrbokeh.camera_track.FocusPull is one)."""
        ...


@runtime_checkable
class DepthSource(Protocol):
    def depth_m_at(self, moment: Moment) -> Float32[np.ndarray, "height width"]:
        """Depth of the photographed scene along the axis in metres."""
        ...


@runtime_checkable
class Finisher(Protocol):
    """What makes virtual light look photographed (mrbokeh.plate_look)."""

    def finished(self, inserted: Inserted, plate: Plate, number: int) -> Inserted:
        """Whole frames; the photograph's own pixels stay as they are."""
        ...


@runtime_checkable
class Distorter(Protocol):
    """Renders as the plate's lens bends them (mrbokeh.lens_distortion)."""

    def overscan_camera(self, camera: Camera) -> Camera:
        """The pinhole that sees all that the plate sees."""
        ...

    def distorted(self, layer: Layer, overscan: Camera, plate: Camera) -> Layer:
        """Its picture as the plate's."""
        ...

"""Inputs of a frame, each behind a protocol, so that any of them can be exchanged.

Descriptions travel to the workers: frozen dataclasses of absolute paths, names and numbers, which say what files they read and are
opened there once. An opened source is asked frame by frame, by the number of the frame. A source that returns the very same object for
two frames says that nothing changed between them; results made from it are then reused (Kept).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, ParamSpec, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float32

from mrbokeh.compositing.plate import Inserted, Plate
from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import Camera

_Given = ParamSpec("_Given")
_Result = TypeVar("_Result")

Opened = TypeVar("Opened", covariant=True)


class Kept(Generic[_Given, _Result]):
    """Function with a cache of its last result. Arguments are the same if they are one object (numbers and texts: if they are equal)."""

    def __init__(self, function: Callable[_Given, _Result]) -> None:
        self._function = function
        self._given: tuple[object, ...] = ()
        self._result: list[_Result] = []

    def __call__(self, *given: _Given.args, **named: _Given.kwargs) -> _Result:
        all_given = (*_flat(given), *_flat(tuple(named.values())))
        if not self._result or len(all_given) != len(self._given) or not all(map(_same, all_given, self._given)):
            self._result.clear()
            self._result.append(self._function(*given, **named))
            self._given = all_given
        return self._result[0]


def _flat(given: tuple[object, ...]) -> tuple[object, ...]:
    """Sequences by what is in them, for they are often made anew."""
    return tuple(each for one in given for each in ((len(one), *one) if isinstance(one, (tuple, list)) else (one,)))


def _same(one: object, other: object) -> bool:
    return one is other or (isinstance(one, (int, float, str)) and type(one) is type(other) and one == other)


@dataclass(frozen=True)
class Moment:
    """Frame of a shot. number: by which files name it. time_s: within the clip. size_px: (width, height) of the plate."""

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
        """Return the camera in the world of the scene. after_s: so much later, or earlier, while the shutter is open."""
        ...


@runtime_checkable
class FocusSource(Protocol):
    def at(self, frame: float | int) -> float:
        """Return the focus distance in metres at a frame's number (mrbokeh.tracking.camera_track.FocusPull is one)."""
        ...


@runtime_checkable
class DepthSource(Protocol):
    def depth_m_at(self, moment: Moment) -> Float32[np.ndarray, "height width"]:
        """Depth of the photographed scene along the axis in metres."""
        ...


@runtime_checkable
class MatteSource(Protocol):
    def near_alpha_at(self, moment: Moment) -> Float32[np.ndarray, "height width"]:
        """Return the coverage of what stands in front of the virtual objects, sharp, 0 to 1."""
        ...


@runtime_checkable
class Finisher(Protocol):
    """Source of the look that makes virtual light look photographed (mrbokeh.compositing.plate_look)."""

    def finished(self, inserted: Inserted, plate: Plate, number: int) -> Inserted:
        """Finish whole frames; the photograph's own pixels stay as they are."""
        ...

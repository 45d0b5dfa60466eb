"""FilmedScene: scene and camera by time; ShutterTiming: the exposure of each row of a frame."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from mrbokeh.optics.camera import Camera
from mrbokeh.scene import Scene
from mrbokeh.system.errors import InputError

_KEPT = 8


@dataclass(frozen=True)
class ShutterTiming:
    """A shutter that turns once per frame, and rows that are read one after the other.

    angle_deg: of 360, for which it is open: 180 at 24 frames per second is 1/48 s.
    The frame's time is in the middle of the exposure.
    readout_s: how much later the lower edge is exposed than the upper one; negative for a sensor that is read upwards.
    rows_px: upper and lower edge of the sensor in the rendered picture, where that has overscan (`within`); None is all of it.
    """

    frame_rate: float
    angle_deg: float = 180.0
    readout_s: float = 0.0
    rows_px: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not self.frame_rate > 0.0 or not 0.0 <= self.angle_deg <= 360.0:
            raise InputError(
                f"a shutter needs a frame rate above 0 and an angle from 0 to 360 degrees, got {self.frame_rate} and {self.angle_deg}"
            )

    @property
    def exposure_s(self) -> float:
        """Exposure time of each row."""
        return self.angle_deg / 360.0 / self.frame_rate

    @property
    def is_rolling(self) -> bool:
        return self.readout_s != 0.0

    def middle_s(self, time_s: float) -> float:
        """The middle of the exposure of the middle row."""
        return time_s + 0.5 * self.readout_s

    def row_delay_s(self, y_px: float, height_px: int) -> float:
        """Return the delay of a height in a rendered picture behind the upper edge of the sensor."""
        top, bottom = self.rows_px or (0.0, float(height_px))
        return (y_px - top) / (bottom - top) * self.readout_s

    def within(self, overscan: Camera, plate: Camera) -> "ShutterTiming":
        """Return this shutter for pictures with overscan; the bending of the plate's rows by distortion is ignored."""
        enlarged = overscan.focal_px[1] / plate.focal_px[1]
        top = overscan.principal_px[1] - plate.principal_px[1] * enlarged
        return replace(self, rows_px=(top, top + plate.height_px * enlarged))


@dataclass(frozen=True)
class FilmedScene:
    """Scene and camera by time, with their shutter.

    scene_at, camera_at: functions of the time in seconds, any time around a frame's. A part that does not move should be the very same
    Scene. The camera keeps its number of pixels; it may zoom.
    """

    scene_at: Callable[[float], Scene]
    camera_at: Callable[[float], Camera]
    shutter: ShutterTiming

    def remembering(self) -> "FilmedScene":
        """Return a copy that caches scenes and cameras of the last few moments: posing a skin costs as much as following it."""
        return replace(self, scene_at=lru_cache(_KEPT)(self.scene_at), camera_at=lru_cache(_KEPT)(self.camera_at))

    def is_still(self, times_s: tuple[float, ...]) -> bool:
        """Return whether scene and camera are the same at all these times."""
        return self.is_scene_still(times_s) and self.is_camera_still(times_s)

    def is_scene_still(self, times_s: tuple[float, ...]) -> bool:
        first = self.scene_at(times_s[0])
        return all(_is_same(first, self.scene_at(time_s)) for time_s in times_s[1:])

    def is_camera_still(self, times_s: tuple[float, ...]) -> bool:
        first = self.camera_at(times_s[0])
        return all(_sees_alike(first, self.camera_at(time_s)) for time_s in times_s[1:])


def _is_same(one: Scene, other: Scene) -> bool:
    if one is other:
        return True
    if len(one.meshes) != len(other.meshes) or one.lights != other.lights or one.environment is not other.environment:
        return False
    return all(
        a is b or (a.triangles.shape == b.triangles.shape and np.array_equal(a.positions_m, b.positions_m))
        for a, b in zip(one.meshes, other.meshes, strict=True)
    )


def _sees_alike(one: Camera, other: Camera) -> bool:
    intrinsics = (one.focal_px, one.principal_px) == (other.focal_px, other.principal_px)
    return intrinsics and np.array_equal(one.camera_from_world, other.camera_from_world)

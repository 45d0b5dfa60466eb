"""FilmedScene: what is filmed, by time."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from mrbokeh.optics.camera import Camera
from mrbokeh.scene import Scene
from mrbokeh.scene.moving_layers.shutter import ShutterTiming

_KEPT = 8


@dataclass(frozen=True)
class FilmedScene:
    """scene_at, camera_at: by the time in seconds, any time around a frame's. What does not move should be the very same Scene.

    The camera keeps its number of pixels; it may zoom.
    """

    scene_at: Callable[[float], Scene]
    camera_at: Callable[[float], Camera]
    shutter: ShutterTiming

    def remembering(self) -> "FilmedScene":
        """The same, but scenes and cameras of the last few moments are kept: posing a skin costs as much as following it."""
        return replace(self, scene_at=lru_cache(_KEPT)(self.scene_at), camera_at=lru_cache(_KEPT)(self.camera_at))

    def is_still(self, times_s: tuple[float, ...]) -> bool:
        """Whether scene and camera are the same at all these times."""
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

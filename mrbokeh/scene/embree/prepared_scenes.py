"""PreparedScenes: what a ray caster keeps of scenes, catchers and panoramas between pictures."""

from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.camera import Camera
from mrbokeh.scene.embree.packed_triangles import PreparedScene, prepared
from mrbokeh.scene.environment import Environment
from mrbokeh.scene.environment_filter import LightingMaps, lighting_maps
from mrbokeh.scene.light import Light
from mrbokeh.scene.material import Material
from mrbokeh.scene.mesh import Mesh
from mrbokeh.scene.rigid_motion import rigid_motion
from mrbokeh.scene.virtual_scene import Scene


@dataclass(frozen=True, eq=False)
class PlacedScene:
    """A prepared scene and where it stands now: cameras and lights are moved into its axes in place of its triangles.

    lights: in the axes of `ready`.
    """

    ready: PreparedScene
    world_from_ready: Float64[np.ndarray, "4 4"]
    lights: tuple[Light, ...]

    @property
    def is_moved(self) -> bool:
        return not np.array_equal(self.world_from_ready, np.eye(4))

    def camera(self, camera: Camera) -> Camera:
        """The camera as the prepared triangles see it."""
        return replace(camera, camera_from_world=camera.camera_from_world @ self.world_from_ready) if self.is_moved else camera

    def maps(self, maps: LightingMaps | None) -> LightingMaps | None:
        """The panorama as the prepared triangles see it."""
        if maps is None or not self.is_moved:
            return maps
        return replace(maps, environment_from_world=np.ascontiguousarray(maps.environment_from_world @ self.world_from_ready[:3, :3]))


class PreparedScenes:
    """Everything is kept as long as its scene, catcher or panorama lives; the scene prepared last also beyond that.

    Where a new scene is the last one moved as a rigid body, it is not prepared again; where it only has the same textures,
    those are kept.
    """

    def __init__(self) -> None:
        self._scenes: WeakKeyDictionary[Scene, PlacedScene] = WeakKeyDictionary()
        self._grounds: WeakKeyDictionary[Mesh, PreparedScene] = WeakKeyDictionary()
        self._maps: WeakKeyDictionary[Environment, LightingMaps] = WeakKeyDictionary()
        self._last: PreparedScene | None = None

    def placed(self, scene: Scene) -> PlacedScene | None:
        """None where the scene has nothing to draw."""
        if scene not in self._scenes:
            drawn = [mesh for mesh in scene.meshes if len(mesh.triangles) and not mesh.catches_shadow]
            if not drawn:
                return None
            self._scenes[scene] = self._placed(drawn, scene.lighting[0])
        return self._scenes[scene]

    def _placed(self, drawn: list[Mesh], lights: tuple[Light, ...]) -> PlacedScene:
        last = self._last
        motion = None if last is None else rigid_motion(last.meshes, drawn)
        if last is None or motion is None:
            self._last = prepared(drawn, last)
            return PlacedScene(self._last, np.eye(4), lights)
        if np.array_equal(motion, np.eye(4)):
            return PlacedScene(last, motion, lights)
        back = np.linalg.inv(motion)
        return PlacedScene(last, motion, tuple(light.transformed(back) for light in lights))

    def ground(self, catcher: Mesh) -> PreparedScene:
        """A catcher by itself, in world axes, receiving light from the side that is seen."""
        if catcher not in self._grounds:
            self._grounds[catcher] = prepared([replace(catcher, material=Material(double_sided=True))])
        return self._grounds[catcher]

    def maps(self, scene: Scene) -> LightingMaps | None:
        """The filtered panorama of a scene, in world axes."""
        _, environment = scene.lighting
        if environment is None:
            return None
        if environment not in self._maps:
            self._maps[environment] = lighting_maps(environment)
        return self._maps[environment]

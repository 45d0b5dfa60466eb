"""Scene: what a virtual object brings, flattened to world space: meshes, lights, environment."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from mrbokeh.scene.environment import Environment, neutral_environment
from mrbokeh.scene.light import Light
from mrbokeh.scene.material import Triple
from mrbokeh.scene.mesh import Mesh
from mrbokeh.system.errors import InputError

WORLD_FROM_GLTF = np.diag([1.0, -1.0, -1.0, 1.0])
"""glTF (x right, y up, z towards the viewer) to ours (x right, y down, z forward): half a turn about x, no mirroring.

The front of a glTF model (+z there) so faces a camera whose camera_from_world is the identity."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Meshes and lights in world space (metres; up is -y where nobody says otherwise) and the light from all around.

    With neither lights nor environment a scene is lit by `neutral_environment()`, so that a bare object is seen.
    """

    meshes: tuple[Mesh, ...] = ()
    lights: tuple[Light, ...] = ()
    environment: Environment | None = None

    @property
    def lighting(self) -> tuple[tuple[Light, ...], Environment | None]:
        """The lights and environment that a renderer has to use."""
        if not self.lights and self.environment is None:
            return (), neutral_environment()
        return self.lights, self.environment

    def transformed(self, world_from_scene: Float[np.ndarray, "4 4"]) -> "Scene":
        """Meshes and lights placed in the world; the environment stays where it is."""
        if world_from_scene.shape != (4, 4) or abs(np.linalg.det(world_from_scene[:3, :3])) < 1e-18:
            raise InputError("placing a scene needs an invertible 4x4 transform, but this one is flat: check for a scale of 0")
        return replace(
            self,
            meshes=tuple(mesh.transformed(world_from_scene) for mesh in self.meshes),
            lights=tuple(light.transformed(world_from_scene) for light in self.lights),
        )

    def with_lights(self, *lights: Light) -> "Scene":
        """The scene with more lights."""
        return replace(self, lights=(*self.lights, *lights))

    def with_light_strength(self, factor: float) -> "Scene":
        """The lights times a factor: 1 / 683 brings a Blender file's lux and candela back to watts."""
        return replace(self, lights=tuple(light.brighter(factor) for light in self.lights))

    def without_lights(self) -> "Scene":
        """The scene without the lights that its file brought."""
        return replace(self, lights=())

    def with_environment(self, environment: Environment | None) -> "Scene":
        """The scene in another environment."""
        return replace(self, environment=environment)

    def with_meshes(self, *meshes: Mesh) -> "Scene":
        """The scene with more meshes."""
        return replace(self, meshes=(*self.meshes, *meshes))

    @property
    def bounds_m(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Lowest and highest corner of the box around all meshes."""
        # Only vertices that a triangle uses: a file may carry more.
        points = [mesh.positions_m[np.unique(mesh.triangles)] for mesh in self.meshes if mesh.triangles.size]
        if not points:
            raise InputError("expected a scene with triangles, got one without any: was the right file or node chosen?")
        return np.min([p.min(0) for p in points], axis=0), np.max([p.max(0) for p in points], axis=0)


def world_from_scene_placing(
    scene: Scene, stands_at_m: Triple, height_m: float | None = None, turn_rad: float = 0.0
) -> Float[np.ndarray, "4 4"]:
    """(4, 4) transform that stands a scene on a point: `scene.transformed(world_from_scene_placing(scene, ...))`.

    stands_at_m: where the middle of the underside comes to lie (up is -y). height_m: scaled to that height; None keeps its size.
    turn_rad: about the vertical; what faced +z turns towards +x.
    """
    low, high = scene.bounds_m
    scale = 1.0
    if height_m is not None:
        if height_m <= 0 or high[1] <= low[1]:
            raise InputError(f"expected a height above 0 for a scene with extent, got {height_m} m for one of {high[1] - low[1]} m")
        scale = height_m / float(high[1] - low[1])
    underside = np.array([(low[0] + high[0]) / 2, high[1], (low[2] + high[2]) / 2])
    cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
    world_from_scene = np.eye(4)
    world_from_scene[:3, :3] = scale * np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    world_from_scene[:3, 3] = np.asarray(stands_at_m) - world_from_scene[:3, :3] @ underside
    return world_from_scene

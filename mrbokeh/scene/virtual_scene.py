"""Scene: meshes, lights and environment in world space; the protocol of scene renderers; shadows as layers."""

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import Camera, level_plane_dioptres
from mrbokeh.scene.light import Environment, Light, neutral_environment
from mrbokeh.scene.material import Triple
from mrbokeh.scene.mesh import Mesh
from mrbokeh.system.errors import InputError

WORLD_FROM_GLTF = np.diag([1.0, -1.0, -1.0, 1.0])
"""glTF (x right, y up, z towards the viewer) to ours (x right, y down, z forward): half a turn about x, no mirroring.

The front of a glTF model (+z there) so faces a camera whose camera_from_world is the identity."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Meshes and lights in world space (metres; up is -y where nobody says otherwise) and the light from all around.

    With neither lights nor environment a scene is lit by `neutral_environment()`, so that a bare object is seen. parts: the objects of
    which it was made, where that is known: light beside things far apart is found the sooner for each of them.
    """

    meshes: tuple[Mesh, ...] = ()
    lights: tuple[Light, ...] = ()
    environment: Environment | None = None
    parts: tuple["Scene", ...] = ()

    @property
    def lighting(self) -> tuple[tuple[Light, ...], Environment | None]:
        """The lights and environment that a renderer has to use."""
        if not self.lights and self.environment is None:
            return (), neutral_environment()
        return self.lights, self.environment

    @property
    def drawn_meshes(self) -> tuple[Mesh, ...]:
        """Meshes with triangles, less those that only catch shadows."""
        return tuple(mesh for mesh in self.meshes if len(mesh.triangles) and not mesh.catches_shadow)

    def transformed(self, world_from_scene: Float[np.ndarray, "4 4"]) -> "Scene":
        """Meshes and lights placed in the world; the environment stays where it is."""
        if world_from_scene.shape != (4, 4) or abs(np.linalg.det(world_from_scene[:3, :3])) < 1e-18:
            raise InputError("placing a scene needs an invertible 4x4 transform, but this one is flat: check for a scale of 0")
        return replace(
            self,
            meshes=tuple(mesh.transformed(world_from_scene) for mesh in self.meshes),
            lights=tuple(light.transformed(world_from_scene) for light in self.lights),
            parts=tuple(each.transformed(world_from_scene) for each in self.parts),
        )

    def with_lights(self, *lights: Light) -> "Scene":
        """The scene with more lights."""
        return replace(self, lights=(*self.lights, *lights))

    def without_lights(self) -> "Scene":
        """The scene without the lights that its file brought."""
        return replace(self, lights=())

    def with_environment(self, environment: Environment | None) -> "Scene":
        """The scene in another environment."""
        return replace(self, environment=environment)

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
    """Return the (4, 4) transform that stands a scene on a point: `scene.transformed(world_from_scene_placing(scene, ...))`.

    stands_at_m: place of the middle of the underside (up is -y). height_m: scaled to that height; None keeps its size. turn_rad: about
    the vertical; what faced +z turns towards +x.
    """
    low, high = scene.bounds_m
    scale = 1.0
    if height_m is not None:
        if height_m <= 0 or high[1] <= low[1]:
            extent_m = high[1] - low[1]
            raise InputError(f"expected a height above 0 for a scene with extent, got {height_m} m for one of {extent_m} m: give another")
        scale = height_m / float(high[1] - low[1])
    underside = np.array([(low[0] + high[0]) / 2, high[1], (low[2] + high[2]) / 2])
    cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
    world_from_scene = np.eye(4)
    world_from_scene[:3, :3] = scale * np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    world_from_scene[:3, 3] = np.asarray(stands_at_m) - world_from_scene[:3, :3] @ underside
    return world_from_scene


@runtime_checkable
class SceneRenderer(Protocol):
    """Renders virtual objects with everything in focus; the lens blur comes afterwards.

    What every backend owes (tests/scene/test_scene_backends.py asks all of them):
    rgb is scene-linear, unclipped and premultiplied; emissive radiance L reads L.
    alpha is the covered share of the pixel's square. depth_m is exact at the pixel's centre, along the optical axis; at a pixel
    that is only partly covered it is the nearest covering surface where the centre sees nothing, never a mixture; inf where
    alpha is 0. The focal lengths and the principal point are any. Single-sided surfaces are invisible from behind.
    The environment lights the objects but is not drawn, and meshes with catches_shadow are not drawn either.
    """

    def render(self, scene: Scene, camera: Camera) -> Layer:
        """The scene as the camera sees it, without lens blur."""
        ...

    def render_shadow_mask(self, scene: Scene, camera: Camera, catcher: Mesh) -> Float32[np.ndarray, "height width"]:
        """Return the (H, W) share of the lights' irradiance on the catcher that the scene's meshes let through; 1 is lit.

        The share is 1 outside the catcher, on parts turned away from the lights, and without lights. The catcher is seen through the
        virtual objects, so that a soft edge of an object blends over the right value.
        """
        ...


def shadow_layer(renderer: SceneRenderer, scene: Scene, camera: Camera, catcher: Mesh, strength: float) -> Layer:
    """The scene's shadow on a level catcher. strength: the alpha where none of the lights arrives."""
    alpha = (strength * (1.0 - renderer.render_shadow_mask(scene, camera, catcher))).astype(np.float32)
    dioptres = level_plane_dioptres(camera, float(catcher.positions_m[0, 1]))
    depth_m = np.full(alpha.shape, np.inf, np.float32)
    np.divide(1.0, dioptres, out=depth_m, where=(alpha > 0) & (dioptres > 0))
    return Layer(np.zeros((*alpha.shape, 3), np.float32), alpha, depth_m)

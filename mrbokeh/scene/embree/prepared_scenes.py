"""Scenes prepared for ray casting: packed triangles with Embree hierarchies (Wald et al. 2014), kept between pictures."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float, Float32, Float64, Int32

from mrbokeh.optics.camera import Camera
from mrbokeh.scene._surface_numba import Surfaces, empty_surfaces, fill_surfaces
from mrbokeh.scene.embree.pixel_edges import MeshEdges, mesh_edges
from mrbokeh.scene.environment_filter import LightingMaps, lighting_maps
from mrbokeh.scene.light import Environment, Light
from mrbokeh.scene.material import Material
from mrbokeh.scene.mesh import Mesh, rigid_motion
from mrbokeh.scene.packed_scene import OPAQUE, KeptTextures, PackedMaterials, PackedTextures, PackedTriangles, packed
from mrbokeh.scene.virtual_scene import Scene

STEP = 2.0**-18
"""Relative step past a surface, 32 float32 roundings: what keeps a ray from meeting again where it starts."""

NOTHING_LEFT = 1.0 / 1024
"""Once less than this shines through, what lies behind is not followed."""

_FLAT = 1e-5


@dataclass(frozen=True, eq=False)
class PreparedScene:
    """Triangles relative to centre_m, within half_size_m of it. all_rays sees every triangle; for shadows opaque_rays and
    see_through_rays part them. is_flat: all vertex normals are one."""

    meshes: tuple[Mesh, ...]
    centre_m: Float64[np.ndarray, "3"]
    half_size_m: Float64[np.ndarray, "3"]
    reach_m: float
    is_flat: bool
    triangles: PackedTriangles
    materials: PackedMaterials
    textures: PackedTextures
    kept_textures: KeptTextures
    edges: MeshEdges
    all_rays: EmbreeScene
    opaque_rays: EmbreeScene | None
    see_through_rays: EmbreeScene | None
    see_through: Int32[np.ndarray, " see_through_triangles"]

    def surfaces(
        self, eye: Float[np.ndarray, "3"], directions: Float[np.ndarray, "rays 3"], hits: Int32[np.ndarray, " rays"], footprint: float
    ) -> Surfaces:
        """Return the shading points of rays at the triangles `hits`. footprint: width that a ray stands for, at a distance of 1."""
        surfaces = empty_surfaces(len(hits))
        fill_surfaces(self.triangles, self.materials, self.textures, eye[None], directions, hits, footprint, False, surfaces)
        return surfaces


def prepared(meshes: Sequence[Mesh], like: PreparedScene | None = None) -> PreparedScene:
    """Pack meshes (at least one triangle) and build their hierarchies. like: its textures are used where they are the same."""
    points = np.concatenate([mesh.positions_m[mesh.triangles].reshape(-1, 3) for mesh in meshes])
    centre_m = (points.min(0) + points.max(0)) / 2
    triangles, materials, kept_textures = packed(meshes, centre_m, None if like is None else like.kept_textures)
    is_opaque = materials.alpha_mode[triangles.material] == OPAQUE
    all_rays = _hierarchy(triangles.corners_m)
    return PreparedScene(
        meshes=tuple(meshes),
        centre_m=centre_m,
        half_size_m=np.abs(triangles.corners_m).max((0, 1)),
        reach_m=float(np.abs(triangles.corners_m).max()),
        is_flat=bool(np.abs(triangles.normals - triangles.normals[0, 0]).max() < _FLAT),
        triangles=triangles,
        materials=materials,
        textures=kept_textures.packed,
        kept_textures=kept_textures,
        edges=mesh_edges(triangles.corners_m),
        all_rays=all_rays,
        opaque_rays=all_rays if is_opaque.all() else _hierarchy(triangles.corners_m[is_opaque]),
        see_through_rays=_hierarchy(triangles.corners_m[~is_opaque]),
        see_through=np.flatnonzero(~is_opaque).astype(np.int32),
    )


def _hierarchy(corners_m: Float64[np.ndarray, "triangles 3 3"]) -> EmbreeScene | None:
    if not len(corners_m):
        return None
    rays = EmbreeScene(robust=True)  # watertight along shared edges
    TriangleMesh(rays, corners_m.astype(np.float32))
    return rays


def closest(rays: EmbreeScene, origins: Float[np.ndarray, "rays 3"], directions: Float[np.ndarray, "rays 3"]) -> Int32[np.ndarray, " rays"]:
    """Index of the first triangle that each ray meets, or -1."""
    return rays.run(*float32(origins, directions), query="INTERSECT")


def float32(*arrays: Float[np.ndarray, "rays 3"]) -> tuple[Float32[np.ndarray, "rays 3"], ...]:
    return tuple(np.ascontiguousarray(array, dtype=np.float32) for array in arrays)


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
    """Cache of prepared scenes, catchers and panoramas; entries live as long as their keys, the last scene also beyond that.

    A new scene that is the last one moved as a rigid body is not prepared again; one with the same textures reuses them.
    """

    def __init__(self) -> None:
        self._scenes: WeakKeyDictionary[Scene, PlacedScene] = WeakKeyDictionary()
        self._grounds: WeakKeyDictionary[Mesh, PreparedScene] = WeakKeyDictionary()
        self._maps: WeakKeyDictionary[Environment, LightingMaps] = WeakKeyDictionary()
        self._last: PreparedScene | None = None

    def placed(self, scene: Scene) -> PlacedScene | None:
        """Return the prepared scene and its place; None if there is nothing to draw."""
        if scene not in self._scenes:
            drawn = scene.drawn_meshes
            if not drawn:
                return None
            self._scenes[scene] = self._placed(drawn, scene.lighting[0])
        return self._scenes[scene]

    def _placed(self, drawn: Sequence[Mesh], lights: tuple[Light, ...]) -> PlacedScene:
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

"""Scenes prepared for ray casting: packed triangles with Embree hierarchies (Wald et al. 2014), kept between pictures.

Pixels at borders between surfaces and along silhouettes, the edges where a surface ends as seen from the eye, however thin it is in the
picture, need more samples than one; the places of these are chosen here.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Bool, Float, Float32, Float64, Int32, Int64

from mrbokeh.optics.camera import Camera
from mrbokeh.scene._surface_numba import Surfaces, empty_surfaces, fill_surfaces
from mrbokeh.scene.embree._marking_numba import mark_edges, mark_segments
from mrbokeh.scene.environment_filter import LightingMaps, lighting_maps
from mrbokeh.scene.light import Environment, Light
from mrbokeh.scene.material import Material
from mrbokeh.scene.mesh import Mesh, rigid_motion
from mrbokeh.scene.packed_scene import OPAQUE, KeptTextures, PackedMaterials, PackedTextures, PackedTriangles, packed
from mrbokeh.scene.virtual_scene import Scene

_DEPTH_STEP = 0.02
"""Relative distance from the neighbour's tangent plane beyond which two pixels do not show one surface."""
_LARGEST_TURN_RAD = 0.5
_SHARE_STEP = 0.02
_SIXTEENTHS = (
    *((1, 2), (4, 3), (8, 0), (12, 1), (2, 6), (6, 7), (9, 4), (14, 5)),
    *((3, 10), (7, 11), (11, 8), (13, 9), (0, 12), (5, 15), (10, 14), (15, 13)),
)
"""One sample in each cell of 4x4 and in each of sixteen rows and columns. Of such patterns this one came out of an annealing
for the least error of coverage over straight edges of all directions: 0.031 RMS, and 0.018 for upright and level edges,
where the centres of 4x4 cells have 0.031 and 0.072."""
_FOUR_EIGHTHS = ((2, 0), (6, 2), (0, 4), (4, 6))
"""The same in 2x2 cells and four rows and columns: the turned grid of graphics cards. Error of coverage 0.093 RMS."""
SAMPLE_COUNTS = (4, 16)


def sample_offsets_px(count: int) -> Float[np.ndarray, "samples 2"]:
    """Points of a pixel, (x, y) from 0 to 1. count: one of SAMPLE_COUNTS."""
    return (np.array(_FOUR_EIGHTHS) + 1.0) / 8 if count == 4 else (np.array(_SIXTEENTHS) + 0.5) / 16


def edge_pixels(
    mesh: Int32[np.ndarray, "height width"],
    alpha: Float32[np.ndarray, "height width"],
    depth_m: Float[np.ndarray, "height width"],
    normal: Float32[np.ndarray, "height width 3"],
    lit: Float32[np.ndarray, "height width"],
    directions: Float[np.ndarray, "height width 3"],
) -> Bool[np.ndarray, "height width"]:
    """Pixels beside which another mesh, coverage, normal, distance or a shadow begins; both sides are marked.

    lit: share of the lights that is not in shadow, so that shadow borders are smooth too.
    directions: of the pixels' rays, 1 long along the optical axis; normals in the same axes.
    """
    edges = np.zeros(mesh.shape, np.bool_)
    flat = (np.ascontiguousarray(values).ravel() for values in (mesh, alpha, depth_m))
    vectors = (np.ascontiguousarray(values).reshape(-1, 3) for values in (normal, directions))
    steps = np.array([_SHARE_STEP, _DEPTH_STEP, np.cos(_LARGEST_TURN_RAD)])
    normals, rays = vectors
    mark_edges(*flat, normals, np.ascontiguousarray(lit).ravel(), rays, mesh.shape[1], steps, edges.ravel())
    return edges


@dataclass(frozen=True, eq=False)
class MeshEdges:
    """Every edge of the triangles once: its two ends, and the two triangles that share it.

    ends_m: (E, 2, 3). faces: (E, 2) triangle indices; the second is -1 at the border of an open surface.
    face_planes: (T, 4) normal and offset of each triangle's plane.
    """

    ends_m: Float64[np.ndarray, "edges 2 3"]
    faces: Int64[np.ndarray, "edges 2"]
    face_planes: Float64[np.ndarray, "triangles 4"]

    def seen_from(self, eye_m: Float[np.ndarray, "3"]) -> Float64[np.ndarray, "silhouettes 2 3"]:
        """Edges between a triangle that faces the eye and one that does not, or nothing."""
        faces_eye = self.face_planes[:, :3] @ eye_m > self.face_planes[:, 3]
        is_outline = (self.faces[:, 1] < 0) | (faces_eye[self.faces[:, 0]] != faces_eye[self.faces[:, 1]])
        return self.ends_m[is_outline]


def mesh_edges(corners_m: Float64[np.ndarray, "triangles 3 3"]) -> MeshEdges:
    """Find the edges of triangles given by their corners; corners at exactly the same place are one vertex."""
    count = len(corners_m)
    flat = np.ascontiguousarray(corners_m.reshape(-1, 3).astype(np.float32) + np.float32(0.0))  # + 0 makes -0 and 0 the same bytes
    _, vertex = np.unique(flat.view(np.dtype((np.void, 12))).ravel(), return_inverse=True)
    vertex = vertex.reshape(count, 3).astype(np.int64)
    start, end = vertex.ravel(), np.roll(vertex, -1, axis=1).ravel()
    key = np.minimum(start, end) * 3 * count + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    sorted_key = key[order]
    is_first = np.concatenate([[True], sorted_key[1:] != sorted_key[:-1]])
    first = np.flatnonzero(is_first)
    shares = np.diff(np.append(first, len(order)))
    faces = np.stack([order[first] // 3, order[np.minimum(first + 1, len(order) - 1)] // 3], axis=1)
    faces[shares != 2, 1] = -1  # one triangle only, or more than two: always a candidate
    corner = order[first]
    ends = np.stack([corners_m.reshape(-1, 3)[corner], np.roll(corners_m, -1, axis=1).reshape(-1, 3)[corner]], axis=1)
    normals = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
    planes = np.concatenate([normals, (normals * corners_m[:, 0]).sum(-1, keepdims=True)], axis=1)
    return MeshEdges(ends, faces, planes)


def silhouette_pixels(
    ends_in_camera_m: Float64[np.ndarray, "silhouettes 2 3"],
    focal_px: tuple[float, float],
    principal_px: tuple[float, float],
    depth_m: Float64[np.ndarray, "height width"],
) -> Bool[np.ndarray, "height width"]:
    """Pixels that a visible silhouette crosses. depth_m: what the pixel centres see, to leave hidden silhouettes out."""
    farthest = np.pad(depth_m, 1, mode="edge")
    farthest = np.maximum(np.maximum(farthest[:-2], farthest[1:-1]), farthest[2:])
    farthest = np.ascontiguousarray(np.maximum(np.maximum(farthest[:, :-2], farthest[:, 1:-1]), farthest[:, 2:]))
    marked = np.zeros(depth_m.shape, np.bool_)
    mark_segments(np.ascontiguousarray(ends_in_camera_m), np.array([*focal_px, *principal_px], np.float64), farthest, marked)
    return marked


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

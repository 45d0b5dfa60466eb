"""GLB files to Scene: nodes flattened to world space, skins and morph targets applied at a moment of an animation."""

from collections.abc import Iterator
from functools import cached_property
from math import inf, pi
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mrbokeh.scene.gltf.accessors import GltfFile, open_gltf
from mrbokeh.scene.gltf.animation import NodePose, animation_durations_s, poses_at
from mrbokeh.scene.gltf.materials import materials_of
from mrbokeh.scene.gltf.primitives import read_primitive
from mrbokeh.scene.light import Light
from mrbokeh.scene.material import Material
from mrbokeh.scene.mesh import Mesh, unit
from mrbokeh.scene.virtual_scene import WORLD_FROM_GLTF, Scene
from mrbokeh.system.errors import InputError


def load_glb(path: str | Path, time_s: float = 0.0, animation: str | int | None = None) -> Scene:
    """The scene of a .glb or .gltf at a moment of one of its animations, in our axes (x right, y down, z forward; metres).

    animation: name or number; None is the first, if there is one. The time is clamped to the animation's ends.
    Light strengths are the file's own (KHR_lights_punctual: lux, candela). Extensions that are neither supported nor
    required (clearcoat, transmission ...) are left out. For many moments of one file keep a GltfAsset.
    """
    return GltfAsset(path).scene_at(time_s, animation)


class GltfAsset:
    """An opened file: materials are decoded once, then it is posed at any time."""

    def __init__(self, path: str | Path) -> None:
        self._file = open_gltf(path)

    @property
    def animation_durations_s(self) -> dict[str, float]:
        """Names and lengths of the animations."""
        return animation_durations_s(self._file)

    def scene_at(self, time_s: float = 0.0, animation: str | int | None = None) -> Scene:
        """The scene at a time; see `load_glb`."""
        poses = poses_at(self._file, time_s, animation)
        world_from_node = _world_from_node(self._file, poses)
        meshes: list[Mesh] = []
        lights: list[Light] = []
        for number, transform in world_from_node.items():
            meshes += self._meshes(number, poses, world_from_node)
            lights += _lights(self._file, number, transform)
        if not meshes and not lights:
            raise InputError(f"{self._file.path}: expected triangles, found none in its scene: export a mesh")
        return Scene(tuple(meshes), tuple(lights)).transformed(WORLD_FROM_GLTF)

    @cached_property
    def _materials(self) -> tuple[Material, ...]:
        return materials_of(self._file)

    def _meshes(self, number: int, poses: list[NodePose], world_from_node: dict[int, Float[np.ndarray, "4 4"]]) -> Iterator[Mesh]:
        node = self._file.gltf.nodes[number]
        if node.mesh is None:
            return
        skin = None if node.skin is None else _world_from_joints(self._file, node.skin, world_from_node)
        for primitive in self._file.gltf.meshes[node.mesh].primitives:
            if (4 if primitive.mode is None else primitive.mode) not in (4, 5, 6):  # points and lines have no surface
                continue
            raw = read_primitive(self._file, primitive, poses[number].weights)
            material = Material() if primitive.material is None else self._materials[primitive.material]
            # A skinned mesh stands where its joints are; its own node's transform does not count (section 3.7.3.3).
            placed = raw.skinned(skin) if skin is not None and raw.joints is not None else raw
            mesh = placed.mesh(material, node.name or "")
            yield mesh if placed is not raw else mesh.transformed(world_from_node[number])


def _world_from_node(file: GltfFile, poses: list[NodePose]) -> dict[int, Float[np.ndarray, "4 4"]]:
    """Global transforms of the nodes that the file's scene shows."""
    gltf = file.gltf
    if gltf.scenes:
        roots = gltf.scenes[gltf.scene or 0].nodes or []
    else:
        roots = sorted(set(range(len(gltf.nodes))) - {child for node in gltf.nodes for child in node.children or ()})
    world_from_node: dict[int, Float[np.ndarray, "4 4"]] = {}
    waiting = [(root, np.eye(4)) for root in roots]
    while waiting:
        number, world_from_parent = waiting.pop()
        if number in world_from_node:
            raise InputError(f"{file.path}: node {number} has two parents: the file is damaged, export it again")
        world_from_node[number] = world_from_parent @ poses[number].parent_from_node
        waiting += [(child, world_from_node[number]) for child in reversed(gltf.nodes[number].children or ())]
    return world_from_node


def _world_from_joints(file: GltfFile, skin: int, world_from_node: dict[int, Float[np.ndarray, "4 4"]]) -> Float[np.ndarray, "joints 4 4"]:
    joints = file.gltf.skins[skin]
    missing = [joint for joint in joints.joints if joint not in world_from_node]
    if missing:
        raise InputError(f"{file.path}: the joints {missing} of a skin are not in its scene: export skeleton and mesh together")
    world_from_joint = np.stack([world_from_node[joint] for joint in joints.joints])
    if joints.inverseBindMatrices is None:
        return world_from_joint
    return world_from_joint @ file.floats(joints.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1)


def _lights(file: GltfFile, number: int, world_from_node: Float[np.ndarray, "4 4"]) -> Iterator[Light]:
    """The node's KHR_lights_punctual light; it shines along the node's -z. A node's scale does not change it."""
    reference = (file.gltf.nodes[number].extensions or {}).get("KHR_lights_punctual")
    if reference is None:
        return
    light = file.gltf.extensions["KHR_lights_punctual"]["lights"][reference["light"]]
    intensity, spot = light.get("intensity", 1.0), light.get("spot", {})
    red, green, blue = (float(channel * intensity) for channel in light.get("color", (1.0, 1.0, 1.0)))
    yield Light(
        kind=light["type"],
        rgb=(red, green, blue),
        position_m=tuple(world_from_node[:3, 3].tolist()),
        direction=tuple(unit(-world_from_node[:3, 2]).tolist()),
        range_m=float(light.get("range", inf)),
        inner_cone_rad=float(spot.get("innerConeAngle", 0.0)),
        outer_cone_rad=float(spot.get("outerConeAngle", pi / 4)),
    )

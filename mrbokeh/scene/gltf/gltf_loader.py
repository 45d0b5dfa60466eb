"""GLB files to Scene: nodes posed at a moment of an animation, flattened to world space, skins and morph targets applied.

See the glTF 2.0 specification, section 3.11 and appendix C.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf, pi
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mrbokeh.scene.gltf.surfaces import GltfFile, Numbered, materials_of, open_gltf, read_primitive
from mrbokeh.scene.light import Light
from mrbokeh.scene.material import Material
from mrbokeh.scene.mesh import Mesh, unit
from mrbokeh.scene.virtual_scene import WORLD_FROM_GLTF, Scene
from mrbokeh.system.errors import InputError


@dataclass(frozen=True, eq=False)
class NodePose:
    """A node relative to its parent: translation, rotation (quaternion x, y, z, w), scale, morph weights."""

    translation: Float[np.ndarray, "3"]
    rotation: Float[np.ndarray, "4"]
    scale: Float[np.ndarray, "3"]
    weights: Float[np.ndarray, " targets"]
    matrix: Float[np.ndarray, "4 4"] | None = None

    @property
    def parent_from_node(self) -> Float[np.ndarray, "4 4"]:
        if self.matrix is not None:
            return self.matrix
        result = np.eye(4)
        result[:3, :3] = rotation_matrix(self.rotation) * self.scale
        result[:3, 3] = self.translation
        return result


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
        with self._undamaged():
            return animation_durations_s(self._file)

    def scene_at(self, time_s: float = 0.0, animation: str | int | None = None) -> Scene:
        """The scene at a time; see `load_glb`."""
        with self._undamaged():
            return self._scene_at(time_s, animation)

    @contextmanager
    def _undamaged(self) -> Iterator[None]:
        try:
            yield
        except InputError:
            raise
        except (LookupError, TypeError, ValueError, AttributeError) as reason:
            raise InputError(f"{self._file.path} is a damaged glTF file ({reason!r}): export it again") from reason

    def _scene_at(self, time_s: float, animation: str | int | None) -> Scene:
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
    def _materials(self) -> Numbered:
        return Numbered(materials_of(self._file))

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


def rotation_matrix(quaternion: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    """A quaternion (x, y, z, w) as a matrix."""
    x, y, z, w = unit(np.asarray(quaternion, np.float64))
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def animation_durations_s(file: GltfFile) -> dict[str, float]:
    """Name and length of the file's animations; nameless ones are called by their number."""
    return {
        animation.name or str(number): max(float(file.floats(sampler.input)[-1, 0]) for sampler in animation.samplers)
        for number, animation in enumerate(file.gltf.animations)
    }


def poses_at(file: GltfFile, time_s: float, animation: str | int | None) -> list[NodePose]:
    """The pose of every node at a time, which is clamped to the animation's ends. None is the file's first animation."""
    poses = Numbered(_rest_pose(file, node) for node in file.gltf.nodes)
    chosen = _chosen_animation(file, animation)
    if chosen is None:
        return poses
    for channel in chosen.channels:
        if channel.target.node is None:
            continue
        sampler = chosen.samplers[channel.sampler]
        path = channel.target.path
        value = _sampled(file, sampler, time_s, is_rotation=path == "rotation")
        poses[channel.target.node] = replace(poses[channel.target.node], matrix=None, **{path: value})
    return poses


def _chosen_animation(file: GltfFile, animation: str | int | None) -> Any:
    animations = file.gltf.animations
    if animation is None:
        return animations[0] if animations else None
    names = list(animation_durations_s(file))
    number = names.index(animation) if animation in names else animation
    if not isinstance(number, int) or not 0 <= number < len(animations):
        raise InputError(f"{file.path} has the animations {names}, not {animation!r}: choose one of them")
    return animations[number]


def _rest_pose(file: GltfFile, node: Any) -> NodePose:
    weights = node.weights or (file.gltf.meshes[node.mesh].weights if node.mesh is not None else None)
    return NodePose(
        translation=np.array(node.translation or (0, 0, 0), np.float64),
        rotation=np.array(node.rotation or (0, 0, 0, 1), np.float64),
        scale=np.array(node.scale or (1, 1, 1), np.float64),
        weights=np.array(weights or (), np.float64),
        matrix=np.array(node.matrix, np.float64).reshape(4, 4).T if node.matrix else None,
    )


def _sampled(file: GltfFile, sampler: Any, time_s: float, is_rotation: bool) -> Float[np.ndarray, " width"]:
    """An animation sampler's output at a time (appendix C.2 to C.5)."""
    times = file.floats(sampler.input)[:, 0].astype(np.float64)
    is_cubic = sampler.interpolation == "CUBICSPLINE"
    # A cubic sampler stores (in-tangent, value, out-tangent) per key; morph weights are stored one after the other.
    keys = file.floats(sampler.output).astype(np.float64).reshape(len(times), 3 if is_cubic else 1, -1)
    values = keys[:, 1 if is_cubic else 0]
    last = int(np.searchsorted(times, time_s, side="right")) - 1
    if last < 0 or last >= len(times) - 1 or sampler.interpolation == "STEP":
        return values[np.clip(last, 0, len(times) - 1)]
    step_s = times[last + 1] - times[last]
    fraction = (time_s - times[last]) / step_s
    if is_cubic:
        value = _hermite(keys[last], keys[last + 1], fraction, step_s)
        return unit(value) if is_rotation else value
    if is_rotation:
        return _slerp(values[last], values[last + 1], fraction)
    return (1 - fraction) * values[last] + fraction * values[last + 1]


def _hermite(
    before: Float[np.ndarray, "3 width"], after: Float[np.ndarray, "3 width"], fraction: float, step_s: float
) -> Float[np.ndarray, " width"]:
    t, t2, t3 = fraction, fraction**2, fraction**3
    start, end = before[1] * (2 * t3 - 3 * t2 + 1), after[1] * (3 * t2 - 2 * t3)
    return start + end + step_s * (before[2] * (t3 - 2 * t2 + t) + after[0] * (t3 - t2))


def _slerp(start: Float[np.ndarray, "4"], end: Float[np.ndarray, "4"], fraction: float) -> Float[np.ndarray, "4"]:
    start, end = unit(start), unit(end)
    cosine = float(start @ end)
    if cosine < 0:  # the two signs of a quaternion are one rotation: take the shorter way
        end, cosine = -end, -cosine
    if cosine > 0.9995:
        return unit((1 - fraction) * start + fraction * end)
    angle = np.arccos(cosine)
    return (np.sin((1 - fraction) * angle) * start + np.sin(fraction * angle) * end) / np.sin(angle)

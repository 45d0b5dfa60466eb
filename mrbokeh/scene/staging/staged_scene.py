"""StagedScene: what a scene file describes, loaded, and stood on the table at any moment of its animations."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float

from mrbokeh.scene import Environment, Light, Mesh, Scene, shadow_catcher, world_from_scene_placing
from mrbokeh.scene.gltf.gltf_loader import GltfAsset
from mrbokeh.scene.staging.assets import Assets
from mrbokeh.scene.staging.picture_box import drawn_points_m
from mrbokeh.scene.staging.scene_description import PlacedObject, SceneDescription
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.world_axes import turned

MOMENT_S = 1 / 120
"""Live, animations are posed at whole multiples of this, so that two frames of one moment share one scene."""


_first_scenes: WeakKeyDictionary[GltfAsset, dict[str | None, Scene]] = WeakKeyDictionary()


@dataclass(frozen=True, eq=False)
class StagedObject:
    """An object with its file opened; scenes are in the upright world."""

    placed: PlacedObject
    asset: GltfAsset
    up: str

    @property
    def is_animated(self) -> bool:
        return self.placed.visible and self.placed.animation is not None

    def pose_time_s(self, time_s: float) -> float:
        """The moment of its animation that is shown at a time since the scene began."""
        if self.placed.animation is None:
            return 0.0
        duration_s = self.asset.animation_durations_s[self.placed.animation]
        return time_s % duration_s if self.placed.loop and duration_s > 0 else min(time_s, duration_s)

    def scene_at(self, time_s: float) -> Scene:
        animation = self.placed.animation
        bare = self._first if animation is None else self.asset.scene_at(self.pose_time_s(time_s), animation)
        return bare.without_lights().transformed(self._upright_from_asset)

    @property
    def triangle_count(self) -> int:
        return sum(len(mesh.triangles) for mesh in self._first.meshes) if self.placed.visible else 0

    @property
    def _first(self) -> Scene:
        """The very same for every version of the object: by its arrays a backend knows that it was only moved."""
        of_asset = _first_scenes.setdefault(self.asset, {})
        if self.placed.animation not in of_asset:
            of_asset[self.placed.animation] = self.asset.scene_at(0.0, self.placed.animation)
        return of_asset[self.placed.animation]

    @cached_property
    def _upright_from_asset(self) -> Float[np.ndarray, "4 4"]:
        """From the first moment of the animation, so that the object neither jumps nor breathes while it moves."""
        low, high = self._first.bounds_m
        height_m = self.placed.height_m or float(high[1] - low[1]) * self.placed.scale
        return world_from_scene_placing(self._first, turned(self.placed.position_m, self.up), height_m, self.placed.yaw_rad)


class StagedScene:
    """One version of the scene; moving an object makes another version that shares what is loaded."""

    def __init__(
        self,
        description: SceneDescription,
        objects: tuple[StagedObject, ...],
        lighting: tuple[Environment | None, tuple[Light, ...]],
        moment_s: float = MOMENT_S,
    ) -> None:
        """moment_s: scenes are posed at whole multiples of this; 0 for any time, as a shutter asks for."""
        self.description, self.objects, self._lighting, self._moment_s = description, objects, lighting, moment_s
        self._made: tuple[float, Scene, Mapping[str, Scene]] | None = None
        self._points: tuple[Scene, Float[np.ndarray, "points 3"]] | None = None

    @classmethod
    def load(cls, description: SceneDescription, assets: Assets, moment_s: float = MOMENT_S) -> "StagedScene":
        """InputError where a file or an animation is not what the description says."""
        objects = tuple(_opened(each, assets, description) for each in description.objects)
        staged = cls(description, objects, assets.light(description.light, description.up), moment_s)
        staged.scene_at(0.0)
        return staged

    @property
    def is_animated(self) -> bool:
        return any(each.is_animated for each in self.objects)

    @cached_property
    def catcher(self) -> Mesh | None:
        """The part of the table that catches shadows, in the upright world."""
        shadow = self.description.shadow
        if shadow is None:
            return None
        x, y, z = turned(shadow.centre_m, self.description.up)
        return shadow_catcher(y, (x, z), 0.5 * shadow.size_m)

    def scene_at(self, time_s: float) -> Scene:
        """All visible objects, lit; the very same Scene for the same moment, because backends keep what they prepared for it."""
        return self._made_at(time_s)[0]

    def parts_at(self, time_s: float) -> Mapping[str, Scene]:
        """Each visible object by its name."""
        return self._made_at(time_s)[1]

    def drawn_points_m(self, time_s: float) -> Float[np.ndarray, "points 3"]:
        """Vertices of all that is drawn, and of its shadow on the catcher."""
        scene, points = self.scene_at(time_s), self._points
        if points is None or points[0] is not scene:
            points = self._points = scene, drawn_points_m(scene, self.catcher)
        return points[1]

    def with_object(self, name: str, **changes: object) -> "StagedScene":
        """One object changed (fields of PlacedObject); InputError where no object has that name."""
        names = [each.placed.name for each in self.objects]
        if name not in names:
            raise InputError(f"expected the name of an object of the scene ({', '.join(names) or 'it has none'}), got {name!r}")
        placed = tuple(replace(each, **changes) if each.name == name else each for each in self.description.objects)  # type: ignore[arg-type]
        objects = tuple(
            each if new is each.placed else StagedObject(new, each.asset, each.up) for new, each in zip(placed, self.objects, strict=True)
        )
        return StagedScene(replace(self.description, objects=placed), objects, self._lighting, self._moment_s)

    def _made_at(self, time_s: float) -> tuple[Scene, Mapping[str, Scene]]:
        moment_s = self._moment_of(time_s) if self.is_animated else 0.0
        made = self._made
        if made is None or made[0] != moment_s:
            parts = {each.placed.name: each.scene_at(moment_s) for each in self.objects if each.placed.visible}
            environment, lights = self._lighting
            whole = Scene(tuple(mesh for part in parts.values() for mesh in part.meshes), lights, environment)
            made = self._made = moment_s, whole, parts
        return made[1], made[2]

    def _moment_of(self, time_s: float) -> float:
        return round(time_s / self._moment_s) * self._moment_s if self._moment_s > 0.0 else time_s


def _opened(placed: PlacedObject, assets: Assets, description: SceneDescription) -> StagedObject:
    asset = assets.glb(placed.glb)
    names = list(asset.animation_durations_s)
    if placed.animation is not None and placed.animation not in names:
        raise InputError(
            f"{description.path}, [[object]] {placed.name!r}: expected animation to be one of {names} of {placed.glb.name}, "
            f"got {placed.animation!r}"
        )
    return StagedObject(placed, asset, description.up)

"""StagedScene: a scene file's content, loaded and posed at any moment; Assets: opened files, kept until they change."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.images.image_io import read_linear
from mrbokeh.scene import Environment, Light, Mesh, Scene, shadow_catcher, split_sun, sun, world_from_scene_placing
from mrbokeh.scene.gltf.gltf_loader import GltfAsset
from mrbokeh.scene.staging.picture_box import drawn_points_m
from mrbokeh.scene.staging.scene_description import Lighting, PlacedObject, SceneDescription
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.world_axes import turned

SUN_DIRECTION = (0.45, 1.0, 0.55)
_GREY, _SUN = 0.45, 1.6
"""Where a scene file brings no light: as bright as `mrbokeh composite` lights an object."""

MOMENT_S = 1 / 120
"""Live, animations are posed at whole multiples of this, so that two frames of one moment share one scene."""
_first_scenes: WeakKeyDictionary[GltfAsset, dict[str | None, Scene]] = WeakKeyDictionary()


class Assets:
    """Opened GLB files and lighting, kept until their files change. Not thread-safe: use it in the thread that loads scenes."""

    def __init__(self) -> None:
        self._kept: dict[object, tuple[object, Any]] = {}

    def glb(self, path: Path) -> GltfAsset:
        return self._kept_while(modified_s(path), path, lambda: GltfAsset(path))

    def light(self, light: Lighting, up: str) -> tuple[Environment | None, tuple[Light, ...]]:
        """Environment and lights in the upright world; the very same objects as long as nothing changed, for backends keep their tables."""
        path = light.environment
        if (made := light.made) is not None:
            return self._kept_while((light, up), "light", lambda: _exposed(*made, light.exposure))
        if path is None:
            return self._kept_while((light, up), "light", lambda: _made_up_light(light, up))
        panorama = self._kept_while((path, modified_s(path)), "panorama", lambda: Panorama(read_linear(path)))
        return self._kept_while((light, up, modified_s(path)), "light", lambda: _panorama_light(panorama, light, up))

    def _kept_while(self, stamp: object, key: object, load: Callable[[], Any]) -> Any:
        if key not in self._kept or self._kept[key][0] != stamp:
            self._kept[key] = stamp, load()
        return self._kept[key][1]


def modified_s(path: Path) -> float:
    """Return the time of a file's last change; -1 if it does not exist."""
    try:
        return path.stat().st_mtime
    except OSError:
        return -1.0


@cache
def _even_grey(radiance: float) -> Environment:
    """Return uniform light; the same object for the same radiance, since a backend spends a second on each."""
    return Environment(np.full((8, 16, 3), radiance, np.float32))


def _suns(light: Lighting, up: str) -> tuple[Light, ...]:
    return tuple(sun(turned(each.direction, up), each.irradiance).brighter(light.exposure) for each in light.suns)


def _made_up_light(light: Lighting, up: str) -> tuple[Environment | None, tuple[Light, ...]]:
    return _even_grey(_GREY * light.exposure), _suns(light, up) or (sun(SUN_DIRECTION, _SUN * light.exposure),)


def _exposed(environment: Environment, lights: tuple[Light, ...], factor: float) -> tuple[Environment, tuple[Light, ...]]:
    return (environment, lights) if factor == 1.0 else (environment.brighter(factor), tuple(each.brighter(factor) for each in lights))


class Panorama:
    """A panorama's file as it is, and without its sun; turned and exposed otherwise it is not read and split again."""

    def __init__(self, radiance: Float32[np.ndarray, "height width 3"]) -> None:
        self.whole = Environment(radiance)

    @cached_property
    def split(self) -> tuple[Environment, Light | None]:
        """A sky without a sun lights without shadows; that is no mistake."""
        try:
            return split_sun(self.whole)
        except InputError:
            return self.whole, None


def _panorama_light(panorama: Panorama, light: Lighting, up: str) -> tuple[Environment | None, tuple[Light, ...]]:
    sky, brightest = (panorama.whole, None) if light.suns else panorama.split
    turned_sky = sky.turned(light.rotation_rad)
    if light.exposure != 1.0:
        turned_sky = turned_sky.brighter(light.exposure)
    if light.suns or brightest is None:
        return turned_sky, _suns(light, up)
    turn = np.eye(4)
    turn[:3, :3] = turned_sky.world_from_environment
    return turned_sky, (brightest.transformed(turn).brighter(light.exposure),)


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
        """Transform by the first moment of the animation, so that the object neither jumps nor breathes while it moves."""
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
        """Set up one version of a scene. moment_s: scenes are posed at whole multiples of this; 0 for any time, as a shutter needs."""
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
        """Return the visible objects, lit; the very same Scene for the same moment, because backends keep what they prepared for it."""
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
            whole = Scene(tuple(mesh for part in parts.values() for mesh in part.meshes), lights, environment, tuple(parts.values()))
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

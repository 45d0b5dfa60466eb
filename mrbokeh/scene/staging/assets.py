"""Assets: opened GLB files and lighting, kept until their files change, so that an edit of the scene reloads only what it touched."""

from collections.abc import Callable
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.image_io import read_linear
from mrbokeh.scene import Environment, Light, split_sun, sun
from mrbokeh.scene.gltf.gltf_loader import GltfAsset
from mrbokeh.scene.staging.scene_description import Lighting
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.world_axes import turned

SUN_DIRECTION = (0.45, 1.0, 0.55)
_GREY, _SUN = 0.45, 1.6
"""Where a scene file brings no light: as bright as `mrbokeh composite` lights an object."""


class Assets:
    """Not thread-safe: belongs to the thread that loads scenes."""

    def __init__(self) -> None:
        self._kept: dict[object, tuple[object, Any]] = {}

    def glb(self, path: Path) -> GltfAsset:
        return self._kept_while(modified_s(path), path, lambda: GltfAsset(path))

    def light(self, light: Lighting, up: str) -> tuple[Environment | None, tuple[Light, ...]]:
        """Environment and lights in the upright world; the very same objects as long as nothing changed, for backends keep their tables."""
        path = light.environment
        if path is None:
            return self._kept_while((light, up), "light", lambda: _made_up_light(light, up))
        panorama = self._kept_while((path, modified_s(path)), "panorama", lambda: Panorama(read_linear(path)))
        return self._kept_while((light, up, modified_s(path)), "light", lambda: _panorama_light(panorama, light, up))

    def _kept_while(self, stamp: object, key: object, load: Callable[[], Any]) -> Any:
        if key not in self._kept or self._kept[key][0] != stamp:
            self._kept[key] = stamp, load()
        return self._kept[key][1]


def modified_s(path: Path) -> float:
    """When a file was written last; -1 where there is none."""
    try:
        return path.stat().st_mtime
    except OSError:
        return -1.0


@cache
def _even_grey(radiance: float) -> Environment:
    """The same object for the same light: a backend spends a second on each."""
    return Environment(np.full((8, 16, 3), radiance, np.float32))


def _suns(light: Lighting, up: str) -> tuple[Light, ...]:
    return tuple(sun(turned(each.direction, up), each.irradiance).brighter(light.exposure) for each in light.suns)


def _made_up_light(light: Lighting, up: str) -> tuple[Environment | None, tuple[Light, ...]]:
    return _even_grey(_GREY * light.exposure), _suns(light, up) or (sun(SUN_DIRECTION, _SUN * light.exposure),)


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

"""Assets: opened GLB files and lighting, kept until their files change, so that an edit of the scene reloads only what it touched."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from mrbokeh.errors import InputError
from mrbokeh.image_io import read_linear
from mrbokeh.object_layers import SUN_DIRECTION
from mrbokeh.scene import Environment, Light, split_sun, sun
from mrbokeh.scene.gltf_loader import GltfAsset
from viewfinder.stage.scene_description import Lighting
from viewfinder.stage.upright import turned

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
        return self._kept_while((light, up, modified_s(path)), "light", lambda: _panorama_light(path, light, up))

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


def _panorama_light(path: Path, light: Lighting, up: str) -> tuple[Environment | None, tuple[Light, ...]]:
    panorama = Environment(read_linear(path)).turned(light.rotation_rad).brighter(light.exposure)
    if light.suns:
        return panorama, _suns(light, up)
    try:
        sky, brightest = split_sun(panorama)
    except InputError:
        # A sky without a sun lights without shadows; that is no mistake.
        return panorama, ()
    return sky, (brightest,)

"""Proxy: a shot in fewer pixels, its plate, layers, depth and mattes shrunk after they are read.

Cameras, distortion and lens follow by themselves: cameras are resampled to the plate's size, and blur is counted in widths of the sensor.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32

from mrbokeh.compositing.plate import shrunk_matte
from mrbokeh.images.layer import Layer
from mrbokeh.shots.composite_recipe import CompositeRecipe
from mrbokeh.shots.frame_sources import ClipLook
from mrbokeh.shots.inputs import CameraSource, DepthSource, Description, Kept, LayerSource, MatteSource, Moment
from mrbokeh.shots.layer_sources import SceneLayers
from mrbokeh.video.clip import VideoInfo

Size = tuple[int, int]
Plane = Float32[np.ndarray, "height width"]


def picked(plane: np.ndarray, size_px: Size) -> np.ndarray:
    """Return a plane of fewer pixels whose numbers are some of its own, as depth and IDs ask: a mean of two surfaces is none."""
    return np.ascontiguousarray(cv2.resize(plane, size_px, interpolation=cv2.INTER_NEAREST_EXACT))


def shrunk_layer(layer: Layer, size_px: Size) -> Layer:
    """Return a layer of fewer pixels; a partly covered pixel lies where the mean of its light does, in dioptres."""
    mean = partial(cv2.resize, dsize=size_px, interpolation=cv2.INTER_AREA)
    alpha = mean(layer.alpha)
    near = mean(layer.alpha / layer.depth_m)
    depth_m = np.divide(alpha, near, out=np.full_like(alpha, np.inf), where=near > 0)
    return Layer(mean(layer.rgb), alpha, depth_m, {name: mean(values).reshape(*alpha.shape, -1) for name, values in layer.extra.items()})


@dataclass(frozen=True)
class Shrunk:
    """Description of layers, depth or mattes of the whole size, which are shrunk to that of the frame."""

    whole: Description[Any]
    size_px: Size

    @property
    def files(self) -> tuple[Path, ...]:
        return self.whole.files

    def opened(self, threads: int) -> "_Shrunk":
        return _Shrunk(self.whole.opened(threads), self.size_px)


class _Shrunk:
    """A LayerSource, DepthSource or MatteSource; what did not change is not shrunk again."""

    def __init__(self, whole: Any, size_px: Size) -> None:
        self._whole, self._size_px = whole, size_px
        self._layers: Callable[..., list[Layer]] = Kept(lambda layers, *size_px: [shrunk_layer(each, size_px) for each in layers])
        self._depth: Callable[..., Plane] = Kept(lambda plane, *size_px: picked(plane, size_px))
        self._matte: Callable[..., Plane] = Kept(lambda plane, *size_px: shrunk_matte(plane, size_px))

    def layers_at(self, moment: Moment, cameras: CameraSource | None) -> Sequence[Layer]:
        source: LayerSource = self._whole
        return self._layers(source.layers_at(replace(moment, size_px=self._size_px), cameras), *moment.size_px)

    def depth_m_at(self, moment: Moment) -> Plane:
        source: DepthSource = self._whole
        return self._depth(source.depth_m_at(replace(moment, size_px=self._size_px)), *moment.size_px)

    def near_alpha_at(self, moment: Moment) -> Plane:
        source: MatteSource = self._whole
        return self._matte(source.near_alpha_at(replace(moment, size_px=self._size_px)), *moment.size_px)


def proxy_recipe(recipe: CompositeRecipe, whole: VideoInfo, scale: Fraction) -> CompositeRecipe:
    """Return the recipe for frames of a ProxySource. Scenes are rendered at its size; files are read whole and shrunk."""
    size_px = (whole.width_px, whole.height_px)
    return replace(
        recipe,
        layers=tuple(each if isinstance(each, SceneLayers) else Shrunk(each, size_px) for each in recipe.layers),
        depth=None if recipe.depth is None else Shrunk(recipe.depth, size_px),
        matte=None if recipe.matte is None else Shrunk(recipe.matte, size_px),
        look=replace(recipe.look, proxy=scale) if isinstance(recipe.look, ClipLook) else recipe.look,
    )

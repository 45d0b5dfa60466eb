"""One render cut into layers by its objects: those of a Cryptomatte that were chosen, or all but some.

A pixel that objects share has one colour, so each gets the share of it that it covers. Laid over one another again the layers give the
render: what is behind is divided by what the layers before it leave free, for it is hidden there rather than thin. The depth of a shared
pixel is that of one of them; so all take theirs from the nearest pixel that is wholly their own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.layer import Layer
from mrbokeh.stacks.exr_layers.cryptomatte import Cryptomatte, cryptomattes
from mrbokeh.stacks.exr_layers.flat_render import FlatRender
from mrbokeh.stacks.exr_layers.nearest_depth import nearest_depth
from mrbokeh.stacks.exr_layers.render_channels import RenderChannels
from mrbokeh.system.errors import InputError

_NOTHING = np.float32(1e-6)
_WHOLLY = 0.999


@dataclass(frozen=True)
class ObjectSplit:
    """objects: names, one layer each; empty takes none apart. without: names left out. with_rest: what belongs to neither, as a layer.

    matte: name of the Cryptomatte, such as "CryptoObject", where a file has several; its end is enough.
    """

    objects: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    with_rest: bool = True
    matte: str = ""
    render: FlatRender = field(default_factory=FlatRender)

    def __post_init__(self) -> None:
        names = (*self.objects, *self.without)
        if len(set(names)) < len(names):
            raise InputError(f"every object can be named once, but came {', '.join(names)}")
        if not self.objects and not self.with_rest:
            raise InputError("nothing of the render would be left: name objects, or keep the rest")

    def layers(self, path: Path | str) -> list[Layer]:
        """Front first, by their mean depth in dioptres."""
        channels = RenderChannels.read(path, self.render.view)
        picture, matte = self.render.layer_of(channels), self._matte(channels)
        total = np.maximum(picture.alpha, matte.covered)
        shares = [_share(matte.matte(name), total) for name in self.objects]
        if self.with_rest:
            left_out = [_share(matte.matte(name), total) for name in self.without]
            shares.append(np.maximum(1.0 - np.sum([np.zeros_like(total), *shares, *left_out], axis=0), 0.0).astype(np.float32))
        return in_order([part_of(picture, share) for share in shares])

    def _matte(self, channels: RenderChannels) -> Cryptomatte:
        found = cryptomattes(channels)
        named = [each for name, each in found.items() if name.endswith(self.matte)]
        if len(named) != 1:
            raise InputError(f"{channels.path}: choose one of its Cryptomattes {', '.join(found)}, not {self.matte or 'none'!r}")
        return named[0]


def part_of(picture: Layer, share: Float32[np.ndarray, "height width"]) -> Layer:
    """What a share of every pixel, in [0, 1], has of a picture, with its own depth; parts add up, and are not yet behind one another."""
    extra = {name: values * share[..., None] for name, values in picture.extra.items()}
    is_part = share > 0
    depth_m = np.where(is_part, _own_depth(picture.depth_m, share), np.float32(np.inf))
    return Layer(picture.rgb * share[..., None], picture.alpha * share, depth_m, extra)


def in_order(parts: Sequence[Layer]) -> list[Layer]:
    """Layers that "over" puts together as the parts add up: front first, each divided by what those before it leave free."""
    free, layers = np.ones_like(parts[0].alpha), []
    for part in sorted(parts, key=_mean_dioptres, reverse=True):
        scale = (1.0 / np.maximum(free, _NOTHING)).astype(np.float32)
        extra = {name: values * scale[..., None] for name, values in part.extra.items()}
        layers.append(replace(part, rgb=part.rgb * scale[..., None], alpha=part.alpha * scale, extra=extra))
        free = free - part.alpha
    return layers


def _share(
    coverage: Float32[np.ndarray, "height width"], total: Float32[np.ndarray, "height width"]
) -> Float32[np.ndarray, "height width"]:
    return np.minimum(np.divide(coverage, total, out=np.zeros_like(total), where=total > 0), np.float32(1.0))


def _own_depth(
    depth_m: Float32[np.ndarray, "height width"], share: Float32[np.ndarray, "height width"]
) -> Float32[np.ndarray, "height width"]:
    """Depth of pixels that are wholly a thing's own; those it shares take it from the nearest such pixel, if there is one."""
    is_own = (share > _WHOLLY) & np.isfinite(depth_m)
    return nearest_depth(depth_m, is_own)[0] if is_own.any() else depth_m


def _mean_dioptres(layer: Layer) -> float:
    weight = float(layer.alpha.sum())
    return float((layer.alpha / layer.depth_m).sum()) / weight if weight > 0 else 0.0

"""Renders of other programs: all channels of an EXR file by their full name, whatever parts and views they are spread over, and RGBA with Z
as one layer.

| program | colour | depth along the axis |
|---|---|---|
| EXR itself, Nuke, mrbokeh | R G B A without a layer | Z or depth.Z |
| Blender, multilayer | VIEWLAYER.Combined.* | VIEWLAYER.Depth.Z, 1e10 is background |
| Houdini, Mantra and Karma | R G B A, or C.* | Pz (part Pz) |
| Arnold, V-Ray, Redshift | R G B A, or beauty.*, RGBA.* in parts | Z, depth.Z |

Blender 4 writes one part, 5 one for each layer if not told otherwise; its File Output node calls depth Depth.V. Some of these programs
can write a depth that is not along the axis (Nuke 1/z, Arnold and Karma the distance along the ray): nobody can tell from the numbers.
Z is that of one ray, which may have passed by what covers part of the pixel: depth at edges is mended from the nearest known pixel.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float32

from mrbokeh.images.exr_io import Channels, ExrPart, in_rec709, read_exr, stated_primaries
from mrbokeh.images.image_io import doubt_metres, require_alpha, require_depth_ahead, require_numbers
from mrbokeh.images.layer import Layer
from mrbokeh.layering.motion import with_motion
from mrbokeh.system.errors import InputError

COLOUR_LAYERS = ("", "Combined", "C", "RGBA", "rgba", "beauty", "Beauty")
"""Layers that are taken as the picture; the unnamed one goes before all others."""
DEPTH_NAMES = ("Z", "depth.Z", "Depth.Z", "Depth.V", "depth.z", "Pz", "Pz.Z", "Pz.z", "Pz.Pz", "z")
BACKGROUND_FROM = 1e9
"""Depths from here on are background: Blender writes 1e10 (inf as half)."""


def joined(layer: str, channel: str) -> str:
    """Return the full name of a channel of a layer; the unnamed layer is ""."""
    return f"{layer}.{channel}" if layer else channel


_NAMES = (("forward.u", "forward.v"), ("motion.u", "motion.v"), ("u", "v"))


def read_motion(path: Path | str) -> Float32[np.ndarray, "height width 2"]:
    """Read motion in pixels, right and down, as mrbokeh counts; files count upwards, as Nuke and Blender do.

    Raises InputError where there are no such channels.
    """
    channels = {name: pixels for part in reversed(read_exr(path)) for name, pixels in part.channels.items()}
    for right, up in _NAMES:
        if right in channels and up in channels:
            return np.stack([channels[right], -channels[up]], axis=2).astype(np.float32)
    raise InputError(f"{path}: expected motion in the channels forward.u and forward.v, but it has {', '.join(sorted(channels))}")


def taken_from_channels(layer: Layer, shutter: float) -> Layer:
    """Return the layer with extra channels forward.u and forward.v (times alpha, as all extra channels) as its motion; else unchanged."""
    if not {"forward.u", "forward.v"} <= layer.extra.keys():
        return layer
    alpha = np.maximum(layer.alpha, np.float32(1e-6))[..., None]
    motion_px = np.concatenate([layer.extra["forward.u"], -layer.extra["forward.v"]], axis=2) / alpha
    rest = {name: values for name, values in layer.extra.items() if name not in ("forward.u", "forward.v")}
    return with_motion(replace(layer, extra=rest), motion_px.astype(np.float32), shutter)


MULTI_VIEW = "multiView"


@dataclass(frozen=True)
class RenderChannels:
    """Channels of a file; of a stereo file those of its first view (eye).

    channels: full name to (H, W), as stored; a channel of a named part can also be had as PART.CHANNEL. stored: the names as the
    file has them, for errors. primaries: what R, G and B are, if stated. metadata: all strings and numbers of the headers.
    """

    path: Path
    channels: Channels
    stored: tuple[str, ...]
    primaries: tuple[float, ...] | None
    metadata: dict[str, Any]

    @classmethod
    def read(cls, path: Path | str) -> "RenderChannels":
        """Read a file; of a stereo file its first view."""
        path = Path(path)
        parts = read_exr(path)
        of_parts = _views_of_parts(parts)
        views = of_parts or _views_of_names(path)
        chosen = views[0] if views else ""
        mine = [part for part in parts if part.attributes.get("view", chosen) == chosen]
        by_part = [(part.name, part.channels if of_parts else _of_first_view(part.channels, views)) for part in mine]
        metadata = {key: value for part in reversed(parts) for key, value in part.attributes.items()}
        stored = tuple(sorted({name for part in mine for name in part.channels}))
        return cls(path=path, channels=_named(by_part), stored=stored, primaries=stated_primaries(mine[0], parts), metadata=metadata)

    def colour_layer(self) -> str:
        """Return the layer whose R, G and B are the picture. Raises InputError if several or none could be meant."""
        layers = [layer for layer in self._layers() if all(joined(layer, name) in self.channels for name in "RGB")]
        known = [layer for layer in layers if layer.rpartition(".")[2] in COLOUR_LAYERS]
        found = [layer for layer in known if layer == ""] or self._distinct(known)
        # Blender's compositor writes its picture beside the layers that were rendered, without depth.
        found = [each for each in found if self._has_depth(each)] if len(found) > 1 else found
        if len(found) == 1:
            return found[0]
        if found:
            raise InputError(
                f"{self.path}: R, G and B could be any of the layers {', '.join(found)}: write the picture without a layer's name"
            )
        raise InputError(f"{self.path}: expected R, G and B, but it has {', '.join(self.stored)}: render with colour")

    def depth_name(self, colour_layer: str) -> str:
        """Return the channel that holds depth: beside the colour layer, else anywhere at the top. Raises InputError if there is none."""
        for parent in dict.fromkeys([colour_layer, colour_layer.rpartition(".")[0], ""]):
            for name in DEPTH_NAMES:
                if joined(parent, name) in self.channels:
                    return joined(parent, name)
        raise InputError(
            f"{self.path}: expected depth in a channel {', '.join(DEPTH_NAMES)}, but it has {', '.join(self.stored)}: render with depth"
        )

    def _has_depth(self, layer: str) -> bool:
        """Return whether depth lies beside a layer, under its own name or that of the layer it is in."""
        return any(joined(parent, name) in self.channels for parent in (layer, layer.rpartition(".")[0]) if parent for name in DEPTH_NAMES)

    def plane(self, name: str) -> Float[np.ndarray, "height width"]:
        return self.channels[name]

    def _layers(self) -> list[str]:
        return sorted({name.rpartition(".")[0] for name in self.channels})

    def _distinct(self, layers: Sequence[str]) -> list[str]:
        """Return layers without those that are another's pixels under a longer name."""
        kept: dict[int, str] = {}
        for layer in sorted(layers, key=len):
            kept.setdefault(id(self.channels[joined(layer, "R")]), layer)
        return list(kept.values())


def _views_of_parts(parts: Sequence[ExrPart]) -> list[str]:
    """Return names of the eyes if each has parts of its own, the default first."""
    return list(dict.fromkeys(str(part.attributes["view"]) for part in parts if "view" in part.attributes))


def _views_of_names(path: Path) -> list[str]:
    """Return names of the eyes if they stand in the names of channels, the default first."""
    import OpenEXR

    with OpenEXR.File(str(path), header_only=True) as file:
        return [str(view) for view in file.parts[0].header.get(MULTI_VIEW, [])]


def _named(by_part: Sequence[tuple[str, Channels]]) -> Channels:
    """Return the channels of all parts. A name that several parts have needs the part's before it, unless one of them is the picture."""
    owners: dict[str, list[str]] = {}
    for part, of_part in by_part:
        for name in of_part:
            owners.setdefault(name, []).append(part)
    channels: Channels = {}
    for part, of_part in by_part:
        for name, pixels in of_part.items():
            if len(owners[name]) == 1 or part in COLOUR_LAYERS:
                channels.setdefault(name, pixels)
            if part and not name.startswith(f"{part}."):
                channels.setdefault(f"{part}.{name}", pixels)
    return channels


def _of_first_view(channels: Channels, views: Sequence[str]) -> Channels:
    """Return channels under the names that they would have if there were one view (Multi-View OpenEXR: LAYER.VIEW.CHANNEL)."""
    result: Channels = {}
    for name, pixels in channels.items():
        *layer, channel = name.split(".")
        owner = layer[-1] if len(views) > 1 and layer and layer[-1] in views else None
        if owner is None:
            # Layers without a view belong to all.
            result.setdefault(name, pixels)
        elif owner == views[0]:
            result[".".join([*layer[:-1], channel])] = pixels
    return result


# The eight neighbours.
_BESIDE_PX = 1.5


def edges_mended(layer: Layer) -> Layer:
    """Give partly covered pixels without depth that of a pixel beside them. Opaque ones without depth are sky and stay."""
    is_known = np.isfinite(layer.depth_m)
    is_lost = ~is_known & (layer.alpha > 0) & (layer.alpha < 1)
    if not is_lost.any() or not is_known.any():
        return layer
    nearest_m, distance_px = nearest_depth(layer.depth_m, is_known)
    depth_m = np.where(is_lost & (distance_px < _BESIDE_PX), nearest_m, layer.depth_m)
    return Layer(layer.rgb, layer.alpha, depth_m, layer.extra)


def nearest_depth(
    depth_m: Float32[np.ndarray, "height width"], is_known: Bool[np.ndarray, "height width"]
) -> tuple[Float32[np.ndarray, "height width"], np.ndarray]:
    """Return the depth of the nearest known pixel, and how far away that is, in pixels; at least one must be known."""
    from scipy.ndimage import distance_transform_edt

    distance_px, (rows, columns) = distance_transform_edt(~is_known, return_indices=True)
    return depth_m[rows, columns], distance_px


@runtime_checkable
class LayerReader(Protocol):
    """Way of reading one file of a render; its settings are its constructor's."""

    def layers(self, path: Path | str) -> list[Layer]:
        """Return sharp layers, front first, linear Rec.709, depth in metres. Raises InputError if the file lacks what is asked for."""
        ...


class FlatRender:
    """Reader of a flat render: premultiplied colour, depth along the axis in metres."""

    def layers(self, path: Path | str) -> list[Layer]:
        """Return the one layer; pixels at edges whose depth is that of the background behind are mended."""
        return [edges_mended(layer_of(RenderChannels.read(path)))]


def layer_of(render: RenderChannels) -> Layer:
    """Return the picture of channels, without mending depth at edges. Colour above alpha is light of its own (flames) and stays as it is.

    Depths not above 0 or farther than any scene are background.
    """
    name = render.colour_layer()
    rgb = np.stack([render.plane(joined(name, each)) for each in "RGB"], axis=2).astype(np.float32)
    alpha_name = joined(name, "A")
    alpha = render.plane(alpha_name).astype(np.float32) if alpha_name in render.channels else np.ones(rgb.shape[:2], np.float32)
    require_numbers(render.path, {"colour": rgb, "alpha": alpha})
    require_alpha(render.path, alpha)
    rgb = in_rec709(rgb, render.primaries, render.path)
    depth_name, is_seen = render.depth_name(name), (alpha > 0) | (rgb != 0).any(axis=2)
    depth_m = render.plane(depth_name).astype(np.float32)
    require_depth_ahead(render.path, depth_name, render.plane(depth_name)[is_seen])
    require_numbers(render.path, {depth_name: depth_m})
    is_there = is_seen & (depth_m > 0) & (depth_m < BACKGROUND_FROM)
    doubt_metres(render.path, depth_m[is_there])
    return Layer(rgb, alpha, np.where(is_there, depth_m, np.float32(np.inf)))

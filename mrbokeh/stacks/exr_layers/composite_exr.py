"""Our own layered EXR: the finished picture, depth, and what it was put together from, to go on with in another program; and deep EXR.

One part, for not all programs read several. The picture is the unnamed R, G, B, A and depth is Z, as EXR says; every layer is
NAME.R, NAME.G, NAME.B, NAME.A, premultiplied; mattes and maps are layers of their own with one channel.

Deep EXR is for sharp layers and for compositors that hold out and merge by depth: one sample per layer and pixel that holds anything.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.alpha_io import in_named_space, stated
from mrbokeh.images.carried_exr import CarriedExr
from mrbokeh.images.color_management import NamedSpace
from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.images.layer import Layer
from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.errors import InputError

_DEEP_COMMENTS = "Scene-linear; premultiplied alpha; Z in metres along the optical axis; samples have no thickness. Written by mrbokeh."


def write_deep_exr(path: Path | str, layers: Sequence[Layer], *, half: bool = True) -> None:
    """Write R, G, B, A in half or float and Z in float, nearest sample first. Blurred light has no one depth, so layers must be sharp.

    Readers go by depth alone: if layers are not in the order of their depth, that changes.
    """
    import OpenEXR

    sizes = {layer.alpha.shape for layer in layers}
    if len(sizes) != 1:
        raise InputError(f"a deep picture needs layers of one size, got {sorted((w, h) for h, w in sizes) or 'none'} (width, height)")
    dtype = np.float16 if half else np.float32
    rgba = np.stack([np.dstack([layer.rgb, layer.alpha]) for layer in layers])
    depth_m = np.stack([layer.depth_m for layer in layers])
    which, rows, columns = np.nonzero((rgba != 0).any(axis=3))
    order = np.lexsort((which, depth_m[which, rows, columns], columns, rows))
    which, rows, columns = which[order], rows[order], columns[order]
    # Where a pixel's samples begin.
    begins = np.flatnonzero(np.diff(rows, prepend=-1) | np.diff(columns, prepend=-1))
    values = {name: rgba[which, rows, columns, i].astype(dtype) for i, name in enumerate("RGBA")} | {"Z": depth_m[which, rows, columns]}
    planes = {name: np.full(depth_m.shape[1:], None, object) for name in values}
    for y, x, begin, end in np.column_stack([rows[begins], columns[begins], begins, np.append(begins, len(rows))[1:]]).tolist():
        for name, of_samples in values.items():
            planes[name][y, x] = of_samples[begin:end]
    header = {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION, "comments": _DEEP_COMMENTS}
    with atomic_path(path) as temporary:
        OpenEXR.File([OpenEXR.Part(header, planes, "rgba")]).write(str(temporary))


COMMENTS = (
    "Alpha premultiplied; unnamed R,G,B,A is the finished picture. Z and *.Z: metres along the optical axis, sharp, not "
    "antialiased, inf is background. virtual.*: light of the virtual objects as it arrives, blurred and partly hidden, so picture = "
    "photo left over + virtual. shadow.*: what darkens the photo. matte.A: part of the pupil that sees virtual things. coc.px: diameter "
    "of the circle of confusion in pixels, + behind the focus, - in front of it. Written by mrbokeh."
)
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_RESERVED = ("matte", "coc")


@dataclass(frozen=True)
class CompositeLayers:
    """Finished picture with what it consists of; what is None is not written.

    rgb: (H, W, 3) linear. alpha: of the picture; None is opaque. depth_m: of the picture. layers: by name, such as "virtual" and
    "shadow", front first, each with its own depth; letters, digits and _ (Nuke changes all else). matte: in [0, 1]. coc_px: signed.
    objects: Cryptomatte with its header entries (`cryptomatte.carried_cryptomatte`).
    """

    rgb: Float32[np.ndarray, "height width 3"]
    alpha: Float32[np.ndarray, "height width"] | None = None
    depth_m: Float32[np.ndarray, "height width"] | None = None
    layers: Mapping[str, Layer] = field(default_factory=dict)
    matte: Float32[np.ndarray, "height width"] | None = None
    coc_px: Float32[np.ndarray, "height width"] | None = None
    objects: ExrPart | None = None

    def __post_init__(self) -> None:
        size = self.rgb.shape[:2]
        planes = {"alpha": self.alpha, "depth": self.depth_m, "matte": self.matte, "coc": self.coc_px}
        planes |= {name: layer.alpha for name, layer in self.layers.items()}
        for name, plane in planes.items():
            if plane is not None and plane.shape != size:
                raise InputError(f"{name} is {plane.shape[1]}x{plane.shape[0]} px but the picture is {size[1]}x{size[0]} px: resize it")
        for name in self.layers:
            if not _NAME.fullmatch(name) or name in _RESERVED:
                raise InputError(f"a layer's name is letters, digits and _, a letter first, and not {' or '.join(_RESERVED)}; got {name!r}")


def write_composite_exr(
    path: Path | str,
    composite: CompositeLayers,
    *,
    half: bool = True,
    space: NamedSpace | None = None,
    carried: CarriedExr | None = None,
) -> None:
    """Write colour in half or float, depth and circles of confusion always in float.

    space: to which the colours of the picture and of all layers are brought. carried: metadata and windows of the plate.
    """
    dtype = np.float16 if half else np.float32
    alpha = np.ones(composite.rgb.shape[:2], np.float32) if composite.alpha is None else composite.alpha
    channels = _rgba("", in_named_space(composite.rgb, composite.alpha, space), alpha, dtype)
    for name, layer in composite.layers.items():
        rgb = in_named_space(layer.rgb, layer.alpha, space)
        channels |= _rgba(f"{name}.", rgb, layer.alpha, dtype) | {f"{name}.Z": layer.depth_m}
    maps = {"Z": composite.depth_m, "coc.px": composite.coc_px}
    channels |= {name: plane for name, plane in maps.items() if plane is not None}
    if composite.matte is not None:
        channels["matte.A"] = composite.matte.astype(dtype)
    attributes = {"comments": COMMENTS, "mrbokehLayers": ",".join(composite.layers), **stated(space)}
    if composite.objects is not None:
        channels |= composite.objects.channels
        attributes |= composite.objects.attributes
    part = ExrPart(channels, attributes=attributes)
    write_exr(path, part if carried is None else carried.onto(part, space))


def _rgba(prefix: str, rgb: np.ndarray, alpha: np.ndarray, dtype: type) -> dict[str, np.ndarray]:
    """Return RGBA channels, clipped to 65504 in half floats: inf would spoil every blur that follows."""
    planes = {name: rgb[..., i] for i, name in enumerate("RGB")} | {"A": alpha}
    limit = np.finfo(dtype).max
    return {f"{prefix}{name}": np.clip(plane, -limit, limit).astype(dtype) for name, plane in planes.items()}

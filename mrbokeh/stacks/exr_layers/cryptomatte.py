"""Cryptomatte 1.2 (Friedman and Jones 2015): how much of every pixel an object covers, by name; and renders cut into layers by it.

Every matte has a header entry "cryptomatte/KEY/name", the prefix of its channels NAME00, NAME01, ... (ranks two by two: R the ID of one
object, G its coverage, B and A of the next), and mostly a manifest of names. An ID is the hash of the name (MurmurHash3_x86_32 with seed 0,
Appleby, public domain), kept as a float of the same bits; only its bits are compared, for as a float it means nothing.

A pixel that objects share has one colour, so each gets the share of it that it covers. Laid over one another again the layers give the
render: what is behind is divided by what the layers before it leave free, for it is hidden there rather than thin. The depth of a shared
pixel is that of one of them; so all take theirs from the nearest pixel that is wholly their own.
"""

import difflib
import json
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt32

from mrbokeh.images.exr_io import ExrPart
from mrbokeh.images.layer import Layer
from mrbokeh.stacks.exr_layers.deep_layers import is_deep
from mrbokeh.stacks.exr_layers.render_channels import RenderChannels, layer_of, nearest_depth
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import say

_MASK = 0xFFFFFFFF


def murmur3_32(data: bytes) -> int:
    """Return the hash of bytes, in 0 to 2^32 - 1."""
    hashed, whole = 0, len(data) // 4 * 4
    for (word,) in struct.iter_unpack("<I", data[:whole]):
        hashed = (_rotated(hashed ^ _mixed(word), 13) * 5 + 0xE6546B64) & _MASK
    hashed ^= _mixed(int.from_bytes(data[whole:], "little")) ^ len(data)
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        hashed = ((hashed ^ hashed >> shift) * factor) & _MASK
    return hashed ^ hashed >> 16


def id_bits(name: str) -> int:
    """Return the bits of a name's ID. An exponent of zeros or ones would be denormal, infinite or NaN: its lowest bit is turned over."""
    hashed = murmur3_32(name.encode("utf-8"))
    return hashed ^ 1 << 23 if hashed >> 23 & 255 in (0, 255) else hashed


def _mixed(word: int) -> int:
    return _rotated((word * 0xCC9E2D51) & _MASK, 15) * 0x1B873593 & _MASK


def _rotated(word: int, bits: int) -> int:
    return (word << bits | word >> 32 - bits) & _MASK


_CHANNELS = (("R", "G", "B", "A"), ("r", "g", "b", "a"), ("red", "green", "blue", "alpha"))
_BACKGROUND = 0
"""No object: coverage that belongs to nobody has the ID 0."""


@dataclass(frozen=True)
class Cryptomatte:
    """Matte of a file, such as CryptoObject or CryptoMaterial.

    manifest: name to the bits of its ID; empty where the file has none, names then have to be known.
    ids, coverages: per rank (H, W), the largest coverage first; coverage in [0, 1].
    """

    name: str
    manifest: Mapping[str, int]
    ids: Sequence[UInt32[np.ndarray, "height width"]]
    coverages: Sequence[Float32[np.ndarray, "height width"]]

    @property
    def names(self) -> list[str]:
        """Return the names of the manifest; not all of them need to be in the picture."""
        return sorted(self.manifest)

    def matte(self, name: str) -> Float32[np.ndarray, "height width"]:
        """Return how much of every pixel an object covers. Raises InputError if the name is neither listed nor in the picture."""
        bits = np.uint32(self._bits_of(name))
        total = np.zeros(self.coverages[0].shape, np.float32)
        for ids, coverage in zip(self.ids, self.coverages, strict=True):
            total += np.where(ids == bits, coverage, np.float32(0.0))
        return total

    @cached_property
    def covered(self) -> Float32[np.ndarray, "height width"]:
        """Return how much of every pixel all objects cover together."""
        total = np.zeros(self.coverages[0].shape, np.float32)
        for ids, coverage in zip(self.ids, self.coverages, strict=True):
            total += np.where(ids != _BACKGROUND, coverage, np.float32(0.0))
        return total

    def _bits_of(self, name: str) -> int:
        if name in self.manifest:
            return self.manifest[name]
        bits = id_bits(name)
        if any((ids == np.uint32(bits)).any() for ids in self.ids):
            return bits
        near = difflib.get_close_matches(name, self.names, n=3, cutoff=0.4) or self.names[:8]
        told = f"there are {', '.join(near)}" if near else "the file has no manifest"
        raise InputError(f"{name!r} is not in the Cryptomatte {self.name}: {told}")


def cryptomattes(render: RenderChannels) -> dict[str, Cryptomatte]:
    """Read all mattes of a file by name. Raises InputError if there are none, or IDs are not what the specification says."""
    keys = {name.split("/")[1] for name in render.metadata if name.startswith("cryptomatte/") and name.count("/") == 2}
    found = [_cryptomatte(render, {what: render.metadata.get(f"cryptomatte/{key}/{what}") for what in _ENTRIES}) for key in sorted(keys)]
    if not found:
        raise InputError(f"{render.path}: expected Cryptomatte (header entries cryptomatte/...), but it has none: render with it")
    return {each.name: each for each in found}


_ENTRIES = ("name", "hash", "conversion", "manifest", "manif_file")


def carried_cryptomatte(path: Path) -> ExrPart | None:
    """Return all Cryptomattes of a render, channels and header entries, to be written into a picture made of it; None without any.

    They stay as rendered, sharp: an ID cannot be blurred. Manifests of files beside the render are put into the header.
    """
    render = RenderChannels.read(path)
    prefix = "cryptomatte/"
    entries = {name: value for name, value in render.metadata.items() if name.startswith(prefix)}
    channels: dict[str, np.ndarray] = {}
    for name, value in list(entries.items()):
        if name.endswith("/name"):
            ranked = re.compile(rf"{re.escape(str(value))}\d\d\.\w+")
            channels |= {each: render.plane(each) for each in render.channels if ranked.fullmatch(each)}
        if name.endswith("/manif_file"):
            beside = entries.pop(name)
            bits = _manifest(path, {"name": name, "manifest": None, "manif_file": beside})
            entries[name.removesuffix("manif_file") + "manifest"] = json.dumps({each: f"{of:08x}" for each, of in bits.items()})
    return ExrPart(channels, attributes=entries) if channels else None


def _cryptomatte(render: RenderChannels, entries: Mapping[str, Any]) -> Cryptomatte:
    name = str(entries["name"])
    for what, expected in (("hash", "MurmurHash3_32"), ("conversion", "uint32_to_float32")):
        if entries[what] not in (None, expected):
            raise InputError(
                f"{render.path}: expected {what} {expected} of the Cryptomatte {name}, got {entries[what]!r}: write it as Cryptomatte 1.2"
            )
    planes = _ranked_planes(render, name)
    ids = [_bits(render, name, plane) for plane in planes[::2]]
    return Cryptomatte(name, _manifest(render.path, entries), ids, [plane.astype(np.float32) for plane in planes[1::2]])


def _ranked_planes(render: RenderChannels, name: str) -> list[np.ndarray]:
    """Return ID, coverage, ID, coverage, ... of all ranks."""
    planes: list[np.ndarray] = []
    while True:
        layer = f"{name}{len(planes) // 4:02d}"
        spelled = next((each for each in _CHANNELS if f"{layer}.{each[0]}" in render.channels), None)
        if spelled is None:
            break
        planes += [render.plane(f"{layer}.{channel}") for channel in spelled if f"{layer}.{channel}" in render.channels]
    if not planes or len(planes) % 2:
        came = f"{len(planes)} channels" if planes else "none"
        raise InputError(
            f"{render.path}: expected ID and coverage of the Cryptomatte {name} by turns in the channels {name}00.R, G, B, A and on, "
            f"got {came}: write the render again with all of them"
        )
    return planes


def _bits(render: RenderChannels, name: str, plane: np.ndarray) -> UInt32[np.ndarray, "height width"]:
    if plane.dtype != np.float32:
        raise InputError(f"{render.path}: IDs of the Cryptomatte {name} are stored as {plane.dtype}, which breaks them: write 32 bit float")
    return np.ascontiguousarray(plane).view(np.uint32)


def _manifest(path: Path, entries: Mapping[str, Any]) -> dict[str, int]:
    """Return name to bits, from the header or from a file beside the picture."""
    text = entries["manifest"]
    try:
        if text is None and entries["manif_file"] is not None:
            text = (path.parent / str(entries["manif_file"])).read_text(encoding="utf-8")
        return {name: int(bits, 16) for name, bits in json.loads(text).items()} if text else {}
    except (OSError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: the manifest of the Cryptomatte {entries['name']} cannot be read ({error})") from None


def cryptomatte_among(paths: Sequence[Path]) -> ExrPart | None:
    """Return the Cryptomattes of several renders; of those with one name the first is taken, and said. None without any."""
    found = {path: each for path in paths if not is_deep(path) and (each := carried_cryptomatte(path)) is not None}
    channels: dict[str, np.ndarray] = {}
    entries: dict[str, Any] = {}
    for path, each in found.items():
        if channels.keys() & each.channels.keys():
            say(f"{path} has a Cryptomatte of the same name as a layer before it: the first is written, write them under other names")
            continue
        channels |= each.channels
        entries |= each.attributes
    return ExrPart(channels, attributes=entries) if channels else None


_NOTHING = np.float32(1e-6)
_WHOLLY = 0.999


@dataclass(frozen=True)
class ObjectSplit:
    """Reader of a render as layers of its objects.

    objects: names, one layer each. with_rest: what belongs to none of them, as a layer.
    """

    objects: tuple[str, ...]
    with_rest: bool = True

    def __post_init__(self) -> None:
        if len(set(self.objects)) < len(self.objects):
            raise InputError(f"every object can be named once, but came {', '.join(self.objects)}")

    def layers(self, path: Path | str) -> list[Layer]:
        """Return the layers, front first by their mean depth in dioptres."""
        channels = RenderChannels.read(path)
        picture, matte = layer_of(channels), _only_matte(channels)
        total = np.maximum(picture.alpha, matte.covered)
        shares = [_share(matte.matte(name), total) for name in self.objects]
        if self.with_rest:
            shares.append(np.maximum(1.0 - np.sum([np.zeros_like(total), *shares], axis=0), 0.0).astype(np.float32))
        return in_order([part_of(picture, share) for share in shares])


def _only_matte(channels: RenderChannels) -> Cryptomatte:
    found = cryptomattes(channels)
    if len(found) != 1:
        raise InputError(f"{channels.path}: expected one Cryptomatte, got {', '.join(found)}: write the render with that of objects alone")
    return next(iter(found.values()))


def part_of(picture: Layer, share: Float32[np.ndarray, "height width"]) -> Layer:
    """Return a share of every pixel, in [0, 1], of a picture, with its own depth; parts add up, and are not yet behind one another."""
    extra = {name: values * share[..., None] for name, values in picture.extra.items()}
    is_part = share > 0
    depth_m = np.where(is_part, _own_depth(picture.depth_m, share), np.float32(np.inf))
    return Layer(picture.rgb * share[..., None], picture.alpha * share, depth_m, extra)


def in_order(parts: Sequence[Layer]) -> list[Layer]:
    """Return layers that "over" puts together as the parts add up: front first, each divided by what those before it leave free."""
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
    """Return depth of pixels that are wholly a thing's own; shared pixels take it from the nearest such pixel, if there is one."""
    is_own = (share > _WHOLLY) & np.isfinite(depth_m)
    return nearest_depth(depth_m, is_own)[0] if is_own.any() else depth_m


def _mean_dioptres(layer: Layer) -> float:
    weight = float(layer.alpha.sum())
    return float((layer.alpha / layer.depth_m).sum()) / weight if weight > 0 else 0.0

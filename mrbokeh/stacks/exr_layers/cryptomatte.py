"""Cryptomatte 1.2 (Friedman and Jones 2015): which object covers how much of every pixel, by name, from a render's channels.

Every matte has a header entry "cryptomatte/KEY/name", the prefix of its channels NAME00, NAME01, ... (ranks two by two: R the ID of one
object, G its coverage, B and A of the next), and mostly a manifest of names. An ID is the hash of the name, kept as a float of the
same bits; only its bits are compared, for as a float it means nothing.
"""

import difflib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt32

from mrbokeh.stacks.exr_layers.murmur_hash import id_bits
from mrbokeh.stacks.exr_layers.render_channels import RenderChannels
from mrbokeh.system.errors import InputError

_CHANNELS = (("R", "G", "B", "A"), ("r", "g", "b", "a"), ("red", "green", "blue", "alpha"))
_BACKGROUND = 0
"""No object: coverage that belongs to nobody has the ID 0."""


@dataclass(frozen=True)
class Cryptomatte:
    """One matte of a file, such as CryptoObject or CryptoMaterial.

    manifest: name to the bits of its ID; empty where the file has none, names then have to be known.
    ids, coverages: per rank (H, W), the largest coverage first; coverage in [0, 1].
    """

    name: str
    manifest: Mapping[str, int]
    ids: Sequence[UInt32[np.ndarray, "height width"]]
    coverages: Sequence[Float32[np.ndarray, "height width"]]

    @property
    def names(self) -> list[str]:
        """Of the manifest; not all of them need to be in the picture."""
        return sorted(self.manifest)

    def matte(self, name: str) -> Float32[np.ndarray, "height width"]:
        """How much of every pixel an object covers. Raises InputError where the name is neither listed nor in the picture."""
        bits = np.uint32(self._bits_of(name))
        total = np.zeros(self.coverages[0].shape, np.float32)
        for ids, coverage in zip(self.ids, self.coverages, strict=True):
            total += np.where(ids == bits, coverage, np.float32(0.0))
        return total

    @cached_property
    def covered(self) -> Float32[np.ndarray, "height width"]:
        """How much of every pixel all objects cover together."""
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
    """All mattes of a file by name. Raises InputError where there are none, or one whose IDs are not what the specification says."""
    keys = {name.split("/")[1] for name in render.metadata if name.startswith("cryptomatte/") and name.count("/") == 2}
    found = [_cryptomatte(render, {what: render.metadata.get(f"cryptomatte/{key}/{what}") for what in _ENTRIES}) for key in sorted(keys)]
    if not found:
        raise InputError(f"{render.path}: expected Cryptomatte (header entries cryptomatte/...), but it has none: render with it")
    return {each.name: each for each in found}


_ENTRIES = ("name", "hash", "conversion", "manifest", "manif_file")


def _cryptomatte(render: RenderChannels, entries: Mapping[str, Any]) -> Cryptomatte:
    name = str(entries["name"])
    for what, expected in (("hash", "MurmurHash3_32"), ("conversion", "uint32_to_float32")):
        if entries[what] not in (None, expected):
            raise InputError(f"{render.path}: the Cryptomatte {name} has {what} {entries[what]!r}, but only {expected} is known")
    planes = _ranked_planes(render, name)
    ids = [_bits(render, name, plane) for plane in planes[::2]]
    return Cryptomatte(name, _manifest(render.path, entries), ids, [plane.astype(np.float32) for plane in planes[1::2]])


def _ranked_planes(render: RenderChannels, name: str) -> list[np.ndarray]:
    """ID, coverage, ID, coverage, ... of all ranks."""
    planes: list[np.ndarray] = []
    while True:
        layer = f"{name}{len(planes) // 4:02d}"
        spelled = next((each for each in _CHANNELS if f"{layer}.{each[0]}" in render.channels), None)
        if spelled is None:
            break
        planes += [render.plane(f"{layer}.{channel}") for channel in spelled if f"{layer}.{channel}" in render.channels]
    if not planes or len(planes) % 2:
        raise InputError(f"{render.path}: expected ranks of the Cryptomatte {name} in {name}00.R, G, B, A and on, but they are not whole")
    return planes


def _bits(render: RenderChannels, name: str, plane: np.ndarray) -> UInt32[np.ndarray, "height width"]:
    if plane.dtype != np.float32:
        raise InputError(f"{render.path}: IDs of the Cryptomatte {name} are stored as {plane.dtype}, which breaks them: write 32 bit float")
    return np.ascontiguousarray(plane).view(np.uint32)


def _manifest(path: Path, entries: Mapping[str, Any]) -> dict[str, int]:
    """Name to bits, from the header or from a file beside the picture."""
    text = entries["manifest"]
    try:
        if text is None and entries["manif_file"] is not None:
            text = (path.parent / str(entries["manif_file"])).read_text(encoding="utf-8")
        return {name: int(bits, 16) for name, bits in json.loads(text).items()} if text else {}
    except (OSError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: the manifest of the Cryptomatte {entries['name']} cannot be read ({error})") from None

"""Textures on the graphics device: all texels of a scene's textures, with their coarser levels, in one long array."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float16, UInt32

from mrbokeh.scene.material import Texture
from mrbokeh.scene.packed_scene import PackedTextures, packed_textures
from mrbokeh.scene.wgpu.device import Gpu

_ROW = 2048
"""TEXEL_ROW of geometry.wgsl: the long array is a picture of that width in layers, as buffers are too small for it."""
_MOST_TEXELS = 1 << 26
"""512 MB; beyond it the largest textures lose their finest level."""
_ROW_OF_TABLE = 16


@dataclass(frozen=True, eq=False)
class TexelPool:
    """Textures that a scene uses. textures keeps them alive, for they are known by identity."""

    textures: tuple[Texture, ...]
    table: Any
    texels: Any


def texel_pool(gpu: Gpu, textures: Sequence[Texture]) -> TexelPool:
    """Upload textures as half floats, the levels of each one after the other."""
    table = np.zeros((max(len(textures), 1), _ROW_OF_TABLE), np.uint32)
    parts, start = [], 0
    skips = _skipped_levels(textures)
    for row, texture, skip in zip(table, textures, skips, strict=False):
        levels = packed_textures([texture])
        first = int(levels.level_start[skip])
        row[:] = _described(levels, skip, start)
        parts.append(levels.texels[first:].astype(np.float16))
        start += len(parts[-1])
    texels = np.concatenate(parts) if parts else np.zeros((1, 4), np.float16)
    return TexelPool(tuple(textures), gpu.buffer(table), _uploaded(gpu, texels))


def _described(levels: PackedTextures, skip: int, start: int) -> UInt32[np.ndarray, "16"]:
    """A row of the table: struct Texture of geometry.wgsl."""
    height, width = levels.level_size[skip]
    row = np.zeros(_ROW_OF_TABLE, np.uint32)
    row[:7] = start, width, height, len(levels.level_size) - skip, *levels.wrap[0], levels.uv_set[0]
    maps = np.zeros((2, 4), np.float32)
    maps[:, :3] = levels.texture_from_uv[0]
    row[8:] = maps.ravel().view(np.uint32)
    return row


def _skipped_levels(textures: Sequence[Texture]) -> list[int]:
    """How many fine levels of each texture to leave out so that all fit."""
    skips = [0] * len(textures)
    sizes = [texture.texels.shape[0] * texture.texels.shape[1] * 4 / 3 for texture in textures]
    while sum(size / 4**skip for size, skip in zip(sizes, skips, strict=True)) > _MOST_TEXELS:
        largest = max(range(len(textures)), key=lambda index: sizes[index] / 4 ** skips[index])
        skips[largest] += 1
    return skips


def _uploaded(gpu: Gpu, texels: Float16[np.ndarray, "texels 4"]) -> Any:
    rows = -(-len(texels) // _ROW)
    height = min(rows, _ROW)
    layers = -(-rows // height)
    texture = gpu.texture((_ROW, height, layers), "rgba16float", usage="TEXTURE_BINDING|COPY_DST")
    for layer in range(layers):
        part = texels[layer * height * _ROW : (layer + 1) * height * _ROW]
        part_rows = -(-len(part) // _ROW)
        padded = np.zeros((part_rows * _ROW, 4), np.float16)
        padded[: len(part)] = part
        gpu.device.queue.write_texture(
            {"texture": texture, "origin": (0, 0, layer)},
            padded,
            {"bytes_per_row": _ROW * 8, "rows_per_image": part_rows},
            (_ROW, part_rows, 1),
        )
    return texture.create_view(dimension="2d-array")

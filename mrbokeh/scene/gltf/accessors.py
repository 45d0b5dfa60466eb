"""The raw side of a glTF file: buffers, accessors and pictures as arrays (glTF 2.0 specification, section 3.6)."""

import base64
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import cv2
import numpy as np
import pygltflib
from jaxtyping import Float32, Shaped

from mrbokeh.system.errors import InputError

_COMPONENTS = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_READABLE_EXTENSIONS = {
    "KHR_lights_punctual",
    "KHR_materials_emissive_strength",
    "KHR_materials_ior",
    "KHR_materials_specular",
    "KHR_materials_unlit",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
}


@dataclass(frozen=True, eq=False)
class GltfFile:
    """A parsed .glb or .gltf with its buffers in memory."""

    path: Path
    gltf: pygltflib.GLTF2
    buffers: tuple[bytes, ...]

    def accessor(self, index: int) -> Shaped[np.ndarray, "count width"]:
        """The accessor's numbers as stored, (count, components)."""
        accessor = self.gltf.accessors[index]
        dtype, width = np.dtype(_COMPONENTS[accessor.componentType]), _WIDTHS[accessor.type]
        if accessor.bufferView is None:
            values = np.zeros((accessor.count, width), dtype)
        else:
            values = self._view(accessor.bufferView, accessor.byteOffset or 0, accessor.count, width, dtype)
        return values if accessor.sparse is None else self._with_sparse(values, accessor.sparse)

    def floats(self, index: int) -> Float32[np.ndarray, "count width"]:
        """The accessor's numbers with normalised integers brought to [0, 1] or [-1, 1]."""
        values = self.accessor(index)
        if not self.gltf.accessors[index].normalized or values.dtype.kind == "f":
            return values.astype(np.float32)
        return np.maximum(values.astype(np.float32) / np.iinfo(values.dtype).max, -1.0).astype(np.float32)

    def picture(self, index: int) -> Float32[np.ndarray, "height width channels"]:
        """An image's numbers in [0, 1] as stored, RGB or RGBA."""
        image = self.gltf.images[index]
        if image.bufferView is not None:
            view = self.gltf.bufferViews[image.bufferView]
            start = view.byteOffset or 0
            encoded = self.buffers[view.buffer][start : start + view.byteLength]
        else:
            encoded = _read_uri(image.uri, self.path)
        pixels = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_UNCHANGED)
        if pixels is None:
            raise InputError(f"{self.path}: image {index} ({image.mimeType}) cannot be decoded: export it as PNG or JPEG")
        if pixels.ndim == 2:
            pixels = np.repeat(pixels[..., None], 3, axis=2)
        order = cv2.COLOR_BGRA2RGBA if pixels.shape[2] == 4 else cv2.COLOR_BGR2RGB
        largest = 255.0 if pixels.dtype == np.uint8 else 65535.0
        return np.asarray(cv2.cvtColor(pixels, order), np.float32) / np.float32(largest)

    def _view(self, index: int, offset: int, count: int, width: int, dtype: np.dtype[Any]) -> Shaped[np.ndarray, "count width"]:
        view = self.gltf.bufferViews[index]
        stride = view.byteStride or width * dtype.itemsize
        start = (view.byteOffset or 0) + offset
        if start + (count - 1) * stride + width * dtype.itemsize > len(self.buffers[view.buffer]):
            raise InputError(f"{self.path}: a buffer view reaches past the end of its buffer: the file is cut short or damaged")
        strided = np.ndarray((count, width), dtype, self.buffers[view.buffer], start, (stride, dtype.itemsize))
        return np.array(strided)

    def _with_sparse(self, values: Shaped[np.ndarray, "count width"], sparse: pygltflib.Sparse) -> Shaped[np.ndarray, "count width"]:
        where, what = sparse.indices, sparse.values
        index_dtype = np.dtype(_COMPONENTS[where.componentType])
        indices = self._view(where.bufferView, where.byteOffset or 0, sparse.count, 1, index_dtype)
        values[indices[:, 0]] = self._view(what.bufferView, what.byteOffset or 0, sparse.count, values.shape[1], values.dtype)
        return values


def open_gltf(path: str | Path) -> GltfFile:
    """Read a .glb or .gltf and its buffers; refuses what needs an extension that is not read here."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"expected a .glb or .gltf file, found none at {path}: check the path")
    try:
        gltf = pygltflib.GLTF2().load(str(path))
        if gltf is None:
            raise ValueError("neither .glb nor .gltf")
        blob = gltf.binary_blob()
        buffers = tuple(blob if buffer.uri is None else _read_uri(buffer.uri, path) for buffer in gltf.buffers)
    except InputError:
        raise
    except Exception as reason:  # pygltflib lets through whatever struct, json and dataclasses_json raise
        raise InputError(f"{path} is not a readable glTF 2.0 file ({reason}): export it again as .glb") from reason
    missing = sorted(set(gltf.extensionsRequired or ()) - _READABLE_EXTENSIONS)
    if missing:
        raise InputError(f"{path} requires {', '.join(missing)}, which is not supported: export it without compression or extensions")
    return GltfFile(path, gltf, buffers)


def _read_uri(uri: str, beside: Path) -> bytes:
    if uri.startswith("data:"):
        return base64.b64decode(uri.split(",", 1)[1])
    target = beside.parent / unquote(uri)
    if not target.is_file():
        raise InputError(f"{beside} refers to {uri}, which is not beside it: keep the files together or export as .glb")
    return target.read_bytes()

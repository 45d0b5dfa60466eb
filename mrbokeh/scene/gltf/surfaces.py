"""Materials and primitives of a glTF file, and its raw side, buffers, accessors and pictures as arrays (glTF 2.0 specification, 3.6).

Materials: textures decoded to linear light. Primitives: vertex attributes with morph targets, linear blend skinning, flat normals.
"""

import base64
import json
import struct
from dataclasses import dataclass, field
from math import cos, sin
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int32, Shaped

from mrbokeh.images.color import srgb_to_linear
from mrbokeh.scene.material import Material, Texture, Wrap
from mrbokeh.scene.mesh import Mesh, face_normals, unit
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


_LISTS = (
    *("accessors", "animations", "buffers", "bufferViews", "images", "materials", "meshes", "nodes"),
    *("samplers", "scenes", "skins", "textures"),
)
_MAGIC, _JSON_CHUNK, _BINARY_CHUNK = b"glTF", b"JSON", b"BIN\0"


class _Part(dict[str, Any]):
    """An object of the file's JSON, whose properties are attributes; what is absent is None."""

    def __getattr__(self, name: str) -> Any:
        return self.get(name)


class Numbered(list[Any]):
    """A list of the file. Its numbers begin with 0: -1 is a mistake, not the last."""

    def __getitem__(self, number: Any) -> Any:
        if isinstance(number, int) and number < 0:
            raise IndexError(f"there is no number {number}")
        return super().__getitem__(number)


@dataclass(frozen=True, eq=False)
class GltfFile:
    """A parsed .glb or .gltf with its buffers in memory. gltf: its JSON; all lists of the specification are there, if only empty."""

    path: Path
    gltf: Any
    buffers: Numbered

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
        pixels = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_UNCHANGED) if encoded else None
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

    def _with_sparse(self, values: Shaped[np.ndarray, "count width"], sparse: Any) -> Shaped[np.ndarray, "count width"]:
        where, what = sparse["indices"], sparse["values"]
        index_dtype = np.dtype(_COMPONENTS[where.componentType])
        indices = self._view(where.bufferView, where.byteOffset or 0, sparse.count, 1, index_dtype)
        values[indices[:, 0]] = self._view(what.bufferView, what.byteOffset or 0, sparse.count, values.shape[1], values.dtype)
        return values


def _numbered(part: dict[str, Any]) -> _Part:
    return _Part({name: Numbered(value) if isinstance(value, list) else value for name, value in part.items()})


def open_gltf(path: str | Path) -> GltfFile:
    """Read a .glb or .gltf and its buffers; refuses what needs an extension that is not read here."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"expected a .glb or .gltf file, found none at {path}: check the path")
    try:
        text, blob = _chunks(path.read_bytes())
        try:
            gltf = json.loads(text, object_hook=_numbered)
        except UnicodeDecodeError:
            raise ValueError("neither .glb nor the JSON of a .gltf") from None
        for name in _LISTS:
            if not all(isinstance(each, _Part) for each in gltf.setdefault(name, Numbered())):
                raise ValueError(f"its {name} are no list of objects")
        buffers = Numbered(blob if buffer.uri is None else _read_uri(buffer.uri, path) for buffer in gltf.buffers)
        missing = sorted(set(gltf.extensionsRequired or ()) - _READABLE_EXTENSIONS)
    except InputError:
        raise
    except (ValueError, TypeError, AttributeError, RecursionError, struct.error) as reason:
        raise InputError(f"{path} is not a readable glTF 2.0 file ({reason}): export it again as .glb") from reason
    if missing:
        raise InputError(f"{path} requires {', '.join(missing)}, which is not supported: export it without compression or extensions")
    return GltfFile(path, gltf, buffers)


def _chunks(stored: bytes) -> tuple[bytes, bytes]:
    """Return the JSON of a file and the buffer that a .glb holds beside it, else nothing (glTF 2.0, 4.4)."""
    if stored[:4] != _MAGIC:
        return stored, b""
    chunks: dict[bytes, bytes] = {}
    start = 12
    while start + 8 <= len(stored):
        length, kind = struct.unpack_from("<I4s", stored, start)
        chunks.setdefault(kind, stored[start + 8 : start + 8 + length])
        start += 8 + length
    if _JSON_CHUNK not in chunks:
        raise ValueError("a .glb without JSON")
    return chunks[_JSON_CHUNK], chunks.get(_BINARY_CHUNK, b"")


def _read_uri(uri: str, beside: Path) -> bytes:
    if uri.startswith("data:"):
        return base64.b64decode(uri.split(",", 1)[1])
    target = beside.parent / unquote(uri)
    if not target.is_file():
        raise InputError(f"{beside} refers to {uri}, which is not beside it: keep the files together or export as .glb")
    return target.read_bytes()


_WRAPS: dict[int, Wrap] = {10497: "repeat", 33071: "clamp", 33648: "mirror"}


def materials_of(file: GltfFile) -> tuple[Material, ...]:
    """Return the materials of a file in their order."""
    textures = _Textures(file)
    return tuple(_material(textures, material) for material in file.gltf.materials)


@dataclass(frozen=True, eq=False)
class _Textures:
    """Reads textures, decoding a picture once however many materials use it."""

    file: GltfFile
    decoded: dict[tuple[int, bool], Float32[np.ndarray, "height width channels"]] = field(default_factory=dict)

    def read(self, reference: Any, is_srgb: bool) -> Texture | None:
        """The texture of a TextureInfo (or of an extension that is like one)."""
        if reference is None:
            return None
        gltf = self.file.gltf
        texture = gltf.textures[reference.index]
        if texture.source is None:  # only an extension's format that is optional, so the surface goes without
            return None
        wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
        if texture.sampler is not None:
            sampler = gltf.samplers[texture.sampler]
            wrap = _WRAPS[sampler.wrapS or 10497], _WRAPS[sampler.wrapT or 10497]
        transform = (reference.extensions or {}).get("KHR_texture_transform", {})
        uv_set = transform.get("texCoord", reference.texCoord or 0)
        return Texture(self._texels(texture.source, is_srgb), wrap, uv_set, _texture_from_uv(transform))

    def _texels(self, image: int, is_srgb: bool) -> Float32[np.ndarray, "height width channels"]:
        if (image, is_srgb) not in self.decoded:
            texels = self.file.picture(image)
            if is_srgb:
                texels[..., :3] = srgb_to_linear(texels[..., :3])
            self.decoded[image, is_srgb] = texels
        return self.decoded[image, is_srgb]


def _texture_from_uv(transform: dict[str, Any]) -> Float[np.ndarray, "2 3"]:
    """KHR_texture_transform: translation * rotation * scale."""
    (offset_u, offset_v), (scale_u, scale_v) = transform.get("offset", (0, 0)), transform.get("scale", (1, 1))
    angle = transform.get("rotation", 0.0)
    return np.array(
        [[cos(angle) * scale_u, sin(angle) * scale_v, offset_u], [-sin(angle) * scale_u, cos(angle) * scale_v, offset_v]], np.float64
    )


def _material(textures: _Textures, material: Any) -> Material:
    pbr = material.pbrMetallicRoughness
    extensions = material.extensions or {}
    strength = extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
    specular = extensions.get("KHR_materials_specular", {})
    red, green, blue = material.emissiveFactor or (0.0, 0.0, 0.0)
    normal, occlusion = material.normalTexture, material.occlusionTexture
    return Material(
        name=material.name or "",
        base_color=_floats4(pbr.baseColorFactor) if pbr else (1.0, 1.0, 1.0, 1.0),
        base_color_texture=textures.read(pbr.baseColorTexture, is_srgb=True) if pbr else None,
        metallic=float(_given(pbr.metallicFactor, 1.0)) if pbr else 1.0,
        roughness=float(_given(pbr.roughnessFactor, 1.0)) if pbr else 1.0,
        metallic_roughness_texture=textures.read(pbr.metallicRoughnessTexture, is_srgb=False) if pbr else None,
        emissive=(float(red * strength), float(green * strength), float(blue * strength)),
        emissive_texture=textures.read(material.emissiveTexture, is_srgb=True),
        normal_texture=textures.read(normal, is_srgb=False),
        normal_scale=float(_given(normal.scale, 1.0)) if normal else 1.0,
        occlusion_texture=textures.read(occlusion, is_srgb=False),
        occlusion_strength=float(_given(occlusion.strength, 1.0)) if occlusion else 1.0,
        alpha_mode=material.alphaMode or "OPAQUE",
        alpha_cutoff=float(_given(material.alphaCutoff, 0.5)),
        double_sided=bool(material.doubleSided),
        unlit="KHR_materials_unlit" in extensions,
        ior=float(extensions.get("KHR_materials_ior", {}).get("ior", 1.5)),
        specular=float(specular.get("specularFactor", 1.0)),
        specular_color=_floats3(specular.get("specularColorFactor", (1, 1, 1))),
    )


def _given(value: float | None, default: float) -> float:
    return default if value is None else value


def _floats3(values: Any) -> tuple[float, float, float]:
    first, second, third = (float(value) for value in values)
    return first, second, third


def _floats4(values: Any) -> tuple[float, float, float, float]:
    first, second, third, fourth = (float(value) for value in (values if values is not None else (1, 1, 1, 1)))
    return first, second, third, fourth


@dataclass(frozen=True, eq=False)
class Primitive:
    """A primitive's arrays before its pose; normals are None for the flat shading that glTF then asks for."""

    positions: Float[np.ndarray, "vertices 3"]
    triangles: Int32[np.ndarray, "triangles 3"]
    uvs: Float32[np.ndarray, "sets vertices 2"]
    normals: Float[np.ndarray, "vertices 3"] | None
    tangents: Float[np.ndarray, "vertices 4"] | None
    colors: Float32[np.ndarray, "vertices 4"] | None
    joints: Int32[np.ndarray, "vertices influences"] | None
    weights: Float[np.ndarray, "vertices influences"] | None

    def skinned(self, world_from_joints: Float[np.ndarray, "joints 4 4"]) -> "Primitive":
        """Linear blend skinning (section 3.7.3)."""
        if self.weights is None or self.joints is None:
            return self
        weights = self.weights / np.maximum(self.weights.sum(1, keepdims=True), 1e-12)
        world_from_vertex = np.einsum("vi,viab->vab", weights, world_from_joints[self.joints])
        linear = world_from_vertex[:, :3, :3]
        positions = np.einsum("vab,vb->va", linear, self.positions) + world_from_vertex[:, :3, 3]
        normals, tangents = self.normals, self.tangents
        if normals is not None:
            # The cofactors are the inverse transpose times the determinant: safe where a joint is scaled to nothing.
            rows = [np.cross(linear[:, a], linear[:, b]) for a, b in ((1, 2), (2, 0), (0, 1))]
            normals = unit(np.einsum("vab,vb->va", np.stack(rows, axis=1), normals))
        if tangents is not None:
            tangents = np.concatenate([unit(np.einsum("vab,vb->va", linear, tangents[:, :3])), tangents[:, 3:]], axis=1)
        return Primitive(
            positions=positions,
            triangles=self.triangles,
            uvs=self.uvs,
            normals=normals,
            tangents=tangents,
            colors=self.colors,
            joints=self.joints,
            weights=self.weights,
        )

    def mesh(self, material: Material, name: str) -> Mesh:
        """Convert to a Mesh; without normals each triangle gets its own vertices and is flat."""
        if self.normals is not None:
            tangents = None if self.tangents is None else self.tangents.astype(np.float32)
            normals = self.normals.astype(np.float32)
            return Mesh(
                positions_m=self.positions,
                triangles=self.triangles,
                normals=normals,
                uvs=self.uvs,
                material=material,
                tangents=tangents,
                colors=self.colors,
                name=name,
            )
        corner = self.triangles.ravel()
        positions = self.positions[corner]
        normals = np.repeat(face_normals(positions.reshape(-1, 3, 3)), 3, axis=0).astype(np.float32)
        colors = None if self.colors is None else self.colors[corner]
        triangles = np.arange(len(corner), dtype=np.int32).reshape(-1, 3)
        return Mesh(
            positions_m=positions,
            triangles=triangles,
            normals=normals,
            uvs=np.ascontiguousarray(self.uvs[:, corner]),
            material=material,
            tangents=None,
            colors=colors,
            name=name,
        )


def read_primitive(file: GltfFile, primitive: Any, morph_weights: Float[np.ndarray, " targets"]) -> Primitive:
    """A primitive's arrays in its node's space, morph targets mixed in."""
    attributes = primitive.attributes

    def read(name: str) -> Float32[np.ndarray, "vertices width"] | None:
        index = attributes.get(name)
        return None if index is None else file.floats(index)

    def morphed(name: str) -> Float[np.ndarray, "vertices width"] | None:
        values = read(name)
        for weight, target in zip(morph_weights, primitive.targets or (), strict=False):
            if values is not None and weight and target.get(name) is not None:
                values[:, :3] += weight * file.floats(target[name])[:, :3]
        return None if values is None else values.astype(np.float64)

    positions, normals = morphed("POSITION"), morphed("NORMAL")
    if positions is None:
        raise InputError(f"{file.path}: a mesh has no positions: export it again without mesh compression")
    uvs = [uv for uv in (read("TEXCOORD_0"), read("TEXCOORD_1")) if uv is not None]
    colors = read("COLOR_0")
    if colors is not None and colors.shape[1] == 3:
        colors = np.concatenate([colors, np.ones_like(colors[:, :1])], axis=1)
    joints = [file.accessor(index) for index in (attributes.JOINTS_0, attributes.JOINTS_1) if index is not None]
    weights = [values for values in (read("WEIGHTS_0"), read("WEIGHTS_1")) if values is not None]
    corners = np.arange(len(positions)) if primitive.indices is None else file.accessor(primitive.indices)[:, 0]
    return Primitive(
        positions=positions,
        triangles=_triangles(corners.astype(np.int32), 4 if primitive.mode is None else primitive.mode),
        uvs=np.stack(uvs) if uvs else np.zeros((0, len(positions), 2), np.float32),
        normals=None if normals is None else unit(normals),
        tangents=morphed("TANGENT"),
        colors=colors,
        joints=np.concatenate(joints, axis=1).astype(np.int32) if joints else None,
        weights=np.concatenate(weights, axis=1).astype(np.float64) if weights else None,
    )


def _triangles(corners: Int32[np.ndarray, " corners"], mode: int) -> Int32[np.ndarray, "triangles 3"]:
    """Triangle lists, strips and fans (section 3.7.2.1)."""
    if mode == 4:
        return corners[: len(corners) // 3 * 3].reshape(-1, 3)
    first = np.arange(len(corners) - 2)
    if mode == 5:
        odd = first % 2
        return np.stack([corners[first], corners[first + 1 + odd], corners[first + 2 - odd]], axis=1)
    return np.stack([corners[first + 1], corners[first + 2], np.repeat(corners[:1], len(first))], axis=1)

"""glTF materials and textures to Material and Texture, colours decoded to linear light."""

from dataclasses import dataclass, field
from math import cos, sin
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.images.color import srgb_to_linear
from mrbokeh.scene.gltf.accessors import GltfFile
from mrbokeh.scene.material import Material, Texture, Wrap

_WRAPS: dict[int, Wrap] = {10497: "repeat", 33071: "clamp", 33648: "mirror"}


def materials_of(file: GltfFile) -> tuple[Material, ...]:
    """All materials of a file in their order."""
    textures = _Textures(file)
    return tuple(_material(textures, material) for material in file.gltf.materials)


@dataclass(frozen=True, eq=False)
class _Textures:
    """Reads textures, decoding a picture once however many materials use it."""

    file: GltfFile
    decoded: dict[tuple[int, bool], Float32[np.ndarray, "height width channels"]] = field(default_factory=dict)

    def read(self, reference: Any, is_srgb: bool) -> Texture | None:
        """The texture of a TextureInfo (an object of pygltflib or the dictionary of an extension)."""
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

"""Texture and Material: the metallic-roughness surface description of glTF 2.0, in linear light."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.system.errors import InputError

Wrap = Literal["repeat", "clamp", "mirror"]
AlphaMode = Literal["OPAQUE", "MASK", "BLEND"]
Triple = tuple[float | int, float | int, float | int]
"""Three numbers: a colour or a vector."""


def _identity_uv() -> Float[np.ndarray, "2 3"]:
    return np.eye(2, 3)


@dataclass(frozen=True, eq=False)
class Texture:
    """A picture laid on a surface, read bilinearly (and from a coarser level where it would alias).

    texels: (H, W, C) float32, C is 3 or 4; colour is linear Rec.709, data (normals, roughness) is as stored; row 0 is v = 0.
    wrap: what happens outside [0, 1] along u and along v.
    uv_set: which of the mesh's texture coordinates it uses, 0 or 1.
    texture_from_uv: (2, 3) affine map of the mesh's coordinates (KHR_texture_transform).
    """

    texels: Float32[np.ndarray, "height width channels"]
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
    uv_set: int = 0
    texture_from_uv: Float[np.ndarray, "2 3"] = field(default_factory=_identity_uv)

    def __post_init__(self) -> None:
        if self.texels.shape[2] not in (3, 4) or self.uv_set not in (0, 1):
            raise InputError(
                f"a texture needs 3 or 4 channels and texture coordinates 0 or 1, but came with {self.texels.shape[2]} channels "
                f"and coordinates {self.uv_set}: repeat grey over three channels, keep at most two sets of coordinates"
            )


@dataclass(frozen=True, eq=False)
class Material:
    """Reflection and emission of a surface (glTF 2.0 specification, section 3.9 and appendix B).

    base_color: (r, g, b, a) linear factor in [0, 1]; the texture multiplies it.
    metallic, roughness: factors in [0, 1]; the texture's blue channel multiplies metallic, its green channel roughness.
    emissive: (r, g, b) linear radiance, already times KHR_materials_emissive_strength, so it may exceed 1.
    normal_texture: tangent-space normals stored as (n + 1) / 2; normal_scale multiplies x and y.
    occlusion_texture: red channel, dims the light of the environment only.
    alpha_mode: OPAQUE ignores alpha, MASK cuts at alpha_cutoff, BLEND covers by alpha.
    double_sided: a single-sided surface is invisible from behind.
    unlit: the base colour is shown as it is (KHR_materials_unlit).
    ior, specular, specular_color: strength of a non-metal's reflection (KHR_materials_ior, KHR_materials_specular);
        specular = 0 is a pure Lambertian surface.
    """

    name: str = ""
    base_color: tuple[float | int, float | int, float | int, float | int] = (1.0, 1.0, 1.0, 1.0)
    base_color_texture: Texture | None = None
    metallic: float = 1.0
    roughness: float = 1.0
    metallic_roughness_texture: Texture | None = None
    emissive: Triple = (0.0, 0.0, 0.0)
    emissive_texture: Texture | None = None
    normal_texture: Texture | None = None
    normal_scale: float = 1.0
    occlusion_texture: Texture | None = None
    occlusion_strength: float = 1.0
    alpha_mode: AlphaMode = "OPAQUE"
    alpha_cutoff: float = 0.5
    double_sided: bool = False
    unlit: bool = False
    ior: float = 1.5
    specular: float = 1.0
    specular_color: Triple = (1.0, 1.0, 1.0)

    @property
    def dielectric_f0(self) -> Triple:
        """Reflectance at normal incidence of the non-metal part (Fresnel; KHR_materials_specular, "Implementation")."""
        # KHR_materials_ior: 0 stands for an infinite index.
        at_normal = 1.0 if self.ior == 0.0 else ((self.ior - 1.0) / (self.ior + 1.0)) ** 2
        red, green, blue = (min(at_normal * tint, 1.0) * self.specular for tint in self.specular_color)
        return red, green, blue


def matte(red: float | int, green: float | int, blue: float | int) -> Material:
    """A Lambertian surface of the given linear albedo, without any gloss."""
    return Material(base_color=(red, green, blue, 1.0), metallic=0.0, roughness=1.0, specular=0.0)


def emitter(red: float | int, green: float | int, blue: float | int) -> Material:
    """A black surface that shines with the given linear radiance."""
    return Material(base_color=(0.0, 0.0, 0.0, 1.0), metallic=0.0, specular=0.0, emissive=(red, green, blue), double_sided=True)

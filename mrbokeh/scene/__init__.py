"""Virtual objects: GLB scenes with physically based materials, and backends that turn scene and camera into a Layer.

    from mrbokeh.scene import Environment, sun, world_from_scene_placing
    from mrbokeh.scene.gltf.gltf_loader import load_glb
    from mrbokeh.scene.embree.embree_raycaster import EmbreeRaycaster

    scene = load_glb("cake.glb")
    scene = scene.transformed(world_from_scene_placing(scene, stands_at_m=(0.0, 0.3, 2.0), height_m=0.2))
    scene = scene.with_environment(Environment(panorama)).with_lights(sun((0.3, 1.0, 0.5), irradiance=3.0))
    layer = EmbreeRaycaster().render(scene, camera)

    virtual_scene   Scene; WORLD_FROM_GLTF (y up, z back -> y down, z forward); world_from_scene_placing; SceneRenderer; shadow_layer
    mesh, material  Mesh, Material, Texture, matte, emitter: glTF 2.0 metallic-roughness in linear light; sphere, rectangle, shadow_catcher
    light           Light (KHR_lights_punctual), sun; Environment (linear HDR panorama), split_sun, neutral_environment
    light_change    light_change: shadow and reflection of objects on a real surface
    gltf/           load_glb(path, time_s, animation) -> Scene; GltfAsset for many moments of one file
    embree/         EmbreeRaycaster, the backend for any CPU (needs embreex and numba)
    wgpu/           WgpuRasterizer, the backend for graphics cards (needs wgpu)
    mitsuba/        MitsubaTracer, path tracing (needs mitsuba)
    choose          scene_renderer("auto"): the card if there is one, else the ray caster

Only light modules are imported here; the loader and the backends are imported by their own names.
"""

from mrbokeh.scene.light import NEUTRAL_RADIANCE, Environment, Light, neutral_environment, split_sun, sun
from mrbokeh.scene.material import Material, Texture, emitter, matte
from mrbokeh.scene.mesh import Mesh, rectangle, shadow_catcher, sphere
from mrbokeh.scene.virtual_scene import WORLD_FROM_GLTF, Scene, SceneRenderer, world_from_scene_placing

__all__ = [
    "NEUTRAL_RADIANCE",
    "WORLD_FROM_GLTF",
    "Environment",
    "Light",
    "Material",
    "Mesh",
    "Scene",
    "SceneRenderer",
    "Texture",
    "emitter",
    "matte",
    "neutral_environment",
    "rectangle",
    "shadow_catcher",
    "sphere",
    "split_sun",
    "sun",
    "world_from_scene_placing",
]

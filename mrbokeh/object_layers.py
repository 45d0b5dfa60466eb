"""A virtual object stood into a plate: its layer, and its shadow as a layer of its own."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mrbokeh.camera import Camera
from mrbokeh.image_io import read_image
from mrbokeh.layer import Layer
from mrbokeh.scene import Environment, Scene, shadow_catcher, split_sun, sun, world_from_scene_placing
from mrbokeh.scene.shadow_layer import shadow_layer
from mrbokeh.staging.assets import SUN_DIRECTION


@dataclass(frozen=True)
class Staging:
    """Where an object stands and what lights it.

    stands_at_m: in camera axes (x right, y down, z forward). tilt_rad: how far the camera looks down.
    height_m: scaled to it; None keeps the size of the file. turn_rad: about the vertical.
    environment: a linear panorama, whose sun is split off to cast a shadow; None is even grey light and a sun.
    exposure: factor on all light. shadow: how dark the shadow is, 0 to 1.
    """

    stands_at_m: tuple[float, float, float]
    height_m: float | None = None
    turn_rad: float = 0.0
    tilt_rad: float = 0.0
    environment: Path | None = None
    exposure: float = 1.0
    shadow: float = 0.0
    time_s: float = 0.0


def object_layers(glb: Path, staging: Staging, camera: Camera) -> list[Layer]:
    """Layers of the object and, behind it, of its shadow; all in focus, front first."""
    from mrbokeh.scene.embree_raycaster import EmbreeRaycaster
    from mrbokeh.scene.gltf_loader import load_glb

    upright = _upright(camera, staging.tilt_rad)
    foot_m = upright.world_from_camera @ [*staging.stands_at_m, 1.0]
    scene = load_glb(glb, staging.time_s).without_lights()
    scene = _lit(scene, staging)
    scene = scene.transformed(world_from_scene_placing(scene, tuple(foot_m[:3].tolist()), staging.height_m, staging.turn_rad))
    raycaster = EmbreeRaycaster()
    layers = [raycaster.render(scene, upright)]
    if staging.shadow > 0:
        low, high = scene.bounds_m
        catcher = shadow_catcher(float(foot_m[1]), (float(foot_m[0]), float(foot_m[2])), 4.0 * float(np.max(high - low)))
        layers.append(shadow_layer(raycaster, scene, upright, catcher, staging.shadow))
    return layers


def _upright(camera: Camera, tilt_rad: float) -> Camera:
    """The camera in a world whose vertical is true: turned about its x axis by the tilt."""
    cosine, sine = np.cos(tilt_rad), np.sin(tilt_rad)
    camera_from_world = np.eye(4)
    camera_from_world[1:3, 1:3] = [[cosine, -sine], [sine, cosine]]
    return Camera(camera.width_px, camera.height_px, camera.focal_px, camera.principal_px, camera_from_world)


def _lit(scene: Scene, staging: Staging) -> Scene:
    if staging.environment is None:
        grey = Environment(np.full((8, 16, 3), 0.45 * staging.exposure, np.float32))
        return scene.with_environment(grey).with_lights(sun(SUN_DIRECTION, 1.6 * staging.exposure))
    sky, light = split_sun(Environment(read_image(staging.environment)))
    return scene.with_environment(sky.brighter(staging.exposure)).with_lights(light.brighter(staging.exposure))

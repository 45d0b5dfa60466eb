"""The shadow on a catcher while scene and camera move."""

from dataclasses import dataclass, replace

from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import Camera
from mrbokeh.scene import Mesh, Scene, SceneRenderer
from mrbokeh.scene.moving_layers.accumulation import accumulated
from mrbokeh.scene.moving_layers.filmed_scene import FilmedScene
from mrbokeh.scene.moving_layers.moving_layer import MotionQuality, followed
from mrbokeh.scene.shadow_layer import shadow_layer

_SAMPLES = 16


@dataclass(frozen=True)
class ShadowCatcher:
    """A level catcher, and how dark its shadow is where no light arrives (0 to 1)."""

    mesh: Mesh
    strength: float = 1.0


def moving_shadow_layer(
    renderer: SceneRenderer, filmed: FilmedScene, time_s: float, catcher: ShadowCatcher, samples: int = _SAMPLES
) -> Layer:
    """The layer of a scene's shadow in the frame of a time.

    Where only the camera moves, the shadow lies still on the ground: its layer has motion channels, like any. A shadow that
    moves itself changes its shape without surfaces that could be followed: `samples` shadows are averaged.
    """

    def rendering(scene: Scene, camera: Camera) -> Layer:
        return shadow_layer(renderer, scene, camera, catcher.mesh, catcher.strength)

    shutter, middle_s = filmed.shutter, filmed.shutter.middle_s(time_s)
    span_s = shutter.exposure_s + abs(shutter.readout_s)
    if span_s > 0.0 and not filmed.is_scene_still((middle_s - 0.5 * span_s, middle_s, middle_s + 0.5 * span_s)):
        return accumulated(rendering, filmed, time_s, samples)
    # On the ground, whatever is seen keeps its place: nothing has to be followed but the camera.
    scene = filmed.scene_at(middle_s)
    return followed(rendering, replace(filmed, scene_at=lambda _: scene), time_s, MotionQuality(most_samples=samples))

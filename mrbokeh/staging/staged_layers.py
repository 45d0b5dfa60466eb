"""A staged scene as layers, all in focus: its objects, and behind them their shadow."""

from mrbokeh.camera import Camera
from mrbokeh.layer import Layer
from mrbokeh.scene import SceneRenderer
from mrbokeh.scene.shadow_layer import shadow_layer
from mrbokeh.staging.staged_scene import StagedScene
from mrbokeh.staging.upright import upright_camera


def staged_layers(staged: StagedScene, camera: Camera, backend: SceneRenderer, time_s: float = 0.0) -> list[Layer]:
    """Layers at a moment, front first; camera: with its pose in the world of the scene's description."""
    upright, scene = upright_camera(camera, staged.description.up), staged.scene_at(time_s)
    layers = [backend.render(scene, upright)]
    if staged.catcher is not None and staged.description.shadow is not None:
        layers.append(shadow_layer(backend, scene, upright, staged.catcher, staged.description.shadow.strength))
    return layers

"""Motion blur of virtual objects from their own and the camera's motion, with shutter angle and rolling shutter.

from mrbokeh.scene.moving_layers import FilmedScene, ShutterTiming, moving_layer, moving_shadow_layer

filmed = FilmedScene(staged.scene_at, track.camera_at, ShutterTiming(frame_rate=24.0, angle_deg=180.0, readout_s=0.02))
layer = moving_layer(renderer, filmed, time_s)

filmed_scene    FilmedScene: scene and camera by time; ShutterTiming: when which row is exposed
moving_layer    Paths of the surfaces seen at every pixel while the shutter is open;
                one picture with motion channels, or an accumulation if paths are bent; shadows; rolling shutter
"""

from mrbokeh.scene.moving_layers.filmed_scene import FilmedScene, ShutterTiming
from mrbokeh.scene.moving_layers.moving_layer import accumulated, moving_layer, moving_shadow_layer

__all__ = ["FilmedScene", "ShutterTiming", "accumulated", "moving_layer", "moving_shadow_layer"]

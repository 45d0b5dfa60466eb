"""The protocol of everything that turns a virtual scene and a camera into a Layer."""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import Camera
from mrbokeh.scene.mesh import Mesh
from mrbokeh.scene.virtual_scene import Scene


@runtime_checkable
class SceneRenderer(Protocol):
    """Renders virtual objects with everything in focus; the lens blur comes afterwards.

    What every backend owes (tests/objects/test_scene_backends.py asks all of them):
    rgb is scene-linear, unclipped and premultiplied; emissive radiance L reads L.
    alpha is the covered share of the pixel's square. depth_m is exact at the pixel's centre, along the optical axis; at a pixel
    that is only partly covered it is the nearest covering surface where the centre sees nothing, never a mixture; inf where
    alpha is 0. The focal lengths and the principal point are any. Single-sided surfaces are invisible from behind.
    The environment lights the objects but is not drawn, and meshes with catches_shadow are not drawn either.
    """

    def render(self, scene: Scene, camera: Camera) -> Layer:
        """The scene as the camera sees it, without lens blur."""
        ...

    def render_shadow_mask(self, scene: Scene, camera: Camera, catcher: Mesh) -> Float32[np.ndarray, "height width"]:
        """(H, W): what share of the lights' irradiance on the catcher the scene's meshes let through; 1 is lit.

        It is 1 where the catcher is not in the picture, turned away from the lights, or there are no lights. The catcher
        is seen through the virtual objects, so that a soft edge of an object blends over the right value.
        """
        ...

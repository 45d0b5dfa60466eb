"""How virtual objects change the light on a real surface: their shadow, their reflection and the light that they send there.

Differential rendering (Debevec 1998, "Rendering Synthetic Objects into Real Scenes"), with the two directions of change apart: light
that objects take away is a share of what there was, so it multiplies the photograph; light that they send is added. So the
surface's texture comes from the photograph alone, and a rough guess of its material does.
"""

from mrbokeh.optics.camera import Camera
from mrbokeh.scene.base import SceneRenderer
from mrbokeh.scene.light_change.cast import cast_light_change
from mrbokeh.scene.light_change.pictures import LEAST_CHANGE, LightChange
from mrbokeh.scene.material import Material, matte
from mrbokeh.scene.mesh import Mesh
from mrbokeh.scene.mitsuba.mitsuba_tracer import MitsubaTracer
from mrbokeh.scene.virtual_scene import Scene

__all__ = ["GREY", "LEAST_CHANGE", "LightChange", "light_change"]

GREY = matte(0.5, 0.5, 0.5)


def light_change(
    renderer: SceneRenderer, scene: Scene, camera: Camera, catcher: Mesh, surface: Material = GREY, samples: int = 64
) -> LightChange:
    """What a scene's objects change on a real surface that the scene's lights and environment light.

    catcher: its shape (also one that catches shadows); surface: about what it is made of; only light that comes from the objects
    depends on its albedo. With a MitsubaTracer everything counts: shadows of lamps and of the environment, mirror images, colour
    that bleeds, emissive objects; its own number of samples is taken. With any other renderer the surface is matte, and only
    light that is taken away is counted: the renderer's shadow mask of the lamps, and what of the environment is hidden.
    """
    if isinstance(renderer, MitsubaTracer):
        from mrbokeh.scene.light_change.traced import traced_light_change

        return traced_light_change(renderer, scene, camera, catcher, surface)
    return cast_light_change(renderer, scene, camera, catcher, samples)

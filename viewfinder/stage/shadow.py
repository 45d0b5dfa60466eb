"""The shadow on the table as a layer of premultiplied black: the lens blurs it like anything that lies there, "over" darkens the plate."""

import numpy as np

from mrbokeh.camera import Camera
from mrbokeh.layer import Layer
from mrbokeh.scene import Mesh, Scene
from viewfinder.stage.backend import Backend
from viewfinder.stage.upright import table_dioptres


def shadow_layer(backend: Backend, scene: Scene, camera: Camera, catcher: Mesh, strength: float) -> Layer:
    """The scene's shadow on a level catcher. strength: the alpha where none of the lights arrives. The camera is upright."""
    alpha = (strength * (1.0 - backend.render_shadow_mask(scene, camera, catcher))).astype(np.float32)
    height_m = float(catcher.positions_m[0, 1])
    lifted = camera.camera_from_world.copy()
    lifted[:3, 3] += lifted[:3, 1] * height_m
    dioptres = table_dioptres(Camera(camera.width_px, camera.height_px, camera.focal_px, camera.principal_px, lifted))
    depth_m = np.full(alpha.shape, np.inf, np.float32)
    np.divide(1.0, dioptres, out=depth_m, where=(alpha > 0) & (dioptres > 0))
    return Layer(np.zeros((*alpha.shape, 3), np.float32), alpha, depth_m)

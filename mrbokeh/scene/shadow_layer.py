"""A shadow as a layer of premultiplied black: the lens blurs it like anything that lies there, "over" darkens the photograph."""

import numpy as np

from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import Camera, level_plane_dioptres
from mrbokeh.scene.base import SceneRenderer
from mrbokeh.scene.mesh import Mesh
from mrbokeh.scene.virtual_scene import Scene


def shadow_layer(renderer: SceneRenderer, scene: Scene, camera: Camera, catcher: Mesh, strength: float) -> Layer:
    """The scene's shadow on a level catcher. strength: the alpha where none of the lights arrives."""
    alpha = (strength * (1.0 - renderer.render_shadow_mask(scene, camera, catcher))).astype(np.float32)
    dioptres = level_plane_dioptres(camera, float(catcher.positions_m[0, 1]))
    depth_m = np.full(alpha.shape, np.inf, np.float32)
    np.divide(1.0, dioptres, out=depth_m, where=(alpha > 0) & (dioptres > 0))
    return Layer(np.zeros((*alpha.shape, 3), np.float32), alpha, depth_m)

"""A scene of one object that stands before a camera: what the options of a command say, as a SceneDescription."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from mrbokeh.optics.camera import Camera
from mrbokeh.scene.staging.scene_description import Lighting, PlacedObject, SceneDescription, ShadowPlane, Triple


@dataclass(frozen=True)
class OneObject:
    """Where an object stands and what lights it.

    stands_at_m: in camera axes (x right, y down, z forward). tilt_rad: how far the camera looks down.
    height_m: scaled to it; None keeps the size of the file. turn_rad: about the vertical, clockwise seen from above.
    shadow: how dark the shadow is, 0 to 1; shadow_size_m: side of the part of the ground that catches it.
    """

    glb: Path
    stands_at_m: Triple
    height_m: float | None = None
    turn_rad: float = 0.0
    tilt_rad: float = 0.0
    light: Lighting = field(default_factory=Lighting)
    shadow: float = 0.0
    shadow_size_m: float = 2.0

    def described(self) -> SceneDescription:
        """The scene in a world whose vertical is true and whose origin is the camera."""
        foot_m = _world_from_camera(self.tilt_rad) @ np.asarray(self.stands_at_m)
        place = (float(foot_m[0]), float(foot_m[1]), float(foot_m[2]))
        placed = PlacedObject(self.glb.stem, self.glb, place, self.turn_rad, self.height_m)
        shadow = ShadowPlane(self.shadow_size_m, self.shadow, place) if self.shadow > 0 else None
        return SceneDescription(self.glb, "-y", (placed,), self.light, shadow)

    def seen_by(self, camera: Camera) -> Camera:
        """The camera in that world: turned about its x axis by the tilt."""
        camera_from_world = np.eye(4)
        camera_from_world[:3, :3] = _world_from_camera(self.tilt_rad).T
        return replace(camera, camera_from_world=camera_from_world)


def _world_from_camera(tilt_rad: float) -> np.ndarray:
    cosine, sine = np.cos(tilt_rad), np.sin(tilt_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, cosine, sine], [0.0, -sine, cosine]])

"""SceneDescription: the checked content of a scene file, before anything is loaded; OneObject: one object before a camera."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mrbokeh.optics.camera import Camera
from mrbokeh.renderers.choose import DEFAULT

if TYPE_CHECKING:
    from mrbokeh.scene.light import Environment, Light

Triple = tuple[float, float, float]

_SHADOW_SIZE_M, _SHADOW_HEIGHTS = 2.0, 8.0
"""Side of the part of the ground that catches the shadow of one object: at least so many metres, and so many of its heights."""


@dataclass(frozen=True)
class PlacedObject:
    """Object of a scene file. position_m: in the tracker's world. scale counts only if height_m is None. animation: None stands still."""

    name: str
    glb: Path
    position_m: Triple = (0.0, 0.0, 0.0)
    yaw_rad: float = 0.0
    height_m: float | None = None
    scale: float = 1.0
    animation: str | None = None
    loop: bool = True
    visible: bool = True


@dataclass(frozen=True)
class Sun:
    direction: Triple
    irradiance: Triple


@dataclass(frozen=True)
class Lighting:
    """environment: a panorama's file. made: a panorama and lights that are made already, in place of it and of suns."""

    environment: Path | None = None
    rotation_rad: float = 0.0
    exposure: float = 1.0
    suns: tuple[Sun, ...] = ()
    made: "tuple[Environment, tuple[Light, ...]] | None" = None


@dataclass(frozen=True)
class ShadowPlane:
    """A square of the table, size_m wide, that catches shadows; strength: how dark, 0 to 1."""

    size_m: float = 1.0
    strength: float = 0.6
    centre_m: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class RealThings:
    """Real things that hide virtual ones: a mask, or depth and the camera that saw it."""

    depth: Path | None = None
    camera: Path | None = None
    mask: Path | None = None


@dataclass(frozen=True)
class SceneDescription:
    """Content of a scene file; angles in radians, paths absolute or relative to the working folder."""

    path: Path
    up: str = "-z"
    objects: tuple[PlacedObject, ...] = ()
    light: Lighting = field(default_factory=Lighting)
    shadow: ShadowPlane | None = None
    occlusion: RealThings | None = None
    lens: Path | None = None
    renderer: str = DEFAULT

    @property
    def files(self) -> tuple[Path, ...]:
        """The scene file and every file that it names."""
        of_occlusion = (self.occlusion.depth, self.occlusion.camera, self.occlusion.mask) if self.occlusion else ()
        named = (*(each.glb for each in self.objects), self.light.environment, *of_occlusion, self.lens)
        return (self.path, *(path for path in named if path is not None))


@dataclass(frozen=True)
class OneObject:
    """Object that stands before a camera, with its light, described by the options of a command.

    stands_at_m: in camera axes (x right, y down, z forward). world_from_camera: (3, 3) turns them into upright ones (`looking_down`).
    height_m: scaled to it; None keeps the size of the file. turn_rad: about the vertical, clockwise seen from above; at 0 the front of a
    GLB, which is where +z of its file points, faces against the view (a scene file's yaw of 180 degrees). shadow: darkness of
    the shadow, 0 to 1.
    """

    glb: Path
    stands_at_m: Triple
    height_m: float | None = None
    turn_rad: float = 0.0
    world_from_camera: np.ndarray = field(default_factory=lambda: np.eye(3))
    light: Lighting = field(default_factory=Lighting)
    shadow: float = 0.0

    @property
    def foot_m(self) -> Triple:
        """Place where it stands in a world whose vertical is true and whose origin is the camera."""
        x_m, y_m, z_m = (self.world_from_camera @ np.asarray(self.stands_at_m)).tolist()
        return x_m, y_m, z_m

    def described(self, *beside: "OneObject") -> SceneDescription:
        """Return the scene of the object, and of others beside it on its ground, in its light."""
        together = (self, *beside)
        placed = tuple(
            PlacedObject(
                name=f"{each.glb.stem} {number}",
                glb=each.glb,
                position_m=each.foot_m,
                yaw_rad=each.turn_rad + np.pi,
                height_m=each.height_m,
            )
            for number, each in enumerate(together, 1)
        )
        lowest, highest = np.min([each.foot_m for each in together], axis=0), np.max([each.foot_m for each in together], axis=0)
        x_m, _, z_m = ((lowest + highest) / 2).tolist()
        size_m = max(_SHADOW_SIZE_M, _SHADOW_HEIGHTS * max(each.height_m or 0.0 for each in together))
        size_m += float((highest - lowest)[[0, 2]].max())
        shadow = ShadowPlane(size_m, self.shadow, (x_m, self.foot_m[1], z_m)) if self.shadow > 0 else None
        return SceneDescription(path=self.glb, up="-y", objects=placed, light=self.light, shadow=shadow)

    def seen_by(self, camera: Camera) -> Camera:
        """The camera in that world."""
        camera_from_world = np.eye(4)
        camera_from_world[:3, :3] = self.world_from_camera.T
        return replace(camera, camera_from_world=camera_from_world)


def looking_down(tilt_rad: float, roll_rad: float = 0.0) -> np.ndarray:
    """Return the rotation (3, 3) from camera axes to upright ones, by how far the camera looks down and is turned clockwise."""
    cosine, sine = np.cos(tilt_rad), np.sin(tilt_rad)
    level = np.array([[np.cos(roll_rad), -np.sin(roll_rad), 0.0], [np.sin(roll_rad), np.cos(roll_rad), 0.0], [0.0, 0.0, 1.0]])
    return np.array([[1.0, 0.0, 0.0], [0.0, cosine, sine], [0.0, -sine, cosine]]) @ level

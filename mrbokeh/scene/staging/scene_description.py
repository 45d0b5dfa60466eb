"""SceneDescription: what a scene file says, checked, before anything is loaded."""

from dataclasses import dataclass, field
from pathlib import Path

from mrbokeh.renderers.choose import DEFAULT

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class PlacedObject:
    """position_m: in the tracker's world. scale counts only where height_m is None. animation None stands still."""

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
    environment: Path | None = None
    rotation_rad: float = 0.0
    exposure: float = 1.0
    suns: tuple[Sun, ...] = ()


@dataclass(frozen=True)
class ShadowPlane:
    """A square of the table, size_m wide, that catches shadows; strength: how dark, 0 to 1."""

    size_m: float = 1.0
    strength: float = 0.6
    centre_m: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class RealThings:
    """Either a mask, or depth and the camera that saw it."""

    depth: Path | None = None
    camera: Path | None = None
    mask: Path | None = None


@dataclass(frozen=True)
class SceneDescription:
    """What the scene file says; angles in radians, paths absolute or relative to the working folder."""

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

"""The thin lens of the truth scenes: an opening, what a tracer is asked for, and the points that its rays start from.

A camera ray goes from a point of the entrance pupil through the point of the focus plane that its film point is an image of.
The film keeps its distance, so that the field of view does not change with the focus. A lens point u of the unit pupil
(x right, y down) moves a point at depth z by u * coc / 2 with coc = focal_px * pupil diameter * (1 / focus - 1 / z).

Cat-eyes and stops: a front rim clips the pupil by a circle of radius 1 around -cat_eye * field_xy, where field_xy is the place of
the point that is SEEN, in half diagonals from the middle of the frame; a stop (`pupil.FieldStop`) depends on that place too. Each
ray counts 1 over the share of the pupil that is open for its point, so that nothing is vignetted.

The points are Sobol's, with a nested uniform (Owen) scramble of their own for every pixel: Burley, Practical Hash-based Owen Scrambling
(JCGT 9(4), 2020), whose constants are used here, after Laine and Karras (2011). Those functions take arrays of unsigned 32-bit numbers of
NumPy or Dr.Jit alike: both wrap around.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64, UInt32

from datasets_scripts.tracers.pupil import FieldStop, OpenShares, open_shares
from datasets_scripts.tracers.truth_scene import PackedScene
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError

DIMENSIONS = 4
Part = Literal["all", "thin", "rest"]
Picture = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]

# A shadow ray starts this far above its surface, so as not to meet it.
SHADOW_GAP_M = 2e-4
# A ray from a lamp to the lens ends on its own lamp, which must not hide it.
OWN_LAMP = 1.0 - 1e-4
# Lamps draw their numbers from scrambles of their own, beside those of the camera rays.
LAMP_STREAM = 1000


@dataclass(frozen=True, eq=False)
class Opening:
    """The lens of one picture: shape of the unit pupil, its diameter and the distance of the focus plane.

    stop: what a round opening loses besides, by the place in the frame of the point seen.
    """

    aperture: Aperture
    diameter_m: float
    focus_distance_m: float
    stop: FieldStop | None = None

    def __post_init__(self) -> None:
        aperture = self.aperture
        if aperture.spherical_aberration or aperture.is_chromatic:
            raise InputError("the ray tracer knows openings and cat-eyes, but no spherical or chromatic aberration")
        if self.varies and (len(aperture.outlines) > 1 or not np.allclose(np.hypot(*aperture.outlines[0].T), 1.0, atol=5e-3)):
            raise InputError("the ray tracer clips only round openings by rims and stops: use Aperture.disc() with cat_eye or a stop")

    @property
    def varies(self) -> bool:
        """Whether the opening changes over the frame."""
        return bool(self.aperture.cat_eye) or self.stop is not None

    @property
    def shares(self) -> OpenShares:
        """Shares of the pupil that rim and stop leave open; only if there is a stop."""
        assert self.stop is not None
        return open_shares(self.stop, self.aperture.cat_eye)


@dataclass(frozen=True, eq=False)
class Traced:
    """Pictures of one opening.

    rgb: mean radiance over the pixel and the open part of the pupil, lamps black. alpha: share of the rays that met a body
    or the sky. open_share: share of the pupil that the rim leaves open.
    """

    rgb: Picture
    alpha: Plane
    open_share: Plane


@runtime_checkable
class TruthTracer(Protocol):
    """A tracer of one part of a scene ("thin": the foreground alone, "rest": all but that); shadows are those of the whole scene."""

    scene: PackedScene
    camera: Camera
    part: Part

    def traced(self, opening: Opening | None, samples: int) -> Traced:
        """Trace the picture through an opening (None: a pinhole) with so many rays per pixel."""
        ...

    def lamp_light(self, opening: Opening | None, rays: int) -> Picture:
        """Trace the light of the lamps, which `traced` leaves out, with so many rays from each lamp to the film."""
        ...

    def depth_m(self, offset_x: float = 0.5, offset_y: float = 0.5) -> Plane:
        """Return metres along the optical axis at one place of each pixel, inf where there is nothing."""
        ...


def field_scale(camera: Camera) -> tuple[float, float, float]:
    """Return (middle x, middle y, half diagonal) of the frame in pixels: field_xy = (position - middle) / half diagonal."""
    return 0.5 * camera.width_px, 0.5 * camera.height_px, 0.5 * float(np.hypot(camera.width_px, camera.height_px))


def triangles_of(scene: PackedScene, part: Part) -> slice:
    return {"all": slice(0, None), "thin": slice(0, scene.thin_triangles), "rest": slice(scene.thin_triangles, None)}[part]


def lamps_of(scene: PackedScene, part: Part) -> list[int]:
    return [number for number, lamp in enumerate(scene.lamps) if part == "all" or lamp.thin == (part == "thin")]


def lamp_flux(scene: PackedScene, camera: Camera, number: int) -> Float64[np.ndarray, "3"]:
    """Return the sum of a lamp's light over all pixels where nothing hides it: radiance times the area of its sharp image."""
    lamp, depth_m = scene.lamps[number], float(scene.lamp_centres_m[number, 2])
    return np.asarray(lamp.radiance_rgb) * np.pi * lamp.radius_m**2 * np.prod(camera.focal_px) / depth_m**2


def sobol_table(samples: int) -> UInt32[np.ndarray, "samples 4"]:
    """Return the first points of the four-dimensional Sobol sequence as 32-bit fractions; a power of two is best."""
    from scipy.stats import qmc

    sequence = qmc.Sobol(DIMENSIONS, scramble=False, bits=32)
    points = sequence.random(1 << max(0, (samples - 1).bit_length()))[:samples]
    return np.round(points * 2.0**32).astype(np.uint64).astype(np.uint32)


def owen_scrambled(bits: Any, seed: Any, reverse_bits: Callable[[Any], Any]) -> Any:
    """Scramble a 32-bit fraction; points of one sequence stay well spread where they share the seed."""
    x = reverse_bits(bits) + seed
    x = x ^ (x * 0x6C50B47C)
    x = x ^ (x * 0xB82F1E52)
    x = x ^ (x * 0xC7AFE638)
    x = x ^ (x * 0x8D22F6E6)
    return reverse_bits(x)


def scramble_seed(pixel: Any, stream: Any) -> Any:
    """Return a seed for each pixel and each stream (a dimension of one picture)."""
    return _mixed(pixel * 0x9E3779B9 + _mixed(stream + 0x85EBCA6B))


def _mixed(x: Any) -> Any:
    """Mix a number by the finaliser of MurmurHash3: every bit changes about half of the bits of the result."""
    x = (x ^ (x >> 16)) * 0x85EBCA6B
    x = (x ^ (x >> 13)) * 0xC2B2AE35
    return x ^ (x >> 16)

"""The thin lens of the truth scenes: what a tracer is asked for, and the sharp layer made with one.

A camera ray goes from a point of the entrance pupil through the point of the focus plane that its film point is an image of.
The film keeps its distance, so that the field of view does not change with the focus. A lens point u of the unit pupil
(x right, y down) moves a point at depth z by u * coc / 2 with coc = focal_px * pupil diameter * (1 / focus - 1 / z).

Cat-eyes and stops: a front rim clips the pupil by a circle of radius 1 around -cat_eye * field_xy, where field_xy is the place of
the point that is SEEN, in half diagonals from the middle of the frame; a stop (`pupil.FieldStop`) depends on that place too. Each
ray counts 1 over the share of the pupil that is open for its point, so that nothing is vignetted.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64

from datasets_scripts.tracers.pupil import FieldStop, OpenShares
from datasets_scripts.tracers.truth_scene import PackedScene
from mrbokeh.images.layer import Layer
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError

Part = Literal["all", "thin", "rest"]
Picture = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]

# A shadow ray starts this far above its surface, so as not to meet it.
SHADOW_GAP_M = 2e-4
# A ray from a lamp to the lens ends on its own lamp, which must not hide it.
OWN_LAMP = 1.0 - 1e-4
# Lamps draw their numbers from scrambles of their own, beside those of the camera rays.
LAMP_STREAM = 1000

_PLACES_ACROSS = 6
_LAMP_REACH_PX = 0.8


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

    @cached_property
    def shares(self) -> OpenShares:
        """Shares of the pupil that rim and stop leave open; only if there is a stop."""
        assert self.stop is not None
        return OpenShares(self.stop, self.aperture.cat_eye)


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


def make_tracer(scene: PackedScene, camera: Camera, part: Part = "all", seed: int = 0) -> TruthTracer:
    """Return a tracer by Mitsuba's LLVM variant.

    Raises MissingExtraError where Mitsuba is not installed, InputError where there is no LLVM for it.
    """
    from mrbokeh.scene.mitsuba.mitsuba_tracer import load

    load()
    from datasets_scripts.tracers.mitsuba_truth import LlvmTracer

    return LlvmTracer(scene, camera, part, seed)


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


def sharp_layer(tracer: TruthTracer, samples: int, lamp_rays: int) -> Layer:
    """Trace all in focus. A pixel has the depth of its centre, or of a lamp where that gives over half of its light.

    Light belongs to the depth that it comes from: a lamp's light on the pixels around its centre would otherwise be blurred as
    if it came from behind the lamp.
    """
    bodies, light = tracer.traced(None, samples), tracer.lamp_light(None, lamp_rays)
    depth_m, lamp_depth_m = _depth_where_covered(tracer, bodies.alpha), _lamp_depth_m(tracer)
    lamp_rules = (light.sum(axis=-1) > bodies.rgb.sum(axis=-1)) & np.isfinite(lamp_depth_m)
    depth_m = np.where(lamp_rules, lamp_depth_m, depth_m).astype(np.float32)
    return Layer(bodies.rgb + light, np.clip(bodies.alpha, 0.0, 1.0), depth_m)


def _depth_where_covered(tracer: TruthTracer, alpha: Plane) -> Plane:
    """Return the depth at the pixel's centre or, in the foreground alone, at the nearest place where it covers a part of the pixel."""
    depth_m = tracer.depth_m()
    if tracer.part != "thin":
        return depth_m
    across = (np.arange(_PLACES_ACROSS) + 0.5) / _PLACES_ACROSS
    places = [(float(x), float(y)) for x in across for y in across]
    for x, y in sorted(places, key=lambda place: np.hypot(place[0] - 0.5, place[1] - 0.5)):
        missing = ~np.isfinite(depth_m) & (alpha > 0)
        if not missing.any():
            break
        depth_m = np.where(missing, tracer.depth_m(x, y), depth_m)
    return _filled_from_nearest(depth_m, alpha)


def _filled_from_nearest(depth_m: Plane, alpha: Plane) -> Plane:
    """Give slivers that no place has hit the depth of the nearest pixel that has one."""
    from scipy.ndimage import distance_transform_edt

    known = np.isfinite(depth_m)
    if not known.any():
        return depth_m
    row, column = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return np.where(~known & (alpha > 0), depth_m[row, column], depth_m)


def _lamp_depth_m(tracer: TruthTracer) -> Plane:
    """Return the depth of the nearest lamp that touches each pixel, inf elsewhere. Hidden lamps count, but give no light."""
    camera, scene = tracer.camera, tracer.scene
    depth_m = np.full((camera.height_px, camera.width_px), np.inf, np.float32)
    centres_px = camera.pixel_centres_px()
    for number in lamps_of(scene, tracer.part):
        centre_m = scene.lamp_centres_m[number]
        at_px = centre_m[:2] / centre_m[2] * camera.focal_px + camera.principal_px
        reach_px = scene.lamps[number].radius_m * camera.focal_px[0] / centre_m[2] + _LAMP_REACH_PX
        near = np.hypot(*np.moveaxis(centres_px - at_px, -1, 0)) <= reach_px
        depth_m[near] = np.minimum(depth_m[near], centre_m[2])
    return depth_m

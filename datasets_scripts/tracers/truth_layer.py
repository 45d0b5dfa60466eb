"""A tracer of truth scenes by Mitsuba, and the sharp layer made with one: coverage and one depth per pixel."""

import numpy as np

from datasets_scripts.tracers.truth import Part, Plane, TruthTracer, lamps_of
from datasets_scripts.tracers.truth_scene import PackedScene
from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import Camera

_PLACES_ACROSS = 6
_LAMP_REACH_PX = 0.8


def make_tracer(scene: PackedScene, camera: Camera, part: Part = "all", seed: int = 0) -> TruthTracer:
    """Return a tracer by Mitsuba's LLVM variant.

    Raises MissingExtraError where Mitsuba is not installed, InputError where there is no LLVM for it.
    """
    from mrbokeh.scene.mitsuba.mitsuba_tracer import load

    load()
    from datasets_scripts.tracers.mitsuba_truth import LlvmTracer

    return LlvmTracer(scene, camera, part, seed)


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

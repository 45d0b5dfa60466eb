"""The truth tracer on Dr.Jit's LLVM back end: one compiled loop over the rays of all pixels."""

from typing import Any

import drjit as dr
import numpy as np

from datasets_scripts.truth_mitsuba import LLVM, load, scene_of
from datasets_scripts.truth_pupil_llvm import LlvmPupil
from datasets_scripts.truth_sampling import owen_scrambled, scramble_seed, sobol_table
from datasets_scripts.truth_scene import PackedScene
from datasets_scripts.truth_shading_llvm import LlvmShading
from datasets_scripts.truth_tracer import LAMP_STREAM, OWN_LAMP, Opening, Part, Picture, Plane, Traced, lamp_flux, lamps_of, triangles_of
from mrbokeh.optics.camera import Camera

_LAMP_RAYS_AT_ONCE = 1 << 22


class LlvmTracer:
    """See `datasets_scripts.truth_tracer.TruthTracer`."""

    def __init__(self, scene: PackedScene, camera: Camera, part: Part = "all", seed: int = 0) -> None:
        self.mi = load(LLVM)
        self.scene, self.camera, self.part, self._seed = scene, camera, part, seed
        chosen = triangles_of(scene, part)
        self._bodies = scene_of(LLVM, scene.vertices_m, scene.triangles[chosen])
        everything = self._bodies if part == "all" else scene_of(LLVM, scene.vertices_m, scene.triangles)
        self._shading = LlvmShading(self.mi, scene, everything, chosen.start, sky=part != "thin")

    def traced(self, opening: Opening | None, samples: int) -> Traced:
        mi, pixel = self.mi, self._pixels()
        left, top = self._corner(pixel)
        table, pupil = mi.UInt32(sobol_table(samples).ravel()), self._pupil(opening)

        def add_ray(index: Any, rgb: Any, alpha: Any, weights: Any, passed: Any) -> tuple[Any, ...]:
            x, y, along, across = self._numbers(table, index, pixel, 0)
            ray, lens_uv = self._camera_ray(left + x, top + y, pupil, along, across)
            radiance, covered, inverse_depth = self._shading.seen(self._bodies.ray_intersect_preliminary(ray), ray)
            weight = mi.Float(1.0) if pupil is None else pupil.weight(ray, inverse_depth, lens_uv)
            passes = dr.select(weight > 0.0, mi.Float(1.0), 0.0)
            return index + 1, rgb + weight * radiance, alpha + weight * covered, weights + weight, passed + passes

        zeros = [dr.zeros(kind, dr.width(pixel)) for kind in (mi.UInt32, mi.Color3f, mi.Float, mi.Float, mi.Float)]
        _, rgb, alpha, weights, passed = dr.while_loop(tuple(zeros), lambda index, *_: index < dr.opaque(mi.UInt32, samples), add_ray)
        least = dr.maximum(weights, 1e-6)
        mean = np.stack([self._plane(each / least) for each in (rgb.x, rgb.y, rgb.z)], axis=-1)
        return Traced(mean, self._plane(alpha / least), self._plane(passed / samples))

    def depth_m(self, offset_x: float = 0.5, offset_y: float = 0.5) -> Plane:
        left, top = self._corner(self._pixels())
        ray, _ = self._camera_ray(left + offset_x, top + offset_y, None, None, None)
        hit = self._bodies.ray_intersect_preliminary(ray)
        return self._plane(dr.select(hit.is_valid(), hit.t * ray.d.z, dr.inf))

    def lamp_light(self, opening: Opening | None, rays: int) -> Picture:
        mi, camera = self.mi, self.camera
        film = dr.zeros(mi.Float, 3 * camera.width_px * camera.height_px)
        table, pupil = mi.UInt32(sobol_table(rays).ravel()), self._pupil(opening)
        lamps = lamps_of(self.scene, self.part)
        at_once = max(1, _LAMP_RAYS_AT_ONCE // rays)
        for first in range(0, len(lamps), at_once):
            self._add_lamps(lamps[first : first + at_once], rays, table, pupil, film)
            dr.eval(film)
        return np.array(film).reshape(camera.height_px, camera.width_px, 3)

    def _add_lamps(self, lamps: list[int], rays: int, table: Any, pupil: LlvmPupil | None, film: Any) -> None:
        mi = self.mi
        lane = dr.arange(mi.UInt32, len(lamps) * rays)
        number = lane // rays
        around, out, along, across = self._numbers(table, lane % rays, dr.gather(mi.UInt32, mi.UInt32(lamps), number), LAMP_STREAM)
        centre, radius_m, flux = self._lamp_facts(lamps, number)
        out_m, angle = radius_m * dr.sqrt(out), 2.0 * dr.pi * around
        point, start, weight = centre + mi.Vector3f(out_m * dr.cos(angle), out_m * dr.sin(angle), 0.0), mi.Point3f(0.0), mi.Float(1.0)
        if pupil is not None:
            lens_uv = pupil.point(along, across)
            start = mi.Point3f(lens_uv.x * pupil.radius_m, lens_uv.y * pupil.radius_m, 0.0)
            weight = pupil.open_weight(lens_uv, mi.Vector2f(centre.x, centre.y) / centre.z)
        distance_m = dr.norm(point - start)
        ray = mi.Ray3f(start, (point - start) / distance_m)
        ray.maxt = distance_m * OWN_LAMP
        place, inside = self._film_place(start, point, pupil)
        arrives = inside & ~self._bodies.ray_test(ray, inside)
        for channel, value in enumerate(flux * (weight / rays)):
            dr.scatter_add(film, value, 3 * place + channel, arrives)

    def _film_place(self, start: Any, point: Any, pupil: LlvmPupil | None) -> tuple[Any, Any]:
        """(number of the pixel, whether it is one) where the film sees the ray: where that crosses the focus plane."""
        mi, camera = self.mi, self.camera
        plane_m = mi.Float(1.0) if pupil is None else pupil.focus_m
        at = start + (point - start) * (plane_m / point.z)
        (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
        x_px, y_px = fx * at.x / plane_m + cx, fy * at.y / plane_m + cy
        inside = (x_px >= 0) & (y_px >= 0) & (x_px < camera.width_px) & (y_px < camera.height_px)
        return mi.UInt32(dr.select(inside, y_px, 0.0)) * camera.width_px + mi.UInt32(dr.select(inside, x_px, 0.0)), inside

    def _lamp_facts(self, lamps: list[int], number: Any) -> tuple[Any, Any, Any]:
        """Centre, radius and flux (radiance times the area of the sharp image in square pixels) of each ray's lamp."""
        mi, scene = self.mi, self.scene
        radii_m = np.array([scene.lamps[each].radius_m for each in lamps])
        flux = np.array([lamp_flux(scene, self.camera, each) for each in lamps])
        centre = dr.gather(mi.Point3f, mi.Float(scene.lamp_centres_m[lamps].ravel()), number)
        return centre, dr.gather(mi.Float, mi.Float(radii_m), number), dr.gather(mi.Color3f, mi.Float(flux.ravel()), number)

    def _pixels(self) -> Any:
        return dr.arange(self.mi.UInt32, self.camera.width_px * self.camera.height_px)

    def _corner(self, pixel: Any) -> tuple[Any, Any]:
        """Left and top of each pixel."""
        return self.mi.Float(pixel % self.camera.width_px), self.mi.Float(pixel // self.camera.width_px)

    def _pupil(self, opening: Opening | None) -> LlvmPupil | None:
        return None if opening is None else LlvmPupil(self.mi, opening, self.camera)

    def _numbers(self, table: Any, index: Any, pixel: Any, stream: int) -> list[Any]:
        """Four numbers in [0, 1) of one scrambled Sobol point; the upper 24 bits, which float32 holds exactly."""
        mi, numbers = self.mi, []
        for dimension in range(4):
            seed = scramble_seed(pixel, mi.UInt32(4 * self._seed + stream + dimension))
            bits = owen_scrambled(dr.gather(mi.UInt32, table, 4 * index + dimension), seed, dr.brev)
            numbers.append(mi.Float(bits >> 8) * 2.0**-24)
        return numbers

    def _camera_ray(self, x_px: Any, y_px: Any, pupil: LlvmPupil | None, along: Any, across: Any) -> tuple[Any, Any]:
        mi, ((fx, fy), (cx, cy)) = self.mi, (self.camera.focal_px, self.camera.principal_px)
        towards = mi.Vector3f((x_px - cx) / fx, (y_px - cy) / fy, 1.0)
        if pupil is None:
            return mi.Ray3f(mi.Point3f(0.0), dr.normalize(towards)), None
        lens_uv = pupil.point(along, across)
        origin = mi.Point3f(lens_uv.x * pupil.radius_m, lens_uv.y * pupil.radius_m, 0.0)
        return mi.Ray3f(origin, dr.normalize(mi.Point3f(towards * pupil.focus_m) - origin)), lens_uv

    def _plane(self, values: Any) -> Plane:
        return np.array(values).reshape(self.camera.height_px, self.camera.width_px).astype(np.float32)

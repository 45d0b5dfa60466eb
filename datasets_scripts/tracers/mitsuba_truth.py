"""The truth tracer on Mitsuba's LLVM variant (Dr.Jit): one compiled loop over the rays of all pixels.

Mitsuba is asked for intersections only. Pupil, light and film are those of `tracers.truth`, whose slow twin in NumPy stands in the
tests (`tests/support/scalar_truth_tracer.py`).
"""

import importlib
from typing import Any

import drjit as dr
import numpy as np
from jaxtyping import Float32, Int

from datasets_scripts.tracers.pupil import pupil_table
from datasets_scripts.tracers.truth import (
    LAMP_STREAM,
    OWN_LAMP,
    SHADOW_GAP_M,
    Opening,
    Part,
    Picture,
    Plane,
    Traced,
    field_scale,
    lamp_flux,
    lamps_of,
    owen_scrambled,
    scramble_seed,
    sobol_table,
    triangles_of,
)
from datasets_scripts.tracers.truth_scene import FACET_COLUMNS, PackedScene
from mrbokeh.optics.camera import Camera
from mrbokeh.scene.mitsuba.mitsuba_tracer import LLVM, load

_LAMP_RAYS_AT_ONCE = 1 << 22


def triangle_scene(vertices_m: Float32[np.ndarray, "vertices 3"], triangles: Int[np.ndarray, "triangles 3"]) -> Any:
    """Return a scene of these triangles alone, in their order, in the variant of Mitsuba that is set."""
    import mitsuba

    used, renumbered = np.unique(triangles, return_inverse=True)
    mesh = mitsuba.Mesh("triangles", len(used), len(triangles))
    parameters = mitsuba.traverse(mesh)
    parameters["vertex_positions"] = vertices_m[used].ravel()
    parameters["faces"] = renumbered.ravel().astype(np.uint32)
    parameters.update()
    return mitsuba.load_dict({"type": "scene", "triangles": mesh})


class LlvmPupil:
    """The pupil of an Opening on the device; numbers that change from picture to picture are opaque, so that kernels are reused."""

    def __init__(self, mi: Any, opening: Opening, camera: Camera) -> None:
        self._mi, self._camera, self._cat_eye, self._stop = mi, camera, opening.aperture.cat_eye, opening.stop
        self._varies = opening.varies
        if opening.stop is not None:
            self._shares = opening.shares
            self._share_table = mi.Float(self._shares.table.ravel().astype(np.float32))
        table = pupil_table(opening.aperture)
        self._spans, self._columns, self._count = table.spans, table.bands.shape[1], len(table.bands)
        self._bands = mi.Float(table.bands.ravel())
        self.radius_m, self.focus_m = dr.opaque(mi.Float, 0.5 * opening.diameter_m), dr.opaque(mi.Float, opening.focus_distance_m)

    def point(self, along: Any, across: Any) -> Any:
        """Return points of the pupil, as `PupilTable.points` does."""
        mi = self._mi
        scaled = across * self._count
        band = dr.minimum(mi.UInt32(scaled), self._count - 1)
        row = [dr.gather(mi.Float, self._bands, band * self._columns + column) for column in range(self._columns)]
        y = row[0] + (scaled - mi.Float(band)) * (row[1] - row[0])
        widths = [row[2 * span + 3] - row[2 * span + 2] for span in range(self._spans)]
        left = along * sum(widths)
        x = row[2] + left
        for span in range(1, self._spans):
            left = left - widths[span - 1]
            x = dr.select(left > 0, row[2 * span + 2] + left, x)
        return mi.Point2f(x, y)

    def weight(self, ray: Any, inverse_depth: Any, lens_uv: Any) -> Any:
        """Return 1 / (open share) where rim and stop let the ray pass, else 0; the place of the point seen decides where they are."""
        mi = self._mi
        if not self._varies:
            return mi.Float(1.0)
        return self.open_weight(lens_uv, mi.Vector2f(ray.d.x, ray.d.y) / ray.d.z + mi.Vector2f(lens_uv) * self.radius_m * inverse_depth)

    def open_weight(self, lens_uv: Any, slope: Any) -> Any:
        """Return the same weight for a point in the direction `slope` (x / z, y / z) from the middle of the pupil."""
        mi = self._mi
        if not self._varies:
            return mi.Float(1.0)
        (fx, fy), (cx, cy) = self._camera.focal_px, self._camera.principal_px
        middle_x, middle_y, half_diagonal = field_scale(self._camera)
        field = mi.Vector2f(slope.x * fx + cx - middle_x, slope.y * fy + cy - middle_y) / half_diagonal
        passes = dr.squared_norm(mi.Vector2f(lens_uv) + self._cat_eye * field) <= 1.0
        if self._stop is not None:
            radius, stop_x = self._stop.radius_and_shift(field.x, dr.minimum, dr.maximum)
            passes &= dr.square(lens_uv.x - stop_x) + dr.square(lens_uv.y) >= dr.square(radius)
            return dr.select(passes, 1.0 / self._share(field), 0.0)
        half = dr.minimum(0.5 * abs(self._cat_eye) * dr.norm(field), 0.999)
        share = (dr.acos(half) - half * dr.sqrt(1.0 - half * half)) * (2.0 / dr.pi)
        return dr.select(passes, 1.0 / share, 0.0)

    def _share(self, field: Any) -> Any:
        """Return the open share, bilinear in the table, as `OpenShares.at` does."""
        mi, (rows, columns) = self._mi, self._shares.table.shape
        column, row = self._shares.places(field.x, field.y)
        column, row = dr.clip(column, 0.0, columns - 1.001), dr.clip(row, 0.0, rows - 1.001)
        left, top = mi.UInt32(column), mi.UInt32(row)
        across, down = column - mi.Float(left), row - mi.Float(top)
        share = mi.Float(0.0)
        for next_row, share_y in ((0, 1.0 - down), (1, down)):
            for next_column, share_x in ((0, 1.0 - across), (1, across)):
                place = (top + next_row) * columns + left + next_column
                share += share_x * share_y * dr.gather(mi.Float, self._share_table, place)
        return share


class LlvmShading:
    """Texture times light with the shadows of the sun, the same from every direction.

    everything: Mitsuba's scene that throws the shadows; first_triangle: of the part looked at.
    """

    def __init__(self, mi: Any, scene: PackedScene, everything: Any, first_triangle: int, sky: bool) -> None:
        self._mi, self._everything, self._first = mi, everything, first_triangle
        self._sky_texture = scene.sky_texture if sky and scene.sky_texture[1] else None
        self._towards_sun = mi.Vector3f(*scene.towards_sun.tolist())
        self._facets, self._texels = mi.Float(scene.facets.ravel()), mi.Float(scene.texels.ravel())
        self._textures = mi.UInt32(scene.facet_texture.ravel().astype(np.uint32))
        self._normals = mi.Float(scene.facet_normals.ravel())

    def seen(self, hit: Any, ray: Any) -> tuple[Any, Any, Any]:
        """Return (radiance, 1 where a body or the sky is seen, 1 / depth) for Mitsuba's preliminary intersection of a ray."""
        mi, found = self._mi, hit.is_valid()
        radiance, covered = dr.select(found, self._lit_surface(hit, ray, found), 0.0), dr.select(found, mi.Float(1.0), 0.0)
        if self._sky_texture is not None:
            uv = mi.Point2f(0.5 + 0.5 * ray.d.x / ray.d.z, 0.5 + 0.5 * ray.d.y / ray.d.z)
            radiance, covered = (
                dr.select(found, radiance, self._texel(uv, [mi.UInt32(each) for each in self._sky_texture], ~found)),
                mi.Float(1.0),
            )
        return radiance, covered, dr.select(found, 1.0 / (hit.t * ray.d.z), 0.0)

    def _lit_surface(self, hit: Any, ray: Any, found: Any) -> Any:
        mi, facet = self._mi, hit.prim_index + self._first
        b1, b2 = hit.prim_uv.x, hit.prim_uv.y
        b0 = 1.0 - b1 - b2
        row = [dr.gather(mi.Float, self._facets, FACET_COLUMNS * facet + column, found) for column in range(FACET_COLUMNS)]
        uv = mi.Point2f(b0 * row[0] + b1 * row[2] + b2 * row[4], b0 * row[1] + b1 * row[3] + b2 * row[5])
        sun, sky = b0 * row[6] + b1 * row[7] + b2 * row[8], b0 * row[9] + b1 * row[10] + b2 * row[11]
        texture = [dr.gather(mi.UInt32, self._textures, 3 * facet + column, found) for column in range(3)]
        normal = dr.gather(mi.Vector3f, self._normals, facet, found)
        sunny = found & (sun > 0.0)
        sunny &= ~self._everything.ray_test(mi.Ray3f(ray(hit.t) + normal * SHADOW_GAP_M, self._towards_sun), sunny)
        return self._texel(uv, texture, found) * row[12] * (sky + dr.select(sunny, sun, 0.0))

    def _texel(self, uv: Any, texture: list[Any], active: Any) -> Any:
        """Return the repeating texture, bilinear between texel centres; texture: start, width, height."""
        mi, (start, width, height) = self._mi, texture
        x = (uv.x - dr.floor(uv.x)) * mi.Float(width) - 0.5
        y = (uv.y - dr.floor(uv.y)) * mi.Float(height) - 0.5
        left, top = mi.Int32(dr.floor(x)), mi.Int32(dr.floor(y))
        w, h = mi.Int32(width), mi.Int32(height)
        columns = ((dr.select(left < 0, w - 1, left), 1.0 - x + dr.floor(x)), (dr.select(left + 1 >= w, 0, left + 1), x - dr.floor(x)))
        rows = ((dr.select(top < 0, h - 1, top), 1.0 - y + dr.floor(y)), (dr.select(top + 1 >= h, 0, top + 1), y - dr.floor(y)))
        result = mi.Color3f(0.0)
        for row, share_y in rows:
            for column, share_x in columns:
                result += share_x * share_y * dr.gather(mi.Color3f, self._texels, start + mi.UInt32(row * w + column), active)
        return result


class LlvmTracer:
    """A `TruthTracer`: looks at one part of a scene."""

    def __init__(self, scene: PackedScene, camera: Camera, part: Part = "all", seed: int = 0) -> None:
        load()
        self.mi = importlib.import_module(f"mitsuba.{LLVM}")
        self.scene, self.camera, self.part, self._seed = scene, camera, part, seed
        chosen = triangles_of(scene, part)
        self._bodies = triangle_scene(scene.vertices_m, scene.triangles[chosen])
        everything = self._bodies if part == "all" else triangle_scene(scene.vertices_m, scene.triangles)
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
        """Return (number of the pixel, whether it is one) where the film sees the ray: where that crosses the focus plane."""
        mi, camera = self.mi, self.camera
        plane_m = mi.Float(1.0) if pupil is None else pupil.focus_m
        at = start + (point - start) * (plane_m / point.z)
        (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
        x_px, y_px = fx * at.x / plane_m + cx, fy * at.y / plane_m + cy
        inside = (x_px >= 0) & (y_px >= 0) & (x_px < camera.width_px) & (y_px < camera.height_px)
        return mi.UInt32(dr.select(inside, y_px, 0.0)) * camera.width_px + mi.UInt32(dr.select(inside, x_px, 0.0)), inside

    def _lamp_facts(self, lamps: list[int], number: Any) -> tuple[Any, Any, Any]:
        """Return centre, radius and flux (radiance times the area of the sharp image in square pixels) of each ray's lamp."""
        mi, scene = self.mi, self.scene
        radii_m = np.array([scene.lamps[each].radius_m for each in lamps])
        flux = np.array([lamp_flux(scene, self.camera, each) for each in lamps])
        centre = dr.gather(mi.Point3f, mi.Float(scene.lamp_centres_m[lamps].ravel()), number)
        return centre, dr.gather(mi.Float, mi.Float(radii_m), number), dr.gather(mi.Color3f, mi.Float(flux.ravel()), number)

    def _pixels(self) -> Any:
        return dr.arange(self.mi.UInt32, self.camera.width_px * self.camera.height_px)

    def _corner(self, pixel: Any) -> tuple[Any, Any]:
        """Return the left and top of each pixel."""
        return self.mi.Float(pixel % self.camera.width_px), self.mi.Float(pixel // self.camera.width_px)

    def _pupil(self, opening: Opening | None) -> LlvmPupil | None:
        return None if opening is None else LlvmPupil(self.mi, opening, self.camera)

    def _numbers(self, table: Any, index: Any, pixel: Any, stream: int) -> list[Any]:
        """Return four numbers in [0, 1) of one scrambled Sobol point; the upper 24 bits, which float32 holds exactly."""
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

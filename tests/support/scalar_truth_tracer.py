"""The slow and obvious twin of the truth tracer: NumPy, with Mitsuba's scalar variant for intersections, ray by ray (2 us each)."""

import numpy as np
import pytest
from jaxtyping import Bool, Float, Float32, Int, UInt32

from datasets_scripts.tracers.pupil import PupilTable, pupil_table
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
from datasets_scripts.tracers.truth_scene import PackedScene
from mrbokeh.optics.camera import Camera
from mrbokeh.scene.mitsuba.mitsuba_tracer import load
from mrbokeh.system.errors import InputError

Points = Float[np.ndarray, "n 3"]
Pairs = Float[np.ndarray, "n 2"]
Numbers = Float[np.ndarray, " n"]
Flags = Bool[np.ndarray, " n"]


def two_disc_overlap(distance: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """Return the share of a unit disc that a second unit disc covers, their centres `distance` apart."""
    half = np.clip(np.abs(distance) / 2.0, 0.0, 1.0)
    return (np.arccos(half) - half * np.sqrt(1.0 - half**2)) * 2.0 / np.pi


def reversed_bits(x: UInt32[np.ndarray, "*batch"]) -> UInt32[np.ndarray, "*batch"]:
    """Return the 32 bits of each number in reverse order."""
    for shift, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF)):
        x = ((x >> shift) & mask) | ((x & mask) << shift)
    return (x >> 16) | (x << 16)


def require_mitsuba() -> None:
    """Skip the test where Mitsuba or LLVM's library is not installed."""
    pytest.importorskip("mitsuba", reason="Mitsuba is not installed (pip install 'mrbokeh[datasets]')")
    try:
        load()
    except InputError as error:
        pytest.skip(str(error))


class ScalarBodies:
    """Triangles that rays may meet."""

    def __init__(self, vertices_m: Float32[np.ndarray, "vertices 3"], triangles: Int[np.ndarray, "triangles 3"]) -> None:
        import mitsuba

        from datasets_scripts.tracers.mitsuba_truth import triangle_scene

        mitsuba.set_variant("scalar_rgb")
        self._scene, self._ray = triangle_scene(vertices_m, triangles), mitsuba.Ray3f

    def nearest(self, starts_m: Points, towards: Points) -> tuple[Numbers, Int[np.ndarray, " n"], Numbers, Numbers]:
        """Return (distance or inf, number of the triangle, barycentric weights of its second and third corner) of the first hits."""
        found = np.full((len(starts_m), 4), (np.inf, 0, 0, 0))
        for index, (start, direction) in enumerate(zip(starts_m.tolist(), towards.tolist(), strict=True)):
            hit = self._scene.ray_intersect_preliminary(self._ray(start, direction))
            if hit.is_valid():
                found[index] = hit.t, hit.prim_index, hit.prim_uv.x, hit.prim_uv.y
        return found[:, 0], found[:, 1].astype(int), found[:, 2], found[:, 3]

    def blocked(self, starts_m: Points, towards: Points, reach: float, asked: Flags) -> Flags:
        """Return whether a triangle lies within `reach` times `towards` of the start; False where not asked."""
        blocked = np.zeros(len(starts_m), bool)
        length_m = np.linalg.norm(towards, axis=1)
        for index in np.flatnonzero(asked):
            ray = self._ray(starts_m[index].tolist(), (towards[index] / length_m[index]).tolist())
            if np.isfinite(reach):
                ray.maxt = float(length_m[index] * reach)
            blocked[index] = self._scene.ray_test(ray)
        return blocked


class ScalarTracer:
    """A `TruthTracer`: looks at one part of a scene."""

    def __init__(self, scene: PackedScene, camera: Camera, part: Part = "all", seed: int = 0) -> None:
        self.scene, self.camera, self.part, self._seed = scene, camera, part, seed
        self._chosen = triangles_of(scene, part)
        self._bodies = ScalarBodies(scene.vertices_m, scene.triangles[self._chosen])
        self._everything = self._bodies if part == "all" else ScalarBodies(scene.vertices_m, scene.triangles)

    def traced(self, opening: Opening | None, samples: int) -> Traced:
        size = self.camera.width_px * self.camera.height_px
        pixel, table, pupil = np.arange(size, dtype=np.uint32), sobol_table(samples), _pupil(opening)
        rgb, alpha, weights, passed = np.zeros((size, 3)), np.zeros(size), np.zeros(size), np.zeros(size)
        for point in table:
            x, y, along, across = self._numbers(point[:, None], pixel, 0)
            x_px, y_px = pixel % self.camera.width_px + x, pixel // self.camera.width_px + y
            lens_uv = _lens_points(pupil, along, across)
            starts_m, towards = self._camera_rays(x_px, y_px, opening, lens_uv)
            radiance, covered, inverse_depth = self._seen(starts_m, towards)
            slope = towards[:, :2] / towards[:, 2:] + starts_m[:, :2] * inverse_depth[:, None]
            weight = self._open_weight(opening, lens_uv, slope)
            rgb, alpha = rgb + weight[:, None] * radiance, alpha + weight * covered
            weights, passed = weights + weight, passed + (weight > 0)
        least = np.maximum(weights, 1e-6)
        return Traced(self._planes(rgb / least[:, None]), self._planes(alpha / least), self._planes(passed / samples))

    def depth_m(self, offset_x: float = 0.5, offset_y: float = 0.5) -> Plane:
        pixel = np.arange(self.camera.width_px * self.camera.height_px)
        x_px, y_px = pixel % self.camera.width_px + offset_x, pixel // self.camera.width_px + offset_y
        starts_m, towards = self._camera_rays(x_px, y_px, None, np.zeros((len(pixel), 2)))
        return self._planes(self._bodies.nearest(starts_m, towards)[0] * towards[:, 2])

    def lamp_light(self, opening: Opening | None, rays: int) -> Picture:
        film = np.zeros((self.camera.height_px * self.camera.width_px, 3))
        table, pupil = sobol_table(rays), _pupil(opening)
        for number in lamps_of(self.scene, self.part):
            self._add_lamp(number, table, opening, pupil, film)
        return self._planes(film)

    def _add_lamp(self, number: int, table: np.ndarray, opening: Opening | None, pupil: PupilTable | None, film: np.ndarray) -> None:
        camera, lamp, centre = self.camera, self.scene.lamps[number], self.scene.lamp_centres_m[number]
        around, out, along, across = self._numbers(table.T, np.full(len(table), number, np.uint32), LAMP_STREAM)
        rim = np.stack([np.cos(2 * np.pi * around), np.sin(2 * np.pi * around), np.zeros(len(table))], axis=1)
        points_m = centre + lamp.radius_m * np.sqrt(out)[:, None] * rim
        lens_uv = _lens_points(pupil, along, across)
        starts_m = _starts_m(opening, lens_uv)
        weight = self._open_weight(opening, lens_uv, np.broadcast_to(centre[:2] / centre[2], lens_uv.shape))
        plane_m = 1.0 if opening is None else opening.focus_distance_m
        at = starts_m + (points_m - starts_m) * (plane_m / points_m[:, 2:])
        xy_px = at[:, :2] / plane_m * camera.focal_px + camera.principal_px
        inside = ((xy_px >= 0) & (xy_px < (camera.width_px, camera.height_px))).all(axis=1)
        arrives = inside & ~self._bodies.blocked(starts_m, points_m - starts_m, OWN_LAMP, inside & (weight > 0))
        x, y = xy_px[arrives].astype(int).T
        flux = lamp_flux(self.scene, camera, number)
        np.add.at(film, y * camera.width_px + x, flux * (weight[arrives, None] / len(table)))

    def _seen(self, starts_m: Points, towards: Points) -> tuple[Points, Numbers, Numbers]:
        """Return (radiance, 1 where a body or the sky is seen, 1 / depth)."""
        scene = self.scene
        distance, triangle, b1, b2 = self._bodies.nearest(starts_m, towards)
        found, facet = np.isfinite(distance), triangle + self._chosen.start
        corners = np.stack([1.0 - b1 - b2, b1, b2], axis=1)
        row, texture = scene.facets[facet], scene.facet_texture[facet]
        uv = np.einsum("nc,nck->nk", corners, row[:, :6].reshape(-1, 3, 2))
        sun, sky = (corners * row[:, 6:9]).sum(axis=1), (corners * row[:, 9:12]).sum(axis=1)
        hits_m = starts_m + np.where(found, distance, 0.0)[:, None] * towards + scene.facet_normals[facet] * SHADOW_GAP_M
        sunny = found & (sun > 0)
        sunny &= ~self._everything.blocked(hits_m, np.broadcast_to(scene.towards_sun, hits_m.shape), np.inf, sunny)
        radiance = self._texels(uv, texture) * (row[:, 12] * (sky + np.where(sunny, sun, 0.0)) * found)[:, None]
        covered, inverse_depth = found.astype(float), np.where(found, 1.0 / (distance * towards[:, 2]), 0.0)
        if scene.sky_texture[1] and self.part != "thin":
            uv_sky = 0.5 + 0.5 * towards[:, :2] / towards[:, 2:]
            sky_radiance = self._texels(uv_sky, np.tile(scene.sky_texture, (len(uv_sky), 1)))
            radiance, covered = np.where(found[:, None], radiance, sky_radiance), np.ones(len(found))
        return radiance, covered, inverse_depth

    def _texels(self, uv: Pairs, texture: np.ndarray) -> Points:
        """Return repeating textures, bilinear between texel centres; texture (N, 3): start, width, height."""
        size = texture[:, 1:]
        xy = (uv - np.floor(uv)) * size - 0.5
        first, share = np.floor(xy).astype(int), xy - np.floor(xy)
        result = np.zeros((len(uv), 3))
        for corner in ((0, 0), (1, 0), (0, 1), (1, 1)):
            column, row = ((first + corner) % size).T
            weight = np.where(corner, share, 1.0 - share).prod(axis=1)
            result += weight[:, None] * self.scene.texels[texture[:, 0] + row * texture[:, 1] + column]
        return result

    def _camera_rays(self, x_px: Numbers, y_px: Numbers, opening: Opening | None, lens_uv: Pairs) -> tuple[Points, Points]:
        """Return (starts, unit directions)."""
        (fx, fy), (cx, cy) = self.camera.focal_px, self.camera.principal_px
        towards = np.stack([(x_px - cx) / fx, (y_px - cy) / fy, np.ones(len(x_px))], axis=1)
        starts_m = _starts_m(opening, lens_uv)
        if opening is not None:
            towards = towards * opening.focus_distance_m - starts_m
        return starts_m, towards / np.linalg.norm(towards, axis=1, keepdims=True)

    def _open_weight(self, opening: Opening | None, lens_uv: Pairs, slope: Pairs) -> Numbers:
        """Return 1 / (open share) where rim and stop let the ray pass, else 0, for points in the direction (x / z, y / z)."""
        if opening is None or not opening.varies:
            return np.ones(len(lens_uv))
        middle_x, middle_y, half_diagonal = field_scale(self.camera)
        field = (slope * self.camera.focal_px + self.camera.principal_px - (middle_x, middle_y)) / half_diagonal
        shift = opening.aperture.cat_eye * field
        passes = np.hypot(*(lens_uv + shift).T) <= 1.0
        if opening.stop is None:
            return passes / two_disc_overlap(np.minimum(np.hypot(*shift.T), 1.998))
        radius, stop_x = opening.stop.radius_and_shift(field[:, 0])
        passes &= np.hypot(lens_uv[:, 0] - stop_x, lens_uv[:, 1]) >= radius
        return passes / opening.shares.at(*field.T)

    def _numbers(self, bits: np.ndarray, pixel: np.ndarray, stream: int) -> list[np.ndarray]:
        """Return four numbers in [0, 1) of scrambled Sobol points: bits (4, 1 or N)."""
        streams = np.arange(4, dtype=np.uint32) + np.uint32(4 * self._seed + stream)
        scrambled = (owen_scrambled(bits[k], scramble_seed(pixel, streams[k : k + 1]), reversed_bits) for k in range(4))
        return [(each >> 8) * 2.0**-24 for each in scrambled]

    def _planes(self, values: np.ndarray) -> np.ndarray:
        return values.reshape(self.camera.height_px, self.camera.width_px, *values.shape[1:]).astype(np.float32)


def _pupil(opening: Opening | None) -> PupilTable | None:
    return None if opening is None else pupil_table(opening.aperture)


def _lens_points(pupil: PupilTable | None, along: Numbers, across: Numbers) -> Pairs:
    return np.zeros((len(along), 2)) if pupil is None else pupil.points(along, across)


def _starts_m(opening: Opening | None, lens_uv: Pairs) -> Points:
    radius_m = 0.0 if opening is None else 0.5 * opening.diameter_m
    return np.concatenate([lens_uv * radius_m, np.zeros((len(lens_uv), 1))], axis=1)

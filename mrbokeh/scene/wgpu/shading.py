"""Shading of the triangles that samples see, in one compute pass per layer, under lights with shadow maps and filtered panoramas."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import cos, isinf
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, UInt32

from mrbokeh.images.color import luminance
from mrbokeh.optics.camera import Camera
from mrbokeh.scene.environment_filter import LightingMaps, reflected_share_table
from mrbokeh.scene.light import Light
from mrbokeh.scene.wgpu.device import READ_ONLY, UNIFORM, WRITABLE, Gpu, sampled
from mrbokeh.scene.wgpu.geometry import GpuGeometry
from mrbokeh.scene.wgpu.visibility import Targets, View, Visibility, light_views, sample_places

_KINDS = {"directional": 0, "point": 1, "spot": 2}
_ROWS_BEFORE_MAPS, _ROWS_OF_MAPS = 4, 1 + 6 * 4
_ROWS_OF_LIGHT = _ROWS_BEFORE_MAPS + 2 * _ROWS_OF_MAPS
_ROWS_OF_PANORAMA = 5 + 16 + 3 * 16

_STEP = 2.0**-18
"""Relative step past a surface, as of the ray caster."""
_SAMPLES = 17
_HEADER = 16
"""Words before the lists: LISTED of frame.wgsl."""


@dataclass(frozen=True, eq=False)
class GpuLights:
    """Lights on the device. lights: struct Light of light.wgsl each. maps: layers of triangle numbers. veils: see-through layers per
    view.
    """

    count: int
    lights: Any
    maps: Any
    veils: int


@dataclass(frozen=True, eq=False)
class GpuPanorama:
    """Panorama on the device: struct Panorama of light.wgsl and its values; is_lit is False without a panorama."""

    header: Any
    values: Any
    is_lit: bool


def lights_with_shadows(
    gpu: Gpu, visibility: Visibility, geometry: GpuGeometry, group: Any, lights: Sequence[Light], size_px: int, veils: int
) -> GpuLights:
    """Draw every light's maps. They depend on the scene only, so that a new camera needs none. veils: layers of blended surfaces."""
    near = [_relative(light, geometry.centre_m) for light in lights]
    veils = veils if geometry.has_blended else 0
    boxes = geometry.cluster_boxes_m
    views = [[light_views(light, box, size_px) for box in boxes] if light.casts_shadow else [] for light in near]
    in_turn = [(cluster, view) for of_light in views for cluster, some in enumerate(of_light) for view in some]
    maps = gpu.texture((size_px, size_px, max((1 + veils) * len(in_turn), 1)), "r32uint")
    depths = [gpu.texture((size_px, size_px, 1), "depth32float").create_view() for _ in range(2)]
    encoder = gpu.device.create_command_encoder()
    for number, (cluster, view) in enumerate(in_turn):
        layers = range(number * (1 + veils), (number + 1) * (1 + veils))
        of_view = [maps.create_view(dimension="2d", base_array_layer=layer, array_layer_count=1) for layer in layers]
        visibility.draw_light(encoder, geometry, group, view, cluster, of_view, (depths[0], depths[1]))
    gpu.device.queue.submit([encoder.finish()])
    words, first = np.zeros((max(len(lights), 1), _ROWS_OF_LIGHT, 4), np.float32), 0
    for row, light, of_light in zip(words, near, views, strict=False):
        _describe(row, light, of_light, first, 1 + veils)
        first += (1 + veils) * sum(map(len, of_light))
    return GpuLights(len(lights), gpu.buffer(words), maps.create_view(dimension="2d-array"), veils)


def _relative(light: Light, centre_m: Float[np.ndarray, "3"]) -> Light:
    x, y, z = (np.asarray(light.position_m) - centre_m).tolist()
    return replace(light, position_m=(x, y, z))


def _describe(
    rows: Float32[np.ndarray, "rows 4"], light: Light, clusters: Sequence[Sequence[View]], first_map: int, maps_per_view: int
) -> None:
    """Write struct Light of light.wgsl."""
    whole = rows.view(np.int32)
    rows[0] = *light.rgb, float(luminance(np.asarray([light.rgb], np.float64))[0])
    rows[1, :3], whole[1, 3] = light.position_m, _KINDS[light.kind]
    rows[2] = *light.direction, 0.0 if isinf(light.range_m) else 1.0 / light.range_m
    rows[3, :2] = cos(light.outer_cone_rad), max(1e-3, cos(light.inner_cone_rad) - cos(light.outer_cone_rad))
    whole[3, 2] = len(clusters)
    for number, views in enumerate(clusters):
        start = _ROWS_BEFORE_MAPS + number * _ROWS_OF_MAPS
        whole[start, :2], rows[start, 2] = (first_map, len(views)), views[0].texel
        for face, view in enumerate(views):
            rows[start + 1 + 4 * face : start + 5 + 4 * face] = view.clip_from_point.T
        first_map += maps_per_view * len(views)


def no_panorama(gpu: Gpu) -> GpuPanorama:
    return GpuPanorama(gpu.buffer(np.zeros((_ROWS_OF_PANORAMA, 4), np.float32), "UNIFORM"), gpu.buffer(np.zeros(4, np.float32)), False)


def panorama(gpu: Gpu, maps: LightingMaps) -> GpuPanorama:
    """Upload what environment_filter made of a panorama: one long array, and where in it each part begins."""
    table = reflected_share_table()
    parts = [maps.irradiance.radiance.ravel(), table.ravel(), maps.reflections.radiance.ravel()]
    _, table_start, reflections = np.cumsum([0, *map(len, parts)])[:3]
    rows = np.zeros((_ROWS_OF_PANORAMA, 4), np.float32)
    whole = rows.view(np.uint32)
    rows[:3, :3] = maps.environment_from_world.T
    whole[3, 1:] = len(table), len(maps.reflections.start), table_start
    whole[4, 1:3] = maps.irradiance.size[0]
    levels = whole[5 : 5 + len(maps.reflections.start)]
    levels[:, 0] = reflections + 3 * maps.reflections.start
    levels[:, 1:3] = maps.reflections.size
    rows[21 : 21 + 3 * len(maps.peaks), :3] = maps.peaks.reshape(-1, 3)
    return GpuPanorama(gpu.buffer(rows, "UNIFORM"), gpu.buffer(np.concatenate(parts)), True)


@dataclass(frozen=True, eq=False)
class Lighting:
    """Lights and panorama of a picture. caster: the geometry whose triangles the shadow maps number."""

    caster: GpuGeometry
    lights: GpuLights
    panorama: GpuPanorama


@dataclass(frozen=True, eq=False)
class Canvas:
    """Room for a tile: samples, colour, per pixel the deciding surface and share of light, for layered scenes what each sample
    still lets through, and the lists of pixels to shade with their sizes."""

    targets: Targets
    rgba: Any
    pixels: Any
    shines_through: Any
    work: Any
    sizes: Any


class Shading:
    """The pipelines of shade.wgsl and the modules that it draws on.

    Pixels are sorted into lists first, as neighbouring threads should do the same work: plain ones are shaded once, with one look
    at the shadow maps, those at edges and at borders of shadows by all of their samples.
    """

    def __init__(self, gpu: Gpu, visibility: Visibility) -> None:
        self._gpu = gpu
        seen = [sampled("uint"), *[sampled("uint", multisampled=True)] * 4]
        self._layout = gpu.layout("COMPUTE", UNIFORM, UNIFORM, *[READ_ONLY] * 3, sampled("uint", "2d-array"), *[WRITABLE] * 4, *seen)
        self._pipeline_layout = gpu.device.create_pipeline_layout(bind_group_layouts=[visibility.geometry_layout, self._layout])
        self._module = gpu.shader("geometry", "frame", "light", "shadow", "surface", "samples", "shade")
        self._pipelines: dict[tuple[str, tuple[bool, ...]], Any] = {}

    def canvas(self, targets: Targets, layered: bool) -> Canvas:
        count, room = targets.size_px[0] * targets.size_px[1], self._gpu.empty_buffer
        through = room(4 * _SAMPLES * count if layered else 16)
        return Canvas(
            targets=targets,
            rgba=room(16 * count),
            pixels=room(8 * count),
            shines_through=through,
            work=room(4 * (_HEADER + 2 * count)),
            sizes=room(4 * _HEADER, "INDIRECT"),
        )

    def run(self, encoder: Any, job: "Job", canvas: Canvas, layer: int, is_last: bool) -> None:
        """Add one layer of the picture; the last is what is solid, those before it are blended."""
        gpu, lighting = self._gpu, job.lighting
        frame = gpu.buffer(_frame_words(job, layer, is_last), "UNIFORM")
        numbers = canvas.targets.solid if is_last else canvas.targets.blended
        lights, panorama = lighting.lights, lighting.panorama
        group = gpu.bound(
            self._layout,
            *(frame, panorama.header, panorama.values, lights.lights, lighting.caster.triangles, lights.maps),
            *(canvas.rgba, canvas.pixels, canvas.shines_through, canvas.work, *numbers),
        )
        tiles = (-(-job.camera.width_px // 8), -(-job.camera.height_px // 8))
        encoder.clear_buffer(canvas.work, 0, 4 * _HEADER)
        plain, edges = ("mask_plain", "mask_edges") if job.is_mask else ("shade_plain", "shade_edges")
        self._pass(encoder, job, group, ("classify", tiles), ("size_lists", (1, 1)))
        encoder.copy_buffer_to_buffer(canvas.work, 0, canvas.sizes, 0, 4 * _HEADER)
        if is_last:
            self._pass(encoder, job, group, (plain, (canvas.sizes, 4)), ("find_borders", tiles), ("size_lists", (1, 1)))
            encoder.copy_buffer_to_buffer(canvas.work, 0, canvas.sizes, 0, 4 * _HEADER)
        self._pass(encoder, job, group, (edges, (canvas.sizes, 20)))

    def _pass(self, encoder: Any, job: "Job", group: Any, *steps: tuple[str, tuple[Any, int]]) -> None:
        """Run entry points, each over (columns, rows) of thread groups or as many as (a buffer, at an offset) holds."""
        shading = encoder.begin_compute_pass()
        shading.set_bind_group(0, job.shading_group)
        shading.set_bind_group(1, group)
        for entry, (first, second) in steps:
            shading.set_pipeline(self._pipeline(entry, job))
            if isinstance(first, int):
                shading.dispatch_workgroups(first, second)
            else:
                shading.dispatch_workgroups_indirect(first, second)
        shading.end()

    def _pipeline(self, entry: str, job: "Job") -> Any:
        """Made for what the scene has, when it is first needed."""
        caster = job.lighting.caster
        traits = {
            "TEXTURED": bool(caster.pool.textures) and (not job.is_mask or caster.has_see_through),
            "SEE_THROUGH": caster.has_see_through,
            "LIT_BY_LIGHTS": job.lighting.lights.count > 0,
            "LIT_BY_PANORAMA": job.lighting.panorama.is_lit and not job.is_mask,
            "CATCHER": job.is_mask,
            "LAYERED": job.layered,
        }
        key = (entry, tuple(traits.values()))
        if key not in self._pipelines:
            stage = {"module": self._module, "entry_point": entry, "constants": traits}
            self._pipelines[key] = self._gpu.device.create_compute_pipeline(layout=self._pipeline_layout, compute=stage)
        return self._pipelines[key]

    def read(self, canvas: Canvas, camera: Camera) -> tuple[Float32[np.ndarray, "h w 4"], UInt32[np.ndarray, "h w"]]:
        """Return (colour and coverage, deciding surface)."""
        size, count = (camera.height_px, camera.width_px), camera.height_px * camera.width_px
        rgba = self._gpu.read(canvas.rgba, np.float32, 4 * count)
        return rgba.reshape(*size, 4), self._gpu.read(canvas.pixels, np.uint32, count).reshape(size)

    def read_mask(self, canvas: Canvas, camera: Camera) -> Float32[np.ndarray, "h w"]:
        size, count = (camera.height_px, camera.width_px), camera.height_px * camera.width_px
        # Where the catcher is not seen, nobody looked at the light: NOT_PLAIN of frame.wgsl.
        return np.minimum(self._gpu.read(canvas.pixels, np.float32, count, first=count), np.float32(1.0)).reshape(size)

    def is_done(self, canvas: Canvas) -> bool:
        """Return whether the layer drawn last shows nothing any more."""
        return not self._gpu.read(canvas.work, np.uint32, 5)[[0, 4]].any()


@dataclass(frozen=True, eq=False)
class Job:
    """Geometry to shade in the picture of a camera, as a scene or as a catcher of shadows.

    group binds the geometry for drawing, shading_group with the materials of the casters for shading.
    """

    geometry: GpuGeometry
    group: Any
    shading_group: Any
    camera: Camera
    lighting: Lighting
    is_mask: bool = False

    @property
    def layered(self) -> bool:
        return self.geometry.has_blended and not self.is_mask


def _frame_words(job: Job, layer: int, is_last: bool) -> Float32[np.ndarray, "96"]:
    """Return struct Frame of frame.wgsl; positions are relative to the geometry's centre."""
    geometry, camera, lighting = job.geometry, job.camera, job.lighting
    rows = np.zeros((24, 4), np.float32)
    whole = rows.view(np.uint32)
    rows[0, :3] = camera.world_from_camera[:3, 3] - geometry.centre_m
    rows[1:4, :3] = camera.camera_from_world[:3, :3]
    rows[0, 3] = 1.0 / np.sqrt(camera.focal_px[0] * camera.focal_px[1])
    rows[1, 3] = _STEP * geometry.reach_m
    whole[2, 3] = lighting.lights.count
    rows[4] = *camera.focal_px, *camera.principal_px
    rows[5, :3], whole[5, 3] = geometry.centre_m - lighting.caster.centre_m, lighting.lights.veils
    whole[6] = camera.width_px, camera.height_px, layer, is_last
    places, further = sample_places()
    rows[7:23, :2], rows[7:23, 2:] = places, further
    return rows.ravel()

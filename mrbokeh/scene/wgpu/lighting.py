"""Lights with their shadow maps, and filtered panoramas, as the shading reads them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import cos, isinf
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.images.color import luminance
from mrbokeh.scene.environment_filter import LightingMaps, reflected_share_table
from mrbokeh.scene.light import Light
from mrbokeh.scene.wgpu.device import Gpu
from mrbokeh.scene.wgpu.geometry import GpuGeometry
from mrbokeh.scene.wgpu.views import View, light_views
from mrbokeh.scene.wgpu.visibility import Visibility

_KINDS = {"directional": 0, "point": 1, "spot": 2}
_ROWS_BEFORE_MAPS, _ROWS_OF_MAPS = 4, 1 + 6 * 4
_ROWS_OF_LIGHT = _ROWS_BEFORE_MAPS + 2 * _ROWS_OF_MAPS
_ROWS_OF_PANORAMA = 5 + 16 + 3 * 16


@dataclass(frozen=True, eq=False)
class GpuLights:
    """lights: struct Light of light.wgsl each. maps: layers of triangle numbers; veils: how many of them are see-through, per view."""

    count: int
    lights: Any
    maps: Any
    veils: int


@dataclass(frozen=True, eq=False)
class GpuPanorama:
    """struct Panorama of light.wgsl and its values; is_lit is False where there is no panorama."""

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

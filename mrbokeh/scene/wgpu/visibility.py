"""Drawing of the triangle that each sample of a picture sees, from a camera (17 samples per pixel) or a light (one).

Views are the matrices and rays by which cameras and lights look at a scene.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64

from mrbokeh.optics.camera import Camera
from mrbokeh.scene.light import Light
from mrbokeh.scene.wgpu.device import READ_ONLY, UNIFORM, Gpu, sampled
from mrbokeh.scene.wgpu.geometry import GpuGeometry

_NEAREST = 2.0**-12
"""Nothing nearer than this share of a scene's reach is drawn where the scene lies around the eye; a camera inside an object
is no use, while a near plane much nearer than the surfaces costs the depth test its precision."""
_WIDEST_TANGENT = 2.0

_OF_FOUR = np.array([(6, 2), (14, 6), (2, 10), (10, 14)]) / 16
"""Where WebGPU's four samples lie in a pixel (WebGPU specification, "Sample Masking")."""
_SHIFTS = np.array([(2.5, 10.5), (7.5, 12.5), (8.5, 9.5), (13.5, 11.5)]) / 16
"""By how much the picture is shifted from pass to pass, so that the samples of four passes fall into sixteen rows and columns
of every pixel. Of such shifts these came out of a random search for the least error of coverage over straight edges of all
directions: 0.035 RMS, where the pattern of prepared_scenes.py has 0.034."""
MARGIN_PX = 1
"""The sample of a shifted picture that a pixel needs may lie one pixel further on."""


@dataclass(frozen=True, eq=False)
class View:
    """View of a camera or light: struct View of visibility.wgsl, without its flags; points are relative to the geometry's centre.

    way, way_right, way_down: for a camera the ray through (0, 0) of the picture and its change per pixel; for a sun the origin. texel:
    width of a pixel, at unit depth of a camera, in metres of a sun.
    """

    clip_from_point: Float64[np.ndarray, "4 4"]
    eye: Float64[np.ndarray, "4"]
    way: Float64[np.ndarray, "3"]
    way_right: Float64[np.ndarray, "3"]
    way_down: Float64[np.ndarray, "3"]
    texel: float

    def words(self, one_sided: bool, peels: bool, is_hidden: bool) -> Float32[np.ndarray, "36"]:
        """The struct as the device reads it; a matrix goes column by column."""
        rows = np.zeros((9, 4), np.float32)
        rows[:4], rows[4] = self.clip_from_point.T, self.eye
        rows[5, :3], rows[6, :3], rows[7, :3], rows[5, 3] = self.way, self.way_right, self.way_down, self.texel
        rows[8] = np.array([one_sided, peels, is_hidden, 0], np.uint32).view(np.float32)
        return rows.ravel()


def camera_view(camera: Camera, centre_m: Float[np.ndarray, "3"], nearest_m: float) -> View:
    """A pinhole camera with any focal lengths and principal point; depth is reversed (near is 1), its far end at infinity."""
    fx, fy = camera.focal_px
    cx, cy = camera.principal_px
    rotation = camera.camera_from_world[:3, :3]
    camera_from_point = np.eye(4)
    camera_from_point[:3, :3], camera_from_point[:3, 3] = rotation, rotation @ centre_m + camera.camera_from_world[:3, 3]
    clip_from_camera = np.array(
        [
            [2 * fx / camera.width_px, 0, 2 * cx / camera.width_px - 1, 0],
            [0, -2 * fy / camera.height_px, 1 - 2 * cy / camera.height_px, 0],
            [0, 0, 0, nearest_m],
            [0, 0, 1, 0],
        ]
    )
    right, down, forward = rotation
    return View(
        clip_from_point=clip_from_camera @ camera_from_point,
        eye=np.append(camera.world_from_camera[:3, 3] - centre_m, 1.0),
        way=forward - cx / fx * right - cy / fy * down,
        way_right=right / fx,
        way_down=down / fy,
        texel=1.0 / float(np.sqrt(fx * fy)),
    )


def nearest_m(camera: Camera, centre_m: Float[np.ndarray, "3"], box_m: Float[np.ndarray, "8 3"]) -> float:
    """Return the near plane that shows all of the box and leaves the depth test its precision."""
    depth_m = (box_m + centre_m) @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
    reach_m = float(np.ptp(box_m, axis=0).max())
    return max(0.9 * float(depth_m.min()), _NEAREST * reach_m, 1e-9)


def light_views(light: Light, box_m: Float[np.ndarray, "8 3"], size_px: int) -> list[View]:
    """One view that takes in all of the box, or six around a point light that is too near or inside.

    box_m and the light's position are relative to the geometry's centre.
    """
    if light.kind == "directional":
        return [_sun_view(light, box_m, size_px)]
    position = np.asarray(light.position_m)
    if light.kind == "spot" and np.tan(light.outer_cone_rad) < _WIDEST_TANGENT:
        half = 1.02 * max(float(np.tan(light.outer_cone_rad)), 1e-3)
        return [_point_view(position, _axes_along(np.asarray(light.direction)), half, box_m, size_px)]
    middle = box_m.mean(0) - position
    axes = _axes_along(middle / max(float(np.linalg.norm(middle)), 1e-12))
    across, depth = (box_m - position) @ axes[:2].T, (box_m - position) @ axes[2]
    half = 1.02 * float(np.abs(across / depth[:, None]).max()) if depth.min() > 0 else np.inf
    if half < _WIDEST_TANGENT:
        return [_point_view(position, axes, max(half, 1e-6), box_m, size_px)]
    ways = [sign * np.eye(3)[axis] for axis in range(3) for sign in (1.0, -1.0)]
    return [_point_view(position, _axes_along(way), 1.0, box_m, size_px) for way in ways]


def _axes_along(forward: Float[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Rows right, down, forward."""
    aside = np.eye(3)[int(np.argmin(np.abs(forward)))]
    right = np.cross(aside, forward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def _point_view(
    position: Float[np.ndarray, "3"], axes: Float[np.ndarray, "3 3"], half: float, box_m: Float[np.ndarray, "8 3"], size_px: int
) -> View:
    """Return the view of a point or spot light. half: tangent of half the field of view."""
    camera_from_point = np.eye(4)
    camera_from_point[:3, :3], camera_from_point[:3, 3] = axes, -axes @ position
    focal_px = size_px / (2 * half)
    camera = Camera(
        width_px=size_px,
        height_px=size_px,
        focal_px=(focal_px, focal_px),
        principal_px=(size_px / 2, size_px / 2),
        camera_from_world=camera_from_point,
    )
    return camera_view(camera, np.zeros(3), nearest_m(camera, np.zeros(3), box_m))


def _sun_view(light: Light, box_m: Float[np.ndarray, "8 3"], size_px: int) -> View:
    """Along the light's rays; depth is 1 before the box and 0 behind it, as of cameras."""
    axes = _axes_along(np.asarray(light.direction))
    low, high = (box_m @ axes.T).min(0), (box_m @ axes.T).max(0)
    # A little wider, so that no triangle lies on the very border or at the very end of the depth.
    half, middle = np.maximum((high - low) / 2, 1e-9 + 1e-3 * np.ptp(box_m)) * 1.01, (low + high) / 2
    clip_from_point = np.eye(4)
    clip_from_point[0, :3], clip_from_point[0, 3] = axes[0] / half[0], -middle[0] / half[0]
    clip_from_point[1, :3], clip_from_point[1, 3] = -axes[1] / half[1], middle[1] / half[1]
    clip_from_point[2, :3], clip_from_point[2, 3] = -axes[2] / (2 * half[2]), 0.5 + middle[2] / (2 * half[2])
    return View(
        clip_from_point=clip_from_point,
        eye=np.append(axes[2], 0.0),
        way=axes.T @ np.array([middle[0] - half[0], middle[1] - half[1], low[2] - half[2]]),
        way_right=2 * half[0] / size_px * axes[0],
        way_down=2 * half[1] / size_px * axes[1],
        texel=2 * float(max(half[0], half[1])) / size_px,
    )


def sample_places() -> tuple[Float[np.ndarray, "16 2"], Float[np.ndarray, "16 2"]]:
    """Return (places in the pixel from 0 to 1, how many texels further right and down they are found), pass by pass."""
    places = (_SHIFTS[:, None] + _OF_FOUR).reshape(-1, 2)
    return places % 1.0, MARGIN_PX - np.floor(places)


@dataclass(frozen=True, eq=False)
class Targets:
    """Pictures of triangle numbers, one with a sample at each pixel's centre and four with four samples each.

    solid: what is solid or cut out. blended: one layer of what is blended. depths: of what is solid, and of two layers in turn,
    because every layer needs that of the layer before.
    """

    size_px: tuple[int, int]
    solid: tuple[Any, ...]
    blended: tuple[Any, ...]
    depths: tuple[tuple[Any, Any, Any], ...]


def targets(gpu: Gpu, size_px: tuple[int, int], layered: bool) -> Targets:
    size = (size_px[0] + MARGIN_PX, size_px[1] + MARGIN_PX, 1)
    kinds = [("r32uint", 1)] + [("rg16uint", 4)] * 4

    def numbers() -> tuple[Any, ...]:
        return tuple(gpu.texture(size, texel, samples).create_view() for texel, samples in kinds)

    def depths(samples: int) -> tuple[Any, Any, Any]:
        solid, first = (gpu.texture(size, "depth32float", samples).create_view() for _ in range(2))
        return solid, first, gpu.texture(size, "depth32float", samples).create_view() if layered else first

    solid = numbers()
    return Targets((size[0], size[1]), solid, numbers() if layered else solid, tuple(depths(samples) for _, samples in kinds))


class Visibility:
    """The pipelines of visibility.wgsl and their passes."""

    def __init__(self, gpu: Gpu) -> None:
        self._gpu = gpu
        self.geometry_layout = gpu.layout(
            "VERTEX|FRAGMENT|COMPUTE", READ_ONLY, READ_ONLY, READ_ONLY, sampled("unfilterable-float", "2d-array")
        )
        self._view_layout = gpu.layout("VERTEX|FRAGMENT", UNIFORM)
        one, four = sampled("depth"), sampled("depth", multisampled=True)
        before = {1: gpu.layout("FRAGMENT", one, None, one), 4: gpu.layout("FRAGMENT", None, four, None, four)}
        module = gpu.shader("geometry", "visibility")
        self._before_layouts = before
        self._solid = {samples: self._pipeline(module, "solid", samples, []) for samples in (1, 4)}
        self._see_through = {samples: self._pipeline(module, "see_through", samples, [before[samples]]) for samples in (1, 4)}

    def _pipeline(self, module: Any, entry: str, samples: int, more: Sequence[Any]) -> Any:
        device = self._gpu.device
        return device.create_render_pipeline(
            layout=device.create_pipeline_layout(bind_group_layouts=[self.geometry_layout, self._view_layout, *more]),
            vertex={"module": module, "entry_point": "corner"},
            primitive={"topology": "triangle-list", "cull_mode": "none"},
            depth_stencil={"format": "depth32float", "depth_write_enabled": True, "depth_compare": "greater"},
            multisample={"count": samples},
            fragment={
                "module": module,
                "entry_point": entry if samples == 1 else f"{entry}_4",
                "targets": [{"format": "r32uint" if samples == 1 else "rg16uint"}],
            },
        )

    def geometry_group(self, geometry: GpuGeometry, materials_of: GpuGeometry | None = None) -> Any:
        """Triangles with their materials and textures, or with those of another geometry."""
        source = materials_of or geometry
        return self._gpu.bound(self.geometry_layout, geometry.triangles, source.materials, source.pool.table, source.pool.texels)

    def draw_camera(
        self, encoder: Any, geometry: GpuGeometry, group: Any, camera: Camera, into: Targets, layer: int | None, near_m: float
    ) -> None:
        """Draw the samples of solid and cut-out triangles (layer None), or of one layer of blended ones after it."""
        # The targets may be larger than the picture; the same pixels lie at the same places.
        width, height = into.size_px
        shifts = [np.zeros(2), *(MARGIN_PX - _SHIFTS)]
        solid, cut, blended = geometry.ends
        numbers = into.solid if layer is None else into.blended
        ranges = [(0, solid), (solid, cut)] if layer is None else [(0, 0), (cut, blended)]
        for shift, number, depths in zip(shifts, numbers, into.depths, strict=True):
            principal = (camera.principal_px[0] + shift[0], camera.principal_px[1] + shift[1])
            shifted = replace(camera, width_px=width, height_px=height, principal_px=principal)
            view = camera_view(shifted, geometry.centre_m, near_m)
            words = view.words(one_sided=True, peels=layer is not None and layer > 0, is_hidden=layer is not None)
            drawn, before, hiding = (depths[0], depths[1], depths[1]) if layer is None else (*_in_turn(depths[1:], layer), depths[0])
            self._draw(encoder, group, words, ranges, (number, drawn, before, hiding), 1 if number is numbers[0] else 4)

    def draw_light(
        self, encoder: Any, geometry: GpuGeometry, group: Any, view: View, cluster: int, maps: Sequence[Any], depths: tuple[Any, Any]
    ) -> None:
        """The maps of one view of a light on one cluster: what is solid or cut out, then layer by layer what is blended."""
        ends = [0, *geometry.cluster_ends.ravel().tolist()]
        solid, cut, blended = ((ends[part + cluster], ends[part + cluster + 1]) for part in (0, 2, 4))
        for number, numbers in enumerate(maps):
            ranges = [solid, cut] if number == 0 else [(0, 0), blended]
            drawn, before = _in_turn(depths, number)
            words = view.words(one_sided=False, peels=number > 1, is_hidden=False)
            self._draw(encoder, group, words, ranges, (numbers, drawn, before, before), 1)

    def _draw(
        self,
        encoder: Any,
        group: Any,
        view: np.ndarray,
        ranges: Sequence[tuple[int, int]],
        attached: tuple[Any, Any, Any, Any],
        samples: int,
    ) -> None:
        numbers, depth, before, hiding = attached
        gpu = self._gpu
        depth_attachment = {"view": depth, "depth_load_op": "clear", "depth_store_op": "store", "depth_clear_value": 0.0}
        drawing = encoder.begin_render_pass(
            color_attachments=[{"view": numbers, "load_op": "clear", "store_op": "store", "clear_value": (0, 0, 0, 0)}],
            depth_stencil_attachment=depth_attachment,
        )
        drawing.set_bind_group(0, group)
        drawing.set_bind_group(1, gpu.bound(self._view_layout, gpu.buffer(view, "UNIFORM")))
        for (first, end), pipeline in zip(ranges, (self._solid[samples], self._see_through[samples]), strict=True):
            if end <= first:
                continue
            drawing.set_pipeline(pipeline)
            if pipeline is self._see_through[samples]:
                things = [before, None, hiding] if samples == 1 else [None, before, None, hiding]
                drawing.set_bind_group(2, gpu.bound(self._before_layouts[samples], *things))
            drawing.draw(3 * (end - first), 1, 3 * first)
        drawing.end()


def _in_turn(depths: Sequence[Any], layer: int) -> tuple[Any, Any]:
    """Return (depth to draw this layer, depth of the layer before)."""
    return depths[layer % 2], depths[1 - layer % 2]


def tiles(first_px: tuple[int, int], end_px: tuple[int, int], most_px: tuple[int, int]) -> list[tuple[int, int, int, int]]:
    """A rectangle of the picture in parts (x, y, width, height) of at most the given size."""
    columns, rows = (range(first, end, most) for first, end, most in zip(first_px, end_px, most_px, strict=True))
    return [(x, y, min(most_px[0], end_px[0] - x), min(most_px[1], end_px[1] - y)) for y, x in product(rows, columns)]

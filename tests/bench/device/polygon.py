"""Polygonal differences on a device, beside the compiled loops: one layer, and 16 slices of a picture with occluders."""

from collections.abc import Iterator
from functools import partial

import numpy as np

from mrbokeh.images.layer import opaque
from mrbokeh.layering.layering import Layering
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from mrbokeh.renderers.polygon.torch_polygon import TorchPolygons
from mrbokeh.system.torch_device import has_triton
from tests.bench.device.rows import Row, Run, size_of

OCTAGON = Aperture.blades(8, np.pi / 8)
LARGEST_PX = 121.0
SIZES = {(1080, 1920): (1.0, 6.0), (2160, 3840): (3.0, 20.0)}
"""Height and width, and the bars in ms of one layer and of 16 slices."""
SLICES = 16


def texture(size: tuple[int, int]) -> np.ndarray:
    """Return noise between 0.05 and 1 in three channels, coverage 1."""
    values = np.random.default_rng(0).uniform(0.05, 1.0, (*size, 4)).astype(np.float32)
    values[..., 3] = 1.0
    return values


def hills_px(size: tuple[int, int]) -> np.ndarray:
    """Return smooth hills of circles of confusion from 0 to LARGEST_PX."""
    y, x = np.mgrid[: size[0], : size[1]] * (1080.0 / size[0])
    return ((0.5 + 0.5 * np.sin(x / 300.0) * np.cos(y / 200.0)) * LARGEST_PX).astype(np.float32)


def occluded_px(size: tuple[int, int]) -> np.ndarray:
    """Return hills from -40 to 81 px behind a post, a rail and a disc that are nearer."""
    circles = hills_px(size) - np.float32(40.0)
    y, x = np.mgrid[: size[0], : size[1]] * (1080.0 / size[0])
    circles[(x > 600) & (x < 700) & (y > 300)] = -60.0
    circles[(x > 1200) & (x < 1210)] = -70.0
    circles[(x - 1500) ** 2 + (y - 540) ** 2 < 150**2] = -50.0
    return circles


def rows(run: Run) -> Iterator[Row]:
    sizes = {(108, 192): (None, None)} if run.small else SIZES
    for size, (layer_ms, slices_ms) in sizes.items():
        for precision in ("single", "double"):
            yield layer_row(run, size, precision, layer_ms if precision == "single" else None)
        if run.device.type == "cuda" and has_triton():
            yield slices_row(run, size, slices_ms)


def layer_row(run: Run, size: tuple[int, int], precision: str, bar_ms: float | None) -> Row:
    values, coc_px, renderer = texture(size), hills_px(size), TorchPolygons(run.name, precision=precision)
    run.tell(f"  {size[1]} x {size[0]}, one layer, impulses of {precision} precision")
    there = run.on_device(values), run.on_device(coc_px)
    row = Row(f"one layer, octagon to {LARGEST_PX:g} px, {precision} precision", size_of(coc_px), bar_ms=bar_ms)
    moved = lambda: renderer.sum_kernels(run.on_device(values), run.on_device(coc_px), OCTAGON).cpu()  # noqa: E731
    row = run.measured(row, partial(renderer.sum_kernels, *there, OCTAGON), moved)
    compiled = PolygonDifferences()
    row = row.by_processor(partial(compiled.sum_kernels, values, coc_px, OCTAGON), run, most_s=2.0)
    return row.compared(renderer.sum_kernels(*there, OCTAGON), compiled.sum_kernels(values, coc_px, OCTAGON))


def slices_row(run: Run, size: tuple[int, int], bar_ms: float | None) -> Row:
    lens = Lens(100.0, 1.2, 2.0, 36.0, OCTAGON)
    shown_px = occluded_px(size)
    depth_m = (1.0 / (1.0 / lens.focus_distance_m - shown_px / lens.coc_px_per_dioptre(size[1]))).astype(np.float32)
    layer = opaque(np.ascontiguousarray(texture(size)[..., :3]), depth_m)
    coc_px, renderer = np.asarray(lens.coc_px(depth_m, size[1]), np.float32), TorchPolygons(run.name)
    run.tell(f"  {size[1]} x {size[0]}, {SLICES} slices")
    there = run.on_device(layer.rgb), run.on_device(coc_px)
    row = Row(f"{SLICES} slices, hidden background, octagon, -70 to 81 px", size_of(coc_px), bar_ms=bar_ms)
    moved = lambda: renderer.render(run.on_device(layer.rgb), run.on_device(coc_px), OCTAGON, SLICES).cpu()  # noqa: E731
    row = run.measured(row, partial(renderer.render, *there, OCTAGON, SLICES), moved)
    compiled = PolygonDifferences(layering=Layering(slices=SLICES, sees_rims=False))
    row = row.by_processor(partial(compiled.render, [layer], lens), run, most_s=2.0)
    return row.compared(renderer.render(*there, OCTAGON, SLICES)[..., :3], compiled.render([layer], lens).rgb)

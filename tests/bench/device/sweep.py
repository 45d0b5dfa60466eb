"""The plane sweep of dense depth on a device, against the compiled one: a slanted wall seen from five places."""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np

from mrbokeh.depth.views.plane_sweep import plane_sweep
from mrbokeh.depth.views.sweep_view import SweepView
from mrbokeh.depth.views.torch_plane_sweep import plane_sweep_on
from mrbokeh.optics.camera import Camera
from tests.bench.device.rows import Row, Run

PLACES_M = ((0.0, 0.0, 0.0), (0.06, 0.0, 0.0), (-0.06, 0.0, 0.005), (0.0, 0.05, 0.0), (0.0, -0.05, -0.005))
DEPTH_M = 1.2
SIZE_PX, PLANES = (1200, 800), 64
SMALL_SIZE_PX, SMALL_PLANES = (120, 80), 8


def wall_views(width_px: int, height_px: int) -> list[SweepView]:
    """Return what cameras that look along z see of a textured wall at one depth, each a part of one large picture."""
    focal_px = 1.06 * width_px
    margin_px = int(np.ceil(0.07 * focal_px / DEPTH_M)) + 2
    noise = np.random.default_rng(0).uniform(0.0, 1.0, (height_px + 2 * margin_px, width_px + 2 * margin_px)).astype(np.float32)
    texture = cv2.GaussianBlur(noise, (0, 0), 1.5)
    texture = (texture - texture.min()) / np.ptp(texture)
    views = []
    for place in PLACES_M:
        pose = np.eye(4)
        pose[:3, 3] = -np.asarray(place)
        camera = Camera(width_px, height_px, (focal_px, focal_px), (0.5 * width_px, 0.5 * height_px), pose)
        shift_px = focal_px * np.asarray(place[:2]) / (DEPTH_M - place[2])
        moved = np.array([[1, 0, -margin_px - shift_px[0]], [0, 1, -margin_px - shift_px[1]]], np.float32)
        views.append(SweepView(cv2.warpAffine(texture, moved, (width_px, height_px), flags=cv2.INTER_LINEAR), camera))
    return views


def rows(run: Run) -> Iterator[Row]:
    (width_px, height_px), planes = (SMALL_SIZE_PX, SMALL_PLANES) if run.small else (SIZE_PX, PLANES)
    reference, *neighbours = wall_views(width_px, height_px)
    offsets = np.linspace(0.5, 1.3, planes)
    run.tell(f"  {planes} planes, {len(neighbours)} neighbours")
    row = Row(f"{planes} planes, {len(neighbours)} neighbours", f"{width_px} x {height_px}")
    row = run.measured(row, lambda: plane_sweep_on(run.name, reference, neighbours, offsets))
    row = replace(row, transfers_ms=row.device_ms)
    run.tell("  the compiled sweep")
    row = row.by_processor(lambda: plane_sweep(reference, neighbours, offsets), run, most_s=6.0)
    found, known = plane_sweep_on(run.name, reference, neighbours, offsets), plane_sweep(reference, neighbours, offsets)
    off = float(np.mean(np.abs(found.astype(int) - known.astype(int)) > 1))
    yield replace(row.compared(found, known), note=f"costs from 0 to 255; {off:.1e} of them are off by more than 1; transfers among it")

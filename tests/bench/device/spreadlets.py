"""Laplacian spreadlets on a device: two layers that lie there, with defocus and motion, and sums for the compiled renderer."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.psf_models.build import Combined, build_bank
from mrbokeh.renderers.bank.tables import Place
from mrbokeh.renderers.spreadlets.laplacian_spreadlets import LaplacianSpreadlets
from mrbokeh.renderers.spreadlets.torch_spreadlets import DeviceLayer, TorchSpreadlets
from tests.bench.bench_laplacian_spreadlets import frame, hills_px
from tests.bench.device.rows import Row, Run, once_ms, size_of

PUBLISHED = "66 to 163 ms on a GTX 980 Ti"
BAR_MS = 20.0
LARGEST_PX, CELLS, SIDE_PX = 64.0, 64, 1024
SMALL_LARGEST_PX, SMALL_CELLS, SMALL_SIDE_PX = 16.0, 12, 48
DIRECTIONS = 6


class HostLayer(NamedTuple):
    """A layer in the host's memory: premultiplied colour and coverage, circles of confusion, motion."""

    rgba: np.ndarray
    coc_px: np.ndarray
    motion_px: np.ndarray

    def there(self, run: Run) -> DeviceLayer:
        return DeviceLayer(*map(run.on_device, self))


def two_layers(side_px: int, largest_px: float) -> list[HostLayer]:
    """Return a board with holes in front of an opaque picture.

    Both have circles from 0.6 to 1.4 of their mean, up to nearly the largest, and move in some directions by up to a third of it.
    """
    size = (side_px, side_px)
    behind, board = frame(size), frame(size)[::-1].copy()
    rows, columns = np.indices(size)
    board *= ((rows * 5 // side_px + columns * 5 // side_px) % 2 == 0)[..., None].astype(np.float32)
    near_px, far_px = -hills_px(size, 0.4 * largest_px), hills_px(size, 0.6 * largest_px)
    ways = ways_px(size, 0.4, 0.3 * largest_px), ways_px(size, 2.0, 0.1 * largest_px)
    return [HostLayer(board, near_px, ways[0]), HostLayer(behind, far_px, ways[1])]


def ways_px(size: tuple[int, int], first_rad: float, longest_px: float) -> np.ndarray:
    """Return motion that grows from the top down, in directions that change from stripe to stripe."""
    rows, columns = np.indices(size)
    angle = first_rad + 0.5 * (columns * DIRECTIONS // size[1])
    return (np.stack([np.cos(angle), np.sin(angle)], axis=2) * (longest_px * rows / size[0])[..., None]).astype(np.float32)


def by_processor(renderer: LaplacianSpreadlets, layers: list[HostLayer]) -> np.ndarray:
    """Blur and lay over one another as `TorchSpreadlets.picture` does."""
    front, behind = (renderer.sum_bank_kernels(each.rgba, each.coc_px, Place(motion_px=each.motion_px)) for each in layers)
    return front + (1.0 - np.clip(front[..., 3:], 0.0, 1.0)) * behind


def rows(run: Run) -> Iterator[Row]:
    side_px, largest_px = (SMALL_SIDE_PX, SMALL_LARGEST_PX) if run.small else (SIDE_PX, LARGEST_PX)
    cells = SMALL_CELLS if run.small else CELLS
    with TemporaryDirectory() as folder:
        run.tell(f"  building a bank of {cells} kernels for defocus and motion")
        bank = build_bank(Combined(largest_px, 0.5 * largest_px, cells=cells), Path(folder) / "bank", progress=False)
    layers = two_layers(side_px, largest_px)
    for is_whole in (False, True):
        yield layered_row(run, bank, layers, is_whole)
    yield from sums_rows(run)


def layered_row(run: Run, bank: PsfBank, layers: list[HostLayer], is_whole: bool) -> Row:
    """Measure two layers: with sparse points, or with whole Laplacians, which are exact on both."""
    changed: dict[str, Any] = {"sparsification": None} if is_whole else {}
    renderer = TorchSpreadlets(bank, run.name, **changed)
    there = [layer.there(run) for layer in layers]
    name = f"two layers, defocus and motion, {'whole Laplacians' if is_whole else 'sparse points'}"
    run.tell(f"  {name}: first picture, for which the processor makes the points")
    first_ms = once_ms(partial(renderer.picture, there))
    row = Row(name, size_of(layers[0].coc_px), published=PUBLISHED, bar_ms=None if is_whole else BAR_MS)
    row = run.measured(row, lambda: renderer.picture(there), lambda: renderer.picture([each.there(run) for each in layers]).cpu())
    run.tell("  the compiled renderer")
    compiled = LaplacianSpreadlets(bank, **changed)
    row = row.by_processor(lambda: by_processor(compiled, layers), run)
    row = row.compared(renderer.picture(there), by_processor(compiled, layers))
    return replace(row, note=f"first picture {first_ms / 1e3:.1f} s")


def sums_rows(run: Run) -> Iterator[Row]:
    """Measure `LaplacianSpreadlets(device=...)`, whose layers are in the host's memory: its times are all with transfers."""
    size = (54, 96) if run.small else (540, 960)
    values, disc = frame(size), Aperture.disc()
    for mean_px in (12.0,) if run.small else (20.0, 60.0):
        coc_px = hills_px(size, mean_px)
        on_device, compiled = LaplacianSpreadlets(device=run.name), LaplacianSpreadlets()
        name = f"LaplacianSpreadlets(device={run.name!r}), mean circle {mean_px:g} px"
        run.tell(f"  {name}")
        row = Row(name, size_of(coc_px), transfers_ms=run.host_ms(partial(on_device.sum_kernels, values, coc_px, disc)))
        row = row.by_processor(partial(compiled.sum_kernels, values, coc_px, disc), run)
        found, known = (each.sum_kernels(values, coc_px, disc) for each in (on_device, compiled))
        yield row.compared(found, known)

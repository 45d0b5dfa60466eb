"""Rays of lens models traced on a device, against the compiled loops: whole kernels, whose points come from the processor in both."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

from mrbokeh.optics.aperture import Aperture
from mrbokeh.psf_models.build import Combined
from mrbokeh.psf_models.physical_lens import PhysicalLens, biconvex_lens
from mrbokeh.psf_models.simple_lens import SimpleLens
from mrbokeh.psf_models.volume import Volume
from tests.bench.device.rows import Row, Run

MODELS: dict[str, tuple[Callable[..., Any], list[list[float]]]] = {
    "physical lens (biconvex), off the axis": (partial(PhysicalLens, biconvex_lens(), image_width_px=1000), [[1.0, 1.3], [0.4, 0.5]]),
    "simple lens (pentagon)": (partial(SimpleLens, Aperture.blades(5)), [[30.0, 40.0]]),
    "combined (defocus and motion)": (Combined, [[10.0, 40.0], [0.0, 30.0]]),
    "volume (fog)": (Volume, [[1.0, 1.5]]),
}
RAYS, SMALL_RAYS = 1 << 22, 1 << 15


def rows(run: Run) -> Iterator[Row]:
    rays = SMALL_RAYS if run.small else RAYS
    for name, (model, box) in MODELS.items():
        run.tell(f"  {name}, {rays} rays")
        yield model_row(run, name, model, np.array(box), rays)


def model_row(run: Run, name: str, model: Callable[..., Any], box: np.ndarray, rays: int) -> Row:
    """Measure one kernel; the points of the Sobol sequence are made by the processor and are part of both times."""
    on_device, compiled = model(device=run.name), model()
    row = Row(name, f"2^{rays.bit_length() - 1} rays", note="device time is of the whole kernel, points from the host among it")
    row = run.measured(row, lambda: on_device.kernel(box, rays, 3))
    row = row.by_processor(lambda: compiled.kernel(box, rays, 3), run, most_s=4.0)
    return row.compared(on_device.kernel(box, rays, 3), compiled.kernel(box, rays, 3))

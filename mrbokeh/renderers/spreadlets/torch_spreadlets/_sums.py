"""`mrbokeh.renderers.spreadlets.sums.add_light` on a device: the CPU's tables and pictures go over, the sums come back."""

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from jaxtyping import Float32, Int32

from mrbokeh.renderers.kernels.laplacian_tables import Points
from mrbokeh.renderers.spreadlets.layout import window_of
from mrbokeh.renderers.spreadlets.torch_spreadlets._integration import integrate
from mrbokeh.renderers.spreadlets.torch_spreadlets._points import table_of
from mrbokeh.renderers.spreadlets.torch_spreadlets._splat import splat
from mrbokeh.system.errors import InputError
from mrbokeh.system.torch_device import device_named


def add_light_on(device: str) -> Callable[..., None]:
    """What stands in for `add_light`: same arguments, same windows, and the same result to rounding."""
    return partial(_add_light, device_named(device))


def _add_light(
    device: torch.device,
    out: Float32[np.ndarray, "height width channels"],
    values: Float32[np.ndarray, "height width channels"],
    cells: Int32[np.ndarray, "height width"],
    points: Points,
    integration: str | None,
    threads: int = 0,  # noqa: ARG001
) -> None:
    if integration == "pyramid":
        raise InputError("on a device a Laplacian is integrated by 'exact', got 'pyramid': leave it out, or leave out the device")
    window = window_of(cells, points.reach_px, integration is not None)
    light, where = torch.from_numpy(np.ascontiguousarray(values)).to(device), torch.from_numpy(cells).to(device)
    sums = splat(light, where, table_of(points, device), window, float(np.abs(values).max()))
    if integration is not None:
        sums = integrate(sums)
    height, width, _ = out.shape
    y0, x0 = max(0, window.top), max(0, window.left)
    y1, x1 = min(height, window.top + window.height), min(width, window.left + window.width)
    inside = sums[:, y0 - window.top : y1 - window.top, x0 - window.left : x1 - window.left]
    out[y0:y1, x0:x1] += inside.permute(1, 2, 0).float().cpu().numpy()

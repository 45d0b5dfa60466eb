"""Layers for a bank of kernels: where a pixel lies in the frame and how far away travels along as extra channels of its light."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float32

from mrbokeh.aperture import Aperture
from mrbokeh.errors import InputError
from mrbokeh.layer import Layer
from mrbokeh.lens import Lens
from mrbokeh.psf_bank import PsfBank
from mrbokeh.renderers._laplacian_bank import Place

_PLACE = "place of a kernel"
_LEAST_DIAMETER_PX = 2.0


def with_places(layers: Sequence[Layer], bank: PsfBank) -> tuple[list[Layer], Callable[[np.ndarray, np.ndarray], Place]]:
    """Layers with field position and 1 / depth as extra channels, and what reads a `Place` from light and circles of confusion.

    Extra channels are spread with coverage, so their ratio to it is the pixel's own, whatever slice it went into.
    """
    names = {axis.name for axis in bank.axes}
    if "motion_px" in names or bank.turns == "motion":
        raise InputError(
            f"the bank '{bank.model}' has kernels for motion, which layers are not rendered with: their motion is drawn out before "
            f"they are blurred; use a bank without motion, or spread_bank"
        )
    placed = [replace(layer, extra={**layer.extra, _PLACE: _place(layer)}) for layer in layers]

    def place_of(values: np.ndarray, coc_px: np.ndarray) -> Place:  # noqa: ARG001
        coverage = values[..., 3:4]
        own = np.divide(values[..., -3:], coverage, out=np.zeros((*coverage.shape[:2], 3), np.float32), where=coverage > 0)
        with np.errstate(divide="ignore"):
            depth_m = np.where(own[..., 2] > 0, 1.0 / own[..., 2], np.inf)
        return Place(None, own[..., :2], depth_m)

    return placed, place_of


def without_places(result: Layer, layers: Sequence[Layer]) -> Layer:
    """The result with the extra channels that the layers had."""
    return replace(result, extra={name: result.extra[name] for name in layers[0].extra})


def bank_lens(lens: Lens, bank: PsfBank, width_px: int) -> Lens:
    """The lens with a round opening that reaches as far as the bank's kernels, for windows and margins of the layering.

    Kernels of less than 2 px of blur do not count: what they spread farther than the others do at their size, as a
    scattering medium does in focus, may be cut off at the border of a slice.
    """
    widest = 1.0
    for kernel, box in zip(bank.kernels, bank.boxes, strict=True):
        for axis, ends in zip(bank.axes, box, strict=True):
            if axis.name in ("diameter_px", "depth_m"):
                diameters_px = np.abs(lens.coc_px(ends, width_px) if axis.name == "depth_m" else ends)
                if diameters_px.min() >= _LEAST_DIAMETER_PX:
                    widest = max(widest, (kernel.shape[0] // 2 + 1.0) / (0.5 * float(diameters_px.min())))
    return replace(lens, aperture=Aperture(tuple(widest * outline for outline in Aperture.disc().outlines), (1.0,)))


def _place(layer: Layer) -> Float32[np.ndarray, "height width 3"]:
    rows, columns = np.indices(layer.alpha.shape) + 0.5
    half_diagonal_px = 0.5 * np.hypot(layer.width_px, layer.height_px)
    x, y = (columns - 0.5 * layer.width_px) / half_diagonal_px, (rows - 0.5 * layer.height_px) / half_diagonal_px
    with np.errstate(divide="ignore"):
        dioptres = np.where(layer.alpha > 0, 1.0 / layer.depth_m, 0.0)
    return (np.stack([x, y, dioptres], axis=2) * layer.alpha[..., None]).astype(np.float32)

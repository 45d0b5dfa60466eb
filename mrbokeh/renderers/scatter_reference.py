"""Exact reference that the fast renderers are tested against: every pixel throws its light over its own exact PSF.

Slow and obvious: no kernel is rounded, one is drawn again wherever the diameter is another; everything is summed in float64.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from os import cpu_count

import numpy as np
from jaxtyping import Float, Float32, Float64

from mrbokeh.images.layer import Layer
from mrbokeh.layering.layering import Layering, render_layers
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.psf import kernel_radius_px
from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.renderers.bank.renderers import BankRenderer, by_scatter
from mrbokeh.system.errors import InputError

_BAND_PX = 64  # rows that are summed by themselves; fixed, so that the sum does not depend on the number of threads


@dataclass(frozen=True)
class ScatterReference:
    """Renderer that sums exact kernels; layers, slices and hidden background as in mrbokeh.layering.layering.

    threads: 0 takes all cores. bank: kernels to use instead of the lens's aperture, each pixel's blended from the bank's kernels around it
    (bilinearly over the frame, linearly over the diameter).
    """

    layering: Layering = field(default_factory=Layering)
    threads: int = 0
    bank: PsfBank | None = None

    def render(self, layers: Sequence[Layer], lens: Lens) -> Layer:
        if self._of_bank is None or not layers:
            return render_layers(layers, lens, self.sum_kernels, self.layering)
        return self._of_bank.render(layers, lens, self.layering)

    @cached_property
    def _of_bank(self) -> BankRenderer | None:
        return None if self.bank is None else by_scatter(self.bank)

    def sum_kernels(
        self, values: Float32[np.ndarray, "height width channels"], coc_px: Float32[np.ndarray, "height width"], aperture: Aperture
    ) -> Float32[np.ndarray, "height width channels"]:
        """Sum kernels as mrbokeh.layering.psf_over_field.KernelSum says."""
        return scatter(values.astype(np.float64), coc_px, aperture, self.threads).astype(np.float32)


def blur_layer(layer: Layer, coc_px: Float[np.ndarray, "height width"], aperture: Aperture) -> Layer:
    """Blur one layer by one PSF per pixel and nothing else: the light of all pixels adds up, whatever their depth.

    Coverage that sums to more than 1 is divided by that sum, and colour with it; light that leaves the frame is lost.
    """
    spread = scatter(np.dstack([layer.rgb, layer.alpha]).astype(np.float64), coc_px, aperture)
    spread /= np.maximum(spread[..., 3:], 1.0)
    return Layer(spread[..., :3].astype(np.float32), spread[..., 3].astype(np.float32), layer.depth_m)


def scatter(
    values: Float64[np.ndarray, "height width channels"],
    coc_px: Float[np.ndarray, "height width"],
    aperture: Aperture,
    threads: int = 0,
) -> Float64[np.ndarray, "height width channels"]:
    """Return the sum over all pixels of value times PSF; a pixel whose values are all 0 adds nothing, whatever its circle of confusion."""
    diameters_px = np.where(np.any(values != 0, axis=-1), coc_px, 0.0).astype(np.float64)
    if not np.isfinite(diameters_px).all():
        raise InputError("every visible pixel needs a finite circle of confusion: depth must be positive (or inf), not 0 or NaN")
    margin_px = kernel_radius_px(float(np.abs(diameters_px).max(initial=0.0)), aperture.unit_radius)
    height, width, channels = values.shape
    padded = np.zeros((height + 2 * margin_px, width + 2 * margin_px, channels))
    with ThreadPoolExecutor(threads or cpu_count() or 1) as pool:
        bands = pool.map(lambda top: _band(values, diameters_px, top, aperture), range(0, height, _BAND_PX))
        for top, (band, reach_px) in zip(range(0, height, _BAND_PX), bands, strict=True):
            side = margin_px - reach_px
            padded[top + side : top + side + band.shape[0], side : side + band.shape[1]] += band
    return padded[margin_px : margin_px + height, margin_px : margin_px + width].copy()


def _band(values: np.ndarray, diameters_px: np.ndarray, top: int, aperture: Aperture) -> tuple[np.ndarray, int]:
    """Return the light of a band of rows with the margin it reaches, and that margin."""
    from mrbokeh.renderers.bank._scatter_numba import scatter_rows

    rows = slice(top, top + _BAND_PX)
    reach_px = kernel_radius_px(float(np.abs(diameters_px[rows]).max(initial=0.0)), aperture.unit_radius)
    height, width, channels = values[rows].shape
    padded = np.zeros((height + 2 * reach_px, width + 2 * reach_px, channels))
    scatter_rows(padded, values[rows], diameters_px[rows], reach_px, aperture.unit_radius, *aperture.packed())
    return padded, reach_px

"""The truth that the fast renderers are tested against: every pixel throws its light over its own exact PSF.

Slow and obvious: no kernel is rounded, cached or shared; everything is summed in float64.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from mrbokeh.aperture import Aperture
from mrbokeh.errors import InputError
from mrbokeh.layer import Layer, flatten
from mrbokeh.lens import Lens
from mrbokeh.psf import kernel_radius_px


@dataclass(frozen=True)
class ScatterReference:
    """A Renderer: within a layer the spread light of all pixels adds up, between layers "over" decides.

    Where pixels of one layer but of different depth spread over one another their coverage can sum to more than 1;
    it is then divided by that sum, so that an opaque layer never becomes more than opaque. Light spread beyond the
    border is lost: pad the layers where what lies outside matters.
    """

    def render(self, layers: Sequence[Layer], lens: Lens) -> Layer:
        return flatten([blur_layer(layer, lens.coc_px(layer.depth_m, layer.width_px), lens.aperture) for layer in layers])


def blur_layer(layer: Layer, coc_px: Float[np.ndarray, "height width"], aperture: Aperture) -> Layer:
    """One layer through one PSF per pixel; coc_px (H, W) is the signed diameter of each pixel's blur."""
    spread = scatter(np.dstack([layer.rgb, layer.alpha]).astype(np.float64), coc_px, aperture)
    spread /= np.maximum(spread[..., 3:], 1.0)
    return Layer(spread[..., :3].astype(np.float32), spread[..., 3].astype(np.float32), layer.depth_m)


def scatter(
    values: Float64[np.ndarray, "height width channels"], coc_px: Float[np.ndarray, "height width"], aperture: Aperture
) -> Float64[np.ndarray, "height width channels"]:
    """Sum over all pixels of value times PSF; a pixel without any value has no say, whatever its circle of confusion."""
    from mrbokeh.renderers._scatter_reference_numba import scatter_pixels

    diameters_px = np.where(np.any(values != 0, axis=-1), coc_px, 0.0).astype(np.float64)
    if not np.isfinite(diameters_px).all():
        raise InputError("every visible pixel needs a finite circle of confusion: depth must be positive (or inf), not 0 or NaN")
    largest_px = float(np.abs(diameters_px).max(initial=0.0))
    radius_px = kernel_radius_px(largest_px, aperture.unit_radius)
    return scatter_pixels(values, diameters_px, radius_px, aperture.unit_radius, *aperture.packed())

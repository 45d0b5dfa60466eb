"""Whole pictures blurred by the reference renderer, at circles of confusion that are given."""

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.layer import opaque
from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.scatter_reference import blur_layer


def scatter_reference(
    rgb: Float32[np.ndarray, "height width 3"],
    coc_px: Float32[np.ndarray, "height width"],
    aperture: Aperture,
) -> Float32[np.ndarray, "height width 3"]:
    """Run the reference renderer with the aperture of the lens, as one opaque layer, at exactly these circles of confusion.

    The picture is extended beyond its border, from where light enters it.
    """
    margin = int(np.ceil(np.abs(coc_px).max(initial=0.0) / 2.0)) + 1
    around = ((margin, margin), (margin, margin))
    wide = opaque(np.pad(rgb, (*around, (0, 0)), mode="edge"), np.ones(np.array(coc_px.shape) + 2 * margin, np.float32))
    blurred = blur_layer(wide, np.pad(coc_px, around, mode="edge"), aperture)
    inside = np.s_[margin:-margin, margin:-margin]
    return (blurred.rgb[inside] / np.maximum(blurred.alpha[inside], 1e-6)[..., None]).astype(np.float32)

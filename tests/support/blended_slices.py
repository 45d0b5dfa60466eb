"""Slices blended by a focus index in one go: what `sharp_all_in_focus` begins with, for tests."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float32

from capture.merging.all_in_focus import BANDS, NARROW_CROSSOVER, BandBlend, slice_weight

Rgb = Float32[np.ndarray, "height width 3"]


def all_in_focus(
    registered: Iterable[Rgb], focus_index: Float32[np.ndarray, "height width"], crossover: float = NARROW_CROSSOVER, bands: int = BANDS
) -> Rgb:
    """Blend registered slices by `slice_weight`, read one at a time; bands: 0 mixes pixels, without regard to seams."""
    blend = BandBlend(focus_index.shape, bands)
    for index, rgb in enumerate(registered):
        blend.add(rgb, slice_weight(focus_index, index, crossover))
    return blend.result()

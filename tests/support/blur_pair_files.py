"""Files of blur pairs, as others measure them."""

import numpy as np

from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.lens_measuring.fitting.blur_pairs import BLURRED, COC, SHARP, BlurPair


def write_blur_pair(pair: BlurPair) -> None:
    """Write both files into the pair's folder, in float32."""
    pair.folder.mkdir(parents=True, exist_ok=True)
    planes = {name: np.ascontiguousarray(pair.sharp[..., i]) for i, name in enumerate("RGB")}
    write_exr(pair.folder / SHARP, ExrPart(planes | {COC: pair.coc_px}))
    write_exr(pair.folder / BLURRED, ExrPart({name: np.ascontiguousarray(pair.blurred[..., i]) for i, name in enumerate("RGB")}))

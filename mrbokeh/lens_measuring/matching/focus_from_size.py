"""Where a lens is focused, or how wide it is open, from the size of blurred points: `optics.lens.Lens.coc_px` solved the other way."""

import numpy as np

from mrbokeh.optics.lens import MM_PER_M, Lens
from mrbokeh.system.errors import InputError


def focus_from_size(lens: Lens, coc_px: float, depth_m: float, image_width_px: int) -> float:
    """The focus distance at which a point at `depth_m` (inf is allowed) blurs to the signed diameter `coc_px`.

    With A the opening's diameter and c the blur's, both in the same unit, c = A f (1/s - 1/d) / (1 - f/s), so that
    1/s = (c + A f / d) / (f (A + c)). lens: its own focus distance does not matter.
    """
    focal_m, opening_m = lens.focal_length_mm / MM_PER_M, lens.aperture_diameter_mm / MM_PER_M
    blur_m = coc_px * lens.sensor_width_mm / MM_PER_M / image_width_px
    dioptres = (blur_m + opening_m * focal_m / depth_m) / (focal_m * (opening_m + blur_m))
    if opening_m + blur_m <= 0.0 or not 0.0 <= dioptres < 1.0 / focal_m:
        raise InputError(
            f"no focus {'nearer' if coc_px > 0 else 'farther'} than points at {depth_m:g} m blurs them to {abs(coc_px):.1f} px "
            f"with this lens: check --depth-m, --side and the f-number"
        )
    return 1.0 / dioptres if dioptres > 0.0 else float(np.inf)


def effective_f_number(lens: Lens, coc_px: float, depth_m: float, image_width_px: int) -> float:
    """The f-number that gives blur of this size at a depth; blur is as large as the opening, which is the focal length over it."""
    expected_px = float(lens.coc_px(depth_m, image_width_px))
    if expected_px * coc_px <= 0.0:
        raise InputError(
            f"lights at {depth_m:g} m are {'behind' if expected_px > 0 else 'in front of'} a focus at {lens.focus_distance_m:g} m, but "
            f"discs of the other side were asked for: check --depth-m, --focus and --side"
        )
    return lens.f_number * expected_px / coc_px


def depth_from_size(lens: Lens, coc_px: float, image_width_px: int) -> float:
    """The depth at which points blur to a signed diameter, infinite or negative beyond infinity."""
    dioptres = 1.0 / lens.focus_distance_m - coc_px / lens.coc_px_per_dioptre(image_width_px)
    return 1.0 / dioptres if dioptres != 0.0 else float(np.inf)

"""PhonePhoto: what a phone keeps in its photograph beside the picture; PhoneFocus: where it was focused and how it was blurred."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from mrbokeh.depth.depth_map import DepthMap


@dataclass(frozen=True)
class PhoneFocus:
    """Focus of a phone's photograph, as GFocus states it or guessed.

    focus_distance_m: in the unit of the depth. blur_at_infinity: RADIUS of the blur at infinity over the longer side of the picture; None
    if the phone put none on. f_number: at which full frame has that blur, if the file tells. note, blur_note: what of the focus and of the
    blur is guessed, for people.
    """

    focus_distance_m: float
    blur_at_infinity: float | None
    note: str = ""
    blur_note: str = ""
    f_number: float | None = None

    def coc_px_per_dioptre(self, width_px: int, height_px: int) -> float:
        """Return c_inf d_f, by which coc = c_inf (1 - d_f / d) grows for each dioptre away from the focus. Only where the phone blurred."""
        assert self.blur_at_infinity is not None
        return 2.0 * self.blur_at_infinity * max(width_px, height_px) * self.focus_distance_m


@dataclass(frozen=True)
class PhonePhoto:
    """Contents of a phone's photograph, upright as its Exif says.

    depth: at its own size. original_rgb: (H, W, 3) linear, before the phone's own blur, or None. focus: None if not stated.
    has_unit: False where the depth is up to scale, taken for metres.
    """

    depth: DepthMap
    original_rgb: Float32[np.ndarray, "height width 3"] | None
    focus: PhoneFocus | None
    has_unit: bool = True

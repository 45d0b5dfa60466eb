"""Glass: refractive index by wavelength, and an estimate of its dispersion where a prescription has one index only."""

import numpy as np
from jaxtyping import Float

from mrbokeh.errors import InputError

# Fraunhofer lines in micrometres; n_d is the index a prescription states, V = (n_d - 1) / (n_F - n_C) the Abbe number.
LINE_C_UM, LINE_D_UM, LINE_F_UM = 0.65627, 0.58756, 0.48613

# (n_d, V) of glasses of the Schott catalogue along the two edges of the Abbe diagram. Upper edge: FK5, BK7, SK5, SK16,
# LAK22, LAK9, LAK34, LASF44, LASF31A. Lower edge: FK5, BK7, KF9, LLF1, LF5, F2, SF2, SF5, SF15, SF10, SF11, SF6, SF57.
_CROWNS = (
    (1.48749, 70.41), (1.51680, 64.17), (1.58913, 61.27), (1.62041, 60.32), (1.65113, 55.89),
    (1.69100, 54.71), (1.72916, 54.50), (1.80420, 46.50), (1.88300, 40.76),
)  # fmt: skip
_FLINTS = (
    (1.48749, 70.41), (1.51680, 64.17), (1.52346, 51.54), (1.54814, 45.75), (1.58144, 40.85), (1.62004, 36.37), (1.64769, 33.85),
    (1.67270, 32.21), (1.69895, 30.07), (1.72825, 28.41), (1.78472, 25.76), (1.80518, 25.43), (1.84666, 23.83),
)  # fmt: skip


def estimated_abbe_number(index: float, is_positive: bool) -> float:
    """The Abbe number of a glass of which only n_d is known, from the sign of its element's power.

    Lenses are freed from colour by collecting elements of low and diverging elements of high dispersion (Kingslake and
    Johnson, Lens Design Fundamentals, 2010, chapter 5), so the glass of a positive element is taken from the upper (crown)
    edge of the Abbe diagram of the Schott catalogue at its index and that of a negative one from the lower (flint) edge,
    linear between catalogue glasses and constant beyond them.
    """
    indices, abbe_numbers = zip(*(_CROWNS if is_positive else _FLINTS), strict=True)
    return float(np.interp(index, indices, abbe_numbers))


def cauchy_coefficients(index: float, abbe_number: float) -> tuple[float, float]:
    """(A, B in um^2) of n(wavelength) = A + B / wavelength^2 through n_d and V; B is 0 for an infinite V (air)."""
    if not (index >= 1.0 and abbe_number > 0.0):
        raise InputError(f"expected a refractive index of at least 1 and a positive Abbe number, got {index:g} and {abbe_number:g}")
    slope_um2 = (index - 1.0) / (abbe_number * (LINE_F_UM**-2 - LINE_C_UM**-2))
    return index - slope_um2 / LINE_D_UM**2, slope_um2


def index_at(index: float, abbe_number: float, wavelength_um: Float[np.ndarray, "*batch"] | float) -> Float[np.ndarray, "*batch"]:
    """Refractive index at wavelengths in micrometres, by Cauchy's formula with two terms."""
    constant, slope_um2 = cauchy_coefficients(index, abbe_number)
    return np.asarray(constant + slope_um2 / np.square(wavelength_um))

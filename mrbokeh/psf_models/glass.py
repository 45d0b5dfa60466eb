"""Glass: refractive index by wavelength, and an estimate of its dispersion where a prescription has one index only.

Where the numbers come from. Indices n_d and Abbe numbers of catalogue glasses: Schott's catalogue, checked against its indices
at the C and F lines (tests/psf_models/test_lens_prescription.py). Cauchy's two terms through n_d and V meet those to 1e-4 for V above 40
and to 5e-4 for the densest flints. Indices of a lens: its table. Abbe numbers of a lens: its table, where it has them.

Where it has none, which is so of the published double Gauss, wide-angle and fisheye: an estimate. Of the double Gauss
(Tronnier, US 2,673,491) the Abbe numbers are known from Kolb et al. 1995: 47.1, 47.1, 30.1, 38.0, 57.3, 48.0. From the
edges of the Abbe diagram alone they come out as 55.3, 55.3, 30.1, 38.3, 55.7, 54.6, and blue is focused 0.22 mm behind red,
when it is 0.07 mm in front of it. With the edges mixed until blue and red meet
(`mrbokeh.psf_models.lens_prescription_file`) they are 53.0, 53.0, 30.9, 39.2, 53.5, 51.8. Red and blue kernels at f/2, focused
at 2 m, then differ from those of the known glass by 2 to 3 % of their light at 0.7 m (edges alone: 10 to 21 %) and by 17 to 25 %
at 20 m (63 to 95 %). No published numbers were found for the other two lenses.
"""

import numpy as np
from jaxtyping import Float

from mrbokeh.system.errors import InputError

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


def estimated_abbe_number(index: float, is_positive: bool, mix: float = 0.0) -> float:
    """The Abbe number of a glass of which only n_d is known, from the sign of its element's power.

    Lenses are freed from colour by collecting elements of low and diverging elements of high dispersion (Kingslake and
    Johnson, Lens Design Fundamentals, 2010, chapter 5), so the glass of a positive element is taken from the upper (crown)
    edge of the Abbe diagram of the Schott catalogue at its index and that of a negative one from the lower (flint) edge,
    linear between catalogue glasses and constant beyond them. mix: 0 to 1, how far from its own edge towards the other one
    the dispersion lies.
    """
    crown, flint = (float(np.interp(index, edge[:, 0], edge[:, 1])) for edge in map(np.array, (_CROWNS, _FLINTS)))
    own, other = (crown, flint) if is_positive else (flint, crown)
    return 1.0 / ((1.0 - mix) / own + mix / other)


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

"""The simplest lens: two equal surfaces of one glass."""

from math import sqrt

from mrbokeh.psf_models.lens_prescription import LensPrescription, Surface
from mrbokeh.system.errors import InputError


def biconvex_lens(
    focal_length_mm: float = 50.0, f_number: float = 4.0, edge_mm: float = 1.0, index: float = 1.5168, abbe_number: float = 64.17
) -> LensPrescription:
    """The simple bi-convex spherical lens of Leimkuehler et al. 2018: two equal radii, by default of BK7, no iris but its rims.

    The paper states no numbers. Radius R and thickness t follow from the thick lensmaker's formula
    1/f = (n - 1)(2/R - (n - 1) t / (n R^2)) with t just leaving `edge_mm` at the rim.
    """
    semi_mm, thickness_mm, radius_mm = 0.5 * focal_length_mm / f_number, 0.0, 0.0
    for _ in range(50):
        if thickness_mm >= index * focal_length_mm or radius_mm < 0.0:
            break
        radius_mm = focal_length_mm * (index - 1.0) * (1.0 + sqrt(1.0 - thickness_mm / (index * focal_length_mm)))
        if radius_mm <= semi_mm:
            raise InputError(f"one bi-convex lens of index {index:g} cannot have f/{f_number:g}: choose a larger f-number")
        thickness_mm = edge_mm + 2.0 * (radius_mm - sqrt(radius_mm**2 - semi_mm**2))
    front = Surface(radius_mm, thickness_mm, index, 2.0 * semi_mm, abbe_number)
    return LensPrescription("biconvex", (front, Surface(-radius_mm, 0.0, 1.0, 2.0 * semi_mm)))

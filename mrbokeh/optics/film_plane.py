"""Focus distances as cameras state them, from the film plane, counted from the lens."""

import math

from mrbokeh.optics.lens import MM_PER_M, Lens


def lens_distance_m(film_plane_m: float, focal_length_mm: float, hiatus_mm: float = 0.0) -> float | None:
    """The distance d_f from the front principal plane for a distance D = d_f + h + d_s from the film plane, d_s = f d_f / (d_f - f).

    h is the hiatus, the distance between the principal planes (0 for a thin lens). d_f is the far root of
    d_f^2 - (D - h) d_f + (D - h) f = 0. None below D = 4 f + h, which no lens of that focal length reaches.
    """
    if math.isinf(film_plane_m):
        return film_plane_m
    focal_m, conjugates_m = focal_length_mm / MM_PER_M, film_plane_m - hiatus_mm / MM_PER_M
    discriminant = conjugates_m * (conjugates_m - 4.0 * focal_m)
    return 0.5 * (conjugates_m + math.sqrt(discriminant)) if conjugates_m > 0.0 and discriminant >= 0.0 else None


def film_plane_m(lens: Lens) -> float:
    """Focus distance as a camera's scale and metadata count it: d_f + d_s, the principal planes of a thin lens being one."""
    return lens.focus_distance_m + lens.image_distance_mm / MM_PER_M

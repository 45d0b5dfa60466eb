"""Lens prescriptions read from the tables in which lens designs are published, and the simplest one by formula."""

from dataclasses import replace
from math import inf, sqrt
from pathlib import Path

import numpy as np

from mrbokeh.psf_models.lens_prescription import LensPrescription, Surface, estimated_abbe_number
from mrbokeh.system.errors import InputError


def biconvex_lens(
    focal_length_mm: float = 50.0, f_number: float = 4.0, edge_mm: float = 1.0, index: float = 1.5168, abbe_number: float = 64.17
) -> LensPrescription:
    """Return the bi-convex spherical lens of Leimkuehler et al. 2018: two equal radii, by default of BK7, no iris but its rims.

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
    front = Surface(radius_mm=radius_mm, distance_mm=thickness_mm, index=index, diameter_mm=2.0 * semi_mm, abbe_number=abbe_number)
    return LensPrescription("biconvex", (front, Surface(-radius_mm, 0.0, 1.0, 2.0 * semi_mm)))


_COLUMNS = "radius, distance to the next surface, index behind it, [Abbe number,] aperture diameter, in mm"
_HALVINGS = 30


def read_prescription(path: Path | str) -> LensPrescription:
    """Read a table of surfaces from the scene to the sensor, one per line, `#` begins a comment.

    Columns, in mm: radius (0: the stop; inf: flat), distance to the next surface, index n_d behind it (0: as before),
    aperture diameter; with five columns the Abbe number stands before the aperture (the order of Kolb et al. 1995).
    Where it is missing it is estimated (mrbokeh.psf_models.lens_prescription). InputError names the line that is not understood.
    """
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"expected a table of lens surfaces ({_COLUMNS}) at {path}, but it cannot be read: {error}") from None
    rows = [(number, line.split("#")[0].split()) for number, line in enumerate(lines, 1)]
    rows = [(number, words) for number, words in rows if words]
    surfaces: list[Surface] = []
    for number, words in rows:
        try:
            surfaces.append(_surface(words, surfaces[-1].index if surfaces else 1.0, surfaces[-1].abbe_number if surfaces else inf))
        except InputError as error:
            raise InputError(f"{path}, line {number}: {error}") from None
    return with_estimated_abbe_numbers(LensPrescription(path.stem, tuple(surfaces)))


def _surface(words: list[str], index_before: float, abbe_before: float) -> Surface:
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        raise InputError(f"expected numbers ({_COLUMNS}), got {' '.join(words)!r}") from None
    if len(numbers) not in (4, 5) or any(np.isnan(numbers)):
        raise InputError(f"expected 4 or 5 numbers ({_COLUMNS}), got {' '.join(words)!r}")
    radius_mm, distance_mm, index, diameter_mm = (*numbers[:3], numbers[-1])
    is_stop = radius_mm == 0.0 and index in (0.0, index_before)
    if radius_mm == 0.0 and not is_stop:
        raise InputError(f"a radius of 0 is the stop and cannot change the index to {index:g}: write a flat surface as inf")
    abbe = numbers[3] if len(numbers) == 5 and index not in (0.0, 1.0) else inf
    if index == 0.0:
        index, abbe = index_before, abbe_before
    return Surface(
        radius_mm=inf if is_stop else radius_mm,
        distance_mm=distance_mm,
        index=index,
        diameter_mm=diameter_mm,
        abbe_number=abbe,
        is_stop=is_stop,
    )


def with_estimated_abbe_numbers(lens: LensPrescription) -> LensPrescription:
    """Give glass (index above 1.01) without an Abbe number one by its index and the power (n - 1)(1/R1 - 1/R2) of its element.

    Designers bring blue and red to one focus. If glass from the edges of the Abbe diagram would do more than that, all
    estimates are moved from their edge towards the other one until no axial colour is left (`estimated_abbe_number`'s mix).
    Half way every index has one Abbe number, as for a single lens, which has too little correction: the solution lies before.
    """
    unknown = {i: _is_positive(lens.surfaces, i) for i, each in enumerate(lens.surfaces) if each.index > 1.01 and each.abbe_number == inf}

    def mixed(mix: float) -> LensPrescription:
        surfaces = list(lens.surfaces)
        for i, is_positive in unknown.items():
            surfaces[i] = replace(surfaces[i], abbe_number=estimated_abbe_number(surfaces[i].index, is_positive, mix))
        return replace(lens, surfaces=tuple(surfaces))

    low, high = 0.0, 0.5
    if not unknown or mixed(low).axial_colour_mm >= 0.0:
        return mixed(low)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if mixed(middle).axial_colour_mm >= 0.0 else (middle, high)
    return mixed(high)


def _is_positive(surfaces: tuple[Surface, ...], i: int) -> bool:
    """Return whether the element that begins at surface i collects light."""
    front = next((before for before in surfaces[i::-1] if not before.is_stop), surfaces[i])
    back = next((behind for behind in surfaces[i + 1 :] if not behind.is_stop), surfaces[i])
    return front.curvature_per_mm >= back.curvature_per_mm

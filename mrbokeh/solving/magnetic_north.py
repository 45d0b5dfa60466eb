"""Magnetic north: how far east of true north a compass needle points.

The field of the Earth's core of 2020 by IGRF-14 (IAGA 2024, doi 10.5281/zenodo.14012302) up to degree 4, on a sphere. Between 45 degrees
south and 65 north that is off the whole model by 0.9 degrees in the median, and by less than 3.2 in 95 of 100 places; the field turns by
0.1 to 0.2 degrees a year.
"""

import math

_COEFFICIENTS_NT = {
    (1, 0): (-29403.41, 0.0),
    (1, 1): (-1451.37, 4653.35),
    (2, 0): (-2499.78, 0.0),
    (2, 1): (2981.96, -2991.72),
    (2, 2): (1676.85, -734.62),
    (3, 0): (1363.00, 0.0),
    (3, 1): (-2380.80, -81.96),
    (3, 2): (1236.06, 241.80),
    (3, 3): (525.60, -542.52),
    (4, 0): (902.82, 0.0),
    (4, 1): (809.47, 282.10),
    (4, 2): (86.18, -158.50),
    (4, 3): (-309.47, 199.75),
    (4, 4): (47.44, -350.30),
}
"""Degree and order to g and h, Schmidt semi-normalised."""
_DEGREES, _STEP_RAD = 4, 1e-4


def declination_deg(latitude_deg: float, longitude_deg: float) -> float:
    """Return how many degrees east of true north magnetic north lies at a place; west is negative."""
    latitude, longitude = math.radians(min(max(latitude_deg, -89.0), 89.0)), math.radians(longitude_deg)
    north = _potential(latitude - _STEP_RAD, longitude) - _potential(latitude + _STEP_RAD, longitude)
    east = _potential(latitude, longitude - _STEP_RAD) - _potential(latitude, longitude + _STEP_RAD)
    return math.degrees(math.atan2(east / math.cos(latitude), north))


def _potential(latitude_rad: float, longitude_rad: float) -> float:
    """Return the potential of the field on the surface, in nanotesla times the Earth's radius."""
    legendre = _legendre(latitude_rad)
    waves = {order: (math.cos(order * longitude_rad), math.sin(order * longitude_rad)) for order in range(_DEGREES + 1)}
    return sum(
        legendre[degree, order] * (g * waves[order][0] + h * waves[order][1]) for (degree, order), (g, h) in _COEFFICIENTS_NT.items()
    )


def _legendre(latitude_rad: float) -> dict[tuple[int, int], float]:
    """Return Schmidt's semi-normalised Legendre functions of the sine of the latitude by degree and order, by their recurrences."""
    sine, cosine = math.sin(latitude_rad), math.cos(latitude_rad)
    values = {(0, 0): 1.0}
    for order in range(_DEGREES + 1):
        if order:
            values[order, order] = cosine * values[order - 1, order - 1] * (math.sqrt(1.0 - 0.5 / order) if order > 1 else 1.0)
        for degree in range(order + 1, _DEGREES + 1):
            before = math.sqrt((degree - 1) ** 2 - order**2) * values.get((degree - 2, order), 0.0) if degree > order + 1 else 0.0
            values[degree, order] = ((2 * degree - 1) * sine * values[degree - 1, order] - before) / math.sqrt(degree**2 - order**2)
    return values

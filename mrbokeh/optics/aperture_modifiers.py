"""What changes an opening with the place in the frame and the side of the focus, worked out on weighted polygons.

Where a modifier leaves an outline untouched, the very same array comes back. Boolean work is Shapely's.
"""

import math

import numpy as np

from mrbokeh.optics.aperture_shapes import Outline, WeightedOutlines, outlines_of, unit_disc

_ABERRATION_STEP = 1.0 / 8.0
_FEWEST_ZONES = 4
_RIM_TOLERANCE = 1e-3


def clipped(outline: Outline, clip: Outline, weight: float = 1.0) -> WeightedOutlines:
    """What of an outline lies within the convex outline `clip`, in as many parts as that leaves, each with `weight`."""
    from shapely import Polygon

    whole, window = Polygon(outline), Polygon(clip)
    if window.covers(whole):
        return (outline,), (weight,)
    if whole.covers(window):
        return (clip,), (weight,)
    return outlines_of(whole.intersection(window), weight)


def clipped_by_rim(opening: WeightedOutlines, centre_xy: tuple[float, float]) -> WeightedOutlines:
    """Cat-eye: the part of the opening that is seen through a round rim of radius 1 about `centre_xy`.

    Outlines that reach beyond the rim by less than its own polygon strays from a circle are left as they are.
    """
    centre = np.asarray(centre_xy)
    parts: list[WeightedOutlines] = []
    for outline, weight in zip(*opening, strict=True):
        untouched = float(np.hypot(*(outline - centre).T).max()) <= 1.0 + _RIM_TOLERANCE
        parts.append(((outline,), (weight,)) if untouched else clipped(outline, unit_disc() + centre, weight))
    return joined(parts)


def joined(parts: list[WeightedOutlines]) -> WeightedOutlines:
    return tuple(outline for part in parts for outline in part[0]), tuple(weight for part in parts for weight in part[1])


def radially_weighted(opening: WeightedOutlines, strength: float) -> WeightedOutlines:
    """Spherical aberration: light weighted by 1 + strength (2 rho^2 - 1), rho the distance from the centre of the pupil.

    strength: -1 (rim dark) to 1 (centre dark). The mean over the unit disc is 1, whatever the strength. The weight is
    constant within concentric zones of equal area and equals the formula in the middle of each (in rho^2); there are as
    many zones as keep a step within 1/8 of the mean, and no weight is negative. Written as a sum: the whole opening with
    the outermost zone's weight, corrected on the smaller and smaller discs inside it.
    """
    zones = max(_FEWEST_ZONES, math.ceil(2.0 * abs(strength) / _ABERRATION_STEP))
    parts: list[WeightedOutlines] = []
    for outline, weight in zip(*opening, strict=True):
        parts.append(((outline,), (weight * (1.0 + strength * (1.0 - 1.0 / zones)),)))
        discs = (math.sqrt(zone / zones) * unit_disc() for zone in range(1, zones))
        parts.extend(clipped(outline, disc, -weight * 2.0 * strength / zones) for disc in discs)
    return _without_repeats(joined(parts))


def _without_repeats(opening: WeightedOutlines) -> WeightedOutlines:
    """Equal outlines as one with the sum of their weights; the discs inside the hole of a ring cancel."""
    total: dict[bytes, tuple[Outline, float]] = {}
    for outline, weight in zip(*opening, strict=True):
        before = total.get(outline.tobytes(), (outline, 0.0))[1]
        total[outline.tobytes()] = (outline, before + weight)
    kept = [(outline, weight) for outline, weight in total.values() if abs(weight) > 1e-12]
    return tuple(outline for outline, _ in kept), tuple(weight for _, weight in kept)


def shifted(opening: WeightedOutlines, by_xy: tuple[float, float]) -> WeightedOutlines:
    return tuple(outline + np.asarray(by_xy) for outline in opening[0]), opening[1]

"""Which of two surfaces a pixel at an edge of depth belongs to, told by the photograph's colours, and what depth edges miss by that.

A pixel within a few of an edge is compared with pixels that lie surely on either side: those farther away, or in the middle of thin
things. The most alike of each side stands for it, because surfaces have textures. Neighbours of the same colour vote with it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.layering.highlights import find_highlights
from mrbokeh.system.resources import in_bands, workers

Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]
Picture = Float32[np.ndarray, "height width 3"]

SURE_PX = 2
"""How far a hard edge may be misplaced."""
_WINDOW_PX = 5
_PER_STEP, _NO_MATTER = np.float32(2.5e-5), np.float32(0.0)
"""What a pixel of distance, squared, adds to the square of a difference of colours."""
_VOTE_WEIGHT, _VOTES = np.float32(0.1), 4
_OUT_OF_REACH = np.float32(99.0)
_GREY, _WHITE, _LAMP = 0.25, np.float32(4.0), 0.8
_ROWS = 16
"""The least rows that are worth a thread."""


@dataclass(frozen=True)
class Sides:
    """Pixels near edges of a map whose values grow with nearness.

    other: the value of the nearest pixel of another surface, away_px: how far that is (99: out of reach). like: from 1, coloured as the
    own side, to -1, as the other; 0 where colours tell nothing.
    """

    other: Plane
    away_px: Plane
    like: Plane


@dataclass(frozen=True)
class Guide:
    """A photograph as a guide: the root of its light, single pixels of bright light, and all in or beside highlights, whose colour tells
    nothing.
    """

    root: Picture
    lamps: Mask
    lit: Mask

    @classmethod
    def of(cls, rgb: Picture) -> "Guide":
        lit, light = find_highlights(np.ascontiguousarray(rgb, np.float32)), np.clip(rgb, 0.0, None)
        scale = np.float32(_GREY / max(float(np.minimum(light, _WHITE).mean()), 1e-9))
        root = np.sqrt(np.minimum(light * scale, _WHITE)).astype(np.float32)
        return cls(root, lit & (root.max(axis=2) > _LAMP), grown(lit, 1))


def by_rows(pixels: int, rows: int, work: Callable[[int, int], object]) -> None:
    """Call work(top, bottom) for bands of rows, side by side where the picture is large."""
    with workers(pixels) as pool:
        in_bands(pool, rows, _ROWS, work)


def grown(mask: Mask, by_px: int) -> Mask:
    """Return a mask that holds all pixels up to so many beside those of the given one, corners included."""
    from cv2 import dilate

    return np.asarray(dilate(mask.astype(np.uint8), np.ones((2 * by_px + 1,) * 2, np.uint8)) > 0)


def highest(values: Plane, window_px: int) -> Plane:
    """Return the greatest value of the square window around each pixel."""
    from cv2 import dilate

    return np.asarray(dilate(values, np.ones((window_px, window_px), np.uint8)))


def lowest(values: Plane, window_px: int) -> Plane:
    """Return the least value of the square window around each pixel."""
    from cv2 import erode

    return np.asarray(erode(values, np.ones((window_px, window_px), np.uint8)))


def other_sides(values: Plane, jump: float, reach_px: int) -> tuple[Plane, Plane]:
    """Return the value of the nearest pixel of another surface, and how far that is."""
    from mrbokeh.depth._mended_depth_numba import other_side

    window_px = 2 * reach_px + 1
    uneven = highest(values, window_px) - lowest(values, window_px) > jump
    other, away_px = np.empty_like(values), np.empty_like(values)
    by_rows(values.size, len(values), lambda top, bottom: other_side(other, away_px, values, uneven, jump, reach_px, top, bottom))
    return other, away_px


def sides_of(values: Plane, guide: Guide, jump: float, reach_px: int) -> Sides:
    """Look at the pixels within reach of an edge."""
    from mrbokeh.depth._mended_depth_numba import likeness, mark_sure

    other, away_px = other_sides(values, jump, reach_px + 1)
    sure, like = np.empty(values.shape, bool), np.empty_like(values)
    by_rows(values.size, len(values), lambda top, bottom: mark_sure(sure, values, away_px, jump, SURE_PX, top, bottom))
    sure &= ~guide.lit
    seen_px = np.where(guide.lit | (away_px > reach_px), _OUT_OF_REACH, away_px)

    def look(top: int, bottom: int) -> None:
        likeness(like, guide.root, values, other, seen_px, sure, _WINDOW_PX, _PER_STEP, top, bottom)

    by_rows(values.size, len(values), look)
    return Sides(other, away_px, like)


def voted(values: Plane, sides: Sides, guide: Guide, may: Mask, stays: float | Plane) -> Plane:
    """Return the values after pixels that may have chosen their side. stays: what counts for the side that they are on."""
    from mrbokeh.depth._mended_depth_numba import vote

    like = (sides.like + stays).astype(np.float32)
    now, following = values, np.empty_like(values)
    for _ in range(_VOTES):

        def count(top: int, bottom: int, now: Plane = now, following: Plane = following) -> None:
            vote(following, now, guide.root, values, sides.other, like, may, _VOTE_WEIGHT, top, bottom)

        by_rows(values.size, len(values), count)
        now, following = following, np.empty_like(values) if now is values else now
    return now


_SETTLED_PX, _WIDER_BY, _NARROWED_STAYS = 2, 3, 0.05


def narrowed(values: Plane, guide: Guide, jump: float, trusted: Mask, reach_px: int) -> Plane:
    """Return the values with near things no wider than their colours are, where these are too wide by up to a reach.

    What lies two pixels beside such a thing is surely far; the thing itself is sure only farther inside, or in its middle. trusted: pixels
    whose value may stand for their surface.
    """
    from mrbokeh.depth._mended_depth_numba import likeness, mark_sure

    other, away_px = other_sides(values, jump, reach_px + 1)
    near, inside, like = values > other, np.empty(values.shape, bool), np.empty_like(values)
    by_rows(values.size, len(values), partial(mark_sure, inside, values, away_px, jump, reach_px))
    sure = np.where(near, inside, away_px > _SETTLED_PX) & trusted & ~guide.lit
    asked = near & (away_px <= reach_px) & ~guide.lit
    seen_px = np.where(asked, away_px, _OUT_OF_REACH)
    by_rows(
        values.size,
        len(values),
        partial(likeness, like, guide.root, values, other, seen_px, sure, reach_px + _WIDER_BY, _NO_MATTER),
    )
    may = asked & (like != 0.0)
    return voted(values, Sides(other, away_px, like), guide, may, _NARROWED_STAYS)


_RIM_PX = 1.5
_SAYS_OTHER = -0.3
_LEAST_SHARE, _LEAST_RATIO, _LEAST_RIM_PX = 0.15, 2.5, 60
_PULL, _ISLAND_PX = 0.1, 4


def moved_by_colour(values: Plane, guide: Guide, jump: float) -> tuple[Plane, str]:
    """Return the values with edges that are hard moved where colours say so, and how they were: "too narrow", "too wide" or "".

    Colours are right more often than not, so single pixels say nothing. Of edges in their place the pixels beside them say as often
    inwards as outwards that they belong to the other side; only where many say the same are edges moved, and only that way.
    """
    sides = sides_of(values, guide, jump, SURE_PX)
    near = values > sides.other
    asked = (sides.away_px < _RIM_PX) & (sides.like != 0.0)
    wrong = asked & (sides.like < _SAYS_OTHER)
    counts = [int(np.count_nonzero(asked & side)) for side in (near, ~near)]
    if min(counts) < _LEAST_RIM_PX:
        return values, ""
    inner, outer = (np.count_nonzero(wrong & side) / count for side, count in zip((near, ~near), counts, strict=True))
    for share, opposite, side, told in ((outer, inner, ~near, "too narrow"), (inner, outer, near, "too wide")):
        if share > _LEAST_SHARE and share > _LEAST_RATIO * opposite:
            now = voted(values, sides, guide, side & (sides.away_px <= SURE_PX) & ~guide.lamps, -_PULL)
            return _without_collars(now, guide, jump) if told == "too wide" else now, told
    return values, ""


def _without_collars(values: Plane, guide: Guide, jump: float) -> Plane:
    """Return the values with islands of depth around lamps in the air cut down to the lamps themselves."""
    from scipy.ndimage import distance_transform_edt, find_objects, label

    result, numbers = values.copy(), label(guide.lamps, np.ones((3, 3)))[0]
    for number, (rows, columns) in enumerate(find_objects(numbers), 1):
        where = tuple(slice(max(each.start - _ISLAND_PX, 0), each.stop + _ISLAND_PX) for each in (rows, columns))
        around, own = values[where], numbers[where] == number
        alike, _ = label(np.abs(around - around[own].max()) <= jump)
        island = alike == alike[own][np.argmax(around[own])]
        if not island.all() and not (_rim(island).any()):
            nearest = distance_transform_edt(island, return_distances=False, return_indices=True)
            result[where] = np.where(island & ~own, around[tuple(nearest)], result[where])
    return result


def _rim(mask: Mask) -> Bool[np.ndarray, " n"]:
    return np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])

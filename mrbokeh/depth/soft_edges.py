"""Soft edges of depth made hard: what a blur of known width did to a map is undone where the photograph has its edges.

Networks and phones give edges as ramps. Blurred by a lens, a ramp is a ghost surface between near and far, and a wire, or a lamp in the
air, that the ramp has swallowed lies too far away. How soft edges are they tell themselves: the rise at their middle over their jump. They
are steepened (Osher and Rudin, Feature-Oriented Image Enhancement Using Shock Filters, 1990), put where colours change (edge_votes),
and then surfaces are moved as wholes until the map, blurred as it was, is the one that came. Lamps are taken out first: they are single
pixels, seen in the photograph, and their own blur is known.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.depth.edge_votes import Guide, Mask, Plane, by_rows, grown, highest, lowest, sides_of, voted

LEAST_SOFT_PX, _MOST_SOFT_PX = 0.9, 4.0
_LEAST_CRESTS = 12
_AROUND_PX, _BESIDE_PX, _LEAST_STEEP, _EVEN, _LEVEL, _SLANTED = 17, 7.0, 0.08, 0.6, 0.35, 1.6
Places = Float[np.ndarray, " n"]
_ROUNDS, _MOVES = (1, 2), 2
_STAYS, _TAPS = 0.1, 1.5
_SPARE, _LEAST_SHARE = np.float32(1.4), np.float32(0.15)
_SETTLE_PX, _SETTLE_JUMPS = 7, 3.0


@dataclass(frozen=True)
class Softness:
    """How soft edges are: the standard deviation of the blur in pixels, and how far the middle of ramps lies from half of the jump.

    Both 0 where there are too few to tell.
    """

    sigma_px: float
    skewed: float


def softness(values: Plane, jump: float) -> Softness:
    """Measure the edges of a map; 0 where it has hardly any. A blurred step of height h is steepest by h / (sigma sqrt(2 pi)).

    Steps between two even sides tell, where there are some; thin things are blurred to less than they were.
    """
    right, down = np.zeros_like(values), np.zeros_like(values)
    right[:, :-1], down[:-1] = np.diff(values, axis=1), np.diff(values, axis=0)
    steep = np.hypot(right, down)
    high, low = highest(values, _AROUND_PX), lowest(values, _AROUND_PX)
    step = high - low
    crest = (step > jump) & (steep > _LEAST_STEEP * step) & (steep >= highest(steep, 7))
    crest &= (lowest(steep, _AROUND_PX) < _EVEN * steep) & (highest(high, _AROUND_PX) - lowest(low, _AROUND_PX) < _SLANTED * step)
    y, x = np.nonzero(crest)
    height, low, across, along = (each[y, x] for each in (step, low, right, down))
    steepest = steep[y, x]
    ends = [(y + way * along / steepest, x + way * across / steepest) for way in (_BESIDE_PX, -_BESIDE_PX)]
    even = (_at(values, *ends[0]) > low + 0.9 * height) & (_at(values, *ends[1]) < low + 0.1 * height)
    even &= np.maximum(_at(steep, *ends[0]), _at(steep, *ends[1])) < _LEVEL * steepest
    even |= np.count_nonzero(even) < _LEAST_CRESTS
    if np.count_nonzero(even) < _LEAST_CRESTS:
        return Softness(0.0, 0.0)
    blurred_px = float(np.median((height / (steepest * np.sqrt(2.0 * np.pi)))[even]))
    # A difference of neighbours is a mean over a pixel, whose own variance is 1/12.
    sigma_px = float(np.sqrt(max(blurred_px * blurred_px - 1.0 / 12.0, 0.0)))
    middle = (values[y, x] + 0.5 * (across + along) - low) / height
    return Softness(sigma_px, abs(float(np.median(middle[even])) - 0.5))


def _at(values: Plane, y: Places, x: Places) -> Places:
    """Return the values at the nearest pixels."""
    height, width = values.shape
    return values[np.clip(np.rint(y), 0, height - 1).astype(np.int64), np.clip(np.rint(x), 0, width - 1).astype(np.int64)]


def blurred(values: Plane, sigma_px: float) -> Plane:
    """Return a map blurred by a Gaussian; it goes on beyond its border."""
    from cv2 import BORDER_REPLICATE, GaussianBlur

    return np.asarray(GaussianBlur(values, (0, 0), sigma_px, borderType=BORDER_REPLICATE))


def sharpened(values: Plane, guide: Guide, jump: float, sigma_px: float, most: tuple[float, float]) -> Plane:
    """Return a map (values grow with nearness) whose edges are as hard as before it was blurred by sigma.

    most: no surface can be nearer than the first, unless the map itself is there, and no lamp nearer than the second.
    """
    sigma_px = min(sigma_px, _MOST_SOFT_PX)
    lamps = _Lamps.of(values, guide, jump, sigma_px)
    if any(each.nearer == 0.0 for each in lamps.each):
        lamps = lamps.looked_at_again(values, _surfaces(lamps.taken_out(values), guide, jump, sigma_px, _ROUNDS[0]))
    held = highest(values, 2 * round(_TAPS * sigma_px) + 1)
    surfaces = np.minimum(_surfaces(lamps.taken_out(values), guide, jump, sigma_px, _ROUNDS[1]), np.maximum(np.float32(most[0]), held))
    return lamps.put_in(surfaces, most[1])


def _surfaces(soft: Plane, guide: Guide, jump: float, sigma_px: float, rounds: int) -> Plane:
    """Return the map without its blur, lamps apart."""
    reach_px, hard = round(1.5 * sigma_px), steepened(soft, jump, sigma_px)
    for _ in range(rounds):
        sides = sides_of(hard, guide, jump, reach_px)
        hard = voted(hard, sides, guide, sides.away_px <= reach_px, _STAYS)
        hard = _given_back(hard, soft, jump, sigma_px, settled=rounds > 1)
    return hard


def steepened(soft: Plane, jump: float, sigma_px: float) -> Plane:
    """Return a map whose edges rise from one pixel to the next where they were soft by sigma."""
    from cv2 import CV_32F, Laplacian

    from mrbokeh.depth._mended_depth_numba import steepen

    around_px = 2 * round(1.5 * sigma_px) + 1
    step = highest(soft, around_px) - lowest(soft, around_px)
    at_edge = (step > jump) & (highest(soft, 3 * around_px) - lowest(soft, 3 * around_px) < 2.0 * step)
    bend, now = Laplacian(blurred(soft, 1.0), CV_32F), soft
    for _ in range(4 * round(sigma_px)):
        following = np.empty_like(soft)

        def step_on(top: int, bottom: int, now: Plane = now, following: Plane = following) -> None:
            steepen(following, now, bend, at_edge, top, bottom)

        by_rows(soft.size, len(soft), step_on)
        now = following
    return now


def _given_back(hard: Plane, soft: Plane, jump: float, sigma_px: float, *, settled: bool) -> Plane:
    from mrbokeh.depth._mended_depth_numba import give_back, settle, shares

    reach_px = round(_TAPS * sigma_px)
    along = np.exp(-(np.arange(-reach_px, reach_px + 1) ** 2) / (2.0 * sigma_px * sigma_px))
    taps = np.outer(along, along) / along.sum() ** 2
    around_px = 2 * reach_px + 1
    band = highest(hard, around_px) - lowest(hard, around_px) > jump
    for _ in range(_MOVES):
        left, share, now = soft - blurred(hard, sigma_px), np.empty_like(hard), np.empty_like(hard)

        def weigh(top: int, bottom: int, hard: Plane = hard, share: Plane = share) -> None:
            shares(share, hard, band, taps, jump, top, bottom)

        def move(top: int, bottom: int, hard: Plane = hard, left: Plane = left, share: Plane = share, now: Plane = now) -> None:
            give_back(now, hard, left, share, band, taps, jump, top, bottom)

        by_rows(hard.size, len(hard), weigh)
        by_rows(hard.size, len(hard), move)
        hard = now
        hard = np.where(band, _within_reason(hard, soft, share, reach_px), hard)
        if settled:
            now = np.empty_like(hard)

            def calm(top: int, bottom: int, hard: Plane = hard, share: Plane = share, now: Plane = now) -> None:
                settle(now, hard, share, band, _SETTLE_PX, np.float32(_SETTLE_JUMPS * jump), top, bottom)

            by_rows(hard.size, len(hard), calm)
            hard = now
    return hard


def _within_reason(hard: Plane, soft: Plane, share: Plane, reach_px: int) -> Plane:
    """Return values that go beyond those of the soft map around them no farther than what was blurred away allows."""
    high, low = highest(soft, 2 * reach_px + 1), lowest(soft, 2 * reach_px + 1)
    most = (high - low) * (_SPARE / np.maximum(share, _LEAST_SHARE))
    return np.clip(hard, high - most, low + most)


_CLEAR, _CLEAR_AGAIN, _LEAST_BUMP = 4.0, 2.0, 0.1


@dataclass(frozen=True)
class _Lamp:
    """A lamp in the air: rows and columns around it, its own pixels there, their blur, and by how much it is nearer than what is there."""

    where: tuple[slice, slice]
    own: Mask
    spread: Plane
    nearer: float


@dataclass(frozen=True)
class _Lamps:
    sigma_px: float
    least: float
    each: tuple[_Lamp, ...]

    @classmethod
    def of(cls, values: Plane, guide: Guide, jump: float, sigma_px: float) -> "_Lamps":
        """Find how much nearer each lamp is than what is around it, 0 where that is not clear."""
        from cv2 import BORDER_CONSTANT, GaussianBlur
        from scipy.ndimage import find_objects, label

        numbers, _ = label(guide.lamps, np.ones((3, 3)))
        around_px, found = int(np.ceil(2.5 * sigma_px)), []
        for number, (rows, columns) in enumerate(find_objects(numbers), 1):
            where = tuple(slice(max(each.start - around_px, 0), each.stop + around_px) for each in (rows, columns))
            own = numbers[where] == number
            spread = np.asarray(GaussianBlur(own.astype(np.float32), (0, 0), sigma_px, borderType=BORDER_CONSTANT))
            found.append(_Lamp((where[0], where[1]), own, spread, _nearer(values[where], spread, 1, _CLEAR, _LEAST_BUMP * jump)))
        return cls(sigma_px, _LEAST_BUMP * jump, tuple(found))

    def looked_at_again(self, values: Plane, hard: Plane) -> "_Lamps":
        """Look again at those that were not clear, when the surfaces around them are known."""
        from cv2 import MORPH_OPEN, morphologyEx

        unclear = np.zeros(values.shape, bool)
        for each in self.each:
            unclear[each.where] |= each.own & (each.nearer == 0.0)
        if not unclear.any():
            return self
        plain = np.where(grown(unclear, 3), morphologyEx(hard, MORPH_OPEN, np.ones((5, 5), np.uint8)), hard)
        left = self.taken_out(values) - blurred(plain, self.sigma_px)
        again = (each.nearer or _nearer(left[each.where], each.spread, 0, _CLEAR_AGAIN, self.least) for each in self.each)
        return replace(self, each=tuple(replace(each, nearer=now) for each, now in zip(self.each, again, strict=True)))

    def taken_out(self, values: Plane) -> Plane:
        without = values.copy()
        for each in self.each:
            without[each.where] -= np.float32(each.nearer) * each.spread
        return without

    def put_in(self, values: Plane, most: float) -> Plane:
        for each in self.each:
            there = values[each.where] + np.float32(each.nearer) * each.own
            values[each.where] = np.where(there <= most, there, values[each.where])
        return values


def _nearer(
    around: Float32[np.ndarray, "rows columns"], spread: Float32[np.ndarray, "rows columns"], degree: int, clear: float, least: float
) -> float:
    """Return the height of a bump of that shape on an even surface, or on a plane (degree 1); 0 where it does not stand out clearly, or by
    less than the least.
    """
    y, x = np.mgrid[: spread.shape[0], : spread.shape[1]] / 8.0 - 0.5
    basis = np.stack([spread.ravel(), np.ones(spread.size), *((y.ravel(), x.ravel()) if degree else ())], axis=1)
    start = np.sqrt(spread.ravel() / spread.max()) + 0.05
    weight, seen = start, around.ravel()
    for _ in range(3):
        fitted = np.linalg.lstsq(basis * weight[:, None], seen * weight, rcond=None)[0]
        off = np.abs(seen - basis @ fitted)
        usual = 1.5 * float(np.median(off)) + 1e-7
        weight = start / (1.0 + (off / (3.0 * usual)) ** 2)
    return float(fitted[0]) if fitted[0] * spread.max() > max(clear * usual, least) else 0.0

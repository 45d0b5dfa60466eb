"""Order and direction of a focus sweep, from the pictures alone.

Order: fine detail of a place grows up to the slice in which it is sharp and falls after it. So no slice has less of it than two slices on
either side of it both have; what is amiss there, summed over all places and triples, is what an order costs, however uneven its steps are.
An order that is as good as the best one, within what noise and chance do, is kept: names of files are usually right.

Direction: blur alone looks the same on both sides of the focus, but contours do not. Where a near thing hides a far one, the contour
between them belongs to the near one: it is sharp in the slice that is focused there, and in the slice of the far surface it is blurred with
the near one. So along every jump of the focus map the step across it is compared between the two slices. (Field of view says little: most
lenses narrow it towards near focus, but many with internal focusing widen it.)
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int

_LONG_SIDE_PX = 640.0
_SCALES_PX = (0.8, 2.0)
_CELL_PX = 12
_KEPT = 0.05
"""The given order stays unless another is better by this share of what slices in no order cost."""
_CLEAR, _CLEARLY_BETTER = 0.2, 0.5
"""An order that costs more than the first share, and more than the second one of what the given order costs, is no clear one."""
_NOISE_PERCENTILE = 5.0
_MOST_CELLS = 3000
_MOST_STARTS = 8
_LEAST_JUMP = 1.2
_MOST_POINTS = 1600
_ACROSS_PX = 12
_ALONG_PX = 6
_SMOOTH_PX = 4.0
_SIDE_PX = (5, 8, 11)
_MOST_PIXELS = 1.2e6
_LEAST_BLUR_PX = 3.0
_BLOCKS = 6
_SURE_Z, _SURE_Z_WITH_FIELD = 4.0, 3.0
_FIELD_AGREES, _FIELD_CONTRADICTS = 0.01, 0.02
"""Changes of the field of view over the stack, as logarithms of its scale."""
_FEWEST_BLOCKS = 4

Rgb = Float32[np.ndarray, "height width 3"]
Maps = Float32[np.ndarray, "scales rows columns"]
Violations = Float[np.ndarray, "slices slices slices"]
Plane = Float32[np.ndarray, "height width"]
Points = Float32[np.ndarray, "points 2"]


@dataclass(frozen=True)
class Direction:
    """Direction of a sweep.

    near_first: the first slice is focused nearest. source: what says so. sure: whether that is evidence and no guess.
    z: the evidence of contours in standard errors; above 0 speaks for near first.
    """

    near_first: bool
    source: str
    sure: bool
    z: float = 0.0


@dataclass
class Contours:
    """Points on jumps of a focus map, and the step across them in every slice that has passed.

    places_px: (x, y) in OpenCV's centres; normals point to the side of the higher index; low, high: indices of the two sides.
    """

    places_px: Points
    normals: Points
    low: Float[np.ndarray, " points"]
    high: Float[np.ndarray, " points"]
    block: Int[np.ndarray, " points"]
    step_px: float
    _strength: list[Float[np.ndarray, " points"]] = field(default_factory=list)

    @classmethod
    def of(cls, focus_index: Plane) -> "Contours":
        height, width = focus_index.shape
        step_px = max(1.0, float(np.sqrt(height * width / _MOST_PIXELS)))
        jumps = np.zeros((height, width), bool)
        jumps[:, 1:] |= np.abs(np.diff(focus_index, axis=1)) > _LEAST_JUMP
        jumps[1:] |= np.abs(np.diff(focus_index, axis=0)) > _LEAST_JUMP
        margin = int(np.ceil((_ACROSS_PX + _ALONG_PX) * step_px))
        jumps[:margin], jumps[-margin:], jumps[:, :margin], jumps[:, -margin:] = False, False, False, False
        rows, columns = np.nonzero(jumps)
        chosen = np.random.default_rng(0).permutation(len(rows))[:_MOST_POINTS]
        places = np.stack([columns[chosen], rows[chosen]], axis=1).astype(np.float32)
        slope = _slopes(focus_index, step_px)[rows[chosen], columns[chosen]]
        normals = slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-9)
        low, high = (_side(focus_index, places, normals * np.float32(sign * step_px)) for sign in (-1, 1))
        block = (rows[chosen] * _BLOCKS // height) * _BLOCKS + columns[chosen] * _BLOCKS // width
        return cls(places_px=places, normals=normals.astype(np.float32), low=low, high=high, block=block, step_px=step_px)

    def watching(self, slices: Iterable[Rgb]) -> Iterator[Rgb]:
        """Pass slices on and measure them."""
        for rgb in slices:
            self._strength.append(self._step_strength(rgb))
            yield rgb

    def direction(self, positions_px: Float[np.ndarray, " slices"], scales: Sequence[float], as_given: bool = True) -> Direction:
        """Judge from the slices that have passed. positions_px: where they are focused; scales: how much registration enlarged each.

        as_given: slices are in the order of their names, which tends to be near first.
        """
        z = self._z(positions_px)
        # What registration enlarges least sees the narrowest field.
        field = float(np.log(scales[-1] / scales[0]) * np.sign(z))
        sure = abs(z) >= (_SURE_Z_WITH_FIELD if field >= _FIELD_AGREES else _SURE_Z) and field > -_FIELD_CONTRADICTS
        if sure or not as_given:
            return Direction(near_first=z >= 0, source="contours", sure=sure, z=z)
        return replace(FILE_ORDER, z=z)

    def _z(self, positions_px: Float[np.ndarray, " slices"]) -> float:
        """Return by how many standard errors, from blocks of the picture, contours are sharper in the low side's slice."""
        if len(self.places_px) == 0:
            return 0.0
        strength, along = np.stack(self._strength), np.arange(len(positions_px))
        blur = np.interp(self.high, along, positions_px) - np.interp(self.low, along, positions_px)
        points = np.arange(len(self.places_px))
        low, high = (strength[np.rint(side).astype(int), points] for side in (self.low, self.high))
        usable = (blur > _LEAST_BLUR_PX) & (np.rint(self.low) < np.rint(self.high))
        # Weak contours tell little: each vote counts as much as the step is high.
        both = low + high
        vote, height = (low - high) / np.maximum(both, 1e-12), np.sqrt(both)
        heights, summed = (np.bincount(self.block[usable], each[usable], _BLOCKS**2) for each in (height, height * vote))
        if (heights > 0).sum() < _FEWEST_BLOCKS:
            return 0.0
        votes = summed / np.maximum(heights, 1e-12)
        share = np.sqrt(heights) / np.sqrt(heights).sum()
        mean = float((share * votes).sum())
        return mean / (float(np.sqrt((share**2 * (votes - mean) ** 2).sum())) + 1e-6)

    def _step_strength(self, rgb: Rgb) -> Float[np.ndarray, " points"]:
        """Return the energy of the derivative across the contour, of light averaged along it."""
        if len(self.places_px) == 0:
            return np.zeros(0)
        grey = cv2.transform(np.ascontiguousarray(rgb), np.full((1, 3), 1.0 / 3.0, np.float32))
        sampled = cv2.remap(grey, *self._grid, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        profile = np.sqrt(np.maximum(sampled.reshape(len(self.places_px), 2 * _ALONG_PX + 1, -1).mean(axis=1), 0.0))
        return (np.diff(profile, axis=1) ** 2).sum(axis=1).astype(np.float64)

    @cached_property
    def _grid(self) -> tuple[Float32[np.ndarray, "points samples"], Float32[np.ndarray, "points samples"]]:
        """Return x and y of the samples about each point: rows along its contour, columns across it."""
        across = np.arange(-_ACROSS_PX, _ACROSS_PX + 1, dtype=np.float32) * np.float32(self.step_px)
        along = np.arange(-_ALONG_PX, _ALONG_PX + 1, dtype=np.float32) * np.float32(self.step_px)
        tangents = np.stack([-self.normals[:, 1], self.normals[:, 0]], axis=1)
        grid = (
            self.places_px[:, None, None, :]
            + along[None, :, None, None] * tangents[:, None, None, :]
            + across[None, None, :, None] * self.normals[:, None, None, :]
        ).reshape(len(self.places_px), -1, 2)
        return np.ascontiguousarray(grid[..., 0]), np.ascontiguousarray(grid[..., 1])


def focus_order(read_rgb: Callable[[int], Rgb], count: int) -> tuple[int, ...]:
    """Return slices 0 to count - 1 in the order of their focus, each read once; as given where that is as good as any.

    Which end is near is not told: of the two directions it takes the one that goes more along the given order.
    """
    given = tuple(range(count))
    if count < 3:
        return given
    violations = violations_of([detail_map(read_rgb(index)) for index in range(count)])
    best = best_order(violations)
    unclear = max(_CLEAR * violations.sum() / 6.0, _CLEARLY_BETTER * cost_of(violations, given))
    if gain_of(violations, given, best) < _KEPT or cost_of(violations, best) > unclear:
        return given
    return tuple(best if _rises(best) else best[::-1])


def best_order(violations: Violations) -> list[int]:
    """Insert slices one after the other where they cost least, then take each out and insert it again, until nothing gets better."""
    count = len(violations)
    found: list[tuple[float, list[int]]] = []
    for start in range(0, count, -(-count // _MOST_STARTS)):
        order: list[int] = []
        for each in [*range(start, count), *range(start)]:
            order = _inserted(violations, order, each)
        cost = cost_of(violations, order)
        while True:
            for moved in range(count):
                order = _inserted(violations, [each for each in order if each != moved], moved)
            better = cost_of(violations, order)
            if not better < cost - 1e-12:
                break
            cost = better
        found.append((cost, order))
    return min(found)[1]


def gain_of(violations: Violations, given: Sequence[int], best: Sequence[int]) -> float:
    """Return by how much the best order is better, as a share of what slices in no order would cost."""
    at_random = float(violations.sum()) / 6.0
    return (cost_of(violations, given) - cost_of(violations, best)) / max(at_random, 1e-12)


def cost_of(violations: Violations, order: Sequence[int]) -> float:
    """Return what an order costs, summed over all slices that lie between two others."""
    index = np.array(order, int)
    ordered = violations[np.ix_(index, index, index)]
    return float(sum(ordered[:b, b, b + 1 :].sum() for b in range(1, len(order) - 1)))


def violations_of(maps: Sequence[Maps]) -> Violations:
    """Return [a, b, c]: by how much slice b has less detail than both a and c, summed over cells: what speaks against b between a and c."""
    energies = np.stack(maps)
    floor = np.percentile(energies.min(axis=0), _NOISE_PERCENTILE, axis=(1, 2))[None, :, None, None] + 1e-9
    logs = np.log(energies + np.float32(2.0) * floor).astype(np.float32)
    weight = (np.sqrt(energies.max(axis=0)) * np.ptp(logs, axis=0)).ravel()
    cells = np.argsort(weight)[-_MOST_CELLS:]
    logs, weight = logs.reshape(len(maps), -1)[:, cells], weight[cells] / max(float(weight[cells].sum()), 1e-12)
    found = np.zeros((len(maps),) * 3)
    for a in range(len(maps)):
        for c in range(a):
            found[a, :, c] = found[c, :, a] = np.maximum(np.minimum(logs[a], logs[c]) - logs, 0.0) @ weight
    return found


def detail_map(rgb: Rgb) -> Maps:
    """Return the energy of fine detail on a coarse grid, at a few scales, of the square root of light, where photons are evenly noisy."""
    shrink = max(1.0, max(rgb.shape[:2]) / _LONG_SIDE_PX)
    size = (round(rgb.shape[1] / shrink), round(rgb.shape[0] / shrink))
    grey = cv2.transform(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.full((1, 3), 1.0 / 3.0, np.float32))
    encoded = np.sqrt(np.maximum(grey, 0.0))
    grid = (max(2, size[0] // _CELL_PX), max(2, size[1] // _CELL_PX))
    maps, finer = [], encoded
    for sigma_px in _SCALES_PX:
        coarser = cv2.GaussianBlur(encoded, (0, 0), sigma_px)
        energy = cv2.resize((finer - coarser) ** 2, grid, interpolation=cv2.INTER_AREA)
        maps.append(cv2.GaussianBlur(energy, (0, 0), 1.0))
        finer = coarser
    return np.stack(maps)


def _rises(order: Sequence[int]) -> bool:
    """Return whether an order goes more along the given one than against it."""
    return float(np.corrcoef(np.arange(len(order)), order)[0, 1]) >= 0.0


def _inserted(violations: Violations, order: list[int], new: int) -> list[int]:
    """Return the order with one more slice where it costs least."""
    count = len(order)
    index = np.array(order, int)
    outer = np.triu(violations[:, new][np.ix_(index, index)], 1)
    # Slices b between the new one before them and c behind, and between a and the new one behind.
    behind = np.triu(violations[new][np.ix_(index, index)], 1)
    before = np.triu(violations[..., new][np.ix_(index, index)], 1)
    costs = [outer[:at, at:].sum() + behind[at:, at:].sum() + before[:at, :at].sum() for at in range(count + 1)]
    at = int(np.argmin(costs))
    return [*order[:at], new, *order[at:]]


FILE_ORDER = Direction(near_first=True, source="file order", sure=False)


def _slopes(focus_index: Plane, step_px: float) -> Float32[np.ndarray, "height width 2"]:
    """Return how the focus map rises to the right and downwards, as seen from a few pixels away."""
    height, width = focus_index.shape
    size = (round(width / step_px / 2), round(height / step_px / 2))
    smooth = cv2.GaussianBlur(cv2.resize(focus_index, size, interpolation=cv2.INTER_AREA), (0, 0), _SMOOTH_PX / 2)
    slopes = np.dstack([cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)])
    return cv2.resize(slopes, (width, height), interpolation=cv2.INTER_LINEAR)


def _side(focus_index: Plane, places: Points, steps: Points) -> Float[np.ndarray, " points"]:
    height, width = focus_index.shape
    samples = []
    for distance in _SIDE_PX:
        at = np.rint(places + distance * steps).astype(int)
        samples.append(focus_index[np.clip(at[:, 1], 0, height - 1), np.clip(at[:, 0], 0, width - 1)])
    return np.median(samples, axis=0).astype(np.float64)

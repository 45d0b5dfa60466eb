"""Compiled loops of Laplacian spreadlets: points splatted, sums converted to integers and back, highlights among the pixels.

Every pixel adds its value times the points of its cell to an accumulator; one loop over the points serves a pixel or two neighbours.
Into reals every point adds its weight times the light. Into whole numbers `weights` are sums: of the weights before each point, and
at last of all. A point adds by how much that sum times the light, rounded, has grown. What a pixel adds is thus 0 in the end where
its weights sum to 0, to the last bit, however its points are divided. A dither of each pixel's own says how it rounds: in an even
area all would round the same way else, which shows once integrated.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.core.cgutils import get_or_insert_function
from numba.extending import intrinsic

from mrbokeh.renderers.kernels._vectors_numba import Lowering, data_of, filled, load_vector, shuffled
from mrbokeh.system.compiled import njit

# ruff: noqa: ARG001  (numba reads the arguments of an intrinsic by their names)

_LANES = 4
_WIDEST_BYTES = 32  # wider vectors straddle two cache lines more often than they save steps

Vectors = list[Any]


class _Points(NamedTuple):
    """Parts that the loop over points is built from: where sums, offsets and weights begin, the light in vectors, and its place."""

    builder: ir.IRBuilder
    sums: Any
    offsets: Any
    weights: Any
    here: Any
    light: Vectors
    size: int

    def each(self, first: Any, end: Any, carried: Vectors, step: Callable[[Any, Vectors], Vectors]) -> None:
        """Replace carried vectors by step(n, carried) for n from first to end."""
        builder = self.builder
        before, loop, after = builder.block, builder.append_basic_block("points"), builder.append_basic_block("done")
        builder.cbranch(builder.icmp_signed("<", first, end), loop, after)
        builder.position_at_end(loop)
        n, inside = builder.phi(first.type), [builder.phi(vector.type) for vector in carried]
        results = step(n, inside)
        following = builder.add(n, ir.Constant(first.type, 1))
        for phi, start, result in zip([n, *inside], [first, *carried], [following, *results], strict=True):
            phi.add_incoming(start, before)
            phi.add_incoming(result, loop)
        builder.cbranch(builder.icmp_signed("<", following, end), loop, after)
        builder.position_at_end(after)

    def products(self, n: Any, to: Vectors) -> Vectors:
        """Return weights[n] times the light, added to vectors."""
        builder = self.builder
        weight = filled(builder, builder.load(builder.gep(self.weights, [n])), self.light[0].type.count)
        each = [builder.fmul(vector, weight, flags=("contract",)) for vector in self.light]
        return [builder.fadd(base, product, flags=("contract",)) for base, product in zip(to, each, strict=True)]

    def change(self, n: Any, changed: Callable[[Vectors], Vectors], kind: Any) -> None:
        """Replace the sums of point n by what changed() makes of them."""
        builder, lanes = self.builder, kind.count
        place = builder.add(self.here, builder.sext(builder.load(builder.gep(self.offsets, [n])), self.here.type))
        places = [builder.add(place, ir.Constant(place.type, part * lanes)) for part in range(len(self.light))]
        pointers = [builder.bitcast(builder.gep(self.sums, [each]), kind.as_pointer()) for each in places]
        there = [builder.load(pointer) for pointer in pointers]
        for each in there:
            each.align = self.size
        for pointer, vector in zip(pointers, changed(there), strict=True):
            builder.store(vector, pointer).align = self.size


def _adding_points(pixels: int) -> Any:
    """Make the intrinsic that adds points low:high of a kernel to sums[here + offsets[n] : .. + 4 pixels] for the light values[at : at +
    4 pixels].

    All arrays are flat, places are not checked. sums and weights are of one type, gains and dithers without meaning; or sums are
    int32, weights float32 and one more than points, light is multiplied by gains (4,) first and rounded by the dither of each of two
    pixels, within +-0.5.
    """

    @intrinsic
    def add(
        typing_context: Any,
        sums: Any,
        here: Any,
        offsets: Any,
        weights: Any,
        low: Any,
        high: Any,
        values: Any,
        at: Any,
        gains: Any,
        dithers: Any,
    ) -> Lowering:
        signature = types.void(
            sums, types.intp, offsets, weights, types.intp, types.intp, values, types.intp, gains, types.UniTuple(types.float32, 2)
        )
        size = sums.dtype.bitwidth // 8
        lanes = min(_LANES * pixels, _WIDEST_BYTES // size)

        def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
            out, places, factors, source, gain_data = (data_of(context, builder, signature.args[k], arguments[k]) for k in (0, 2, 3, 6, 8))
            first, end, at = arguments[4], arguments[5], arguments[7]
            starts = [builder.add(at, ir.Constant(at.type, part)) for part in range(0, _LANES * pixels, lanes)]
            light = [load_vector(builder, source, start, ir.FloatType(), lanes, 4) for start in starts]
            points = _Points(builder, out, places, factors, arguments[1], light, size)
            if isinstance(sums.dtype, types.Integer):
                _add_rounded(points, first, end, gain_data, arguments[9])
            else:
                _add_products(points, first, end, context.get_value_type(sums.dtype))
            return context.get_dummy_value()

        return signature, generate

    return add


def _add_products(points: _Points, first: Any, end: Any, real: Any) -> None:
    kind = ir.VectorType(real, points.light[0].type.count)
    light = points.light if real == ir.FloatType() else [points.builder.fpext(vector, kind) for vector in points.light]
    points = points._replace(light=light)

    def step(n: Any, carried: Vectors) -> Vectors:
        points.change(n, lambda there: points.products(n, there), kind)
        return carried

    points.each(first, end, [], step)


def _add_rounded(points: _Points, first: Any, end: Any, gains: Any, dithers: Any) -> None:
    builder, lanes = points.builder, points.light[0].type.count
    gain = load_vector(builder, gains, ir.Constant(first.type, 0), ir.FloatType(), _LANES, 4)
    gain = shuffled(builder, gain, [lane % _LANES for lane in range(lanes)])
    points = points._replace(light=[builder.fmul(vector, gain) for vector in points.light])
    both = [filled(builder, builder.extract_value(dithers, k), _LANES) for k in range(2)]
    dither = shuffled(builder, both[0], range(lanes), both[1])

    def levels(n: Any) -> Vectors:
        return [_rounded(builder, each) for each in points.products(n, [dither] * len(points.light))]

    def step(n: Any, before: Vectors) -> Vectors:
        after = levels(builder.add(n, ir.Constant(n.type, 1)))

        def grown(there: Vectors) -> Vectors:
            return [builder.add(each, builder.sub(new, old)) for each, new, old in zip(there, after, before, strict=True)]

        points.change(n, grown, after[0].type)
        return after

    points.each(first, end, levels(first), step)


def _rounded(builder: ir.IRBuilder, vector: Any) -> Any:
    """Round to the nearest whole numbers."""
    lanes = vector.type.count
    nearest = get_or_insert_function(builder.module, ir.FunctionType(vector.type, [vector.type]), f"llvm.nearbyint.v{lanes}f32")
    return builder.fptosi(builder.call(nearest, [vector]), ir.VectorType(ir.IntType(32), lanes))


# Compiled code calls them without the typing context, which type checkers cannot know.
add_points: Any = _adding_points(1)
add_points_of_two: Any = _adding_points(2)


NONE = -1
_STRETCH_PX = 64
LANES = 4
"""Channels that are added at once."""
_MOST_BESIDE = 0.25
_TILE_ROWS, _TILE_COLUMNS = 64, 32
_ALONG, _DOWN = 0.7548776662466927, 0.5698402909980532  # a lattice whose points are spread evenly over any area (Roberts 2018, R2)


@njit(cache=True, nogil=True)
def rows_of(points: np.ndarray, starts: np.ndarray, reach_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Return where each row of a cell's points begins, and whether its points lie apart.

    points (N, 2), cell i at starts[i]:starts[i + 1] sorted by y. Returns (cells, 2 reach + 2): the first point with y >= k - reach;
    (cells,): False where many points have one right beside them, so that two neighbouring pixels at once would write onto what
    was just written, for which processors wait.
    """
    cells = len(starts) - 1
    rows, apart = np.empty((cells, 2 * reach_px + 2), np.int32), np.empty(cells, np.bool_)
    for cell in range(cells):
        n, beside = starts[cell], 0
        for k in range(2 * reach_px + 2):
            while n < starts[cell + 1] and points[n, 1] < k - reach_px:
                n += 1
            rows[cell, k] = n
        for n in range(starts[cell] + 1, starts[cell + 1]):
            beside += points[n, 1] == points[n - 1, 1] and points[n, 0] == points[n - 1, 0] + 1
        apart[cell] = beside <= _MOST_BESIDE * (starts[cell + 1] - starts[cell])
    return rows, apart


@njit(cache=True, nogil=True)
def dither_of(x: int, y: int) -> np.float32:
    """Return how a pixel rounds, within +-0.5: neighbours differ, and any area has about as much of each."""
    phase = _ALONG * x + _DOWN * y
    return np.float32(phase - np.rint(phase))


@njit(cache=True, nogil=True, error_model="numpy")
def splat_strip(
    out: np.ndarray,
    values: np.ndarray,
    cells: np.ndarray,
    points: tuple,
    gains: np.ndarray,
    origin: tuple[int, int],
    first: int,
    end: int,
) -> None:
    """Add the light that falls into rows first:end of out (h, w, LANES), whose first pixel is row and column `origin` of the picture.

    values (H, W, LANES) single precision, cells (H, W) or NONE. points: offsets (N,) int32 from their pixel in the flat array, weights
    (they and gains: see `add_points`), rows and apart as from `rows_of`; all must fall into out. Tile by tile, so that what a
    tile reaches stays in the cache. Every sum is taken in the order of tiles, rows, columns and points, neighbours of one cell together,
    whatever the strip.
    """
    offsets, weights, rows, apart = points
    height, width = cells.shape
    top, left = origin
    reach_px = rows.shape[1] // 2 - 1
    flat, light, stride = out.reshape(-1), values.reshape(-1), LANES * out.shape[1]
    first_row, end_row = max(0, first + top - reach_px), min(height, end + top + reach_px)
    for tile in range(first_row // _TILE_ROWS * _TILE_ROWS, end_row, _TILE_ROWS):
        for first_column in range(0, width, _TILE_COLUMNS):
            for y in range(max(tile, first_row), min(tile + _TILE_ROWS, end_row)):
                low_row, high_row = max(0, first + top - y + reach_px), min(2 * reach_px + 1, end + top - y + reach_px)
                x, end_column = first_column, min(first_column + _TILE_COLUMNS, width)
                while x < end_column:
                    cell = cells[y, x]
                    if cell == NONE:
                        x += 1
                        continue
                    low, high = rows[cell, low_row], rows[cell, high_row]
                    here, at = (y - top) * stride + LANES * (x - left), LANES * (y * width + x)
                    dithers = dither_of(x, y), dither_of(x + 1, y)
                    if x + 1 < end_column and cells[y, x + 1] == cell and apart[cell]:
                        add_points_of_two(flat, here, offsets, weights, low, high, light, at, gains, dithers)
                        x += 2
                    else:
                        add_points(flat, here, offsets, weights, low, high, light, at, gains, dithers)
                        x += 1


@njit(cache=True, nogil=True)
def add_and_clear(out: np.ndarray, sums: np.ndarray, origin: tuple[int, int], first: int, end: int) -> None:
    """Add rows first:end of sums (h, w, LANES), as far as they fall into out (H, W, up to LANES), and make them zero."""
    height, width, channels = out.shape
    top, left = origin
    for y in range(first, end):
        if 0 <= y + top < height:
            for x in range(max(0, left), min(width, left + sums.shape[1])):
                for c in range(channels):
                    out[y + top, x, c] += sums[y, x - left, c]
        sums[y] = 0.0


@njit(cache=True, nogil=True)
def largest_sum(points: np.ndarray, weights: np.ndarray, reach_px: int) -> float:
    """Return a bound on the sum of points (N, 2) times light of at most 1, whichever cell every pixel around takes."""
    side = 2 * reach_px + 1
    most = np.zeros((side, side))
    for n in range(len(weights)):
        y, x = points[n, 1] + reach_px, points[n, 0] + reach_px
        most[y, x] = max(most[y, x], abs(weights[n]))
    return most.sum()


@njit(cache=True, nogil=True)
def to_reals(whole: np.ndarray, reals: np.ndarray, gains: np.ndarray) -> None:
    """Set reals (h, w, LANES) to whole (h, w, LANES) over gains (LANES,), powers of two; they may lie in the same memory."""
    height, width, lanes = whole.shape
    row, unit = np.empty(width * lanes, np.float32), np.empty(width * lanes, np.float32)
    for i in range(len(unit)):
        unit[i] = 1.0 / gains[i % lanes]
    for y in range(height):
        source, target = whole[y].reshape(-1), reals[y].reshape(-1)
        for i in range(len(row)):
            row[i] = source[i]
        for i in range(len(row)):
            target[i] = row[i] * unit[i]


@njit(cache=True, nogil=True)
def add_up(sums: np.ndarray, values: np.ndarray, codes: np.ndarray, sparse: np.ndarray) -> int:
    """Add the light, without sign, of pixels of values (H, W, C) whose code (H, W) is sparse to sums (C,), and return their number."""
    height, width, channels = values.shape
    count = 0
    for y in range(height):
        for x in range(width):
            code = codes[y, x]
            if code != NONE and sparse[code]:
                count += 1
                for c in range(channels):
                    sums[c] += abs(values[y, x, c])
    return count


@njit(cache=True, nogil=True)
def mark_highlights(
    found: np.ndarray, most: np.ndarray, values: np.ndarray, codes: np.ndarray, sparse: np.ndarray, limits: np.ndarray
) -> None:
    """Mark the sparse pixels with a channel beyond its limit (C,); no other light is larger than most (C,), NaN if some is NaN.

    Stretches without anything beyond the limits are passed in vectors, whatever their codes.
    """
    height, width, channels = values.shape
    limit, highest = np.empty(_STRETCH_PX * channels, np.float32), np.zeros(_STRETCH_PX * channels, np.float32)
    for i in range(len(limit)):
        limit[i] = limits[i % channels]
    for y in range(height):
        row = values[y].reshape(-1)
        for first in range(0, width, _STRETCH_PX):
            end = min(first + _STRETCH_PX, width)
            here, within = row[first * channels : end * channels], 0
            for i in range(len(here)):
                within += abs(here[i]) <= limit[i]
            if within == len(here):
                for i in range(len(here)):
                    highest[i] = max(highest[i], abs(here[i]))
            else:
                for x in range(first, end):
                    if codes[y, x] != NONE and sparse[codes[y, x]]:
                        _look_at(found[y], most, values[y], x, limits)
    for i in range(len(highest)):
        most[i % channels] = max(most[i % channels], highest[i]) if most[i % channels] == most[i % channels] else most[i % channels]


@njit(cache=True, nogil=True)
def _look_at(found: np.ndarray, most: np.ndarray, values: np.ndarray, x: int, limits: np.ndarray) -> None:
    for c in range(len(limits)):
        found[x] |= abs(values[x, c]) > limits[c]
    if not found[x]:
        for c in range(len(limits)):
            light = abs(values[x, c])
            if light > most[c] or light != light:
                most[c] = light

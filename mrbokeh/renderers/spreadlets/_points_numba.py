"""Compiled loop over all points of a kernel, for one pixel or for two neighbours: one weight and one place serve both pixels.

Into reals every point adds its weight times the light. Into whole numbers `weights` are sums: of the weights before each point, and
at last of all. A point adds by how much that sum times the light, rounded, has grown. What a pixel adds is thus 0 in the end where
its weights sum to 0, to the last bit, however its points are divided. A dither of each pixel's own says how it rounds: in an even
area all would round the same way else, which shows once integrated.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from llvmlite import ir
from numba.core import types
from numba.core.cgutils import get_or_insert_function
from numba.extending import intrinsic

from mrbokeh.renderers.kernels._vectors_numba import Lowering, data_of, filled, load_vector, shuffled

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

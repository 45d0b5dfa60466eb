"""Vector intrinsics of splatting, in LLVM: four channels of one or two cells at once, and the aim of eight pixels at a polygon's corner.

Plain loops over them were compiled to single steps or to tests for overlap.
"""

from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

# ruff: noqa: ARG001  (numba reads the arguments of an intrinsic by their names)

Lowering = tuple[Any, Callable[..., Any]]


def data_of(context: Any, builder: ir.IRBuilder, kind: Any, array: Any) -> Any:
    return context.make_array(kind)(context, builder, array).data


def load_vector(builder: ir.IRBuilder, data: Any, at: Any, element: Any, lanes: int, size: int) -> Any:
    """Load `lanes` elements of `size` bytes from data[at] on, which need not be aligned."""
    loaded = builder.load(builder.bitcast(builder.gep(data, [at]), ir.VectorType(element, lanes).as_pointer()))
    loaded.align = size
    return loaded


def store_vector(builder: ir.IRBuilder, vector: Any, data: Any, at: Any, size: int) -> None:
    builder.store(vector, builder.bitcast(builder.gep(data, [at]), vector.type.as_pointer())).align = size


def shuffled(builder: ir.IRBuilder, first: Any, lanes: Sequence[int], second: Any = None) -> Any:
    """Return lanes of one vector, or of two behind one another."""
    other = ir.Constant(first.type, ir.Undefined) if second is None else second
    return builder.shuffle_vector(first, other, ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), list(lanes)))


def filled(builder: ir.IRBuilder, value: Any, lanes: int) -> Any:
    """Return a vector of one value."""
    one = builder.insert_element(ir.Constant(ir.VectorType(value.type, 1), ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    return shuffled(builder, one, [0] * lanes)


def _add_weighted(builder: ir.IRBuilder, data: Any, at: Any, weights: Any, value: Any, size: int) -> None:
    """Add to data[at + 4 k : at + 4 k + 4] weights[k] times value, a tuple of four."""
    real, cells = weights.type.element, weights.type.count
    four = ir.Constant(ir.VectorType(real, 4), ir.Undefined)
    for lane in range(4):
        four = builder.insert_element(four, builder.extract_value(value, lane), ir.Constant(ir.IntType(32), lane))
    each = shuffled(builder, weights, [lane // 4 for lane in range(4 * cells)])
    product = builder.fmul(shuffled(builder, four, [lane % 4 for lane in range(4 * cells)]), each, flags=("contract",))
    there = load_vector(builder, data, at, real, 4 * cells, size)
    store_vector(builder, builder.fadd(there, product, flags=("contract",)), data, at, size)


def _adding_to(cells: int) -> Any:
    """Make the intrinsic array[at + 4 k : at + 4 k + 4] += weights[first + k] * value for k = 0 .. cells - 1, neighbouring cells.

    array and weights are flat and of one type, value is a tuple of four of it; places are not checked.
    """

    @intrinsic
    def add(typing_context: Any, array: Any, at: Any, weights: Any, first: Any, value: Any) -> Lowering:
        signature = types.void(array, types.intp, weights, types.intp, types.UniTuple(array.dtype, 4))
        size = array.dtype.bitwidth // 8

        def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
            real = context.get_value_type(array.dtype)
            data, weights = (data_of(context, builder, signature.args[k], arguments[k]) for k in (0, 2))
            weight = load_vector(builder, weights, arguments[3], real, cells, size)
            _add_weighted(builder, data, arguments[1], weight, arguments[4], size)
            return context.get_dummy_value()

        return signature, generate

    return add


@intrinsic
def _scaled(typing_context: Any, values: Any, at: Any, gain: Any) -> Lowering:
    """Return values[at : at + 4] * gain, in the type of gain; values is flat, `at` is not checked."""
    signature = types.UniTuple(gain, 4)(values, types.intp, gain)

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        given, real = (context.get_value_type(kind) for kind in (values.dtype, gain))
        data = data_of(context, builder, signature.args[0], arguments[0])
        four = load_vector(builder, data, arguments[1], given, 4, values.dtype.bitwidth // 8)
        if given != real:
            four = builder.fpext(four, ir.VectorType(real, 4))
        product = builder.fmul(four, filled(builder, arguments[2], 4))
        result = ir.Constant(context.get_value_type(signature.return_type), ir.Undefined)
        for lane in range(4):
            result = builder.insert_value(result, builder.extract_element(product, ir.Constant(ir.IntType(32), lane)), lane)
        return result

    return signature, generate


BLENDED_CELLS = 4


@intrinsic
def _blend_onto_cells(typing_context: Any, array: Any, at: Any, lower: Any, rise: Any, first: Any, upper: Any, value: Any) -> Lowering:
    """Add to array[at + 4 k : at + 4 k + 4] (lower[first + k] + upper * rise[first + k]) * value, for BLENDED_CELLS neighbouring cells.

    lower, rise: flat, single precision, as `upper` is; for the rest see `_adding_to`.
    """
    signature = types.void(array, types.intp, lower, rise, types.intp, types.float32, types.UniTuple(array.dtype, 4))

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        data, lower, rise = (data_of(context, builder, signature.args[k], arguments[k]) for k in (0, 2, 3))
        low, more = (load_vector(builder, each, arguments[4], ir.FloatType(), BLENDED_CELLS, 4) for each in (lower, rise))
        added = builder.fmul(filled(builder, arguments[5], BLENDED_CELLS), more, flags=("contract",))
        weights = builder.fadd(low, added, flags=("contract",))
        real = context.get_value_type(array.dtype)
        if real != ir.FloatType():
            weights = builder.fpext(weights, ir.VectorType(real, BLENDED_CELLS))
        _add_weighted(builder, data, arguments[1], weights, arguments[6], array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def _fetch(typing_context: Any, array: Any, at: Any) -> Lowering:
    """Prefetch the cache line of array[at] for writing."""
    signature = types.void(array, types.intp)

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        i32, i8p = ir.IntType(32), ir.IntType(8).as_pointer()
        function = builder.module.declare_intrinsic("llvm.prefetch", [i8p], ir.FunctionType(ir.VoidType(), [i8p, i32, i32, i32]))
        pointer = builder.bitcast(builder.gep(data_of(context, builder, signature.args[0], arguments[0]), [arguments[1]]), i8p)
        builder.call(function, [pointer, ir.Constant(i32, 1), ir.Constant(i32, 3), ir.Constant(i32, 1)])
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def _one_by_one(typing_context: Any) -> Lowering:
    """Do nothing, but keep the compiler from making vectors across the steps of a loop: tuned for 512 bits that is five times slower."""

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        builder.asm(ir.FunctionType(ir.VoidType(), []), "", "", [], side_effect=True)
        return context.get_dummy_value()

    return types.void(), generate


# Compiled code calls them without the typing context, which type checkers cannot know.
add_to_cell: Any = _adding_to(1)
add_to_two_cells: Any = _adding_to(2)
blend_onto_cells: Any = _blend_onto_cells
scaled: Any = _scaled
fetch: Any = _fetch
one_by_one: Any = _one_by_one


# ruff: noqa: ARG001  (numba reads the arguments of an intrinsic by their names)

CHUNK_PX = 64
"""Pixels of a row that are prepared together."""
AIM_PX = 8
"""Pixels that one call aims."""


def _aiming(pairs: tuple[tuple[int, int], tuple[int, int]]) -> Any:
    """Make `aim` for pairs of crossings that are stored together: 0 (neither edge's line moved), 1 (that of the edge before), 2 (after), 3
    (both).
    """

    @intrinsic
    def aim(
        typing_context: Any, targets: Any, weights: Any, columns: Any, lines: Any, shares: Any, places: Any, steps: Any, signs: Any
    ) -> Lowering:
        """Store crossing 0 as an element of the ring, and the weights of all four, two by two.

        targets, columns, lines: int32; weights, shares: of the ring's type; all flat. places: (pixel, first target,
        first weight, first line before, first line after); the pairs of weights lie 2 CHUNK_PX apart. steps: int32 (of the
        chunk, of a line before, of a line after, of the plane, elements of the ring, which positions wrap around at). signs:
        (whole weight, share before at 0 and its slope, the same after): 0 and 1, or 1 and -1 where the two lines count backwards.
        """
        real = weights.dtype
        signature = types.void(
            targets, weights, columns, lines, shares, types.UniTuple(types.intp, 5), types.UniTuple(types.int32, 5), types.UniTuple(real, 5)
        )

        def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
            value, size = context.get_value_type(real), real.bitwidth // 8
            data = [data_of(context, builder, signature.args[k], arguments[k]) for k in range(5)]
            pixel, target, weight, before, after = (builder.extract_value(arguments[5], k) for k in range(5))
            at = _place(builder, data, arguments[6], pixel, before, after)
            store_vector(builder, at, data[0], builder.add(target, pixel), 4)
            whole, *turns = (filled(builder, builder.extract_value(arguments[7], k), AIM_PX) for k in range(5))
            share, share_after = (load_vector(builder, data[4], builder.add(pixel, line), value, AIM_PX, size) for line in (before, after))
            share = builder.fadd(turns[0], builder.fmul(turns[1], share))
            share_after = builder.fadd(turns[2], builder.fmul(turns[3], share_after))
            crossings = _crossings(builder, whole, share, share_after)
            for k, (first, second) in enumerate(pairs):
                both = shuffled(builder, crossings[first], _INTERLEAVED, crossings[second])
                place = builder.add(
                    weight, builder.mul(ir.Constant(pixel.type, 2), builder.add(pixel, ir.Constant(pixel.type, k * CHUNK_PX)))
                )
                store_vector(builder, both, data[1], place, size)
            return context.get_dummy_value()

        return signature, generate

    return aim


_INTERLEAVED = [lane // 2 + AIM_PX * (lane % 2) for lane in range(2 * AIM_PX)]


def _place(builder: ir.IRBuilder, data: list[Any], steps: Any, pixel: Any, before: Any, after: Any) -> Any:
    i32 = ir.IntType(32)
    none = ir.Constant(ir.VectorType(i32, AIM_PX), [0] * AIM_PX)
    start, step, step_after, plane, around = (filled(builder, builder.extract_value(steps, k), AIM_PX) for k in range(5))
    at = builder.add(start, load_vector(builder, data[2], pixel, i32, AIM_PX, 4))
    for along, line in ((step, before), (step_after, after)):
        at = builder.add(at, builder.mul(along, load_vector(builder, data[3], builder.add(line, pixel), i32, AIM_PX, 4)))
    at = builder.add(at, builder.select(builder.icmp_signed("<", at, none), around, none))
    at = builder.sub(at, builder.select(builder.icmp_signed(">=", at, around), around, none))
    return builder.add(at, plane)


def _crossings(builder: ir.IRBuilder, whole: Any, share: Any, share_after: Any) -> tuple[Any, Any, Any, Any]:
    upper = builder.fmul(whole, share)
    upper_after = builder.fmul(upper, share_after)
    lower_after = builder.fsub(builder.fmul(whole, share_after), upper_after)
    lower = builder.fsub(builder.fsub(whole, upper), lower_after)
    return lower, builder.fsub(upper, upper_after), lower_after, upper_after


# Compiled code calls them without the typing context, which type checkers cannot know.
aim_level: Any = _aiming(((0, 1), (2, 3)))
aim_steep: Any = _aiming(((1, 2), (0, 3)))

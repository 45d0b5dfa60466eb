"""Four channels, or eight pixels, at once, in vectors: loops over them were compiled to single steps or to tests for overlap."""

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

# ruff: noqa: ARG001  (numba reads the arguments of an intrinsic by their names)

Lowering = tuple[Any, Callable[..., Any]]

CHUNK_PX = 64
"""Pixels of a row that are prepared together: the distance of the four weights of a crossing from one another."""


def _vector(context: Any, builder: ir.IRBuilder, element: Any, lanes: list[Any]) -> Any:
    vector = ir.Constant(ir.VectorType(context.get_value_type(element), 4), ir.Undefined)
    for lane, value in enumerate(lanes):
        vector = builder.insert_element(vector, value, ir.Constant(ir.IntType(32), lane))
    return vector


def _add(builder: ir.IRBuilder, element: Any, data: Any, at: Any, weight: Any, value: Any) -> None:
    """data[at : at + 4] += weight * value, all but data vectors."""
    pointer = builder.bitcast(builder.gep(data, [at]), value.type.as_pointer())
    loaded = builder.load(pointer)
    product = builder.fmul(value, weight, flags=("contract",))
    stored = builder.store(builder.fadd(loaded, product, flags=("contract",)), pointer)
    loaded.align = stored.align = element.bitwidth // 8


@intrinsic
def _add_scaled(typing_context: Any, array: Any, at: Any, weight: Any, value: Any) -> Lowering:
    """array[at : at + 4] += weight * value; array is flat, value a tuple of four of its type; `at` is not checked."""
    element = array.dtype
    signature = types.void(array, types.intp, element, types.UniTuple(element, 4))

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        array, at, weight, value = arguments
        data = context.make_array(signature.args[0])(context, builder, array).data
        values = _vector(context, builder, element, [builder.extract_value(value, lane) for lane in range(4)])
        _add(builder, element, data, at, _vector(context, builder, element, [weight] * 4), values)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def _add_at_crossings(
    typing_context: Any, array: Any, at: Any, step: Any, step_after: Any, weights: Any, first: Any, value: Any
) -> Lowering:
    """`add_scaled` at `at`, at + step, at + step_after and at + both, by weights[first + k CHUNK_PX] for k = 0, 1, 2, 3."""
    element = array.dtype
    signature = types.void(array, types.intp, types.intp, types.intp, weights, types.intp, types.UniTuple(element, 4))

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        array, at, step, step_after, weights, first, value = arguments
        data = context.make_array(signature.args[0])(context, builder, array).data
        weight = builder.gep(context.make_array(signature.args[4])(context, builder, weights).data, [first])
        values = _vector(context, builder, element, [builder.extract_value(value, lane) for lane in range(4)])
        after = builder.add(at, step_after)
        places = (at, builder.add(at, step), after, builder.add(after, step))
        for k, place in enumerate(places):
            scalar = builder.load(builder.gep(weight, [ir.Constant(ir.IntType(64), k * CHUNK_PX)]))
            _add(builder, element, data, place, _vector(context, builder, element, [scalar] * 4), values)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def _fetch(typing_context: Any, array: Any, at: Any) -> Lowering:
    """Have the cache line of array[at] ready for writing soon."""
    signature = types.void(array, types.intp)

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        i32, i8p = ir.IntType(32), ir.IntType(8).as_pointer()
        function = builder.module.declare_intrinsic("llvm.prefetch", [i8p], ir.FunctionType(ir.VoidType(), [i8p, i32, i32, i32]))
        pointer = builder.bitcast(builder.gep(data, [arguments[1]]), i8p)
        builder.call(function, [pointer, ir.Constant(i32, 1), ir.Constant(i32, 3), ir.Constant(i32, 1)])
        return context.get_dummy_value()

    return signature, generate


AIM_PX = 8
"""Pixels that `aim_at_crossings` prepares at once."""


@intrinsic
def _aim_at_crossings(
    typing_context: Any, targets: Any, weights: Any, columns: Any, lines: Any, shares: Any, places: Any, steps: Any, sign: Any
) -> Lowering:
    """Eight pixels of one corner: where its first crossing lies in the ring, and the weights of all four.

    targets, columns, lines: int32; weights, shares, sign: the ring's type; all flat. places: (pixel, first target, first
    weight, first line before, first line after); weights lie CHUNK_PX apart. steps: int32 (of the chunk, of a line before,
    of a line after, of the plane, elements of the ring, which positions wrap around at).
    """
    element = shares.dtype
    signature = types.void(targets, weights, columns, lines, shares, types.UniTuple(types.intp, 5), types.UniTuple(types.int32, 5), element)

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        i32, real = ir.IntType(32), context.get_value_type(element)
        data = [context.make_array(signature.args[k])(context, builder, arguments[k]).data for k in range(5)]
        pixel, target, weight, before, after = (builder.extract_value(arguments[5], k) for k in range(5))

        def pointer(array: Any, at: Any, scalar: Any) -> Any:
            return builder.bitcast(builder.gep(array, [builder.add(at, pixel)]), ir.VectorType(scalar, AIM_PX).as_pointer())

        def load(array: Any, at: Any, scalar: Any, size: int) -> Any:
            loaded = builder.load(pointer(array, at, scalar))
            loaded.align = size
            return loaded

        def store(value: Any, array: Any, at: Any, scalar: Any, size: int) -> None:
            builder.store(value, pointer(array, at, scalar)).align = size

        def splat(value: Any, scalar: Any) -> Any:
            vector = ir.Constant(ir.VectorType(scalar, AIM_PX), ir.Undefined)
            for lane in range(AIM_PX):
                vector = builder.insert_element(vector, value, ir.Constant(i32, lane))
            return vector

        start, step, step_after, plane, around = (splat(builder.extract_value(arguments[6], k), i32) for k in range(5))
        size = element.bitwidth // 8
        zero, none = ir.Constant(ir.IntType(64), 0), ir.Constant(ir.VectorType(i32, AIM_PX), [0] * AIM_PX)
        at = builder.add(start, load(data[2], zero, i32, 4))
        at = builder.add(at, builder.mul(step, load(data[3], before, i32, 4)))
        at = builder.add(at, builder.mul(step_after, load(data[3], after, i32, 4)))
        at = builder.add(at, builder.select(builder.icmp_signed("<", at, none), around, none))
        at = builder.sub(at, builder.select(builder.icmp_signed(">=", at, around), around, none))
        store(builder.add(at, plane), data[0], target, i32, 4)
        whole = splat(arguments[7], real)
        upper = builder.fmul(whole, load(data[4], before, real, size))
        share = load(data[4], after, real, size)
        upper_after = builder.fmul(upper, share)
        lower_after = builder.fsub(builder.fmul(whole, share), upper_after)
        lower = builder.fsub(builder.fsub(whole, upper), lower_after)
        for k, value in enumerate((lower, builder.fsub(upper, upper_after), lower_after, upper_after)):
            store(value, data[1], builder.add(weight, ir.Constant(ir.IntType(64), k * CHUNK_PX)), real, size)
        return context.get_dummy_value()

    return signature, generate


# Compiled code calls them without the typing context, which type checkers cannot know.
add_scaled: Any = _add_scaled
add_at_crossings: Any = _add_at_crossings
fetch: Any = _fetch
aim_at_crossings: Any = _aim_at_crossings

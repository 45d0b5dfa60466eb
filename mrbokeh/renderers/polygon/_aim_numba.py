"""Where the impulses of a corner fall and how strong they are, for eight pixels at once."""

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from mrbokeh.renderers.kernels._vectors_numba import Lowering, data_of, filled, load_vector, shuffled, store_vector

# ruff: noqa: ARG001  (numba reads the arguments of an intrinsic by their names)

CHUNK_PX = 64
"""Pixels of a row that are prepared together."""
AIM_PX = 8
"""Pixels that one call aims."""


def _aiming(pairs: tuple[tuple[int, int], tuple[int, int]]) -> Any:
    """Of the crossings 0 (neither edge's line moved), 1 (that of the edge before), 2 (after), 3 (both) those that are stored together."""

    @intrinsic
    def aim(
        typing_context: Any, targets: Any, weights: Any, columns: Any, lines: Any, shares: Any, places: Any, steps: Any, signs: Any
    ) -> Lowering:
        """Crossing 0 as an element of the ring, and the weights of all four, two by two.

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

"""All points of a kernel for one pixel or for two neighbours, as one compiled loop: one weight and one place serve both pixels."""

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from mrbokeh.renderers._vectors_numba import Lowering, data_of, filled, load_vector

# ruff: noqa: ARG001  (numba reads the arguments of an intrinsic by their names)

_LANES = 4
_WIDEST_BYTES = 32  # wider vectors straddle two cache lines more often than they save steps


def _adding_points(pixels: int) -> Any:
    """out[here + offsets[n] : .. + 4 pixels] += weights[n] * values[at : at + 4 pixels] for n from low to high.

    All arrays are flat, out and weights of one type, values of single precision; places are not checked.
    """

    @intrinsic
    def add(typing_context: Any, out: Any, here: Any, offsets: Any, weights: Any, low: Any, high: Any, values: Any, at: Any) -> Lowering:
        signature = types.void(out, types.intp, offsets, weights, types.intp, types.intp, values, types.intp)
        size = out.dtype.bitwidth // 8
        lanes = min(_LANES * pixels, _WIDEST_BYTES // size)

        def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
            real = context.get_value_type(out.dtype)
            data, offset_data, weight_data, light = (data_of(context, builder, signature.args[k], arguments[k]) for k in (0, 2, 3, 6))
            first, end = arguments[4], arguments[5]
            parts = range(0, _LANES * pixels, lanes)
            vectors = [_value(builder, light, builder.add(arguments[7], ir.Constant(first.type, part)), real, lanes) for part in parts]
            before, loop, after = builder.block, builder.append_basic_block("points"), builder.append_basic_block("done")
            builder.cbranch(builder.icmp_signed("<", first, end), loop, after)
            builder.position_at_end(loop)
            n = builder.phi(first.type)
            n.add_incoming(first, before)
            place = builder.add(arguments[1], builder.sext(builder.load(builder.gep(offset_data, [n])), first.type))
            weight = filled(builder, builder.load(builder.gep(weight_data, [n])), lanes)
            for part, vector in zip(parts, vectors, strict=True):
                _add_to(builder, builder.gep(data, [builder.add(place, ir.Constant(first.type, part))]), vector, weight, size)
            following = builder.add(n, ir.Constant(first.type, 1))
            n.add_incoming(following, loop)
            builder.cbranch(builder.icmp_signed("<", following, end), loop, after)
            builder.position_at_end(after)
            return context.get_dummy_value()

        return signature, generate

    return add


def _value(builder: ir.IRBuilder, light: Any, at: Any, real: Any, lanes: int) -> Any:
    vector = load_vector(builder, light, at, ir.FloatType(), lanes, 4)
    return vector if real == ir.FloatType() else builder.fpext(vector, ir.VectorType(real, lanes))


def _add_to(builder: ir.IRBuilder, pointer: Any, vector: Any, weight: Any, size: int) -> None:
    pointer = builder.bitcast(pointer, vector.type.as_pointer())
    there = builder.load(pointer)
    there.align = size
    product = builder.fmul(vector, weight, flags=("contract",))
    builder.store(builder.fadd(there, product, flags=("contract",)), pointer).align = size


# Compiled code calls them without the typing context, which type checkers cannot know.
add_points: Any = _adding_points(1)
add_points_of_two: Any = _adding_points(2)

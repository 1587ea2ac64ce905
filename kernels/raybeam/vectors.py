"""Vectors of 8 float32 or 4 float64 numbers that compiled loops keep in CPU registers.

numba vectorizes loops over arrays, but not the body of a tree traversal, and it stores each
intermediate result of such a loop in memory. Values of a type that is an LLVM vector remain in
registers. LLVM splits these vectors if the registers of a CPU are shorter, such as the 4 float32
numbers of SSE and NEON.

A mask is an integer in which bit k belongs to lane k. Pointers come from `cast_record.pointer`,
indices count elements, and addresses do not need to be aligned.
"""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

_I8 = ir.IntType(8)
_I32 = ir.IntType(32)
_I64 = ir.IntType(64)


class Vector(types.Type):
    """The numba type of a vector with `count` elements of a numba number type."""

    def __init__(self, element: Any, count: int) -> None:
        self.element = element
        self.count = count
        super().__init__(f"vector{count}_{element}")


single8 = Vector(types.float32, 8)
double4 = Vector(types.float64, 4)
_LLVM = {single8: ir.VectorType(ir.FloatType(), 8), double4: ir.VectorType(ir.DoubleType(), 4)}
_VECTOR = {types.float32: single8, types.float64: double4}


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _LLVM[kind])


def _define_operator(function: Any, instruction: str) -> None:
    """Implement an operator for two vectors of the same type with an LLVM instruction."""

    @infer_global(function)
    class _Typing(AbstractTemplate):
        def generic(self, arguments: Any, keywords: Any) -> Any:
            first, *others = arguments
            return signature(first, *arguments) if others == [first] else None

    @lower_builtin(function, Vector, Vector)
    def _lower(context: Any, builder: Any, kinds: Any, arguments: Any) -> Any:
        return getattr(builder, instruction)(*arguments)


for _operator, _instruction in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _define_operator(_operator, _instruction)


def _element_pointer(builder: Any, pointer: Any, index: Any, kind: Any) -> Any:
    """Return a pointer to the element `index` after `pointer`."""
    return builder.bitcast(builder.gep(pointer, [index]), kind.as_pointer())


def _splat(builder: Any, number: Any, kind: Any) -> Any:
    """Return a vector of an LLVM type in which all elements are equal."""
    undefined = ir.Constant(kind, ir.Undefined)
    first = builder.insert_element(undefined, number, _I32(0))
    lanes = ir.Constant(ir.VectorType(_I32, kind.count), [0] * kind.count)
    return builder.shuffle_vector(first, undefined, lanes)


@intrinsic
def load(context: Any, pointer: Any, index: Any) -> Any:
    """Load a vector from consecutive elements, starting at an index."""
    kind = _VECTOR[pointer.dtype]

    def generate(context: Any, builder: Any, kinds: Any, arguments: Any) -> Any:
        pointer, index = arguments
        align = kind.element.bitwidth // 8
        return builder.load(_element_pointer(builder, pointer, index, _LLVM[kind]), align=align)

    return kind(pointer, types.int64), generate


@intrinsic
def store(context: Any, pointer: Any, index: Any, value: Any) -> Any:
    """Store a vector in consecutive elements, starting at an index."""

    def generate(context: Any, builder: Any, kinds: Any, arguments: Any) -> Any:
        pointer, index, value = arguments
        align = kinds.args[2].element.bitwidth // 8
        builder.store(value, _element_pointer(builder, pointer, index, value.type), align=align)
        return context.get_dummy_value()

    return types.void(pointer, types.int64, value), generate


@intrinsic
def splat(context: Any, number: Any) -> Any:
    """Return a vector in which all lanes are equal to a float32 or float64 number."""
    kind = _VECTOR[number]

    def generate(context: Any, builder: Any, kinds: Any, arguments: Any) -> Any:
        return _splat(builder, arguments[0], _LLVM[kind])

    return kind(number), generate


def _call(builder: Any, name: str, result: Any, arguments: Any) -> Any:
    kinds = [argument.type for argument in arguments]
    function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(result, kinds), name)
    return builder.call(function, arguments)


def _suffix(kind: Any) -> str:
    """Return the suffix that LLVM intrinsics have for a vector type."""
    return f"v{kind.count}f{kind.element.bitwidth}"


@intrinsic
def multiply_add(context: Any, a: Any, b: Any, c: Any) -> Any:
    """Return ``a * b + c``, computed by a fused instruction if the CPU has one.

    Whether it is fused affects the last bits, so it must not be used where a hit is decided.
    """

    def generate(context: Any, builder: Any, kinds: Any, arguments: Any) -> Any:
        name = f"llvm.fmuladd.{_suffix(kinds.args[0])}"
        return _call(builder, name, arguments[0].type, arguments)

    return a(a, a, a), generate


def _unary(name: str) -> Any:
    @intrinsic
    def function(context: Any, a: Any) -> Any:
        def generate(context: Any, builder: Any, kinds: Any, arguments: Any) -> Any:
            full_name = f"llvm.{name}.{_suffix(kinds.args[0])}"
            return _call(builder, full_name, arguments[0].type, arguments)

        return a(a), generate

    return function


absolute = _unary("fabs")
square_root = _unary("sqrt")


@intrinsic
def copy_sign(context: Any, a: Any, b: Any) -> Any:
    """Return `a` with the signs of `b`."""

    def generate(context: Any, builder: Any, kinds: Any, arguments: Any) -> Any:
        full_name = f"llvm.copysign.{_suffix(kinds.args[0])}"
        return _call(builder, full_name, arguments[0].type, arguments)

    return a(a, a), generate


def _select(comparison: str) -> Any:
    @intrinsic
    def choose(context: Any, a: Any, b: Any) -> Any:
        def generate(context: Any, builder: Any, kinds: Any, arguments: Any) -> Any:
            return builder.select(builder.fcmp_ordered(comparison, *arguments), *arguments)

        return a(a, a), generate

    return choose


# If a lane of either vector is NaN, the result is the lane of the second vector.
minimum = _select("<")
maximum = _select(">")


@intrinsic
def greater_equal(context: Any, a: Any, b: Any) -> Any:
    """Return a mask of the lanes in which ``a >= b``."""

    def generate(context: Any, builder: Any, kinds: Any, arguments: Any) -> Any:
        lanes = builder.fcmp_ordered(">=", *arguments)
        return builder.zext(builder.bitcast(lanes, ir.IntType(kinds.args[0].count)), _I64)

    return types.int64(a, a), generate


def _reduce_lanes(comparison: str) -> Any:
    @intrinsic
    def reduce(context: Any, a: Any) -> Any:
        def generate(context: Any, builder: Any, kinds: Any, arguments: Any) -> Any:
            (vector,) = arguments
            count = kinds.args[0].count
            step = count // 2
            while step:
                lanes = [(lane + step) % count for lane in range(count)]
                turned = builder.shuffle_vector(
                    vector,
                    ir.Constant(vector.type, ir.Undefined),
                    ir.Constant(ir.VectorType(_I32, count), lanes),
                )
                compared = builder.fcmp_ordered(comparison, vector, turned)
                vector = builder.select(compared, vector, turned)
                step //= 2
            return builder.extract_element(vector, _I32(0))

        return a.element(a), generate

    return reduce


max_lane = _reduce_lanes(">")
min_lane = _reduce_lanes("<")


@intrinsic
def to_float32(context: Any, a: Any, b: Any) -> Any:
    """Convert two vectors of 4 float64 numbers to one vector of 8 float32 numbers."""

    def generate(context: Any, builder: Any, kinds: Any, arguments: Any) -> Any:
        lanes = ir.Constant(ir.VectorType(_I32, 8), list(range(8)))
        return builder.fptrunc(builder.shuffle_vector(*arguments, lanes), _LLVM[single8])

    return single8(a, a), generate


@intrinsic
def lowest_bit(context: Any, mask: Any) -> Any:
    """Return the position of the lowest set bit of a nonzero mask."""

    def generate(context: Any, builder: Any, kinds: Any, arguments: Any) -> Any:
        return _call(builder, "llvm.cttz.i64", _I64, [arguments[0], ir.IntType(1)(1)])

    return types.int64(types.int64), generate


@intrinsic
def bit_count(context: Any, mask: Any) -> Any:
    """Return the number of set bits in a mask."""

    def generate(context: Any, builder: Any, kinds: Any, arguments: Any) -> Any:
        return _call(builder, "llvm.ctpop.i64", _I64, arguments)

    return types.int64(types.int64), generate


@intrinsic
def prefetch(context: Any, pointer: Any, index: Any) -> Any:
    """Prefetch the cache line that contains the byte `index` bytes after `pointer`."""

    def generate(context: Any, builder: Any, kinds: Any, arguments: Any) -> Any:
        pointer, index = arguments
        address = _element_pointer(builder, pointer, index, _I8)
        _call(builder, "llvm.prefetch.p0", ir.VoidType(), [address, _I32(0), _I32(3), _I32(1)])
        return context.get_dummy_value()

    return types.void(pointer, types.int64), generate


@intrinsic
def store_masked(context: Any, mask: Any, pointer: Any, index: Any, value: Any) -> Any:
    """Store only the selected lanes of a vector at an index, without branching."""

    def generate(context: Any, builder: Any, kinds: Any, arguments: Any) -> Any:
        mask, pointer, index, value = arguments
        count = value.type.count
        bits = builder.trunc(mask, ir.IntType(count))
        lanes = builder.bitcast(bits, ir.VectorType(ir.IntType(1), count))
        target = _element_pointer(builder, pointer, index, value.type)
        align = kinds.args[3].element.bitwidth // 8
        old = builder.load(target, align=align)
        builder.store(builder.select(lanes, value, old), target, align=align)
        return context.get_dummy_value()

    return types.void(types.int64, pointer, types.int64, value), generate


@intrinsic
def store_int64(context: Any, pointer: Any, index: Any, value: Any) -> Any:
    """Store an int64 at a byte index in the byte order of the CPU."""

    def generate(context: Any, builder: Any, kinds: Any, arguments: Any) -> Any:
        pointer, index, value = arguments
        builder.store(value, _element_pointer(builder, pointer, index, _I64), align=1)
        return context.get_dummy_value()

    return types.void(pointer, types.int64, types.int64), generate


@intrinsic
def splat_bits(context: Any, number: Any) -> Any:
    """Return a float64 vector in which each lane has the bits of an int64.

    The vector is only meant to be stored.
    """

    def generate(context: Any, builder: Any, kinds: Any, arguments: Any) -> Any:
        return _splat(builder, builder.bitcast(arguments[0], ir.DoubleType()), _LLVM[double4])

    return double4(types.int64), generate

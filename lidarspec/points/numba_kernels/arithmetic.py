"""Primitives of generated kernels.

They are indexing without checks, sine and cosine of float32, and the special cases of NumPy.

The only module that imports Numba as it is imported; nothing imports it but a kernel.
"""

from __future__ import annotations

import math
import sys

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

# mypy: disable-error-code="no-untyped-call, no-untyped-def, call-arg"


BYTES = types.Array(types.uint8, 1, "C", readonly=True)
SINGLES = types.Array(types.float32, 1, "C", readonly=True)
DOUBLES = types.Array(types.float64, 1, "C", readonly=True)
PLACES = types.Array(types.int64, 1, "C", readonly=True)
WORDS = types.Array(types.uint16, 1, "C", readonly=True)
MADE_SINGLES = types.Array(types.float32, 1, "C")
MADE_PLACES = types.Array(types.int64, 1, "C")
#: columns of whole numbers, by the name of their type.
MADE = {
    f"{sign}int{bits}": types.Array(getattr(types, f"{sign}int{bits}"), 1, "C")
    for sign in ("", "u")
    for bits in (8, 16, 32)
}
INTEGER = types.int64

#: added to a float64 and taken off again, it leaves a whole number, whose lowest bit is the sum's.
_WHOLE = 6755399441055744.0
_PI = math.pi
#: largest float32 below pi.
_BELOW_PI = np.nextafter(np.float32(_PI), np.float32(0))
_FAR = 1e6
_IS_BIG = sys.byteorder == "big"


def compiled(kept, signature, **options):
    """The decorator of a kernel: compiled for its one signature, or as an earlier run kept it."""

    def make(function):
        dispatcher = njit(nogil=True, **options)(function)
        dispatcher._cache = (
            kept  # Numba's own unpickles what lies in its folder, whoever put it there
        )
        dispatcher.compile(signature)
        dispatcher.disable_compile()
        return dispatcher

    return make


@intrinsic
def byte_at(context, array, index):
    """Return a byte as an integer."""

    def make(target, builder, signature, args):
        held = target.make_array(signature.args[0])(target, builder, args[0])
        return builder.zext(
            builder.load(cgutils.gep_inbounds(builder, held.data, args[1])), ir.IntType(64)
        )

    return types.int64(array, types.int64), make


@intrinsic
def word_at(context, array, index):
    """Eight bytes from an index on, the first one lowest."""

    def make(target, builder, signature, args):
        held = target.make_array(signature.args[0])(target, builder, args[0])
        place = cgutils.gep_inbounds(builder, held.data, args[1])
        word = builder.load(builder.bitcast(place, ir.IntType(64).as_pointer()), align=1)
        if _IS_BIG:
            return builder.call(
                builder.module.declare_intrinsic("llvm.bswap", [ir.IntType(64)]), [word]
            )
        return word

    return types.int64(array, types.int64), make


@intrinsic
def four_at(context, array, index):
    """Four bytes from an index on, the first one lowest."""

    def make(target, builder, signature, args):
        held = target.make_array(signature.args[0])(target, builder, args[0])
        place = cgutils.gep_inbounds(builder, held.data, args[1])
        word = builder.load(builder.bitcast(place, ir.IntType(32).as_pointer()), align=1)
        if _IS_BIG:
            return builder.call(
                builder.module.declare_intrinsic("llvm.bswap", [ir.IntType(32)]), [word]
            )
        return word

    return types.uint32(array, types.int64), make


@intrinsic
def apart(context):
    """Declare that the array arguments of the kernel do not overlap.

    The compiler can then compute several points at a time.
    """

    def make(target, builder, signature, args):
        for argument in builder.function.args[2:]:
            if isinstance(argument.type, ir.PointerType):
                argument.add_attribute("noalias")
        return target.get_dummy_value()

    return types.void(), make


@intrinsic
def fused(context, factor, other, added):
    """Return a product and a sum of float32, rounded once."""

    def make(target, builder, signature, args):
        return builder.fma(*args)

    return types.float32(types.float32, types.float32, types.float32), make


def _float_at(bits, kind):
    """Return an intrinsic that loads a float of `bits` bits as float64.

    It loads from an index of bytes. One is made for each byte order.
    """

    def maker(is_swapped):
        @intrinsic
        def loaded(context, array, index):
            def make(target, builder, signature, args):
                held = target.make_array(signature.args[0])(target, builder, args[0])
                place = cgutils.gep_inbounds(builder, held.data, args[1])
                word = builder.load(builder.bitcast(place, ir.IntType(bits).as_pointer()), align=1)
                if is_swapped:
                    word = builder.call(
                        builder.module.declare_intrinsic("llvm.bswap", [ir.IntType(bits)]), [word]
                    )
                number = builder.bitcast(word, kind)
                if bits == 64:
                    return number
                return builder.fpext(number, ir.DoubleType())

            return types.float64(array, types.int64), make

        return loaded

    return maker(_IS_BIG), maker(not _IS_BIG)


float4_little, float4_big = _float_at(32, ir.FloatType())
float8_little, float8_big = _float_at(64, ir.DoubleType())


@intrinsic
def at(context, array, index):
    """Return an element of an array; whether there is one is not checked."""

    def make(target, builder, signature, args):
        held = target.make_array(signature.args[0])(target, builder, args[0])
        return builder.load(cgutils.gep_inbounds(builder, held.data, args[1]))

    return array.dtype(array, types.int64), make


@intrinsic
def put(context, array, index, value):
    """Store an element of an array; whether there is one is not checked."""

    def make(target, builder, signature, args):
        held = target.make_array(signature.args[0])(target, builder, args[0])
        builder.store(args[2], cgutils.gep_inbounds(builder, held.data, args[1]))
        return target.get_dummy_value()

    return types.void(array, types.int64, array.dtype), make


@intrinsic
def flipped(context, value, whole):
    """Return a float32 with its sign changed where the lowest bit of a float64 is set."""

    def make(target, builder, signature, args):
        word = ir.IntType(32)
        bits = builder.trunc(builder.bitcast(args[1], ir.IntType(64)), word)
        sign = builder.shl(bits, ir.Constant(word, 31))
        return builder.bitcast(builder.xor(builder.bitcast(args[0], word), sign), ir.FloatType())

    return types.float32(types.float32, types.float64), make


@njit(fastmath={"contract"}, forceinline=True, error_model="numpy")
def cos_sin(angle):
    """Cosine and sine in float32, within 1.5e-7, of an angle in half turns."""
    whole = angle + _WHOLE
    x = np.float32((angle - (whole - _WHOLE)) * _PI)
    w = x * x
    a = np.float32(-2.607710598567792e-07) * w + np.float32(2.4761886379565112e-05)
    b = np.float32(2.6000548132287804e-06) * w + np.float32(-0.00019806614727713168)
    a = a * w + np.float32(-0.00138884037733078)
    b = b * w + np.float32(0.008333017118275166)
    a = a * w + np.float32(0.04166664183139801)
    b = b * w + np.float32(-0.16666656732559204)
    a = a * w + np.float32(-0.5)
    return flipped(a * w + np.float32(1.0), whole), flipped(b * (x * w) + x, whole)


@njit(forceinline=True, error_model="numpy")
def modulo(a, b):
    """np.mod; what is within a period already needs no division."""
    if 0.0 <= a < b:
        return a
    if -b <= a < 0.0:
        return a + b
    return a % b


@njit(forceinline=True)
def smaller(a, b):
    """np.minimum."""
    if a <= b or a != a:
        return a
    return b


@njit(forceinline=True)
def larger(a, b):
    """np.maximum."""
    if a >= b or a != a:
        return a
    return b


@njit(forceinline=True)
def number(a):
    """np.nan_to_num."""
    if a != a:
        return 0.0
    return min(max(a, -1.7976931348623157e308), 1.7976931348623157e308)


@njit(forceinline=True)
def returned(a):
    """`conventions.returned_range`."""
    if 0.0 < a < np.inf:
        return a
    return np.nan


@njit(forceinline=True)
def looked_up(table, index):
    """Return the entry of a table; nan where there is none."""
    if 0 <= index < len(table):
        return at(table, np.int64(index))
    return np.nan


@njit(forceinline=True)
def row_at(index, rows):
    """Return the table row for an index.

    Returns the last row, which is nan, for an index that the table does not have.
    """
    if 0 <= index < rows - 1:
        return np.int64(index)
    return rows - 1


@njit(forceinline=True, error_model="numpy")
def narrowed(angle):
    """Radians as float32 in [-pi, pi), as `clouds.narrowed`."""
    turned = angle - 2 * _PI * np.floor((angle + _PI) / (2 * _PI))
    if abs(angle) > _FAR:
        turned = (angle + _PI) % (2 * _PI) - _PI
    short = np.float32(turned)
    if short > _BELOW_PI:
        return _BELOW_PI
    if short < -_BELOW_PI:
        return -_BELOW_PI
    return short

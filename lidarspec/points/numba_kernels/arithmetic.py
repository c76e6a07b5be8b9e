"""Functions that generated kernels call.

Importing this module imports Numba. Only generated kernels import it.
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
INTEGERS = types.Array(types.int64, 1, "C", readonly=True)
WORDS = types.Array(types.uint16, 1, "C", readonly=True)
SINGLE_COLUMN = types.Array(types.float32, 1, "C")
INTEGER_COLUMN = types.Array(types.int64, 1, "C")
#: The types of integer columns, by the name of their dtype.
INTEGER_COLUMNS = {
    f"{sign}int{bits}": types.Array(getattr(types, f"{sign}int{bits}"), 1, "C")
    for sign in ("", "u")
    for bits in (8, 16, 32)
}
INTEGER = types.int64

#: Adding and subtracting this number rounds a float64 to an integer. The lowest bit of the sum is
#: the lowest bit of the integer.
_ROUNDING_CONSTANT = 6755399441055744.0
_PI = math.pi
#: The largest float32 below pi.
_BELOW_PI = np.nextafter(np.float32(_PI), np.float32(0))
_MAX_SUBTRACTED_RAD = 1e6
_IS_BIG = sys.byteorder == "big"


def compile_kernel(stored, signature, **options):
    """Return a decorator that compiles a kernel, or loads its stored code.

    Args:
        stored: an object that loads and saves the compiled code.
        signature: the types of the arguments.
    """

    def make(function):
        dispatcher = njit(nogil=True, **options)(function)
        dispatcher._cache = stored  # Numba's own cache unpickles any file in its folder
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
    """Return the little-endian integer in the eight bytes at an index."""

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
    """Return the little-endian integer in the four bytes at an index."""

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
def assume_no_alias(context):
    """Declare that the array arguments of the kernel do not overlap."""
    # The compiler can then compute several points at a time.

    def make(target, builder, signature, args):
        for argument in builder.function.args[2:]:
            if isinstance(argument.type, ir.PointerType):
                argument.add_attribute("noalias")
        return target.get_dummy_value()

    return types.void(), make


@intrinsic
def multiply_add(context, factor, other, added):
    """Return factor * other + added in float32, rounded once."""

    def make(target, builder, signature, args):
        return builder.fma(*args)

    return types.float32(types.float32, types.float32, types.float32), make


def _float_at(bits, kind):
    """Return functions that read a little-endian and a big-endian float as float64.

    Args:
        bits: the size of the float.
        kind: the type of the float in LLVM.
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
    """Return an element of an array, without a bounds check."""

    def make(target, builder, signature, args):
        held = target.make_array(signature.args[0])(target, builder, args[0])
        return builder.load(cgutils.gep_inbounds(builder, held.data, args[1]))

    return array.dtype(array, types.int64), make


@intrinsic
def put(context, array, index, value):
    """Store an element of an array, without a bounds check."""

    def make(target, builder, signature, args):
        held = target.make_array(signature.args[0])(target, builder, args[0])
        builder.store(args[2], cgutils.gep_inbounds(builder, held.data, args[1]))
        return target.get_dummy_value()

    return types.void(array, types.int64, array.dtype), make


@intrinsic
def flip_sign(context, value, whole):
    """Return the float32 `value`, negated if the lowest bit of `whole` is set."""

    def make(target, builder, signature, args):
        word = ir.IntType(32)
        bits = builder.trunc(builder.bitcast(args[1], ir.IntType(64)), word)
        sign = builder.shl(bits, ir.Constant(word, 31))
        return builder.bitcast(builder.xor(builder.bitcast(args[0], word), sign), ir.FloatType())

    return types.float32(types.float32, types.float64), make


@njit(fastmath={"contract"}, forceinline=True, error_model="numpy")
def cos_sin(angle):
    """Return cosine and sine in float32, within 1.5e-7, of an angle in half turns."""
    whole = angle + _ROUNDING_CONSTANT
    x = np.float32((angle - (whole - _ROUNDING_CONSTANT)) * _PI)
    w = x * x
    a = np.float32(-2.607710598567792e-07) * w + np.float32(2.4761886379565112e-05)
    b = np.float32(2.6000548132287804e-06) * w + np.float32(-0.00019806614727713168)
    a = a * w + np.float32(-0.00138884037733078)
    b = b * w + np.float32(0.008333017118275166)
    a = a * w + np.float32(0.04166664183139801)
    b = b * w + np.float32(-0.16666656732559204)
    a = a * w + np.float32(-0.5)
    return flip_sign(a * w + np.float32(1.0), whole), flip_sign(b * (x * w) + x, whole)


@njit(forceinline=True, error_model="numpy")
def modulo(a, b):
    """Return `np.mod(a, b)`, without a division if a is between -b and b."""
    if 0.0 <= a < b:
        return a
    if -b <= a < 0.0:
        return a + b
    return a % b


@njit(forceinline=True)
def minimum(a, b):
    """Return the same as `np.minimum`."""
    if a <= b or a != a:
        return a
    return b


@njit(forceinline=True)
def maximum(a, b):
    """Return the same as `np.maximum`."""
    if a >= b or a != a:
        return a
    return b


@njit(forceinline=True)
def replace_nan(a):
    """Return the same as `np.nan_to_num`."""
    if a != a:
        return 0.0
    return min(max(a, -1.7976931348623157e308), 1.7976931348623157e308)


@njit(forceinline=True)
def mark_no_return(a):
    """Return the same as `conventions.returned_range`."""
    if 0.0 < a < np.inf:
        return a
    return np.nan


@njit(forceinline=True)
def look_up(table, index):
    """Return an entry of a table; nan if the index is out of range."""
    if 0 <= index < len(table):
        return at(table, np.int64(index))
    return np.nan


@njit(forceinline=True)
def row_at(index, rows):
    """Return `index` if it is in range, else the index of the last row, which is nan."""
    if 0 <= index < rows - 1:
        return np.int64(index)
    return rows - 1


@njit(forceinline=True, error_model="numpy")
def narrow_angle(angle):
    """Return radians as float32 in [-pi, pi), as `conventions.narrow_angle` does."""
    turned = angle - 2 * _PI * np.floor((angle + _PI) / (2 * _PI))
    if abs(angle) > _MAX_SUBTRACTED_RAD:
        turned = (angle + _PI) % (2 * _PI) - _PI
    short = np.float32(turned)
    if short > _BELOW_PI:
        return _BELOW_PI
    if short < -_BELOW_PI:
        return -_BELOW_PI
    return short

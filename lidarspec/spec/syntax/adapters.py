"""Convert adapters of construct to functions between raw and decoded values.

An adapter is tried with all values of a byte, or with several hundred values of a wider field. If
the adapter needs construct's context, or fails for some numbers, only construct can apply it.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import construct
import numpy as np
from construct import BytesInteger, Construct, Subconstruct
from numpy.typing import NDArray

from lidarspec.spec import tree
from lidarspec.spec.syntax.structs import (
    bit_width,
    declared_class_name,
    find_xor_key,
    fixed_size,
    is_independent,
    number_kind,
    to_public,
)

#: The number of random values to try for a field that is wider than a byte.
TRIAL_COUNT = 200
#: The number of random values to try for each size of a part of variable size.
SHORT_TRIAL_COUNT = 25

#: Parts of variable size are tried with fewer bytes than this.
MAX_TRIED_BYTES = 8

#: The maximum width of an integer in a column, in bits.
MAX_INT_BITS = 64

#: Adapters with a known meaning, which `meaning` converts.
_KNOWN = (construct.Enum, construct.Validator, construct.StringEncoded)


@dataclass(frozen=True)
class Trial:
    """The results of an adapter for trial values.

    Attributes:
        valid: the raw values that can be decoded.
        values: the decoded values.
        failed: whether the adapter cannot decode some raw values.
        lost: (raw value, changed value) for a raw value that changes when it is decoded and then
            encoded; None if no value changes.
    """

    valid: tuple[Any, ...]
    values: tuple[Any, ...]
    failed: bool
    lost: tuple[Any, Any] | None


def make_int_adapter(con: Construct) -> tree.Adapter | None:
    """Return the functions that decode and encode an integer, or None.

    None means that the construct is no adapter, or that only construct can apply it.
    """
    if not is_int_adapter(con):
        return None
    trial = try_values(con)
    is_partial = trial.failed and _int_bits(con.subcon) > 8
    if not trial.valid or is_partial or trial.lost is not None:
        return None
    allowed = trial.valid if trial.failed else None
    return _make_adapter(
        functools.partial(_decode_int, con), functools.partial(_encode_int, con), trial, allowed
    )


@functools.lru_cache(maxsize=4096)
def without_int_adapters(con: Construct) -> Construct:
    """Return a copy of a bit block without the adapters of its integers."""
    if make_int_adapter(con) is not None:
        return without_int_adapters(con.subcon)
    if not isinstance(con, Subconstruct | construct.Struct):
        return con
    same = copy.copy(con)
    if isinstance(con, Subconstruct):
        same.subcon = without_int_adapters(con.subcon)
    else:
        same.subcons = [without_int_adapters(child) for child in con.subcons]
        same._subcons = construct.Container((child.name, child) for child in same.subcons)
    return same


def is_int_adapter(con: Construct) -> bool:
    """Return whether a construct is an adapter that converts an integer."""
    if not isinstance(con, construct.Adapter) or isinstance(con, _KNOWN):
        return False
    return _int_bits(con.subcon) > 0


@functools.lru_cache(maxsize=4096)
def try_values(con: Construct) -> Trial:
    """Apply an adapter of an integer to many values, and return the results."""
    bits = _int_bits(con.subcon)
    if bits <= 8:
        raws: Sequence[int] = range(1 << bits)
    else:
        import random  # imported here because finding a sensor does not need it

        source = random.Random(bits)
        edges = [0, 1, 2, (1 << bits) - 1, 1 << (bits - 1), (1 << (bits - 1)) - 1]
        raws = [*edges, *(source.getrandbits(bits) for _ in range(TRIAL_COUNT))]
    if number_kind(con.subcon) == "i":
        raws = [raw - (1 << bits) if raw >> (bits - 1) else raw for raw in raws]
    return _run_trial(
        raws, functools.partial(_decode_int, con), functools.partial(_encode_int, con)
    )


def _run_trial(
    raws: Sequence[Any], decode: Callable[[Any], Any], encode: Callable[[Any, int], Any]
) -> Trial:
    valid = []
    values = []
    lost = None
    for raw in raws:
        try:
            value = decode(raw)
        except Exception:  # a function of a plugin may raise anything, for example without context
            continue
        valid.append(raw)
        values.append(value)
        try:
            back = encode(value, len(raw) if isinstance(raw, bytes) else 0)
        except Exception as error:
            back = f"{type(error).__name__}: {error}"
        if back != raw and value == value and lost is None:
            lost = (raw, back)
    return Trial(tuple(valid), tuple(values), len(valid) < len(raws), lost)


def _make_adapter(
    decode: Callable[[Any], Any],
    encode: Callable[[Any, int], Any],
    trial: Trial,
    allowed: tuple[int, ...] | None = None,
    *,
    is_partial: bool = False,
    form: str = "",
) -> tree.Adapter:
    kinds = {type(value) for value in trial.values}
    is_small = all(-(1 << 63) <= value < 1 << 63 for value in trial.values if type(value) is int)
    if kinds == {int} and is_small:
        dtype: np.dtype[Any] = np.dtype(np.int64)
    elif kinds <= {int, float} and is_small:
        dtype = np.dtype(np.float64)
    elif kinds == {bytes}:
        dtype = np.dtype(np.uint8)
    else:
        dtype = np.dtype(object)
    return tree.Adapter(decode, encode, dtype, allowed, is_partial, form)


def _decode_int(con: Any, raw: int) -> Any:
    return con._decode(raw, None, "")


def _encode_int(con: Any, value: Any, size: int) -> Any:
    return con._encode(value, None, "")


def _int_bits(con: Construct) -> int:
    """Return the width of an integer of at most 64 bits; 0 for any other construct."""
    if number_kind(con) not in ("i", "u") or not isinstance(con.length, int):
        return 0
    bits = bit_width(con)
    return bits if bits <= MAX_INT_BITS else 0


def make_text_adapter(con: construct.StringEncoded) -> tree.Adapter:
    """Return the functions that decode and encode a text."""
    inner = con.subcon
    while isinstance(inner, Subconstruct) and not isinstance(inner, construct.NullStripped):
        inner = inner.subcon
    decode = functools.partial(_decode_text, con.encoding, _find_stripped(inner))
    encode = functools.partial(_encode_text, con, _find_stripped(inner))
    form = f"text {con.encoding}"
    return tree.Adapter(decode, encode, np.dtype(object), is_partial=True, form=form)


def make_number_adapter(con: Construct) -> tree.Adapter:
    """Return the functions that decode and encode a number of variable size.

    Args:
        con: construct's VarInt or ZigZag.
    """
    dtype = np.dtype(np.uint64 if con is construct.VarInt else np.int64)
    limits = np.iinfo(dtype)

    def check(value: int) -> int:
        if not limits.min <= value <= limits.max:
            raise ValueError(f"{value} is outside {limits.min} .. {limits.max}")
        return value

    def decode(data: bytes) -> int:
        value = check(con.parse(data))
        if con.build(value) != bytes(data):
            raise ValueError(f"{bytes(data).hex()} is not the shortest form of {value}")
        return value

    def encode(value: Any, _: int) -> bytes:
        return bytes(con.build(check(value)))

    form = f"{declared_class_name(con)} in its shortest form"
    return tree.Adapter(decode, encode, dtype, is_partial=True, form=form)


def _find_stripped(con: Construct) -> Construct | None:
    return con if isinstance(con, construct.NullStripped) else None


def _decode_text(encoding: str, stripped: Any, data: bytes) -> str:
    content = data if stripped is None else stripped.parse(data)
    return str(content.decode(encoding))


def _encode_text(con: Any, stripped: Any, value: Any, size: int) -> bytes:
    data = bytes(con._encode(value, None, ""))
    return data if stripped is None else data.ljust(size, b"\0")


def make_part_adapter(con: Construct) -> tree.Adapter | None:
    """Return the functions that decode and encode a part of a frame, or None.

    None means that the part depends on other fields, is a struct, or changes when it is decoded and
    then encoded.
    """
    size = fixed_size(con)
    if not is_independent(con):
        return None

    def decode(data: bytes) -> Any:
        return to_public(con.parse(data))

    def encode(value: Any, _: int) -> Any:
        return con.build(value)

    import random  # imported here because finding a sensor does not need it

    source = random.Random(size)
    raws = list[bytes]()
    trial_count = TRIAL_COUNT if size else SHORT_TRIAL_COUNT
    for length in [size] if size else range(MAX_TRIED_BYTES):
        ascii_bytes = bytes(source.choice(b"abcdef") for _ in range(length))
        raws += [bytes(length), ascii_bytes]
        raws += (source.randbytes(length) for _ in range(trial_count))
    trial = _run_trial(raws, decode, encode)
    is_struct = any(isinstance(value, dict) for value in trial.values)
    # Examples of texts consist of letters, which are no letters after a transformation.
    is_transformed_text = trial.failed and _find_xor(con) is not None
    if not trial.valid or trial.lost is not None or is_struct or is_transformed_text:
        return None
    adapter = _make_adapter(
        decode, encode, trial, is_partial=trial.failed, form=_describe_form(con)
    )
    return replace(adapter, decode_bytes=_find_byte_decoder(con))


def _find_byte_decoder(con: Construct) -> Callable[[NDArray[np.uint8]], NDArray[np.uint8]] | None:
    """Return a function that decodes arrays of bytes, or None."""
    xor = _find_xor(con)
    if xor is None or not isinstance(xor.subcon, construct.Bytes | type(construct.GreedyBytes)):
        return None
    key = find_xor_key(xor)
    if key is None:
        return None
    return functools.partial(_xor_bytes, np.frombuffer(key, np.uint8))


def _find_xor(con: Construct) -> construct.ProcessXor | None:
    """Return the ProcessXor of a part, which may be in a FixedSized; else None."""
    while isinstance(con, construct.FixedSized):
        con = con.subcon
    return con if isinstance(con, construct.ProcessXor) else None


def _xor_bytes(key: NDArray[np.uint8], raw: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return raw ^ np.resize(key, raw.shape[-1])


def _describe_form(con: Construct) -> str:
    """Return a description of how a part is stored."""
    xor = _find_xor(con)
    if xor is not None:
        return f"{type(xor.subcon).__name__} xor {xor.padfunc!r}"
    if isinstance(con, BytesInteger):
        order = "le" if con.swapped else "be"
        return f"{'int' if con.signed else 'uint'}{8 * int(con.length)} {order}"
    return type(con).__name__

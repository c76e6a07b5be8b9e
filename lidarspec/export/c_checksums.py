"""Checksum algorithms as C functions of the byte ranges that they cover."""

from __future__ import annotations

from dataclasses import dataclass

from lidarspec.checksums import Checksum, Crc, Fold15, Sum, WordXor, Xor, ZeroPadded
from lidarspec.export import Refused

_FUNCTION = """\
/* {text} */
static inline uint64_t {name}(const uint8_t *p, const int64_t (*spans)[2], size_t number)
{{
{begin}
    for (size_t s = 0; s < number; ++s)
        for (int64_t k = spans[s][0]; k < spans[s][1]; ++k{counting}) {{
            const uint8_t byte = p[k];
{step}
        }}
{pad}    return {result};
}}
"""


@dataclass(frozen=True)
class _Body:
    """What makes one algorithm: before the bytes, for each byte, and what comes of it; `i` counts the bytes covered so far."""

    begin: str
    step: str
    result: str


def checksum(algorithm: Checksum, name: str) -> str:
    """The function that computes a checksum.

    Raises:
        Refused: for an algorithm that is a plugin's own Python code.
    """
    inner = algorithm.algorithm if isinstance(algorithm, ZeroPadded) else algorithm
    body = _body(inner)
    pad, is_counting = "", isinstance(algorithm, ZeroPadded) or isinstance(inner, WordXor | Fold15)
    if isinstance(algorithm, ZeroPadded):
        if isinstance(inner, Fold15):
            raise Refused("a folded sum that is padded with zeros: which bytes count depends on how many there are in all")
        pad = f"    for (; i % {algorithm.to}; ++i) {{\n        const uint8_t byte = 0;\n{_indented(body.step, 8)}\n    }}\n"
    return _FUNCTION.format(
        text=algorithm.describe(),
        name=name,
        begin=_indented(body.begin + "\nsize_t i = 0;" * is_counting, 4),
        step=_indented(body.step, 12),
        counting=", ++i" * is_counting,
        pad=pad,
        result=body.result,
    )


def _body(algorithm: Checksum) -> _Body:
    match algorithm:
        case Crc():
            return _crc(algorithm)
        case Xor():
            return _Body("uint64_t total = 0;", "total ^= byte;", "total")
        case Sum():
            return _Body("uint64_t total = 0;", "total += byte;", f"total & UINT64_C(0x{(1 << algorithm.width) - 1:x})")
        case WordXor():
            return _word_xor(algorithm)
        case Fold15():
            begin = (
                "uint64_t total = 0;\nint64_t size = 0, first;\n"
                "for (size_t t = 0; t < number; ++t)\n    size += spans[t][1] - spans[t][0];\n"
                "first = size - 60 + size % 2;"
            )
            step = (
                "if ((int64_t)i >= first)\n"
                "    total = ((int64_t)i - (first > 0 ? first : 0)) % 2 ? total + ((uint64_t)byte << 8) : (total << 1) + byte;"
            )
            return _Body(begin, step, "((total & 0x7fff) + (total >> 15)) & 0x7fff")
    raise Refused(f"the checksum {type(algorithm).__name__} is Python code, which C does not run")


def _word_xor(algorithm: WordXor) -> _Body:
    halves = [half for size in algorithm.groups for half in range(size)]
    begin = f"static const uint8_t halves[{len(halves)}] = {{{', '.join(map(str, halves))}}};\nuint64_t total = 0;"
    head = f"i < {algorithm.head} ? i % 2 : " if algorithm.head else ""
    back = f"(i - {algorithm.head})" if algorithm.head else "i"
    return _Body(begin, f"total ^= (uint64_t)byte << 8 * ({head}halves[{back} % {len(halves)}]);", "total")


def _crc(crc: Crc) -> _Body:
    """By a table; the register is aligned to the top of its type unless bits enter lowest first."""
    size = next(size for size in (8, 16, 32, 64) if crc.width <= size)
    kind, shift = f"uint{size}_t", size - crc.width
    poly, init = (_mirrored(crc.poly, crc.width), _mirrored(crc.init, crc.width)) if crc.refin else (crc.poly << shift, crc.init << shift)
    entries = [_literal(_entry(byte, poly, size, refin=crc.refin), size) for byte in range(256)]
    per_line = max(96 // (len(entries[0]) + 2), 1)
    lines = [", ".join(entries[first : first + per_line]) for first in range(0, 256, per_line)]
    table = ",\n    ".join(lines)
    begin = f"static const {kind} table[256] = {{\n    {table}}};\n{kind} total = {_literal(init, size)};"
    if crc.refin:
        step = f"total = ({kind})({_shifted('>>', size)}table[(total ^ byte) & 0xff]);"
        result = "total"
    else:
        top = f"(total >> {size - 8})" if size > 8 else "total"
        step = f"total = ({kind})({_shifted('<<', size)}table[({top} ^ byte) & 0xff]);"
        result = f"(total >> {shift})" if shift else "total"
    if crc.refin != crc.refout:
        result = f"lidarspec_mirrored({result}, {crc.width})"
    return _Body(begin, step, f"{result} ^ {_literal(crc.xorout, size)}" if crc.xorout else f"(uint64_t){result}")


def _shifted(sign: str, size: int) -> str:
    return "" if size == 8 else f"(total {sign} 8) ^ "


def _entry(byte: int, poly: int, size: int, *, refin: bool) -> int:
    value, mask = byte if refin else byte << (size - 8), (1 << size) - 1
    for _ in range(8):
        if refin:
            value = value >> 1 ^ (poly if value & 1 else 0)
        else:
            value = (value << 1 ^ (poly if value >> (size - 1) else 0)) & mask
    return value


def _mirrored(value: int, width: int) -> int:
    return int(f"{value:0{width}b}"[::-1], 2)


def _literal(value: int, size: int) -> str:
    digits = f"0x{value:0{size // 4}x}"
    return f"UINT64_C({digits})" if size == 64 else f"{digits}u"


def _indented(text: str, spaces: int) -> str:
    return "\n".join(" " * spaces + line for line in text.splitlines())

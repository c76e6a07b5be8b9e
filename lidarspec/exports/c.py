"""Checksum algorithms as C functions of the byte ranges that they cover.

What tells whether bytes are a frame of one type: its length, its checksums, its constants.

A C99 header for a sensor: accessors, lengths, checksums and scaling, as functions of bytes; nothing in it depends on struct packing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from lidarspec._version import __version__
from lidarspec.exports import Refused
from lidarspec.exports.c_fields import (
    Extent,
    Piece,
    Places,
    Spot,
    arguments,
    comment,
    fields,
    identifier,
    index,
    parameters,
    pieces,
    quoted,
)
from lidarspec.exports.formulas import Formula, Op, Ref, refs
from lidarspec.exports.messages import Message, messages
from lidarspec.exports.tree import Blob, Block, Number, Repeat, Sealed, formulas
from lidarspec.spec.checksums import Checksum, Crc, Fold15, Sum, WordXor, Xor, ZeroPadded
from lidarspec.spec.sensor import Sensor

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


_LENGTH = """\
/* Bytes of the frame that begins at p, by its header; 0 where the n bytes do not hold the header, or no frame can be so long. */
static inline size_t {name}(const uint8_t *p, size_t n)
{{
{unused}{checks}    const int64_t size = {size};
    return size > 0 && size <= {longest} ? (size_t)size : 0;
}}
"""
_CHECKSUM = """\
/* What the checksum has to be, what it is, and whether that is right. */
static inline uint64_t {name}_computed({parameters})
{{
    const int64_t spans[][2] = {{{spans}}};
    return {algorithm}(p, spans, sizeof spans / sizeof spans[0]);
}}
static inline uint64_t {name}_stored({parameters})
{{
    return {stored};
}}
static inline int {name}_ok({parameters})
{{
    const uint64_t stored = {name}_stored({arguments});
    return {absent}stored == {name}_computed({arguments});
}}
"""
_IS_FRAME = """\
/* Whether a whole frame begins at p: length, constants and checksums are right. */
static inline int {name}(const uint8_t *p, size_t n)
{{
    const size_t size = {length}(p, n);
    if (!size || size > n) return 0;
{checks}    return 1;
}}
"""


def frame(places: Places, algorithm: Callable[[Sealed], str]) -> Iterator[str]:
    """The functions of a frame type that are about the whole of it; `algorithm` gives the name of a checksum's function."""
    checks, longest = _lines(_needs(places)), places.message.frame.max_length
    unused = "" if checks else "    (void)p;\n    (void)n;\n"
    yield _LENGTH.format(name=places.name("", "frame_length"), unused=unused, checks=checks, size=places.size, longest=longest)
    seals = [spot for spot in places.spots if isinstance(spot.node, Sealed)]
    for spot in seals:
        yield _checksum(places, spot, algorithm)
    wrong = [*_constants(places), *(_within(spot, f"!{places.name(spot.path, 'checksum_ok')}({arguments(spot.depth)})") for spot in seals)]
    yield _IS_FRAME.format(name=places.name("", "is_frame"), length=places.name("", "frame_length"), checks=_lines(wrong))


def _lines(statements: list[str] | Iterator[str]) -> str:
    return "".join(f"    {statement}\n" for statement in dict.fromkeys(statements))


def _needs(places: Places) -> Iterator[str]:
    """Checks that what the length depends on is there, and makes sense, in the order in which it is met."""
    longest = places.message.frame.max_length
    for spot in places.spots:
        where = " && ".join(condition.text for condition in spot.conditions if condition.is_fixed)
        before = f"{where} && " if where else ""
        for value in formulas(spot.node):
            if any(ref.info.axes for ref in refs(value)):
                continue
            for ref in refs(value):
                yield from (f"if ({before}(int64_t)n < {end}) return 0;" for end in _ends(places, ref))
            for divisor in _divisors(value):
                yield f"if ({before}!lidarspec_int({places.formula(divisor)})) return 0;"
            if isinstance(spot.node, Repeat | Blob) and not isinstance(value, int):
                yield f"if ({before}!lidarspec_within({places.formula(value)}, {longest})) return 0;"


def _ends(places: Places, ref: Ref) -> Iterator[Extent]:
    """The byte behind a field, at each of its places."""
    for spot in places.named(ref.path):
        yield spot.start + spot.size


def _divisors(value: Formula) -> Iterator[Formula]:
    if isinstance(value, Op):
        for arg in value.args:
            yield from _divisors(arg)
        if value.symbol in ("//", "%") and not isinstance(value.args[1], int):
            yield value.args[1]


def _checksum(places: Places, spot: Spot, algorithm: Callable[[Sealed], str]) -> str:
    node = spot.node
    assert isinstance(node, Sealed)
    held = []
    for path in node.fields:
        found = pieces(places, path) or [Piece(spot) for spot in places.named(path)]
        if len(found) != 1 or found[0].spot.depth != spot.depth:
            raise Refused(f"{path}: a checksum that stands in several places")
        held.append(found[0])
    return _CHECKSUM.format(
        name=places.name(spot.path, "checksum_ok").removesuffix("_ok"),
        parameters=parameters(spot.depth),
        arguments=arguments(spot.depth),
        spans=", ".join(f"{{{start}, {end}}}" for start, end in _spans(places, spot, node, held)),
        algorithm=algorithm(node),
        stored=_stored(held, big=node.algorithm.order == "big"),
        absent="".join(f"stored == UINT64_C({value}) || " for value in node.absent),
    )


def _spans(places: Places, spot: Spot, node: Sealed, held: list[Piece]) -> Iterator[tuple[Extent, Extent]]:
    if node.over is not None:
        first, last = (places.whole(path) for path in node.over)
        yield first.start, last.start + last.size
        return
    start = spot.start
    order = {id(other): number for number, other in enumerate(places.spots)}
    for piece in sorted(held, key=lambda piece: (order[id(piece.spot)], _first(piece))):
        begin = piece.spot.start + Extent(_first(piece))
        if str(begin) != str(start):
            yield start, begin
        start = piece.spot.start + (Extent(_last(piece) + 1) if piece.part is not None else piece.spot.size)
    if str(start) != str(spot.start + spot.size):
        yield start, spot.start + spot.size


def _first(piece: Piece) -> int:
    return min(segment.byte for segment in piece.part.bits.segments) if piece.part else 0


def _last(piece: Piece) -> int:
    return max(segment.byte for segment in piece.part.bits.segments) if piece.part else 0


def _stored(held: list[Piece], *, big: bool) -> str:
    """The value that several fields hold, low bits first."""
    terms, shift = [], 0
    for piece in held:
        node = piece.spot.node
        if piece.part is not None:
            value, width = piece.expression, piece.part.bits.width
        elif isinstance(node, Blob):
            assert isinstance(node.size, int)
            value, width = f"lidarspec_{'be' if big else 'le'}(p + {piece.spot.start}, {node.size})", 8 * node.size
        else:
            assert isinstance(node, Number)
            value, width = piece.expression, 8 * node.size
        value = f"((uint64_t)({value}) & UINT64_C(0x{(1 << width) - 1:x}))"
        terms.append(f"{value} << {shift}" if shift else value)
        shift += width
    return " | ".join(f"({term})" if "<<" in term else term for term in terms)


def _constants(places: Places) -> Iterator[str]:
    for spot in places.spots:
        node = spot.node
        if isinstance(node, Blob) and node.const is not None:
            yield _within(spot, f"memcmp(p + {spot.start}, {quoted(node.const)}, {len(node.const)}) != 0")
        elif isinstance(node, Number) and node.info.const is not None:
            yield _within(spot, f"{Piece(spot).expression} != {_number(node.info.const)}")
        elif isinstance(node, Block):
            for part in node.parts:
                if part.info.const is not None:
                    yield _within(spot, f"({Piece(spot, part).expression}) != {_number(part.info.const)}")


def _number(value: object) -> str:
    if isinstance(value, float):
        return repr(value)
    return (
        f"UINT64_C({value})"
        if isinstance(value, int) and value > 0x7FFFFFFF
        else f"{value}u"
        if isinstance(value, int) and value >= 0
        else f"{value}"
    )


def _within(spot: Spot, wrong: str) -> str:
    """A statement that ends with 0 where something is wrong, for every element of the arrays that it is in."""
    where = " && ".join([*(condition.text for condition in spot.conditions), wrong])
    loops = "".join(
        f"for (size_t {index(level)} = 0; {index(level)} < (size_t)({count}); ++{index(level)}) " for level, count in enumerate(spot.loops)
    )
    return f"{loops}if ({where}) return 0;"


_HEAD = """\
/* {title}: its frames as functions of bytes, made by lidarspec {version}.
 * Source: {source}
 *
 * For every frame type F:
 *   {prefix}_F_frame_length(p, n)  bytes of the frame that begins at p, of which n are there; 0 where the header does not tell
 *   {prefix}_F_is_frame(p, n)      whether a whole, sound frame begins at p
 *   {prefix}_F_checksum_ok(p)      whether its checksum is right; ..._computed(p), ..._stored(p)
 *   {prefix}_F_FIELD(p, i, ...)    the raw number of a field, with an index for each array that it is in
 *   {prefix}_F_FIELD_present(p)    whether a field that not every header has is there; without, it reads as 0
 *   {prefix}_F_ARRAY_count(p)      elements of an array
 *   {prefix}_F_FIELD_to_UNIT(raw)  the physical value
 *
 * All but frame_length and is_frame take a whole frame: ask is_frame first. What only Python decides (whether values are plausible, which
 * frames wait for others) is not asked. C99 and C++11; nothing is allocated.
 */
#ifndef {guard}
#define {guard}

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#ifdef __cplusplus
extern "C" {{
#endif
"""

_HELPERS = """\
#ifndef LIDARSPEC_BYTES
#define LIDARSPEC_BYTES
static inline uint64_t lidarspec_le(const uint8_t *p, int size)
{
    uint64_t value = 0;
    while (size-- > 0)
        value = value << 8 | p[size];
    return value;
}
static inline uint64_t lidarspec_be(const uint8_t *p, int size)
{
    uint64_t value = 0;
    while (size-- > 0)
        value = value << 8 | *p++;
    return value;
}
static inline int64_t lidarspec_signed(uint64_t value, int width)
{
    const uint64_t sign = UINT64_C(1) << (width - 1);
    return value & sign ? -(int64_t)(~value & (sign - 1)) - 1 : (int64_t)value;
}
static inline float lidarspec_float(uint64_t bits)
{
    const uint32_t word = (uint32_t)bits;
    float value;
    memcpy(&value, &word, sizeof value);
    return value;
}
static inline double lidarspec_double(uint64_t bits)
{
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}
static inline float lidarspec_half(uint64_t bits)
{
    const uint32_t sign = (uint32_t)(bits & 0x8000) << 16, exponent = (uint32_t)(bits >> 10) & 31, fraction = (uint32_t)bits & 0x3ff;
    if (exponent == 0) return (sign ? -1.0f : 1.0f) * (float)fraction / 16777216.0f;
    return lidarspec_float(sign | (exponent == 31 ? 0x7f800000u : (exponent + 112) << 23) | fraction << 13);
}
static inline int64_t lidarspec_int(int64_t value) { return value; }
static inline int lidarspec_within(int64_t value, int64_t most) { return value >= 0 && value <= most; }
static inline int64_t lidarspec_floor_div(int64_t a, int64_t b)
{
    return b == 0 ? 0 : a / b - (a % b != 0 && (a % b < 0) != (b < 0));
}
static inline int64_t lidarspec_floor_mod(int64_t a, int64_t b)
{
    return b == 0 ? 0 : a - b * lidarspec_floor_div(a, b);
}
static inline uint64_t lidarspec_mirrored(uint64_t value, int width)
{
    uint64_t found = 0;
    for (; width > 0; --width, value >>= 1)
        found = found << 1 | (value & 1);
    return found;
}
#endif
"""

_TAIL = """\
#ifdef __cplusplus
}
#endif
#endif
"""
#: functions of a whole frame, whose names no field may take.
_OWN = ("frame_length", "is_frame", "checksum_computed", "checksum_stored", "checksum_ok")


def header(sensor: Sensor) -> str:
    """A C99 header that reads the frames of a sensor.

    Raises:
        Refused: where only Python code can decide what a frame is made of, or its places cannot be computed in C.
    """
    prefix = identifier(sensor.id if sensor.id[0].isalpha() else f"lidar_{sensor.id}")
    title, source = f"{sensor.vendor} {sensor.model}", " ".join(sensor.source.split()).replace("*/", "* /")
    names, algorithms = _Names(prefix), _Algorithms(prefix)
    frames = ["\n".join(_frame(message, names, algorithms)) for message in messages(sensor)]
    head = _HEAD.format(title=title, version=__version__, source=source, prefix=prefix, guard=f"{prefix.upper()}_H")
    return "\n".join([head, _HELPERS, *algorithms.texts, *frames, _TAIL])


def _frame(message: Message, names: _Names, algorithms: _Algorithms) -> Iterator[str]:
    places = Places(message, names.of(message))
    longest = f"#define {names.prefix.upper()}_{identifier(message.name).upper()}_MAX_LENGTH {message.frame.max_length}"
    yield comment(f"---- {message.name}: {'from' if message.frame.direction == 'in' else 'to'} the sensor ----")
    yield longest
    yield from (text for text in fields(places) if text)
    yield ""
    yield from frame(places, algorithms.of)


class _Names:
    """C names of what stands in frames, each given once."""

    def __init__(self, prefix: str) -> None:
        self.prefix = prefix
        self._given: dict[str, tuple[str, str, str]] = {}

    def of(self, message: Message) -> Callable[[str, str], str]:
        """The names in one frame type: (path, ending) -> name."""
        for own in _OWN:
            self._name(message.name, "", own)
        return lambda path, ending: self._name(message.name, path, ending)

    def _name(self, frame: str, path: str, ending: str) -> str:
        name = "_".join(identifier(part) for part in (self.prefix, frame, path, ending) if part)
        while self._given.setdefault(name, (frame, path, ending)) != (frame, path, ending):
            name += "_"
        return name


class _Algorithms:
    """The checksum functions that are needed, each once."""

    def __init__(self, prefix: str) -> None:
        self._prefix, self._names = prefix, dict[Checksum, str]()
        self.texts: list[str] = []

    def of(self, node: Sealed) -> str:
        """The name of the function for a seal."""
        if node.algorithm not in self._names:
            name = f"{self._prefix}_checksum_{len(self._names) + 1}"
            self.texts.append(checksum(node.algorithm, name))
            self._names[node.algorithm] = name
        return self._names[node.algorithm]

"""Generate a C99 header for a sensor.

The functions of the header take the bytes of a frame, and do not depend on struct packing. `header`
joins the helper functions in ``c_bytes.h``, a function for each checksum algorithm, and the
functions of each frame type. The functions of a frame type are the accessors of
`lidarspec.exports.c_fields`, and functions that return the length, the validity and the checksums
of a frame.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from importlib import resources
from textwrap import indent
from typing import Any

from lidarspec._version import __version__
from lidarspec.exports import (
    ExportedFrame,
    ExportError,
    c_fields,
    describe_left_out,
    list_frames,
    make_prefix,
)
from lidarspec.exports.c_fields import (
    CEntry,
    CLayout,
    find_accesses,
    format_arguments,
    format_comment,
    format_parameters,
    format_word,
    make_identifier,
    quote_bytes,
)
from lidarspec.frames.wire_table import SizeFormula
from lidarspec.spec import (
    Checksum,
    Crc,
    Fletcher,
    Fold15,
    Sensor,
    Sum,
    WordXor,
    Xor,
    ZeroPadded,
)
from lidarspec.spec.checksums import byte_table, mirrored_bytes, reflect
from lidarspec.spec.tree import (
    Blob,
    Block,
    Check,
    ChecksummedStruct,
    Never,
    Number,
    Op,
    Repeat,
    find_runs,
    formulas,
    iter_subformulas,
    refs,
)

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
class _ChecksumBody:
    """The C code of one checksum algorithm.

    In the code, `i` is the number of bytes covered so far.

    Attributes:
        begin: statements before the first byte.
        step: statements for each byte.
        result: the expression of the checksum.
    """

    begin: str
    step: str
    result: str


def write_checksum(algorithm: Checksum, name: str) -> str:
    """Return the C function that computes a checksum.

    Raises:
        ExportError: if C cannot compute the algorithm, e.g. if a plugin implements it in Python.
    """
    if isinstance(algorithm, ZeroPadded):
        inner = algorithm.algorithm
    else:
        inner = algorithm
    body = _make_body(inner)
    pad = ""
    is_counting = isinstance(algorithm, ZeroPadded) or isinstance(inner, WordXor | Fold15)
    if isinstance(algorithm, ZeroPadded):
        if isinstance(inner, Fold15):
            raise ExportError("the export to C does not support Fold15 inside ZeroPadded")
        pad = (
            f"    for (; i % {algorithm.to}; ++i) {{\n"
            f"        const uint8_t byte = 0;\n{indent(body.step, 8 * ' ')}\n    }}\n"
        )
    return _FUNCTION.format(
        text=algorithm.describe(),
        name=name,
        begin=indent(body.begin + "\nsize_t i = 0;" * is_counting, 4 * " "),
        step=indent(body.step, 12 * " "),
        counting=", ++i" * is_counting,
        pad=pad,
        result=body.result,
    )


def _make_body(algorithm: Checksum) -> _ChecksumBody:
    match algorithm:
        case Crc():
            return _make_crc_body(algorithm)
        case Xor():
            return _ChecksumBody("uint64_t total = 0;", "total ^= byte;", "total")
        case Sum():
            return _ChecksumBody(
                "uint64_t total = 0;",
                "total += byte;",
                f"total & UINT64_C(0x{(1 << algorithm.width) - 1:x})",
            )
        case WordXor():
            return _make_word_xor_body(algorithm)
        case Fletcher():
            return _ChecksumBody(
                "uint64_t first = 0, second = 0;",
                "first += byte;\nsecond += first;",
                "(first & 0xff) | (second & 0xff) << 8",
            )
        case Fold15():
            begin = (
                "uint64_t total = 0;\nint64_t size = 0, first;\n"
                "for (size_t t = 0; t < number; ++t)\n    size += spans[t][1] - spans[t][0];\n"
                "first = size - 60 + size % 2;"
            )
            step = (
                "if ((int64_t)i >= first)\n"
                "    total = ((int64_t)i - (first > 0 ? first : 0)) % 2"
                " ? total + ((uint64_t)byte << 8) : (total << 1) + byte;"
            )
            return _ChecksumBody(begin, step, "((total & 0x7fff) + (total >> 15)) & 0x7fff")
    raise ExportError(
        f"the checksum {type(algorithm).__name__} is Python code and cannot be exported to C"
    )


def _make_word_xor_body(algorithm: WordXor) -> _ChecksumBody:
    halves = [half for size in algorithm.groups for half in range(size)]
    begin = (
        f"static const uint8_t halves[{len(halves)}] = {{{', '.join(map(str, halves))}}};\n"
        "uint64_t total = 0;"
    )
    if algorithm.head:
        head = f"i < {algorithm.head} ? i % 2 : "
    else:
        head = ""
    back = f"(i - {algorithm.head})" if algorithm.head else "i"
    return _ChecksumBody(
        begin, f"total ^= (uint64_t)byte << 8 * ({head}halves[{back} % {len(halves)}]);", "total"
    )


def _make_crc_body(crc: Crc) -> _ChecksumBody:
    """Return the body of a CRC that uses the byte table of `lidarspec.spec.checksums`."""
    size = next(size for size in (8, 16, 32, 64) if crc.width <= size)
    entries = [
        _format_literal(register, size) for register in byte_table(crc.width, crc.poly, crc.refin)
    ]
    per_line = max(96 // (len(entries[0]) + 2), 1)
    table = ",\n    ".join(
        ", ".join(entries[first : first + per_line]) for first in range(0, 256, per_line)
    )
    start = reflect(crc.init, crc.width)
    begin = f"static const uint{size}_t table[256] = {{\n    {table}}};\n"
    begin += f"uint{size}_t total = {_format_literal(start if crc.refin else mirrored_bytes(start), size)};"
    step = f"total = (uint{size}_t)(table[(total ^ byte) & 0xff] ^ total >> 8);"
    if crc.refin:
        result = "(uint64_t)total"
    else:
        result = f"lidarspec_swapped(total, {size // 8}) >> {size - crc.width}"
    if crc.refin != crc.refout:
        result = f"lidarspec_mirrored({result}, {crc.width})"
    return _ChecksumBody(
        begin, step, f"({result}) ^ {_format_literal(crc.xorout, size)}" if crc.xorout else result
    )


def _format_literal(value: int, size: int) -> str:
    digits = f"0x{value:0{size // 4}x}"
    if size == 64:
        return f"UINT64_C({digits})"
    return f"{digits}u"


_LENGTH = """\
/* Return the size of the frame at p in bytes, which its header gives; 0 if the n bytes do not contain the header, or if the size is impossible. */
static inline size_t {name}(const uint8_t *p, size_t n)
{{
{unused}{checks}    const int64_t size = {size};
    return size > 0 && size <= {longest} ? (size_t)size : 0;
}}
"""
_CHECKSUM = """\
/* The computed checksum, the stored checksum, and whether both are equal. */
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
/* Return 1 if a whole frame with valid length, constants and checksums begins at p, else 0. */
static inline int {name}(const uint8_t *p, size_t n)
{{
    const size_t size = {length}(p, n);
    if (!size || size > n) return 0;
{checks}    return 1;
}}
"""


def _iter_frame_functions(layout: CLayout, algorithms: Mapping[Checksum, str]) -> Iterator[str]:
    """Yield the C functions of a frame type that read a whole frame."""
    length = layout.name("", "frame_length")
    longest = layout.message.frame.max_length
    checks = _join_statements(_iter_length_checks(layout))
    unused = "" if checks else "    (void)p;\n    (void)n;\n"
    yield _LENGTH.format(
        name=length, unused=unused, checks=checks, size=layout.size, longest=longest
    )
    checksums = dict[str, tuple[CEntry, ChecksummedStruct]]()
    for entry in layout.entries:
        # If several checksums cover one struct, the outermost is named after the struct, each
        # inner checksum after its field.
        if isinstance(entry.node, ChecksummedStruct):
            if layout.name(entry.path, "checksum_ok") not in checksums:
                path = entry.path
            else:
                path = entry.node.fields[0]
            checksums[layout.name(path, "checksum_ok")] = entry, entry.node
    for name, (entry, checksum) in checksums.items():
        yield _format_checksum(layout, entry, checksum, name, algorithms[checksum.algorithm])
    checksum_checks = [
        _format_check(entry, f"!{name}({format_arguments(entry.depth)})")
        for name, (entry, _) in checksums.items()
    ]
    yield _IS_FRAME.format(
        name=layout.name("", "is_frame"),
        length=length,
        checks=_join_statements([*_iter_value_checks(layout), *checksum_checks]),
    )


def _join_statements(statements: Iterable[str]) -> str:
    return "".join(f"    {statement}\n" for statement in dict.fromkeys(statements))


def _iter_length_checks(layout: CLayout) -> Iterator[str]:
    """Yield C checks of the fields that determine the length, in wire order."""
    longest = layout.message.frame.max_length
    for entry in layout.entries:
        before = "".join(
            f"{condition.text} && " for condition in entry.conditions if condition.is_fixed
        )
        for value in formulas(entry.node):
            if any(ref.info.axes for ref in refs(value)):
                continue
            for ref in refs(value):
                ends = [other.start + other.size for other in layout.find_entries(ref.path)]
                yield from (f"if ({before}(int64_t)n < {end}) return 0;" for end in ends)
            for part in iter_subformulas(value):
                if (
                    isinstance(part, Op)
                    and part.symbol in ("//", "%")
                    and not isinstance(part.args[1], int)
                ):
                    yield f"if ({before}!lidarspec_int({layout.format_formula(part.args[1])})) return 0;"
            if isinstance(entry.node, Repeat | Blob) and not isinstance(value, int):
                yield (
                    f"if ({before}!lidarspec_within({layout.format_formula(value)}, {longest})) return 0;"
                )


def _format_checksum(
    layout: CLayout, entry: CEntry, checksum: ChecksummedStruct, name: str, algorithm: str
) -> str:
    checksum_fields = [access for path in checksum.fields for access in find_accesses(layout, path)]
    for path in checksum.fields:
        depths = [access.depth for access in checksum_fields if access.info.path == path]
        if depths != [entry.depth]:
            raise ExportError(
                f"{path}: the export to C does not support a checksum that is stored in several places"
            )
    return _CHECKSUM.format(
        name=name.removesuffix("_ok"),
        parameters=format_parameters(entry.depth),
        arguments=format_arguments(entry.depth),
        spans=", ".join(
            f"{{{start}, {end}}}"
            for start, end in _iter_covered_spans(layout, entry, checksum, checksum_fields)
        ),
        algorithm=algorithm,
        stored=_format_stored_checksum(checksum_fields, checksum.algorithm.order),
        absent="".join(f"stored == UINT64_C({value}) || " for value in checksum.absent),
    )


def _iter_covered_spans(
    layout: CLayout, entry: CEntry, checksum: ChecksummedStruct, checksum_fields: list[CEntry]
) -> Iterator[tuple[SizeFormula, SizeFormula]]:
    """Yield the byte ranges that a checksum covers.

    Args:
        entry: the struct with the checksum.
        checksum_fields: the fields that store the checksum.
    """
    if checksum.over is not None:
        first, last = (layout.find_whole(path) for path in checksum.over)
        yield first.start, last.start + last.size
        return
    start = entry.start
    order = {id(other.node): number for number, other in enumerate(layout.entries)}
    for access in sorted(
        checksum_fields, key=lambda access: (order[id(access.node)], access.span[0])
    ):
        first_byte, size = access.span
        begin = access.start + SizeFormula(first_byte)
        if str(begin) != str(start):
            yield start, begin
        start = access.start + size
    if str(start) != str(entry.start + entry.size):
        yield start, entry.start + entry.size


def _format_stored_checksum(checksum_fields: list[CEntry], order: str) -> str:
    """Return the C expression of a checksum that is stored in one or more fields.

    Args:
        checksum_fields: the fields that store the checksum, the field with the lowest bits first.
        order: the byte order of a checksum in a field of bytes.
    """
    terms = []
    shift = 0
    for access in checksum_fields:
        node = access.node
        if isinstance(node, Blob):
            assert isinstance(node.size, int)
            value = format_word(access.start, node.size, order)
            width = 8 * node.size
        else:
            value = access.expression
            width = access.info.bits
        value = f"((uint64_t)({value}) & UINT64_C(0x{(1 << width) - 1:x}))"
        terms.append(f"({value} << {shift})" if shift else value)
        shift += width
    return " | ".join(terms)


def _iter_value_checks(layout: CLayout) -> Iterator[str]:
    for entry in layout.entries:
        node = entry.node
        if isinstance(node, Blob) and node.const is not None:
            yield _format_check(
                entry,
                f"memcmp(p + {entry.start}, {quote_bytes(node.const)}, {len(node.const)}) != 0",
            )
        elif isinstance(node, Check):
            yield _format_check(entry, f"!{layout.format_formula(node.condition)}")
        elif isinstance(node, Never):
            yield _format_check(entry, "1")
        elif isinstance(node, Number | Block):
            for access in entry.fields:
                if access.info.const is not None:
                    yield _format_check(
                        entry, f"({access.expression}) != {_format_number(access.info.const)}"
                    )
                elif access.info.allowed is not None:
                    yield _format_check(
                        entry, f"!({_format_allowed(access.expression, access.info.allowed)})"
                    )
                elif access.info.is_enforced and access.info.rebuilt is not None:
                    yield _format_check(
                        entry,
                        f"(int64_t)({access.expression}) != {layout.format_formula(access.info.rebuilt)}",
                    )


def _format_allowed(expression: str, allowed: tuple[int, ...]) -> str:
    """Return a C condition that is true if an expression has one of the allowed values."""
    ranges = (
        f"(lidarspec_int({expression}) >= {first} && lidarspec_int({expression}) <= {last})"
        for first, last in find_runs(allowed)
    )
    return " || ".join(ranges) or "0"


def _format_number(value: Any) -> str:
    """Return a constant as a C literal, unsigned if it is not negative."""
    if isinstance(value, float) or value < 0:
        return repr(value)
    if value > 0x7FFFFFFF:
        return f"UINT64_C({value})"
    return f"{value}u"


def _format_check(entry: CEntry, wrong: str) -> str:
    """Return a C statement that returns 0 if the value of an entry is invalid.

    Args:
        wrong: the C condition that is true if the value is invalid.
    """
    where = " && ".join(filter(None, (entry.full_condition, wrong)))
    names = [(c_fields.name_index(level), count) for level, count in enumerate(entry.loops)]
    loops = "".join(
        f"for (size_t {name} = 0; {name} < (size_t)({count}); ++{name}) " for name, count in names
    )
    return f"{loops}if ({where}) return 0;"


_HEAD = """\
/* {title}: functions that read its frames. Made by lidarspec {version}.
 * Source: {source}
 *
 * For every frame type F:
 *   {prefix}_F_frame_length(p, n)  size in bytes of the frame at p; 0 if the n bytes at p do not contain its header
 *   {prefix}_F_is_frame(p, n)      1 if a whole valid frame begins at p, else 0
 *   {prefix}_F_checksum_ok(p)      1 if its checksum is valid, else 0; also ..._computed(p) and ..._stored(p)
 *   {prefix}_F_FIELD(p, i, ...)    the raw value of a field; one index for each array around it
 *   {prefix}_F_FIELD_present(p)    1 if the frame has an optional field, else 0; the value of a missing field is 0
 *   {prefix}_F_ARRAY_count(p)      number of elements of an array
 *   {prefix}_F_FIELD_to_UNIT(raw)  the physical value
 *
 * Call is_frame first: all functions except frame_length and is_frame require a whole frame. is_frame does not check whether values
 * are plausible, nor whether the frame may follow the frames before it. C99 and C++11; no function allocates memory.
 */
#ifndef {guard}
#define {guard}
"""

_TAIL = """\
#ifdef __cplusplus
}
#endif
#endif
"""
#: The names of functions that read a whole frame end with these words, so fields cannot use them.
_RESERVED_ENDINGS = (
    "frame_length",
    "is_frame",
    "checksum_computed",
    "checksum_stored",
    "checksum_ok",
)


def header(sensor: Sensor) -> str:
    """Return a C99 header that reads the frames of a sensor.

    Raises:
        ExportError: if the content of a frame depends on Python code, or if C cannot compute its
            layout.
    """
    prefix = make_identifier(make_prefix(sensor))
    title, source = (
        text.replace("*/", "* /").replace("/*", "/ *")
        for text in (f"{sensor.vendor} {sensor.model}", sensor.source)
    )
    all_messages = list_frames(sensor)
    algorithms = dict.fromkeys(
        checksum.algorithm for message in all_messages for checksum in message.checksums.values()
    )
    names = {
        algorithm: f"{prefix}_checksum_{number}" for number, algorithm in enumerate(algorithms, 1)
    }
    taken: dict[str, tuple[str, str, str]] = {}
    frames = [
        text
        for message in all_messages
        for text in _iter_definitions(message, prefix, taken, names)
    ]
    head = _HEAD.format(
        title=title, version=__version__, source=source, prefix=prefix, guard=f"{prefix.upper()}_H"
    )
    left_out = describe_left_out(sensor)
    helpers = resources.files("lidarspec.exports").joinpath("c_bytes.h").read_text(encoding="utf-8")
    return "\n".join(
        [
            head,
            *([format_comment(left_out)] if left_out else []),
            helpers,
            *(write_checksum(algorithm, name) for algorithm, name in names.items()),
            *frames,
            _TAIL,
        ]
    )


def _iter_definitions(
    message: ExportedFrame,
    prefix: str,
    taken: dict[str, tuple[str, str, str]],
    algorithms: Mapping[Checksum, str],
) -> Iterator[str]:
    """Yield all definitions of a frame type.

    Args:
        taken: the frame type, path and ending of each C name in use. New names are added.
        algorithms: the name of the C function of each checksum algorithm.
    """
    name = functools.partial(_make_name, taken, prefix, message.name)
    for ending in _RESERVED_ENDINGS:
        name("", ending)
    layout = CLayout(message, name)
    yield format_comment(
        f"---- {message.name}: {'from' if message.frame.direction == 'in' else 'to'}"
        " the sensor ----"
    )
    yield (
        f"#define {prefix.upper()}_{make_identifier(message.name).upper()}"
        f"_MAX_LENGTH {message.frame.max_length}"
    )
    yield from (text for text in c_fields.iter_functions(layout) if text)
    yield ""
    yield from _iter_frame_functions(layout, algorithms)


def _make_name(
    taken: dict[str, tuple[str, str, str]], prefix: str, frame: str, path: str, ending: str
) -> str:
    """Return a unique C name for a path of a frame type, and add it to `taken`."""
    name = "_".join(make_identifier(part) for part in (prefix, frame, path, ending) if part)
    while taken.setdefault(name, (frame, path, ending)) != (frame, path, ending):
        name += "_"
    return name

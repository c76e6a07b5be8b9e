"""What tells whether bytes are a frame of one type: its length, its checksums, its constants."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from lidarspec.export import Refused
from lidarspec.export.c_fields import Piece, pieces
from lidarspec.export.c_places import Places, Spot
from lidarspec.export.c_text import Extent, arguments, index, parameters, quoted
from lidarspec.export.formulas import Formula, Op, Ref, refs
from lidarspec.export.tree import Blob, Block, Number, Repeat, Sealed, formulas

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

"""Bit blocks in Kaitai: integers of so many bits where they stand in a row in one of its two bit orders, else calculated from bytes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from lidarspec.bits import BitField, Segment
from lidarspec.export import Refused
from lidarspec.export.expressions import identifier
from lidarspec.export.tree import Block, Number, Part

Attribute = dict[str, Any]

#: bits that Kaitai reads in one go.
WIDEST = 64
#: bytes of its other integers.
SIZES = (1, 2, 4, 8)


def block_type(block: Block, doc: Callable[[Part], Attribute]) -> tuple[list[Attribute], dict[str, Attribute]]:
    """The attributes and the instances of the type of a block, with what is said of each part.

    Raises:
        Refused: for an integer that is too wide for Kaitai.
    """
    if any(part.bits.width > WIDEST for part in block.parts):
        raise Refused(f"{block.info.path}: an integer of more than {WIDEST} bits")
    rows, suffix = _from_high(block), "be"
    if rows is None:
        rows, suffix = _from_low(block), "le"
    if rows is None:
        found = {_name(part): {"value": _assembled(part, "raw")} | doc(part) for part in block.parts}
        return [{"id": "raw", "size": block.size}], found
    seq: list[Attribute] = []
    instances: dict[str, Attribute] = {}
    for part in rows:
        name, width = _name(part), part.bits.width
        kind: Attribute = {"type": f"b{width}{suffix}"}
        if part.bits.signed:
            instances[name] = {"value": f"{name}_bits - (({name}_bits >> {width - 1}) << {width})"} | doc(part)
            seq.append({"id": f"{name}_bits"} | kind)
        else:
            seq.append({"id": name} | kind | _valid(part) | doc(part))
    return seq, instances


def inline(block: Block, more: Mapping[str, Any]) -> tuple[Attribute, dict[str, Attribute]] | None:
    """The attribute and the instances of a block that is one plain integer; None for any other block."""
    if len(block.parts) != 1 or block.parts[0].names or block.parts[0].indices or not block.name:
        return None
    part, name = block.parts[0], identifier(block.name)
    for order, suffix in ((_from_high, "be"), (_from_low, "le")):
        if order(block) is not None and not part.bits.signed and part.bits.width <= WIDEST:
            return {"id": name, "type": f"b{part.bits.width}{suffix}", **more} | _valid(part), {}
    if "repeat" in more:
        return None
    conditions = {"if": more["if"]} if "if" in more else {}
    return {"id": f"{name}_raw", "size": block.size, **more}, {name: {"value": _assembled(part, f"{name}_raw"), **conditions}}


def odd(node: Number) -> Block | None:
    """An integer of a size that Kaitai has no type for, as a block of one part; None for any other number."""
    if node.kind == "float" or node.size in SIZES:
        return None
    targets = [8 * (place if node.order == "little" else node.size - 1 - place) for place in range(node.size)]
    runs = tuple(Segment(place, 0xFF, 0, target) for place, target in enumerate(targets))
    return Block(node.name, node.info, node.size, (Part(node.info, BitField((), runs, 8 * node.size, node.kind == "int"), (), ()),))


def _name(part: Part) -> str:
    """What a part is called in the type of its block."""
    return identifier("_".join([*(part.names or ("value",)), *(str(index) for index in part.indices)]))


def _valid(part: Part) -> Attribute:
    if part.info.const is None:
        return {}
    return {"valid": bool(part.info.const) if part.bits.width == 1 else part.info.const}


def _from_high(block: Block) -> Sequence[Part] | None:
    """The parts in the order in which reading from each byte's highest bit meets them; None where that does not make them."""
    starts = _starts(block, lambda byte, bit: 8 * byte + 7 - bit, lambda part, target: part.bits.width - 1 - target)
    return None if starts is None else [part for _, part in starts]


def _from_low(block: Block) -> Sequence[Part] | None:
    """The same from each byte's lowest bit."""
    starts = _starts(block, lambda byte, bit: 8 * byte + bit, lambda _, target: target)
    return None if starts is None else [part for _, part in starts]


def _starts(block: Block, place: Callable[[int, int], int], inside: Callable[[Part, int], int]) -> list[tuple[int, Part]] | None:
    """Where each part starts, if its bits follow each other from there on and the parts fill the block."""
    found = []
    for part in block.parts:
        starts = {
            place(run.byte, run.low + step) - inside(part, run.target + step)
            for run in part.bits.segments
            for step in range(run.mask.bit_count())
        }
        if len(starts) != 1:
            return None
        found.append((starts.pop(), part))
    found.sort(key=lambda pair: pair[0])
    return found if sum(part.bits.width for _, part in found) == 8 * block.size else None


def _assembled(part: Part, raw: str) -> str:
    """A part as an expression of the block's bytes."""
    pieces = []
    for run in part.bits.segments:
        byte = f"{raw}[{run.byte}]" if run.mask == 0xFF else f"({raw}[{run.byte}] & {run.mask:#04x})"
        shift = run.target - run.low
        pieces.append(f"({byte} {'<<' if shift > 0 else '>>'} {abs(shift)})" if shift else byte)
    value = " | ".join(pieces)
    if part.bits.width == 1:
        return f"({value}) != 0"
    return f"({value}) - ((({value}) >> {part.bits.width - 1}) << {part.bits.width})" if part.bits.signed else value

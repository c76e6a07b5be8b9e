"""A frame type as a neutral tree, for exports: what stands on the wire, in order, with formulas where a header decides.

A node says what it is (`FieldInfo` for what carries a value) and how it is stored; where it begins is the sum of what stands before
it. So every language can walk it: structs become types or subtrees, repeats loops, alternatives conditions.

    Struct          members in a row
    Sealed          a Struct with a checksum
    Number          an integer or float of whole bytes
    Blob            plain bytes; a constant without name is one with name ""
    Block           so many bytes whose bits make up one or more integers (`Part`)
    Repeat          one element so many times
    When            a part that a condition decides on
    Select          a part that a key decides on
    Empty           nothing
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from lidarspec.exports.formulas import Formula
from lidarspec.spec.bits import BitField
from lidarspec.spec.checksums import Checksum
from lidarspec.wire.schema import FieldInfo


@dataclass(frozen=True, eq=False)
class Number:
    """An integer or float of whole bytes.

    Attributes:
        info: the field; `info.const` is the value that it must have.
        size: in bytes.
        kind: "uint", "int" or "float".
        order: byte order.
    """

    info: FieldInfo
    size: int
    kind: Literal["uint", "int", "float"]
    order: Literal["little", "big"]

    @property
    def name(self) -> str:
        """The field's own name."""
        return self.info.name


@dataclass(frozen=True, eq=False)
class Blob:
    """Plain bytes; `const`: what they must be, None where free. Without a name only as a constant."""

    name: str
    info: FieldInfo
    size: Formula
    const: bytes | None = None


@dataclass(frozen=True, eq=False)
class Part:
    """One integer of a block.

    Attributes:
        info: the field.
        bits: which bits of the block make it up: `bits.segments`, `bits.width`, `bits.signed`.
        names: from the block down to it: (), ("distance",).
        indices: which element it is, for each array inside the block.
    """

    info: FieldInfo
    bits: BitField
    names: tuple[str, ...]
    indices: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Block:
    """So many bytes whose bits make up its parts; a block of one part without names is a plain field of odd width or order."""

    name: str
    info: FieldInfo
    size: int
    parts: tuple[Part, ...]


@dataclass(frozen=True, eq=False)
class Struct:
    """Members in a row; `path` is "" for the frame itself."""

    name: str
    path: str
    members: tuple[Node, ...]


@dataclass(frozen=True, eq=False)
class Sealed:
    """A struct with a checksum.

    Attributes:
        body: the struct.
        fields: paths of what holds the checksum, low bits first.
        over: paths of the first and last member that it covers; None: all bytes of the body that hold no bit of `fields`.
        algorithm: of the checksum.
        absent: values that mean "not filled", and pass.
    """

    body: Struct
    fields: tuple[str, ...]
    over: tuple[str, str] | None
    algorithm: Checksum
    absent: tuple[int, ...]

    @property
    def name(self) -> str:
        """The name of the struct."""
        return self.body.name


@dataclass(frozen=True, eq=False)
class Repeat:
    """One element `count` times; `axis` is the path that the array has in `lidarspec.wire.schema`."""

    name: str
    axis: str
    count: Formula
    element: Node


@dataclass(frozen=True, eq=False)
class When:
    """`then` where the condition is not 0, else `otherwise`."""

    name: str
    condition: Formula
    then: Node
    otherwise: Node


@dataclass(frozen=True, eq=False)
class Select:
    """What stands there for each value of the key, and for all others."""

    name: str
    key: Formula
    cases: tuple[tuple[int, Node], ...]
    default: Node


@dataclass(frozen=True, eq=False)
class Empty:
    """Nothing."""

    name: str = ""


Node = Number | Blob | Block | Struct | Sealed | Repeat | When | Select | Empty


def children(node: Node) -> tuple[Node, ...]:
    """The nodes directly below one."""
    match node:
        case Struct():
            return node.members
        case Sealed():
            return (node.body,)
        case Repeat():
            return (node.element,)
        case When():
            return (node.then, node.otherwise)
        case Select():
            return (*(case for _, case in node.cases), node.default)
        case _:
            return ()


def nodes(node: Node) -> Iterator[Node]:
    """A node and all below it, in the order of the wire."""
    yield node
    for child in children(node):
        yield from nodes(child)


def formulas(node: Node) -> tuple[Formula, ...]:
    """The formulas of a node, those of its parts left out."""
    match node:
        case Blob():
            return (node.size,)
        case Repeat():
            return (node.count,)
        case When():
            return (node.condition,)
        case Select():
            return (node.key,)
    return ()

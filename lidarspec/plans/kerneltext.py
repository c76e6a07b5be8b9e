"""The text of a kernel: the loops around what `kernelsource.Writer` has written, and where the columns go."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Set
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.frames.layout import Layout
from lidarspec.frames.tracing import Node
from lidarspec.plans.kernelsource import CHUNK, Expressions, Later, Trig
from lidarspec.plans.kernelwriter import Value, Wanted, Writer

HEAD = """\
# Made by lidarspec; kept so that it is compiled only once.
import math

import numpy as np
from numba import njit

from lidarspec.plans.kernelmath import (
    BYTES, DOUBLES, INTEGER, MADE_PLACES, MADE_SINGLES, PLACES, SINGLES, WORDS,
    at, byte_at, cos_sin, larger, looked_up, modulo, narrowed, number, put, smaller, word_at,
)

nan, inf = np.nan, np.inf


"""

#: a kernel that puts the points of packets to where they belong.
SPREAD = (
    HEAD
    + """\
@njit([(SINGLES, PLACES, INTEGER, MADE_SINGLES)], cache=True, nogil=True)
def kernel(values, first, width, found):
    for p in range(len(first)):
        start = at(first, p)
        if start >= 0:
            for i in range(width):
                put(found, start + i, at(values, p * width + i))
"""
)

_TYPES = {"float32": "SINGLES", "float64": "DOUBLES", "int64": "PLACES"}


@dataclass(frozen=True, eq=False)
class Text:
    """A kernel.

    Attributes:
        source: of a module with the function `kernel`.
        wanted: what it is called with.
        names: of the columns it makes, float32 all of them.
    """

    source: str
    wanted: Wanted
    names: tuple[str, ...]


class Assembly:
    """The stores of a kernel, in its loops and in the flat one after them."""

    def __init__(self, writer: Expressions) -> None:
        self.writer = writer
        self.flat: list[str] = []
        self._kept: dict[str, str] = {}
        self.scratch: list[str] = []

    def column(self, name: str, made: Any) -> None:
        """Where a column goes."""
        if isinstance(made, Value):
            self.writer.lines[-1].append(f"put(out_{name}, o, {made.text})")
        else:
            self.flat.append(f"put(out_{name}, o, {self.text(made)})")

    def together(self, made: Mapping[str, Any]) -> None:
        """Coordinates that are nan all or none."""
        if all(isinstance(value, Value) for value in made.values()):
            lines, texts = self.writer.lines[-1], {name: value.text for name, value in made.items()}
        else:
            lines, texts = self.flat, {name: self.text(value) for name, value in made.items()}
        lines += [f"{name} = {text}" for name, text in texts.items()]
        lines.append(f"bad = np.float32({' + '.join(f'{name} * np.float32(0)' for name in made)})")
        lines += [f"put(out_{name}, o, {name} + bad)" for name in made]

    def text(self, made: Any) -> str:
        """An expression in the flat loop."""
        if isinstance(made, Later):
            return f"({f' {made.sign} '.join(map(self.text, made.parts))})"
        if isinstance(made, Trig):
            return f"{made.name}{made.angle}"
        if made.level == 0:
            return str(made.text)
        return self._stored(made, "float32")

    def _stored(self, made: Value, kind: str) -> str:
        """A value of the loops, kept for the flat one."""
        if made.text not in self._kept:
            name = self._kept[made.text] = f"h{len(self.scratch)}"
            self.scratch.append(f"{name} = np.empty(held, np.{kind})")
            self.writer.lines[-1].append(f"put({name}, k, {made.text})")
        return f"at({self._kept[made.text]}, k)"

    def turns(self) -> list[str]:
        """The cosines and sines that the flat loop begins with."""
        return [f"cos{index}, sin{index} = cos_sin({self._stored(made, 'float64')})" for index, made in enumerate(self.writer.angles)]


def written(
    layout: Layout,
    shape: tuple[int, ...],
    expressions: Mapping[str, Any],
    tables: dict[Any, NDArray[Any]],
    varying: Set[str],
    *,
    together: bool,
) -> Text:
    """The kernel of some columns.

    Args:
        layout, shape, tables, varying: see `Writer`.
        expressions: of the columns, by name.
        together: where one coordinate is nan, all are.
    """
    writer = Expressions(layout, shape, tables, varying)
    assembly = Assembly(writer)
    writer.both = _both(expressions.values())
    made = {name: _made(writer, name, value) for name, value in expressions.items()}
    places = {name: value for name, value in made.items() if name in "xyz"} if together else {}
    if places:
        assembly.together(places)
    for name, value in made.items():
        if name not in places:
            assembly.column(name, value)
    turns = assembly.turns()
    return Text(HEAD + _function(writer, assembly, turns, tuple(made)), writer.wanted, tuple(made))


def _both(expressions: Iterable[Any]) -> set[Node]:
    """The angles of which the cosine and the sine are wanted."""
    seen, waiting = set[Node](), [value for value in expressions if isinstance(value, Node)]
    while waiting:
        node = waiting.pop()
        if node not in seen:
            seen.add(node)
            waiting += [arg for arg in node.args if isinstance(arg, Node)]
    cosines, sines = ({node.args[0] for node in seen if node.function is function} for function in (np.cos, np.sin))
    return {node for node in cosines & sines if isinstance(node, Node)}


def _made(writer: Expressions, name: str, value: Any) -> Any:
    if name == "azimuth":
        angle = writer.double(value, len(writer.shape))
        return writer.let(angle.level, f"narrowed({angle.text})")
    return writer.single(value, exact=name == "intensity", root=True)


def _function(writer: Writer, assembly: Assembly, turns: list[str], names: tuple[str, ...]) -> str:
    """The signature and the loops."""
    width = writer.number(writer.width)
    held = writer.number(max(CHUNK // writer.width, 1)) if turns else "count"
    loops = _loops(writer, width)
    wanted = writer.wanted
    parameters = [("rows", "BYTES"), ("stride", "INTEGER"), ("first", "INTEGER"), ("count", "INTEGER"), ("numbers", "PLACES")]
    parameters += [(f"c{index}", _TYPES[array.dtype.name]) for index, array in enumerate(wanted.arrays)]
    for index in range(len(wanted.nodes)):
        parameters += [(f"g{index}", "DOUBLES"), (f"s{index}", "INTEGER")]
    parameters += [(f"out_{name}", "MADE_SINGLES") for name in names]
    arguments, types = ", ".join(name for name, _ in parameters), ", ".join(kind for _, kind in parameters)
    body = [f"n{index} = at(numbers, {index})" for index in range(len(wanted.numbers))]
    body += [f"step = {held}", f"held = step * {width}", *assembly.scratch, *writer.lines[0]]
    body += [
        "for begin in range(first, first + count, step):",
        "    end = min(begin + step, first + count)",
        "    start = begin * " + width,
    ]
    body += ["    for p in range(begin, end):", "        base = p * stride", *(f"        {text}" for text in loops)]
    if turns:
        body += [f"    for k in range((end - begin) * {width}):", "        o = start + k"]
        body += [f"        {text}" for text in (*turns, *assembly.flat)]
    head = f'@njit([({types},)], cache=True, nogil=True, error_model="numpy")\ndef kernel({arguments}):\n'
    return head + "".join(f"    {text}\n" for text in body)


def _loops(writer: Writer, width: str) -> list[str]:
    """What is done for a packet: its own values, then the loops over its arrays."""
    lines = [*writer.lines[1]]
    depth = 0
    for level in range(2, writer.inner + 1):
        length = writer.shape[level - 2]
        if length > 1:
            lines.append(f"{'    ' * depth}for i{level - 2} in range({writer.number(length)}):")
            depth += 1
        if level == writer.inner:
            lines += [f"{'    ' * depth}{text}" for text in _spot(writer, width)]
        lines += [f"{'    ' * depth}{text}" for text in writer.lines[level]]
    if writer.inner == 1:
        lines = [*_spot(writer, width), *lines]
    return lines


def _spot(writer: Writer, width: str) -> list[str]:
    """Where a point stands among those under way, and among all."""
    return [f"k = (p - begin) * {width} + {writer.place(writer.shape)}", "o = start + k"]


def empty(names: tuple[str, ...], size: int) -> dict[str, NDArray[np.float32]]:
    """The columns before a kernel fills them."""
    return {name: np.empty(size, np.float32) for name in names}

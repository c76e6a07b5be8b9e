"""The messages of a sensor as exports walk them: a frame type with its tree, in which nothing is Python code."""

from __future__ import annotations

from dataclasses import dataclass

from lidarspec.errors import SpecError
from lidarspec.exports import Refused
from lidarspec.spec.description import Frame
from lidarspec.spec.sensor import Sensor
from lidarspec.spec.tree import Code, Node, Opaque, Sealed, Struct, formulas, nodes


@dataclass(frozen=True, eq=False)
class Message:
    """One frame type: its name, what the sensor says of it, and its tree."""

    name: str
    frame: Frame
    root: Struct | Sealed

    @property
    def seals(self) -> dict[str, Sealed]:
        """The checksums, by the path of each field that holds one or a part of it."""
        return {path: node for node in nodes(self.root) if isinstance(node, Sealed) for path in node.fields}


def messages(sensor: Sensor) -> tuple[Message, ...]:
    """All frame types of a sensor, in their order.

    Raises:
        Refused: if it has none yet, or one holds a part that only Python code can decide.
    """
    if not sensor.frames:
        raise Refused(f"{sensor.id}: has no frames yet: configure it first")
    return tuple(message(sensor, name) for name in sensor.frames)


def message(sensor: Sensor, name: str) -> Message:
    """One frame type of a sensor; raises as `messages`."""
    frame = sensor.frames[name]
    try:
        root = frame.tree
        for node in nodes(root):
            _check(node)
    except (Refused, SpecError) as refused:
        raise Refused(f"{sensor.id} {name}: {refused}") from None
    if not isinstance(root, Struct | Sealed):
        raise Refused(f"{sensor.id} {name}: the frame is no struct")
    return Message(name, frame, root)


def _check(node: Node) -> None:
    """Refuse what no other language can say."""
    for formula in formulas(node):
        if isinstance(formula, Code):
            raise Refused(formula.reason)
    if isinstance(node, Opaque):
        raise Refused(f"{node.info.path}: {node.reason if node.inside else f'{node.kind} is Python code, which no other language runs'}")
    if isinstance(node, Sealed):
        _ = node.algorithm

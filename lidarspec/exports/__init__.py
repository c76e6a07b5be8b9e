"""What a spec says, in the languages of other tools: kinds of exports by name.

In: a sensor. Out: a text, by `export`. An export walks the frame trees (`lidarspec.spec.tree`) that
`messages` hands out, and is refused,
with the reason, where they hold Python code or its target cannot say what the spec says. Modules in
reading order:

* `json`, `stubs`: the spec as data, and as types for an editor.
* `reference`, `diagram`: a page in Markdown, and packet diagrams in SVG.
* `ksy`, `wireshark`: a Kaitai Struct format, and a dissector in Lua.
* `c`, `c_fields`: a header in C: the whole of it, and what reads the fields.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from lidarspec.errors import SpecError, UnknownFrame, UnknownName, UsageError, printable
from lidarspec.spec import tree
from lidarspec.spec.description import Frame
from lidarspec.spec.sensor import with_frames

if TYPE_CHECKING:
    from lidarspec.sensor_operations import Sensor

#: kind -> "module:function"; each takes a Sensor and returns the text of the export.
EXPORTS: dict[str, str] = {
    "wireshark": "lidarspec.exports.wireshark:dissector",
    "c": "lidarspec.exports.c:header",
    "ksy": "lidarspec.exports.ksy:ksy",
    "md": "lidarspec.exports.reference:page",
    "svg": "lidarspec.exports.diagram:svg",
    "json": "lidarspec.exports.json:text",
    "pyi": "lidarspec.exports.stubs:pyi",
}


class ExportError(UsageError):
    """An export that cannot say what the spec says, with the reason."""


class UnknownExport(UnknownName):
    """There is no export of this kind."""

    what = "export"


def select_frame(sensor: Sensor, frame: str) -> Sensor:
    """The sensor with one frame type alone, and no commands: what exports of a single message are
    made from.

    Raises:
        UnknownFrame: if it has no frame type of this name.
    """
    if frame not in sensor.frames:
        raise UnknownFrame(frame, sensor.frames, place=sensor.id)
    return with_frames(sensor, {frame: replace(sensor.frames[frame], after=None)})


def beginning(sensor: Sensor) -> str:
    """What names begin with where they have to begin with a letter."""
    if sensor.id[0].isalpha():
        return sensor.id
    return f"lidar-{sensor.id}"


def export(sensor: Sensor, kind: str) -> str:
    """The text of an export of a sensor.

    Args:
        kind: one of `EXPORTS`.

    Raises:
        Refused: where the target cannot say what the spec says.
        UnknownExport: for a kind that is none of them.
    """
    if kind not in EXPORTS:
        raise UnknownExport(kind, EXPORTS)
    module, _, function = EXPORTS[kind].partition(":")
    plain = replace(
        sensor, vendor=_line(sensor.vendor), model=_line(sensor.model), source=_line(sensor.source)
    )
    text: str = getattr(importlib.import_module(module), function)(plain)
    return text


def _line(text: str) -> str:
    """What stands in a heading, a comment or a string of any language as one line; its own marks
    each export escapes itself.
    """
    return printable(" ".join(text.split()))


@dataclass(frozen=True, eq=False)
class ExportedFrame:
    """One frame type: its name, what the sensor says of it, and its tree."""

    name: str
    frame: Frame
    root: tree.Struct | tree.Sealed

    @property
    def seals(self) -> dict[str, tree.Sealed]:
        """The checksums, by the path of each field that holds one or a part of it."""
        return {
            path: node
            for node in tree.nodes(self.root)
            if isinstance(node, tree.Sealed)
            for path in node.fields
        }


def messages(sensor: Sensor, *, on_wire: bool = True) -> tuple[ExportedFrame, ...]:
    """All frame types of a sensor, in their order.

    Args:
        on_wire: their bytes as they are sent are asked for, and not the fields alone.

    Raises:
        Refused: if it has none yet, or one holds a part that only Python code can decide, or stands
            on the wire in a form of its own.
    """
    if not sensor.frames:
        raise ExportError(f"{sensor.id}: has no frames yet: configure it first")
    formed = [
        f"{name} in {frame.wire}"
        for name, frame in sensor.frames.items()
        if frame.wire is not None and on_wire
    ]
    if formed:
        raise ExportError(
            f"{sensor.id}: no other language recodes what stands on the wire: {', '.join(formed)}"
        )
    return tuple(_message(sensor, name, frame) for name, frame in sensor.frames.items())


def find_references(node: tree.Node) -> list[tree.Ref]:
    """The fields that the formulas of a node and of what is in it ask for, and those that lengths
    and conditions are held to.
    """
    found = [
        value
        for below in tree.nodes(node)
        for value in (*tree.formulas(below), *find_held_formulas(below).values())
    ]
    found += [below.condition for below in tree.nodes(node) if isinstance(below, tree.Check)]
    return [ref for value in found for ref in tree.refs(value)]


def find_held_formulas(node: tree.Node) -> dict[str, tree.Formula]:
    """What the fields that a node is have to say of other parts, by their paths."""
    return {
        info.path: info.rebuilt
        for info in tree.infos(node)
        if info.held and info.rebuilt is not None
    }


def _message(sensor: Sensor, name: str, frame: Frame) -> ExportedFrame:
    try:
        root = frame.tree
        for node in tree.nodes(root):
            _check(node)
    except (ExportError, SpecError) as refused:
        raise ExportError(f"{sensor.id} {name}: {refused}") from None
    if not isinstance(root, tree.Struct | tree.Sealed):
        raise ExportError(f"{sensor.id} {name}: the frame is no struct")
    return ExportedFrame(name, frame, root)


def _check(node: tree.Node) -> None:
    """Refuse what no other language can say."""
    for formula in (
        *tree.formulas(node),
        *([node.condition] if isinstance(node, tree.Check) else []),
    ):
        if isinstance(formula, tree.Untraced):
            raise ExportError(formula.reason)
        if element := next((ref.path for ref in tree.refs(formula) if "[" in ref.path), None):
            raise ExportError(
                f"{element}: an element of an array decides on what follows, and this language"
                " keeps none"
            )
    if isinstance(node, tree.Opaque):
        reason = node.reason
        if not node.inside:
            reason = f"{node.kind} is Python code, which no other language runs"
        raise ExportError(f"{node.info.path}: {reason}")
    if isinstance(node, tree.Sealed):
        _ = node.algorithm

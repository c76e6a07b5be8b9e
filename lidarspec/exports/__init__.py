"""Export the spec of a sensor to the formats of other tools.

`export` returns the text of an export, which is selected by name. `ExportError` is raised if the
target format cannot express the spec. Modules in reading order:

* `json`, `stubs`: the spec as data, and as types for an editor.
* `reference`, `diagram`: a page in Markdown, and packet diagrams in SVG.
* `quick_start`: the start of the Markdown page: commands to copy, and notes of the plugin.
* `ksy`, `wireshark`: a Kaitai Struct format, and a dissector in Lua.
* `c`, `c_fields`: a header in C, and its functions that read fields.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from lidarspec.errors import SpecError, UnknownFrame, UnknownName, UsageError, escape_controls
from lidarspec.spec import tree
from lidarspec.spec.description import Frame
from lidarspec.spec.sensor import with_frames

if TYPE_CHECKING:
    from lidarspec.sensor_operations import Sensor

#: For each kind of export, "module:function". The function returns the text of the export of a
#: Sensor.
EXPORTS: dict[str, str] = {
    "wireshark": "lidarspec.exports.wireshark:dissector",
    "c": "lidarspec.exports.c:header",
    "ksy": "lidarspec.exports.ksy:ksy",
    "md": "lidarspec.exports.reference:make_page",
    "svg": "lidarspec.exports.diagram:svg",
    "json": "lidarspec.exports.json:to_text",
    "pyi": "lidarspec.exports.stubs:pyi",
}


#: Exports that describe the bytes as they are sent.
BYTE_EXPORTS = ("wireshark", "c", "ksy")


class ExportError(UsageError):
    """The target format of an export cannot express the spec."""


class UnknownExport(UnknownName):
    """The kind of export does not exist."""

    what = "export"


def select_frame(sensor: Sensor, frame: str) -> Sensor:
    """Return a copy of the sensor with only one frame type, and no commands.

    Raises:
        UnknownFrame: if the sensor has no frame type of this name.
    """
    if frame not in sensor.frames:
        raise UnknownFrame(frame, sensor.frames, place=sensor.id)
    return with_frames(sensor, {frame: replace(sensor.frames[frame], after=None)})


def make_prefix(sensor: Sensor) -> str:
    """Return a prefix for names that must begin with a letter, made from the id."""
    if sensor.id[0].isalpha():
        return sensor.id
    return f"lidar-{sensor.id}"


def export(sensor: Sensor, kind: str) -> str:
    """Return the text of an export of a sensor.

    Args:
        kind: one of `EXPORTS`.

    Raises:
        ExportError: if the target cannot express the spec.
        UnknownExport: for an unknown kind.
    """
    if kind not in EXPORTS:
        raise UnknownExport(kind, EXPORTS)
    module, _, function = EXPORTS[kind].partition(":")
    plain = replace(
        sensor,
        vendor=_make_line(sensor.vendor),
        model=_make_line(sensor.model),
        source=_make_line(sensor.source),
    )
    text: str = getattr(importlib.import_module(module), function)(plain)
    return text


def _make_line(text: str) -> str:
    """Return a text as one printable line."""
    return escape_controls(" ".join(text.split()))


@dataclass(frozen=True, eq=False)
class ExportedFrame:
    """One frame type: its name, declaration and tree."""

    name: str
    frame: Frame
    root: tree.Struct | tree.ChecksummedStruct

    @property
    def checksums(self) -> dict[str, tree.ChecksummedStruct]:
        """The nodes with checksums, by the path of each field that stores a checksum.

        If a checksum is stored in several fields, all their paths are keys.
        """
        return {
            path: node
            for node in tree.nodes(self.root)
            if isinstance(node, tree.ChecksummedStruct)
            for path in node.fields
        }


def list_frames(sensor: Sensor, *, omit_encoded: bool = True) -> tuple[ExportedFrame, ...]:
    """Return the frame types of a sensor that can be exported, in declared order.

    Args:
        omit_encoded: whether to omit frame types that are sent as text or as escaped bytes. Most
            exports contain no code to decode these.

    Raises:
        ExportError: if the sensor has no frames until it is configured, if a frame contains Python
            code, or if all frame types would be omitted.
    """
    if not sensor.frames:
        raise ExportError(f"{sensor.id} has no frames until it is configured")
    with_form = _find_wire_forms(sensor) if omit_encoded else {}
    if len(with_form) == len(sensor.frames):
        raise ExportError(
            f"{sensor.id}: this export does not support frames of text or of escaped bytes:"
            f" {_join_forms(with_form)}"
        )
    return tuple(
        _make_exported_frame(sensor, name, frame)
        for name, frame in sensor.frames.items()
        if name not in with_form
    )


def describe_left_out(sensor: Sensor) -> str:
    """Return a sentence that names the frame types omitted by `BYTE_EXPORTS`, or ""."""
    with_form = _find_wire_forms(sensor)
    if not with_form:
        return ""
    return f"frames of text or of escaped bytes are omitted: {_join_forms(with_form)}"


def _find_wire_forms(sensor: Sensor) -> dict[str, str]:
    """Return the class name of the wire form of each frame type that has one."""
    return {
        name: type(frame.wire).__name__
        for name, frame in sensor.frames.items()
        if frame.wire is not None
    }


def _join_forms(forms: Mapping[str, str]) -> str:
    return ", ".join(f"{name} ({form})" for name, form in forms.items())


def find_references(node: tree.Node) -> list[tree.Ref]:
    """Return the fields that the formulas in a node and its descendants use."""
    formulas = [
        value
        for below in tree.nodes(node)
        for value in (*tree.formulas(below), *find_required_formulas(below).values())
    ]
    formulas += [below.condition for below in tree.nodes(node) if isinstance(below, tree.Check)]
    return [ref for value in formulas for ref in tree.refs(value)]


def find_required_formulas(node: tree.Node) -> dict[str, tree.Formula]:
    """Return the fields that must have the value of a formula: path -> formula."""
    return {
        info.path: info.rebuilt
        for info in tree.infos(node)
        if info.is_enforced and info.rebuilt is not None
    }


def _make_exported_frame(sensor: Sensor, name: str, frame: Frame) -> ExportedFrame:
    try:
        root = frame.tree
        for node in tree.nodes(root):
            _refuse_inexpressible(node)
    except (ExportError, SpecError) as refused:
        raise ExportError(f"{sensor.id} {name}: {refused}") from None
    if not isinstance(root, tree.Struct | tree.ChecksummedStruct):
        raise ExportError(f"{sensor.id} {name}: the frame is not a struct")
    return ExportedFrame(name, frame, root)


def _refuse_inexpressible(node: tree.Node) -> None:
    """Raise `ExportError` if other languages cannot express a node."""
    for formula in (
        *tree.formulas(node),
        *([node.condition] if isinstance(node, tree.Check) else []),
    ):
        if isinstance(formula, tree.Untraced):
            raise ExportError(formula.reason)
        if element := next((ref.path for ref in tree.refs(formula) if "[" in ref.path), None):
            raise ExportError(
                f"{element}: the layout depends on this array element, and exported code cannot"
                " look up an element"
            )
    if isinstance(node, tree.Opaque):
        reason = node.reason
        if not node.inside:
            reason = f"{node.kind} is Python code and cannot be exported"
        raise ExportError(f"{node.info.path}: {reason}")
    if isinstance(node, tree.ChecksummedStruct):
        _ = node.algorithm

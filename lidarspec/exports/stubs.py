"""Export a spec as a type stub for editors and type checkers.

The stub has a class for each struct in a frame, and a class for the sensor, with its methods. The
result of `parse` has the fields as attributes, so the class of a frame type describes it:

    if TYPE_CHECKING:
        from acme_x1 import Data, AcmeX1
    sensor = cast("AcmeX1", ls.sensor("acme-x1"))
    sensor.parse(data, "data").start_angle          # int, completed by the editor
"""

from __future__ import annotations

import keyword
import re
from collections.abc import Iterator
from dataclasses import dataclass, field

from lidarspec.exports import ExportedFrame, ExportError, list_frames
from lidarspec.frames.commands import find_argument_slot, list_choices
from lidarspec.frames.schema import make_schema
from lidarspec.frames.wire_table import describe_field, format_unit
from lidarspec.spec import Sensor
from lidarspec.spec.arguments import Address, Octets, Port, Range, Text
from lidarspec.spec.tree import (
    Blob,
    Block,
    Check,
    ChecksummedStruct,
    Derived,
    Empty,
    FieldInfo,
    Never,
    Node,
    Number,
    Opaque,
    PartSequence,
    Repeat,
    Select,
    Struct,
    When,
    children,
)

#: The Python type of each kind of command argument.
ARGUMENT_TYPES = {Range: "float", Port: "float", Text: "str", Address: "str", Octets: "bytes"}
#: The keyword parameters of `parse`.
PARSE_OPTIONS = "verify: bool = True, units: bool = False"


def pyi(sensor: Sensor) -> str:
    """Return the stub of a sensor.

    Raises:
        ExportError: if a frame contains Python code, or two frame types have the same class name.
    """
    frames = list_frames(sensor, omit_encoded=False)
    names = {message.name: to_class_name(message.name) for message in frames}
    if len(set(names.values())) < len(names):
        raise ExportError(f"{sensor.id}: two frame types have the same class name")
    classes = _StubClasses({to_class_name(sensor.id)})
    for message in frames:
        names[message.name] = classes.add(
            message.root, names[message.name], f"Frame of type {message.name}."
        )
    parts = [
        _HEAD.format(id=sensor.id, title=_quote(f"{sensor.vendor} {sensor.model}")),
        *classes.done,
        _write_sensor(sensor, frames, names),
    ]
    return "\n\n".join(part.rstrip() + "\n" for part in parts)


def to_class_name(name: str) -> str:
    """Return a name in the spelling of a class."""
    words = "".join(part[:1].upper() + part[1:] for part in re.split(r"\W+|_+", name) if part)
    if words[:1].isalpha():
        return words
    return f"_{words}"


_HEAD = '''"""{title}: types of the results of `parse` and of the arguments of `build` and `command`. Made by lidarspec export pyi {id}."""

from typing import Any, Literal, overload

from lidarspec import Sensor
from lidarspec.spec import EnumValue'''


@dataclass
class _StubClasses:
    """The classes of a stub while it is written.

    Attributes:
        done: the text of each class, inner classes first.
    """

    taken: set[str]
    done: list[str] = field(default_factory=list)

    def add(self, node: Struct | ChecksummedStruct | Block, name: str, docstring: str) -> str:
        """Add the class of a struct or block, and return its name.

        Args:
            name: the preferred name; a suffix is added if it is in use.
        """
        while name in self.taken:
            name += "_"
        self.taken.add(name)
        lines = [
            line
            for member in self._write_members(node)
            for line in self._write_attribute(name, *member)
        ]
        self.done.append(
            "\n".join(
                [f"class {name}:", f'    """{_quote(docstring)}"""', "", *(lines or ["    ..."])]
            )
        )
        return name

    def _write_members(
        self, node: Struct | ChecksummedStruct | Block
    ) -> Iterator[tuple[str, Node | list[FieldInfo]]]:
        if isinstance(node, Struct | ChecksummedStruct):
            yield from ((member.name, member) for member in node.struct.members if member.name)
        else:
            for name in dict.fromkeys(part.names[0] for part in node.parts):
                yield name, [part.info for part in node.parts if part.names[0] == name]

    def _write_attribute(self, owner: str, name: str, node: Node | list[FieldInfo]) -> list[str]:
        """Return the lines of a member.

        Args:
            node: the node of the member, or the fields of a bit block that form a nested struct of
                this name.
        """
        if isinstance(node, list):
            kind = _find_number_type(node[0]) if len(node) == 1 else "Any"
            infos = node
        else:
            kind = self._type(owner, name, node)
            if isinstance(node, Number | Blob | Block):
                infos = [node.info]
            else:
                infos = []
        description = "; ".join(
            filter(
                None, (text(info) for info in infos[:1] for text in (format_unit, describe_field))
            )
        )
        line = f"    {name}: {kind}" + (
            "  # a keyword: getattr()" if keyword.iskeyword(name) else ""
        )
        return [
            line if not keyword.iskeyword(name) else f"    # {line.strip()}",
            *([f'    """{_quote(description)}"""'] if description else []),
        ]

    def _type(self, owner: str, name: str, node: Node) -> str:
        match node:
            case Number():
                return _find_number_type(node.info)
            case Blob():
                return _find_bytes_type(node.info)
            case Block() if not node.parts[0].names:
                if len(node.parts) == 1:
                    return _find_number_type(node.parts[0].info)
                return "list[int]"
            case Struct() | ChecksummedStruct() | Block():
                return self.add(node, owner + to_class_name(name), f"`{name}` of `{owner}`.")
            case Repeat():
                return f"list[{self._type(owner, name, node.element)}]"
            case PartSequence():
                types = [
                    self._type(owner, name + to_class_name(kind.name), kind.element)
                    for kind in node.kinds
                ]
                return f"list[{' | '.join(types)}]"
            case When() | Select():
                return " | ".join(
                    dict.fromkeys(self._type(owner, name, branch) for branch in children(node))
                )
            case Derived() if node.node is not None:
                return self._type(owner, name, node.node)
            case Derived():
                return node.info.kind if node.info.kind != "other" else "Any"
            case Empty() | Check() | Never() | Opaque():
                return "None"


def _find_number_type(info: FieldInfo) -> str:
    if info.kind == "float":
        return "float"
    if info.labels:
        return "EnumValue"
    return "int"


def _find_bytes_type(info: FieldInfo) -> str:
    """Return the Python type of a field of bytes, after decoding."""
    if info.adapter is None:
        return "bytes"
    if info.adapter.form.startswith("text"):
        return "str"
    if info.adapter.dtype.name == "uint8":
        return "bytes"
    return {"i": "int", "u": "int", "f": "float"}.get(info.adapter.dtype.kind, "Any")


def _write_sensor(sensor: Sensor, frames: tuple[ExportedFrame, ...], names: dict[str, str]) -> str:
    """Return the class with the sensor's `parse`, `build`, `example` and `command`."""
    parses = "\n".join(
        f'    @overload\n    def parse(self, data: bytes, frame: Literal["{frame}"], *, {PARSE_OPTIONS})'
        f" -> {name}: ..."
        for frame, name in names.items()
    )
    builds = "\n".join(_write_build(message) for message in frames)
    commands = "\n".join(_write_command(sensor, name) for name in sensor.commands)
    if len(sensor.commands) > 0:
        rest = "    @overload\n    def command(self, _name: str, /, **arguments: Any) -> bytes: ..."
    else:
        rest = ""
    literals = ", ".join(f'"{name}"' for name in names)
    data = next((message.frame for message in frames if message.frame.data), frames[0].frame)
    fields = ", ".join(f'"{path}"' for path in make_schema(data.tree).all_fields)
    return f'''FrameName = Literal[{literals}]
FieldPath = Literal[{fields}]

class {to_class_name(sensor.id)}(Sensor):
    """The sensor itself: cast what `lidarspec.sensor("{sensor.id}")` returns to it."""

{parses}
    @overload
    def parse(self, data: bytes, frame: str | None = None, *, {PARSE_OPTIONS}) -> Any: ...
{builds}
    @overload
    def build(self, _frame: str, _value: Any = None, /, *, units: bool = False, **values: Any) -> bytes: ...
{commands}
{rest}'''


def _write_build(message: ExportedFrame) -> str:
    """Return the signature of `build` with the fields of one frame type."""
    fields = "".join(
        f", {member.name}: {'float' if isinstance(member, Number) else 'Any'} = ..."
        for member in message.root.struct.members
        if member.name not in ("", "self", "units")
        and not keyword.iskeyword(member.name)
        and not (
            isinstance(member, Number | Blob)
            and (member.info.const is not None or member.info.is_enforced)
        )
    )
    more = f", units: bool = False{fields}, **values: Any"
    return (
        f'    @overload\n    def build(self, _frame: Literal["{message.name}"], _value: Any = None,'
        f" /, *{more}) -> bytes: ..."
    )


def _write_command(sensor: Sensor, name: str) -> str:
    args = "".join(
        f", {argument}: {_find_argument_type(sensor, name, argument)}"
        for argument in sensor.commands[name].args
    )
    return (
        f'    @overload\n    def command(self, _name: Literal["{name}"],'
        f" /{', *' * bool(args)}{args}) -> bytes: ..."
    )


def _find_argument_type(sensor: Sensor, command: str, argument: str) -> str:
    kind = sensor.commands[command].arguments[argument].kind
    if isinstance(kind, Range):
        choices = list_choices(find_argument_slot(sensor, command, argument).info, kind)
        if choices:
            return f"float | Literal[{', '.join(map(repr, choices))}]"
    return ARGUMENT_TYPES[type(kind)]


def _quote(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', "'")

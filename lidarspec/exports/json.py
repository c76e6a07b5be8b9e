"""A whole spec as data, for programs in any language: JSON whose every key stands in docs/reference/spec-json.md.

Wire types, places of bits, formulas and checksums are said in full, so that a decoder can be written from it. What is Python code
(`points`, `plausible`, `sweep`) is not in it; that a frame has such a function is.
"""

from __future__ import annotations

import dataclasses
import json
from typing import Any

from lidarspec.exports.messages import Message, messages
from lidarspec.spec.checksums import Checksum
from lidarspec.spec.description import Command
from lidarspec.spec.links import Link, Serial, Tcp, Udp
from lidarspec.spec.sensor import Sensor
from lidarspec.spec.tree import (
    Blob,
    Block,
    Empty,
    FieldInfo,
    Formula,
    Node,
    Number,
    Op,
    Opaque,
    Part,
    Ref,
    Repeat,
    Sealed,
    Select,
    Struct,
    When,
)
from lidarspec.wire.wire_table import frame_size

#: raised whenever a key changes its meaning or goes.
VERSION = 1


def text(sensor: Sensor) -> str:
    """The spec as JSON.

    Raises:
        Refused: where a frame holds Python code that no data can stand for.
    """
    return json.dumps(spec(sensor), indent=2, ensure_ascii=False) + "\n"


def spec(sensor: Sensor) -> dict[str, Any]:
    """The spec as plain data: dicts, lists, numbers, texts.

    Raises:
        Refused: where a frame holds Python code that no data can stand for.
    """
    return {
        "lidarspec": VERSION,
        "id": sensor.id,
        "vendor": sensor.vendor,
        "model": sensor.model,
        "aliases": list(sensor.aliases),
        "status": sensor.status,
        "source": sensor.source,
        "range_limits": list(sensor.range_limits),
        "vendor_axes": list(sensor.vendor_axes) if sensor.vendor_axes else None,
        "links": {name: link_data(link) for name, link in sensor.links.items()},
        "scan": {"rule": type(sensor.scan).__name__, **dataclasses.asdict(sensor.scan)},
        "clock": _clock(sensor),
        "sequence": _sequence(sensor),
        "fillers": sensor.fillers.hex(),
        "frames": {message.name: _frame(message) for message in messages(sensor)},
        "commands": {name: _command(command) for name, command in sensor.commands.items()},
        "on_open": list(sensor.on_open),
        "on_close": list(sensor.on_close),
    }


def link_data(link: Link) -> dict[str, Any]:
    """A link as data."""
    kind = {Serial: "serial", Udp: "udp", Tcp: "tcp"}[type(link)]
    return {"kind": kind, **{name: list(value) if isinstance(value, tuple) else value for name, value in vars(link).items()}}


def _clock(sensor: Sensor) -> dict[str, Any] | None:
    if sensor.clock is None:
        return None
    source = sensor.clock.source
    fields = None if callable(source) else [source] if isinstance(source, str) else list(source)
    return {"fields": fields, "wraps_at": sensor.clock.wraps_at}


def _sequence(sensor: Sensor) -> dict[str, Any] | None:
    if sensor.sequence is None:
        return None
    last = None if callable(sensor.sequence.last) else sensor.sequence.last
    return {"field": sensor.sequence.field, "first": sensor.sequence.first, "last": last}


def _frame(message: Message) -> dict[str, Any]:
    frame = message.frame
    return {
        "direction": frame.direction,
        "data": frame.data,
        "size": frame_size(frame),
        "max_length": frame.max_length,
        "after": frame.after,
        "confirm": frame.confirm,
        "plausible": frame.plausible is not None,
        "layout": node_data(message.root),
    }


def _command(command: Command) -> dict[str, Any]:
    return {
        "frame": command.frame,
        "values": dict(command.values),
        "args": {name: {"field": path, "low": low, "high": high} for name, (path, low, high) in command.args.items()},
        "replies": list(command.replies),
        "matches": dict(command.matches),
        "echoes": list(command.echoes),
        "timeout": command.timeout,
        "retries": command.retries,
        "settle": command.settle,
        "link": command.link,
        "lines": dict(command.lines),
        "starts": command.starts,
        "stops": command.stops,
        "every": command.every,
    }


def node_data(node: Node) -> dict[str, Any]:
    """A part of a frame as data: "kind" says which keys follow."""
    match node:
        case Struct():
            return {"kind": "struct", "name": node.name, "members": [node_data(member) for member in node.members]}
        case Sealed():
            return node_data(node.body) | {"checksum": _seal(node)}
        case Number():
            return {"kind": node.kind, "name": node.name, "bytes": node.size, "order": node.order} | _info(node.info)
        case Blob():
            return {"kind": "bytes", "name": node.name, "bytes": formula_data(node.size)} | _info(node.info)
        case Block():
            return {"kind": "block", "name": node.name, "bytes": node.size, "parts": [_part(part) for part in node.parts]}
        case Repeat():
            return {"kind": "array", "name": node.name, "count": formula_data(node.count), "element": node_data(node.element)}
        case When():
            branches = {"then": node_data(node.then), "else": node_data(node.otherwise)}
            return {"kind": "if", "name": node.name, "condition": formula_data(node.condition)} | branches
        case Select():
            cases = [{"value": value, "part": node_data(case)} for value, case in node.cases]
            return {"kind": "switch", "name": node.name, "key": formula_data(node.key), "cases": cases, "default": node_data(node.default)}
        case Empty() | Opaque():
            return {"kind": "nothing", "name": node.name}


def formula_data(formula: Formula) -> Any:
    """A number as it is, a field as {"field": path}, an operation as {"op": symbol, "args": [...]}."""
    match formula:
        case Ref():
            return {"field": formula.path}
        case Op(symbol, args):
            return {"op": symbol, "args": [formula_data(arg) for arg in args]}
        case _:
            return formula


def _info(info: FieldInfo) -> dict[str, Any]:
    const = info.const.hex() if isinstance(info.const, bytes | bytearray) else info.const
    facts = {"path": info.path, "unit": info.unit, "scale": info.scale, "offset": info.offset, "const": const, "docs": info.docs}
    return {**facts, "labels": {str(value): name for value, name in info.labels.items()}}


def _part(part: Part) -> dict[str, Any]:
    runs = [{"byte": run.byte, "low": run.low, "width": run.mask.bit_count(), "target": run.target} for run in part.bits.segments]
    head = {"name": ".".join(part.names), "indices": list(part.indices), "width": part.bits.width, "signed": part.bits.signed}
    return {**head, "runs": runs} | _info(part.info)


def _seal(node: Sealed) -> dict[str, Any]:
    return {
        "fields": list(node.fields),
        "over": list(node.over) if node.over else None,
        "absent": list(node.absent),
        "algorithm": _algorithm(node.algorithm),
    }


def _algorithm(algorithm: Checksum) -> dict[str, Any]:
    own: dict[str, Any] = dataclasses.asdict(algorithm) if dataclasses.is_dataclass(algorithm) else {}
    known = {name: value for name, value in own.items() if isinstance(value, int | str | bool | tuple)}
    return {"kind": type(algorithm).__name__, "width": algorithm.width, "describe": algorithm.describe(), **known}

"""Export a whole spec as JSON, for programs in any language.

docs/reference/spec-json.md describes every key. Wire types, bit positions, formulas and checksums
are complete, so that a decoder can be written from them. Python code (`points`, `plausible`,
`sweep`) is not included.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

from lidarspec.exports import ExportedFrame, list_frames
from lidarspec.frames.wire_table import frame_size
from lidarspec.spec import Checksum, Command, Frame, Sensor, tree
from lidarspec.spec.arguments import Filled
from lidarspec.spec.links import Link, Udp
from lidarspec.spec.timing import ClockStatus, PacketCounter, Split
from lidarspec.spec.wire_forms import WireForm

#: The version of the format. The number changes if a key is removed, or if its meaning changes.
FORMAT_VERSION = 1


def to_text(sensor: Sensor) -> str:
    """Return the spec as JSON.

    Raises:
        ExportError: if the content of a frame depends on Python code, which JSON cannot express.
    """
    return json.dumps(to_data(sensor), indent=2, ensure_ascii=False) + "\n"


def to_data(sensor: Sensor) -> dict[str, Any]:
    """Return the spec as plain data: dicts, lists, numbers, texts.

    Raises:
        ExportError: if the content of a frame depends on Python code, which JSON cannot express.
    """
    return {
        "lidarspec": FORMAT_VERSION,
        **select_attributes(
            sensor,
            "id",
            "vendor",
            "model",
            "aliases",
            "status",
            "source",
            "range_limits",
            "vendor_axes",
            "returns",
        ),
        "links": {name: link_data(link) for name, link in sensor.links.items()},
        "scan": _scan_data(sensor.scan),
        "clock": _clock_data(sensor),
        "sequence": _sequence_data(sensor.sequence),
        "fillers": sensor.fillers.hex(),
        "frames": {
            message.name: _frame_data(message)
            for message in list_frames(sensor, omit_encoded=False)
        },
        "commands": {name: _command_data(command) for name, command in sensor.commands.items()},
        **select_attributes(sensor, "on_open", "on_close"),
    }


def _scan_data(rule: Split | None) -> dict[str, Any] | None:
    """Return the rule for the end of a scan; None for a sensor without points."""
    if rule is None:
        return None
    return {"rule": type(rule).__name__, **dataclasses.asdict(rule)}


def _sequence_data(counter: PacketCounter | None) -> dict[str, Any] | None:
    """Return the packet counter as JSON data; a value that a function calculates is null."""
    if counter is None:
        return None
    data = select_attributes(counter, "field", "first", "last", "returns")
    return {name: None if callable(value) else value for name, value in data.items()}


def select_attributes(value: object, *names: str) -> dict[str, Any]:
    """Return the attributes `names` of an object as JSON data, by name."""
    own = ((name, getattr(value, name)) for name in names)
    return {name: _to_json(fact) for name, fact in own}


def _to_json(fact: Any) -> Any:
    """Return a value as JSON data: tuples as lists, mappings as objects, bytes as hex."""
    if isinstance(fact, Mapping):
        return {name: _to_json(value) for name, value in fact.items()}
    if isinstance(fact, list | tuple):
        return [_to_json(value) for value in fact]
    if isinstance(fact, Filled):
        return {"kind": type(fact).__name__.lower(), **dataclasses.asdict(fact)}
    if isinstance(fact, bytes | bytearray):
        return fact.hex()
    return fact


def link_data(link: Link) -> dict[str, Any]:
    """Return a link as JSON data."""
    data = {"kind": type(link).__name__.lower(), **select_attributes(link, *vars(link))}
    if isinstance(link, Udp) and (rule := link.assembled) is not None:
        fragment = node_data(Frame(rule.struct, max_length=65_535).tree)
        data["assembled"] = {
            **select_attributes(rule, "keys", "index", "count", "payload", "first", "in_bytes"),
            "fragment": fragment,
        }
    return data


def _clock_data(sensor: Sensor) -> dict[str, Any] | None:
    if sensor.clock is None:
        return None
    source = sensor.clock.source
    if callable(source):
        fields = None
    elif isinstance(source, str):
        fields = [source]
    else:
        fields = list(source)
    status = sensor.clock.status
    return {
        "fields": fields,
        "wraps_at": sensor.clock.wraps_at,
        "epoch": sensor.clock.epoch,
        "status": None if status is None else _status_data(status),
    }


def _status_data(status: ClockStatus) -> dict[str, Any]:
    return {
        "frame": status.frame,
        "field": None if callable(status.source) else status.source,
        "states": [{"value": value, **vars(state)} for value, state in status.states.items()],
    }


def _frame_data(message: ExportedFrame) -> dict[str, Any]:
    frame = message.frame
    return {
        **select_attributes(frame, "direction", "data"),
        "size": frame_size(frame),
        **select_attributes(frame, "max_length", "after", "confirm"),
        "plausible": frame.plausible is not None,
        "wire": None if frame.wire is None else _wire_form_data(frame.wire),
        "layout": node_data(message.root),
    }


def _wire_form_data(form: WireForm) -> dict[str, Any]:
    """Return the class and the arguments of a wire form as JSON data."""
    return {"form": type(form).__name__} | {
        name: repr(value) if dataclasses.is_dataclass(value) else _to_json(value)
        for name, value in _read_arguments(form).items()
    }


def _read_arguments(described: object) -> dict[str, Any]:
    """Return the values of a dataclass's fields, by name; {} for any other class."""
    if not dataclasses.is_dataclass(described):
        return {}
    return {item.name: getattr(described, item.name) for item in dataclasses.fields(described)}


def _command_data(command: Command) -> dict[str, Any]:
    return {
        **select_attributes(command, "frame", "values"),
        "args": {name: argument.to_dict() for name, argument in command.arguments.items()},
        **select_attributes(
            command,
            "replies",
            "matches",
            "echoes",
            "refusal",
            "timeout",
            "retries",
            "settle",
            "link",
            "lines",
            "starts",
            "stops",
            "only_stopped",
            "every",
        ),
        "learns": command.learns is not None,
    }


def node_data(node: tree.Node) -> dict[str, Any]:
    """Return a node of a frame as JSON data."""
    match node:
        case tree.Struct():
            return {
                "kind": "struct",
                "name": node.name,
                "members": [node_data(member) for member in node.members],
            }
        case tree.ChecksummedStruct():
            body = node_data(node.body)
            return body | {"checksum": _checksum_data(node) | {"inner": body.get("checksum")}}
        case tree.Number():
            return {
                "kind": node.kind,
                "name": node.name,
                "bytes": node.size,
                "order": node.order,
            } | _info_data(node.info)
        case tree.Blob():
            data = {"kind": "bytes", "name": node.name, "bytes": formula_data(node.size)}
            if node.info.adapter is not None:
                data["form"] = node.info.adapter.form
            if node.ending is not None:
                data["ending"] = {
                    "mark": node.ending.mark.hex(),
                    "mask": node.ending.mask.hex(),
                    "is_content": node.ending.is_content,
                }
            return data | _info_data(node.info)
        case tree.Block():
            return {
                "kind": "block",
                "name": node.name,
                "bytes": node.size,
                "parts": [_part_data(part) for part in node.parts],
            }
        case tree.Repeat():
            return {
                "kind": "array",
                "name": node.name,
                "count": formula_data(node.count),
                "element": node_data(node.element),
            }
        case tree.PartSequence():
            return _parts_data(node)
        case tree.When():
            branches = {"then": node_data(node.then), "else": node_data(node.otherwise)}
            return {
                "kind": "if",
                "name": node.name,
                "condition": formula_data(node.condition),
            } | branches
        case tree.Select():
            cases = [{"value": value, "part": node_data(case)} for value, case in node.cases]
            return {
                "kind": "switch",
                "name": node.name,
                "key": formula_data(node.key),
                "cases": cases,
                "default": node_data(node.default),
            }
        case tree.Check():
            return {"kind": "check", "name": node.name, "condition": formula_data(node.condition)}
        case tree.Never():
            return {"kind": "never", "name": node.name}
        case tree.Derived() if node.formula is not None:
            return {"kind": "computed", "name": node.name, "value": formula_data(node.formula)}
        case tree.Empty() | tree.Derived() | tree.Opaque():
            return {"kind": "nothing", "name": node.name}


def _parts_data(node: tree.PartSequence) -> dict[str, Any]:
    """Return the JSON data of a field that contains a sequence of frames."""
    rules = {"count": node.count, "size": node.size, "within": node.within}
    data = {name: formula_data(rule) for name, rule in rules.items()}
    kinds = [
        {
            "name": kind.name,
            "part": node_data(kind.element),
            "following": formula_data(node.following(kind)),
            **({} if kind.until is None else {"until": formula_data(kind.until)}),
        }
        for kind in node.kinds
    ]
    return {"kind": "parts", "name": node.name, **data, "kinds": kinds}


def formula_data(formula: tree.Formula | None) -> Any:
    """Return a formula as JSON data."""
    match formula:
        case tree.Ref():
            return {"field": formula.path}
        case tree.Op(symbol, args):
            return {"op": symbol, "args": [formula_data(arg) for arg in args]}
        case _:
            return formula


def _info_data(info: tree.FieldInfo) -> dict[str, Any]:
    if isinstance(info.const, bytes | bytearray):
        const = info.const.hex()
    else:
        const = info.const
    facts = {
        "path": info.path,
        "unit": info.unit,
        "scale": info.scale,
        "offset": info.offset,
        "const": const,
        "docs": info.docs,
    }
    if info.allowed is not None:
        facts["allowed"] = list(info.allowed)
    if info.is_enforced and info.rebuilt is not None:
        facts["equals"] = formula_data(info.rebuilt)
    return {**facts, "labels": {str(value): name for value, name in info.labels.items()}}


def _part_data(part: tree.BlockInteger) -> dict[str, Any]:
    runs = [
        {"byte": run.byte, "low": run.low, "width": run.mask.bit_count(), "target": run.target}
        for run in part.bits.segments
    ]
    head = {
        "name": ".".join(part.names),
        "indices": list(part.indices),
        "width": part.bits.width,
        "signed": part.bits.signed,
    }
    return {**head, "runs": runs} | _info_data(part.info)


def _checksum_data(node: tree.ChecksummedStruct) -> dict[str, Any]:
    return {
        **select_attributes(node, "fields", "over", "absent"),
        "algorithm": _algorithm_data(node.algorithm),
    }


def _algorithm_data(algorithm: Checksum) -> dict[str, Any]:
    parameters: dict[str, Any] = {}
    for name, value in _read_arguments(algorithm).items():
        if isinstance(value, Checksum):
            parameters[name] = _algorithm_data(value)
        elif isinstance(value, int | str | tuple):
            parameters[name] = value
    return {
        **parameters,
        "kind": type(algorithm).__name__,
        "width": algorithm.width,
        "describe": algorithm.describe(),
    }

"""Parse and build frames that have no layout, with construct, one at a time.

A frame has no layout if the offset of a field cannot be computed. `lidarspec show` prints which
field it is, and the reason.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from typing import Any

import construct
from construct import Container, EnumIntegerString

from lidarspec.errors import MissingField, SpecError, UsageError, WireError, struct_error
from lidarspec.frames.diagnose import TRAILING
from lidarspec.frames.schema import Schema, make_schema, without_indices
from lidarspec.frames.wire_fields import WireField
from lidarspec.spec.description import Frame
from lidarspec.spec.sensor import SensorDescription
from lidarspec.spec.syntax import MismatchError, field_path, iter_leaves, to_public
from lidarspec.spec.tree import FieldInfo

#: The maximum number of times that a frame is built until its lengths no longer change.
MAX_BUILDS = 4


def parse_plain(frame: Frame, data: bytes, *, verify: bool = True) -> tuple[Any, int]:
    """Parse the frame at the start of `data`; return its values and its size.

    Raises:
        construct.ConstructError: if the bytes do not begin with a frame.
        Exception: any error of an expression of the struct.
    """
    stream = io.BytesIO(data)
    values = frame.prepared.parse_stream(stream, _verify=verify)
    return to_public(values), stream.tell()


def build_plain(frame: Frame, values: Mapping[str, Any], place: str) -> bytes:
    """Return the bytes of a frame.

    Raises:
        UsageError: for values that construct does not accept.
        SpecError: if an expression of the struct fails.
    """
    sizes: dict[str, int] = {}
    data = b""
    named = _add_code_names(values, "", make_schema(frame.tree))
    try:
        for _ in range(MAX_BUILDS):
            known = dict(sizes)
            data = bytes(frame.prepared.build(named, _sizes=sizes))
            if sizes == known:
                break
    except MismatchError as fault:
        path = field_path(fault.path)
        if fault.reason == "missing":
            raise MissingField(path, place=place) from None
        raise UsageError(
            f"{place}: {path or 'frame'}: expected {fault.expected}, got {fault.got}"
        ) from None
    except construct.ConstructError as fault:
        reason = _strip_path(fault)
        raise UsageError(f"{place}: {field_path(fault.path) or 'frame'}: {reason}") from None
    except SpecError:
        raise
    except Exception as fault:
        raise struct_error(fault, path=place) from fault
    return data


def _add_code_names(value: Any, path: str, schema: Schema) -> Any:
    """Replace each number that has a label by the string that construct uses for it."""
    if isinstance(value, Mapping):
        return Container(
            (name, _add_code_names(member, f"{path}.{name}" if path else name, schema))
            for name, member in value.items()
        )
    if isinstance(value, list):
        return [_add_code_names(element, path, schema) for element in value]
    info = schema.all_fields.get(path)
    if info is None or type(value) is not int or value not in info.labels:
        return value
    return EnumIntegerString.new(value, info.labels[value])


def list_plain_fields(frame: Frame, data: bytes) -> list[WireField] | None:
    """Return the fields of the frame at the start of `data`; None if parsing fails."""
    try:
        values = frame.prepared.parse(data, _verify=False)
    except Exception:  # an expression of the struct may raise anything
        return None
    infos = make_schema(frame.tree).all_fields
    return list(_iter_fields(values, "", data, infos))


def _iter_fields(
    struct: Any, prefix: str, data: bytes, infos: Mapping[str, FieldInfo]
) -> Iterator[WireField]:
    """Yield the fields of a parsed struct.

    Args:
        struct: the values of the struct, with the offsets of its members in `_spans`.
    """
    for name, (start, end) in struct["_spans"].items():
        path = f"{prefix}.{name}".strip(".")
        value = struct[name]
        elements = value if isinstance(value, list) else [value]
        if elements and all(_has_spans(element, start, end) for element in elements):
            for index, element in enumerate(elements):
                if isinstance(value, list):
                    below = f"{path}[{index}]"
                else:
                    below = path
                yield from _iter_fields(element, below, data, infos)
        elif isinstance(value, dict):  # a bit block
            for keys, raw in iter_leaves(value):
                below = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in keys)
                info = infos.get(f"{path}{below}", FieldInfo(f"{path}{below}"))
                yield WireField(f"{path}{below}", path, info, start, end, None, raw)
        elif end > start:
            info = infos.get(without_indices(path)[0], FieldInfo(path, kind="bytes"))
            if isinstance(value, int | float | bytes | str):
                raw = value
            else:
                raw = data[start:end]
            yield WireField(path, path, info, start, end, None, raw)


def _has_spans(value: Any, start: int, end: int) -> bool:
    """Return whether a value is a struct that has the offsets of its members."""
    if not isinstance(value, dict) or not value.get("_spans"):
        return False
    spans = value["_spans"].values()
    return bool(min(spans)[0] >= start and max(stop for _, stop in spans) <= end)


def find_plain_fault(sensor: SensorDescription, name: str, data: bytes) -> WireError:
    """Return the first fault of bytes that are not a valid frame of this type.

    Raises:
        SpecError: if an expression of the struct fails.
    """
    frame = sensor.frames[name]
    stream = io.BytesIO(data)
    try:
        frame.prepared.parse_stream(stream, _verify=True)
    except MismatchError as fault:
        path = field_path(fault.path)
        reason = (
            f"{path} at byte {fault.offset}: {fault.reason} {fault.got}, expected {fault.expected}"
        )
        return WireError(
            reason,
            sensor=sensor.id,
            frame=name,
            offset=fault.offset,
            path=path,
            expected=fault.expected,
            got=fault.got,
            data=data,
        )
    except construct.StreamError as fault:
        path = field_path(fault.path)
        reason = f"the frame ends at byte {len(data)}: {path or 'the first field'} is cut off"
        return WireError(
            reason, sensor=sensor.id, frame=name, offset=stream.tell(), path=path, data=data
        )
    except construct.ConstructError as fault:
        path = field_path(fault.path)
        return WireError(
            f"{path}: {_strip_path(fault)}",
            sensor=sensor.id,
            frame=name,
            offset=stream.tell(),
            path=path,
            data=data,
        )
    except SpecError:
        raise
    except Exception as fault:
        raise struct_error(fault, path=name, sensor=sensor.id) from fault
    size = stream.tell()
    return WireError(
        f"the frame ends at byte {size}, but {len(data) - size} more bytes follow",
        sensor=sensor.id,
        frame=name,
        kind=TRAILING,
        offset=size,
        expected=size,
        got=len(data),
        data=data,
    )


def _strip_path(fault: construct.ConstructError) -> str:
    """Return a message of construct without its path."""
    return str(fault).partition("\n")[2].strip() or type(fault).__name__

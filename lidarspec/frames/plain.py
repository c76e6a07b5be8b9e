"""Frames that have no layout, parsed and built by construct, one at a time.

Such a struct has a part whose place no formula of header fields gives: a text up to a terminator, a
Python function that branches on values, parts without an announced length. `lidarspec show` names
the part and the reason.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from typing import Any

import construct

from lidarspec.errors import MissingField, SpecError, UsageError, WireError, struct_error
from lidarspec.frames.schema import make_schema, without_indices
from lidarspec.frames.wire_fields import WireField
from lidarspec.spec.description import Frame
from lidarspec.spec.sensor import SensorDescription
from lidarspec.spec.syntax import MismatchError, field_path, leaves, remove_private
from lidarspec.spec.tree import FieldInfo

#: how often a frame is built until its lengths agree.
MAX_BUILDS = 4


def parse_plain(frame: Frame, data: bytes, *, verify: bool = True) -> tuple[Any, int]:
    """Return the values of a frame at the start of some bytes, and its size.

    Raises:
        construct.ConstructError: for other bytes.
        Exception: whatever an expression of the struct raises.
    """
    stream = io.BytesIO(data)
    values = frame.prepared.parse_stream(stream, _verify=verify)
    return remove_private(values), stream.tell()


def build_plain(frame: Frame, values: Mapping[str, Any], place: str) -> bytes:
    """Return the bytes of a frame.

    Fields that say how long a part is are known when it has been built, so it is built again.

    Raises:
        UsageError: for values that construct does not take.
        SpecError: if an expression of the struct fails.
    """
    sizes: dict[str, int] = {}
    data = b""
    try:
        for _ in range(MAX_BUILDS):
            known = dict(sizes)
            data = bytes(frame.prepared.build(values, _sizes=sizes))
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
        reason = _reason(fault)
        raise UsageError(f"{place}: {field_path(fault.path) or 'frame'}: {reason}") from None
    except SpecError:
        raise
    except Exception as fault:
        raise struct_error(fault, path=place) from fault
    return data


def plain_fields(frame: Frame, data: bytes) -> list[WireField] | None:
    """Return the fields of a frame at the start of some bytes; None if they are none."""
    try:
        values = frame.prepared.parse(data, _verify=False)
    except Exception:  # an expression of the struct may raise anything
        return None
    infos = make_schema(frame.tree).all_fields
    return list(_fields_of(values, "", data, infos))


def _fields_of(
    struct: Any, prefix: str, data: bytes, infos: Mapping[str, FieldInfo]
) -> Iterator[WireField]:
    """Return the fields of a parsed struct, whose members say where they stand."""
    for name, (start, end) in struct["_marks"].items():
        path = f"{prefix}.{name}".strip(".")
        value = struct[name]
        elements = value if isinstance(value, list) else [value]
        if elements and all(_is_placed(element, start, end) for element in elements):
            for index, element in enumerate(elements):
                if isinstance(value, list):
                    below = f"{path}[{index}]"
                else:
                    below = path
                yield from _fields_of(element, below, data, infos)
        elif isinstance(value, dict):  # a bit block
            for keys, raw in leaves(value):
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


def _is_placed(value: Any, start: int, end: int) -> bool:
    """Return whether a value is a struct whose members say where they stand in the frame.

    Members of a struct in bytes that were recoded are placed in those.
    """
    if not isinstance(value, dict) or not value.get("_marks"):
        return False
    spans = value["_marks"].values()
    return bool(min(spans)[0] >= start and max(stop for _, stop in spans) <= end)


def plain_fault(sensor: SensorDescription, name: str, data: bytes) -> WireError:
    """Return what is wrong with bytes that are no frame of this type.

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
        reason = f"frame ends at byte {len(data)}: {path or 'the first field'} is cut off"
        return WireError(
            reason, sensor=sensor.id, frame=name, offset=stream.tell(), path=path, data=data
        )
    except construct.ConstructError as fault:
        path = field_path(fault.path)
        return WireError(
            f"{path}: {_reason(fault)}",
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
        f"{len(data) - size} bytes after the end of the frame at byte {size}",
        sensor=sensor.id,
        frame=name,
        offset=size,
        expected=size,
        got=len(data),
        data=data,
    )


def _reason(fault: construct.ConstructError) -> str:
    """Return the message of construct without the path."""
    return str(fault).partition("\n")[2].strip() or type(fault).__name__

"""Parse one frame into a Container of raw values.

A valid frame is read by its layout. construct parses frames that have no layout
(`lidarspec.frames.plain`).
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from construct import Container, ListContainer

from lidarspec.errors import SpecError, UnknownFrame, WireError, refuse_text, struct_error
from lidarspec.frames import diagnose
from lidarspec.frames.compilability import NotCompilableError
from lidarspec.frames.layout import Derivation, Layout, LayoutRefusal, Leaf
from lidarspec.frames.layout_tree import frame_layouts
from lidarspec.frames.parts import Region
from lidarspec.frames.plain import find_plain_fault, parse_plain
from lidarspec.frames.schema import make_schema
from lidarspec.frames.wire_coder import frame_coder
from lidarspec.frames.wire_fields import ExaminedFrame, examine
from lidarspec.spec.bits import BitField
from lidarspec.spec.description import Frame
from lidarspec.spec.enum_values import EnumValue
from lidarspec.spec.sensor import SensorDescription
from lidarspec.spec.syntax import WireNaN
from lidarspec.spec.tree import (
    Adapter,
    Blob,
    Block,
    ChecksummedStruct,
    Derived,
    FieldInfo,
    Node,
    Number,
    PartSequence,
    Repeat,
    Select,
    Struct,
    When,
)


def parse(
    sensor: SensorDescription,
    data: bytes,
    *,
    frame: str | None = None,
    verify: bool = True,
    units: bool = False,
) -> Any:
    """Return the Container of raw values of one frame.

    Args:
        data: the bytes of one frame, with nothing before or after it.
        frame: the frame type; by default the first type that matches.
        verify: False to accept wrong constants, a wrong checksum and trailing bytes.
        units: True to convert scaled fields to their units.

    Raises:
        WireError: if the bytes are not a valid frame of this type.
        UnknownFrame: if the sensor does not have this frame type.
    """
    data = _to_bytes(data)
    typed_values = _try_parse_any(sensor, data, frame)
    if typed_values is None:
        typed_values = _parse_invalid(sensor, data, frame, verify=verify)
    name, values = typed_values
    if units:
        return _convert_units(make_schema(sensor.frames[name].tree).all_fields, values, "")
    return values


def identify(sensor: SensorDescription, data: bytes, *, frame: str | None = None) -> str:
    """Return the name of the frame type of one frame.

    Args:
        frame: the only type to try; by default all types.

    Raises:
        WireError: if no type matches. The error describes the fault for the type that matches best.
        UnknownFrame: if the sensor does not have this frame type.
    """
    data = _to_bytes(data)
    typed_values = _try_parse_any(sensor, data, frame)
    if typed_values is not None:
        return typed_values[0]
    return _parse_invalid(sensor, data, frame, verify=True)[0]


def _to_bytes(data: bytes) -> bytes:
    if isinstance(data, bytes):
        return data
    refuse_text(data)
    return bytes(data)


def _try_parse_any(
    sensor: SensorDescription, data: bytes, frame: str | None
) -> tuple[str, Any] | None:
    """Return the type and the values of a frame; None if it is invalid."""
    names = sensor.frames if frame is None or frame not in sensor.frames else (frame,)
    for name in names:
        try:
            values = _try_parse(sensor.frames[name], data)
        except SpecError:
            raise
        except Exception:
            continue  # an expression of the plugin failed: `_parse_invalid` raises its error
        if values is not None:
            return name, values[0]
    return None


def _try_parse(frame: Frame, data: bytes) -> tuple[Any] | None:
    """Return the values of a frame in a 1-tuple; None if it is invalid."""
    layouts = frame_layouts(frame)
    if isinstance(layouts, NotCompilableError):
        values, size = parse_plain(frame, data)
        if size == len(data):
            return (values,)
        return None
    coder = frame_coder(frame)
    decoded = coder.decode(data)
    if decoded.problem is not None:
        return None
    layout = layouts.layout(decoded.struct)
    if isinstance(layout, Layout) and layout.is_valid(decoded.struct):
        values = unpack(frame.tree, layout, decoded.struct)
        return (coder.keep_spelling(values, decoded.struct, data),)
    return None


def _parse_invalid(
    sensor: SensorDescription, data: bytes, frame: str | None, *, verify: bool
) -> tuple[str, Any]:
    """Return the type and the values of an invalid frame.

    Raises:
        WireError: if `verify` is True, or if the values cannot be read.
    """
    if frame is not None:
        if frame not in sensor.frames:
            raise UnknownFrame(frame, sensor.frames, place=sensor.id)
        if verify:
            raise _find_fault(sensor, frame, data)
        return frame, _parse_unverified(sensor, frame, data)
    if not sensor.frames:
        raise UnknownFrame(
            "data",
            (),
            place=sensor.id,
            hint="; the sensor requires its configuration file: see sensor.configure",
        )
    faults = [_find_fault(sensor, name, data) for name in sensor.frames]
    if not verify:
        for likely in sorted(faults, key=functools.partial(_rank_fault, sensor), reverse=True):
            try:
                return likely.frame, _parse_unverified(sensor, likely.frame, data)
            except WireError:
                continue
    raise _choose_likeliest(sensor, data, faults)


def _find_fault(sensor: SensorDescription, name: str, data: bytes) -> WireError:
    """Return the first fault of an invalid frame as an error."""
    frame = sensor.frames[name]
    if isinstance(frame_layouts(frame), NotCompilableError):
        return find_plain_fault(sensor, name, data)
    decoded = frame_coder(frame).decode(data)
    problem = decoded.problem
    if problem is not None:
        return WireError(
            problem.reason,
            sensor=sensor.id,
            frame=name,
            offset=problem.offset,
            path=problem.path,
            expected=problem.expected,
            got=problem.got,
            data=data,
        )
    examined = examine(frame.tree, decoded.struct, frame.max_struct_bytes)
    return _find_field_fault(sensor, name, data, examined, decoded.offset)


def _find_field_fault(
    sensor: SensorDescription,
    name: str,
    data: bytes,
    examined: ExaminedFrame,
    to_wire_offset: Callable[[int], int],
) -> WireError:
    """Return the first fault of a frame's fields as an error."""
    fault = _run_search(sensor, name, diagnose.find_fault, examined)
    if fault is None:  # a checksum of a plugin returned a different value this time
        reason = (
            "the frame was invalid, but valid when it was checked again: a checksum function of the"
            " plugin may return different values for the same bytes"
        )
        return WireError(reason, sensor=sensor.id, frame=name, data=data)
    return _to_wire_error(sensor, name, data, fault, to_wire_offset)


def _run_search(
    sensor: SensorDescription,
    name: str,
    find: Callable[[ExaminedFrame], diagnose.Fault | None],
    examined: ExaminedFrame,
) -> diagnose.Fault | None:
    """Return the fault that the search `find` returns, or None.

    Raises:
        SpecError: if an expression or a checksum of the struct raises an exception.
    """
    try:
        return find(examined)
    except Exception as error:
        raise struct_error(error, path=name, sensor=sensor.id) from error


def _to_wire_error(
    sensor: SensorDescription,
    name: str,
    data: bytes,
    fault: diagnose.Fault,
    to_wire_offset: Callable[[int], int],
) -> WireError:
    offset = to_wire_offset(fault.offset)
    return WireError(
        fault.reason(offset),
        kind=fault.kind,
        offset=offset,
        path=fault.path,
        expected=fault.expected,
        got=fault.got,
        sensor=sensor.id,
        frame=name,
        data=data,
    )


def _parse_unverified(sensor: SensorDescription, name: str, data: bytes) -> Any:
    """Return the values of a frame without verifying it."""
    frame = sensor.frames[name]
    if isinstance(frame_layouts(frame), NotCompilableError):
        try:
            return parse_plain(frame, data, verify=False)[0]
        except Exception:
            raise find_plain_fault(sensor, name, data) from None
    decoded = frame_coder(frame).decode(data)
    examined = examine(frame.tree, decoded.struct, frame.max_struct_bytes)
    shortage = _run_search(sensor, name, diagnose.find_shortage, examined)
    if shortage is not None or examined.layout is None:
        assert shortage is not None
        raise _to_wire_error(sensor, name, data, shortage, decoded.offset)
    try:
        return unpack(frame.tree, examined.layout, decoded.struct[: examined.layout.size])
    except Exception:  # bytes that a function cannot decode, such as an invalid text
        raise _find_fault(sensor, name, data) from None


def _convert_units(fields: Mapping[str, FieldInfo], value: Any, path: str) -> Any:
    """Return values with scaled fields converted to their units."""
    if isinstance(value, dict):
        return Container(
            (name, _convert_units(fields, part, f"{path}.{name}".strip(".")))
            for name, part in value.items()
        )
    if isinstance(value, list):
        return ListContainer(_convert_units(fields, part, path) for part in value)
    if value is not None and path in fields and fields[path].scaled:
        return fields[path].physical(value)
    return value


def unpack(root: Node, layout: Layout, frame: bytes) -> Any:
    """Return the Container of raw values of a frame with this layout."""
    reader = layout.notes.get(_make_reader) or layout.notes.setdefault(
        _make_reader, _make_reader(root, "", layout, 1)
    )
    return reader(frame)[0]


#: The byte orders in which a bit block can be read as one number.
BYTE_ORDERS: tuple[Literal["little"], Literal["big"]] = ("little", "big")

#: A function that reads one node of the tree, such as a field or a struct. It returns one value for
#: each element of the arrays that contain the node, in C order. Its argument is the bytes of the
#: frame or, for a number in a bit block, the blocks that were read as numbers.
Reader = Callable[[Any], Sequence[Any]]


def _make_reader(node: Node, path: str, layout: Layout, count: int) -> Reader:
    """Return the reader of a node of the tree, for frames of one layout.

    Args:
        count: the number of elements of the arrays that contain the node.
    """
    if count == 0:
        return _read_no_values
    match node:
        case ChecksummedStruct():
            return _make_reader(node.body, path, layout, count)
        case Struct():
            members = [
                (member.name, f"{node.path}.{member.name}".strip("."), member)
                for member in node.members
                if member.name
            ]
            readers = tuple(
                (name, _make_reader(member, below, layout, count))
                for name, below, member in members
            )
            return functools.partial(_read_containers, readers, count)
        case Repeat():
            if not isinstance(node.count, int):
                length = layout.lengths[node.axis]
            else:
                length = node.count
            return functools.partial(
                _read_lists, _make_reader(node.element, path, layout, count * length), count, length
            )
        case PartSequence():
            return functools.partial(_read_parts, layout.regions[node.axis])
        case When() | Select():
            return _make_reader(layout.branches[node], path, layout, count)
        case Number() | Blob():
            return _make_field_reader(node, _find_leaf(layout, path))
        case Derived():
            return _make_derived_reader(node, path, layout, count)
        case Block():
            return _make_block_reader(node, path, layout, count)
    return functools.partial(_read_nothing, count)


def _find_leaf(layout: Layout, path: str) -> Leaf:
    """Return the position of a field, or of the field that it copies."""
    leaf = layout.column(path)
    assert isinstance(leaf, Leaf)
    return leaf


def _make_derived_reader(node: Derived, path: str, layout: Layout, count: int) -> Reader:
    """Return a reader of values without bytes of their own."""
    if node.node is not None:
        return _make_reader(node.node, path, layout, count)
    found = layout.derived[path]
    if isinstance(found, Leaf):
        return _make_unpacker(found.offsets(len(found.shape) - 1), "<", f"{found.size}s")
    if found.formula is None:
        values = found.load(np.zeros((1, layout.size), np.uint8), layout.leaves)
        return functools.partial(_read_constants, tuple(values.reshape(-1).tolist()))
    return functools.partial(_read_computed, found, layout)


def _read_constants(values: Sequence[Any], frame: bytes) -> Sequence[Any]:
    return values


def _read_computed(derivation: Derivation, layout: Layout, frame: bytes) -> Sequence[Any]:
    row = np.frombuffer(frame, np.uint8).reshape(1, -1)
    values: list[Any] = derivation.load(row, layout.leaves).reshape(-1).tolist()
    return values


def _read_no_values(frame: bytes) -> Sequence[Any]:
    return ()


def _read_nothing(count: int, frame: bytes) -> Sequence[None]:
    return (None,) * count


def _read_containers(
    members: Sequence[tuple[str, Reader]], count: int, frame: bytes
) -> Sequence[Container]:
    # Filling empty containers by name takes half the time of making them from their items.
    containers = [Container() for _ in range(count)]
    if count == 1:
        for name, reader in members:
            containers[0][name] = reader(frame)[0]
        return containers
    for name, reader in members:
        for container, value in zip(containers, reader(frame), strict=True):
            container[name] = value
    return containers


def _read_lists(elements: Reader, count: int, length: int, frame: bytes) -> Sequence[ListContainer]:
    values = elements(frame)
    if length:
        return [
            ListContainer(values[start : start + length])
            for start in range(0, count * length, length)
        ]
    return [ListContainer() for _ in range(count)]


def _read_parts(region: Region, frame: bytes) -> Sequence[ListContainer]:
    return [
        ListContainer(
            unpack(kind.node.root, layout, part) for kind, layout, part in region.list_parts(frame)
        )
    ]


def _make_unpacker(offsets: Sequence[int], order: str, code: str) -> Reader:
    """Return a reader of one value at each offset.

    Args:
        order: the byte order, as in `struct`.
        code: the format character, as in `struct`.
    """
    form = list[str]()
    size = struct.calcsize(order + code)
    end = offsets[0]
    for offset in offsets:
        form.append(f"{offset - end}x{code}" if offset > end else code)
        end = offset + size
    return functools.partial(struct.Struct(order + "".join(form)).unpack_from, offset=offsets[0])


def _make_field_reader(node: Number | Blob, leaf: Leaf) -> Reader:
    if isinstance(node, Blob):
        raw_bytes = _make_unpacker(leaf.offsets(len(leaf.shape) - 1), "<", f"{leaf.size}s")
        return _add_labels(leaf.info, raw_bytes)
    offsets = leaf.offsets()
    order = "<" if node.order == "little" else ">"
    if leaf.wire is None:
        raw = _make_unpacker(offsets, order, f"{leaf.size}s")
        return _add_labels(
            leaf.info, functools.partial(_read_integers, raw, node.order, node.kind == "int")
        )
    if node.kind == "float":
        return functools.partial(
            _read_floats, _make_unpacker(offsets, order, leaf.wire.char), offsets, node.size
        )
    return _add_labels(
        leaf.info,
        _make_unpacker(
            offsets, order, leaf.wire.char if node.size < 8 else "Q" if node.kind == "uint" else "q"
        ),
    )


def _read_integers(
    raw: Reader, order: Literal["little", "big"], signed: bool, frame: bytes
) -> Sequence[int]:
    return [int.from_bytes(value, order, signed=signed) for value in raw(frame)]


def _read_floats(
    numbers: Reader, offsets: Sequence[int], size: int, frame: bytes
) -> Sequence[float]:
    """Return floats; a NaN becomes a `WireNaN`, which keeps its bits."""
    values = numbers(frame)
    if all(value == value for value in values):
        return values
    return [
        value if value == value else WireNaN(frame[offset : offset + size])
        for value, offset in zip(values, offsets, strict=True)
    ]


def _add_labels(info: FieldInfo, numbers: Reader) -> Reader:
    if info.adapter is not None:
        return functools.partial(_apply_adapter, info.adapter, numbers)
    if info.labels:
        return functools.partial(_look_up_labels, _LabelCache(info), numbers)
    return numbers


def _apply_adapter(adapter: Adapter, raw: Reader, frame: bytes) -> Sequence[Any]:
    return [adapter.decode(value) for value in raw(frame)]


class _LabelCache(dict[int, Any]):
    """Cache of the values of an Enum, by raw value."""

    def __init__(self, info: FieldInfo) -> None:
        super().__init__({raw: EnumValue(raw, name) for raw, name in info.labels.items()})

    def __missing__(self, raw: int) -> EnumValue:
        return EnumValue(raw)


def _look_up_labels(names: _LabelCache, numbers: Reader, frame: bytes) -> Sequence[Any]:
    return [names[value] for value in numbers(frame)]


def _make_block_reader(node: Block, path: str, layout: Layout, count: int) -> Reader:
    """Return a reader of bit blocks."""
    leaf = _find_leaf(layout, ".".join(name for name in (path, *node.parts[0].names) if name))
    offsets = leaf.offsets()
    orders = [
        (order, [_find_bit_runs(part.bits, node.size, order) for part in node.parts])
        for order in BYTE_ORDERS
    ]
    order, numbers = min(orders, key=lambda each: sum(len(runs) for runs in each[1]))
    readers = [
        _add_labels(part.info, _make_bits_reader(part.bits, runs))
        for part, runs in zip(node.parts, numbers, strict=True)
    ]
    parts = _combine_readers(
        [(part.bits.keys, reader) for part, reader in zip(node.parts, readers, strict=True)], count
    )
    code = {1: "B", 2: "H", 4: "I", 8: "Q"}.get(node.size)
    if code is not None:
        blocks = _make_unpacker(offsets, "<" if order == "little" else ">", code)
    else:
        blocks = functools.partial(
            _read_integers, _make_unpacker(offsets, "<", f"{node.size}s"), order, False
        )
    return functools.partial(_read_block_parts, parts, blocks)


def _read_block_parts(parts: Reader, blocks: Reader, frame: bytes) -> Sequence[Any]:
    return parts(blocks(frame))


def _find_bit_runs(
    field: BitField, size: int, order: Literal["little", "big"]
) -> list[tuple[int, int, int]]:
    """Return the runs of consecutive bits that make up a value in a bit block.

    A run is (lowest bit in the block, mask, lowest bit in the value).
    """
    runs = list[tuple[int, int, int]]()
    for segment in sorted(field.segments, key=lambda segment: segment.target):
        low = 8 * (segment.byte if order == "little" else size - 1 - segment.byte) + segment.low
        first, mask, target = runs[-1] if runs else (low, 0, segment.target)
        if runs and (
            low - first != segment.target - target or mask.bit_length() != segment.target - target
        ):
            first = low
            mask = 0
            target = segment.target
        elif runs:
            runs.pop()
        runs.append(
            (first, mask | segment.mask >> segment.low << (segment.target - target), target)
        )
    return runs


def _make_bits_reader(field: BitField, runs: Sequence[tuple[int, int, int]]) -> Reader:
    """Return a function that extracts one value from each of several bit blocks."""
    low, mask, target = runs[0]
    if len(runs) > 1 or field.signed or field.flag or target:
        return functools.partial(_join_runs, field, runs)
    return functools.partial(_extract_bits, low, mask)


def _extract_bits(low: int, mask: int, blocks: Sequence[int]) -> Sequence[int]:
    return [block >> low & mask for block in blocks]


def _join_runs(
    field: BitField, runs: Sequence[tuple[int, int, int]], blocks: Sequence[int]
) -> Sequence[int]:
    values = [
        sum((block >> low & mask) << target for low, mask, target in runs) for block in blocks
    ]
    if field.signed:
        sign = 1 << (field.width - 1)
        return [(value ^ sign) - sign for value in values]
    if field.flag:
        return [value == 1 for value in values]
    return values


def _combine_readers(parts: Sequence[tuple[tuple[str | int, ...], Reader]], count: int) -> Reader:
    """Combine the readers of the numbers of a bit block into one reader.

    Args:
        parts: a pair for each number of the block: its path (names and indices), and its reader.
        count: the number of blocks in a frame.
    """
    if not parts[0][0]:
        return parts[0][1]
    groups: dict[str | int, list[tuple[tuple[str | int, ...], Reader]]] = {}
    for (key, *below), reader in parts:
        groups.setdefault(key, []).append((tuple(below), reader))
    readers = tuple((key, _combine_readers(group, count)) for key, group in groups.items())
    if isinstance(readers[0][0], str):
        return functools.partial(_read_containers, readers, count)  # type: ignore[arg-type]
    return functools.partial(_read_rows, tuple(reader for _, reader in readers))


def _read_rows(readers: Sequence[Reader], frame: bytes) -> Sequence[ListContainer]:
    return [ListContainer(row) for row in zip(*(reader(frame) for reader in readers), strict=True)]


def find_frame_layout(
    sensor: SensorDescription, name: str, data: bytes
) -> Layout | LayoutRefusal | None:
    """Return the layout of one frame, or the refusal of its header.

    Returns None if the frame type has no layouts, or if the header is incomplete.
    """
    layouts = frame_layouts(sensor.frames[name])
    if isinstance(layouts, NotCompilableError):
        return None
    return layouts.layout(data)


def _rank_fault(sensor: SensorDescription, fault: WireError) -> tuple[int, int]:
    """Return a sort key, which is higher for a fault that is later in the frame.

    The frame type with the last fault is the likeliest type.
    """
    if sensor.frames[fault.frame].wire is not None:
        return 0, fault.offset
    layout = find_frame_layout(sensor, fault.frame, fault.data)
    fits = isinstance(layout, Layout) and layout.size == len(fault.data)
    is_complete = fault.kind == diagnose.TRAILING or (fits and fault.kind == diagnose.CHECKSUM)
    if is_complete:
        return (1, len(fault.data))
    return (0, fault.offset)


def _choose_likeliest(sensor: SensorDescription, data: bytes, faults: list[WireError]) -> WireError:
    best = max(faults, key=functools.partial(_rank_fault, sensor))
    if best.offset > 0 or len(sensor.frames) == 1:
        return best
    starts = []
    for name, frame in sensor.frames.items():
        starts.append(f"{name} {frame_coder(frame).begins.hex(' ')}".strip())
    if data:
        begins = f"begins with {data[:4].hex(' ')}"
    else:
        begins = "is empty"
    return WireError(
        f"no frame type matches: the data {begins}, expected {', '.join(starts)}",
        sensor=sensor.id,
        expected=starts,
        got=data[:4],
        data=data,
    )

"""Parse one frame: by its layout if it is sound, else with the first fault as a `WireError`.

All values of a field are unpacked at once, for all elements of the arrays that it is in, and the
containers and lists around them are made from the innermost ones outwards (`unpacked`). Frames that
have no layout are parsed by construct (`lidarspec.frames.plain`).
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

from construct import Container, ListContainer

from lidarspec.errors import SpecError, UnknownFrame, WireError, refuse_text, struct_error
from lidarspec.frames import diagnose
from lidarspec.frames.compilability import NotCompilable
from lidarspec.frames.layout import Layout, Leaf, Refused
from lidarspec.frames.layout_tree import frame_layouts
from lidarspec.frames.parts import Region
from lidarspec.frames.plain import parse_plain, plain_fault
from lidarspec.frames.schema import schema
from lidarspec.frames.wire_coder import frame_coder
from lidarspec.frames.wire_fields import Examined, examine
from lidarspec.spec.bits import BitField
from lidarspec.spec.description import Frame
from lidarspec.spec.sensor import Sensor
from lidarspec.spec.syntax import WireNaN, seen, unnamed
from lidarspec.spec.tree import (
    Blob,
    Block,
    FieldInfo,
    Node,
    Number,
    Parts,
    Repeat,
    Sealed,
    Select,
    Struct,
    When,
)


def parse(
    sensor: Sensor,
    data: bytes,
    *,
    frame: str | None = None,
    verify: bool = True,
    units: bool = False,
) -> Any:
    """Return the Container of raw values of exactly one frame.

    Args:
        frame: its type; found out if left out.
        verify: False accepts wrong constants, a wrong checksum and trailing bytes.
        units: scaled values in the units of their fields.

    Raises:
        WireError: for bytes that are no such frame.
        UnknownFrame: for a type that the sensor does not have.
    """
    data = _as_bytes(data)
    found = _find_sound(sensor, data, frame)
    if found is None:
        found = _parse_unsound(sensor, data, frame, verify=verify)
    name, values = found
    if units:
        return _physical(schema(sensor.frames[name].tree).all_fields, values, "")
    return values


def identify(sensor: Sensor, data: bytes, *, frame: str | None = None) -> str:
    """Return the name of the frame type that bytes are a frame of.

    Args:
        frame: the only type that is tried; by default all.

    Raises:
        WireError: for bytes that are no frame, by the type that they come nearest to.
        UnknownFrame: for a type that the sensor does not have.
    """
    data = _as_bytes(data)
    found = _find_sound(sensor, data, frame)
    if found is not None:
        return found[0]
    return _parse_unsound(sensor, data, frame, verify=True)[0]


def _as_bytes(data: bytes) -> bytes:
    if isinstance(data, bytes):
        return data
    refuse_text(data)
    return bytes(data)


def _find_sound(sensor: Sensor, data: bytes, frame: str | None) -> tuple[str, Any] | None:
    """Return type and values of a frame that nothing is wrong with; else None."""
    names = sensor.frames if frame is None or frame not in sensor.frames else (frame,)
    for name in names:
        try:
            found = _parse_sound(sensor.frames[name], data)
        except SpecError:
            raise
        except Exception:
            continue  # an expression of the plugin failed: the search for the fault meets it again
        if found is not None:
            return name, found[0]
    return None


def _parse_sound(frame: Frame, data: bytes) -> tuple[Any] | None:
    """Return the values of a sound frame; else None."""
    layouts = frame_layouts(frame)
    if isinstance(layouts, NotCompilable):
        values, size = parse_plain(frame, data)
        if size == len(data):
            return (values,)
        return None
    coder = frame_coder(frame)
    decoded = coder.decode(data)
    if decoded.problem is not None:
        return None
    layout = layouts.layout(decoded.struct)
    if isinstance(layout, Layout) and layout.sound(decoded.struct):
        values = unpacked(frame.tree, layout, decoded.struct)
        return (coder.keep_spelling(values, decoded.struct, data),)
    return None


def _parse_unsound(
    sensor: Sensor, data: bytes, frame: str | None, *, verify: bool
) -> tuple[str, Any]:
    """Return type and values of a frame that something is wrong with, if that is not verified.

    Raises:
        WireError: if it is verified, or the values cannot be read.
    """
    if frame is not None:
        if frame not in sensor.frames:
            raise UnknownFrame(frame, sensor.frames, place=sensor.id)
        if verify:
            raise _find_fault(sensor, frame, data)
        return frame, _parse_unverified(sensor, frame, data)
    if not sensor.frames:
        raise UnknownFrame(
            "data", (), place=sensor.id, hint="; configure the sensor with its file first"
        )
    faults = [_find_fault(sensor, name, data) for name in sensor.frames]
    if not verify:
        for likely in sorted(faults, key=functools.partial(_progress, sensor), reverse=True):
            try:
                return likely.frame, _parse_unverified(sensor, likely.frame, data)
            except WireError:
                continue
    raise _likeliest(sensor, data, faults)


def _find_fault(sensor: Sensor, name: str, data: bytes) -> WireError:
    """Return what is wrong with the bytes of a frame."""
    frame = sensor.frames[name]
    if isinstance(frame_layouts(frame), NotCompilable):
        return plain_fault(sensor, name, data)
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
    examined = examine(frame.tree, decoded.struct, frame.room)
    return _error_of(sensor, name, data, examined, decoded.offset)


def _error_of(
    sensor: Sensor, name: str, data: bytes, examined: Examined, place: Callable[[int], int]
) -> WireError:
    """Return the first fault of a frame as an error.

    Args:
        place: from an offset in the frame to one on the wire.
    """
    fault = _search(sensor, name, diagnose.find_fault, examined)
    if fault is None:  # a plugin's checksum that gives another value each time
        return WireError("not a valid frame", sensor=sensor.id, frame=name, data=data)
    return _wire_error(sensor, name, data, fault, place)


def _search(
    sensor: Sensor,
    name: str,
    find: Callable[[Examined], diagnose.Fault | None],
    examined: Examined,
) -> diagnose.Fault | None:
    """Return what a search finds.

    Raises:
        SpecError: if an expression or a checksum of the struct raises.
    """
    try:
        return find(examined)
    except Exception as error:
        raise struct_error(error, path=name, sensor=sensor.id) from error


def _wire_error(
    sensor: Sensor, name: str, data: bytes, fault: diagnose.Fault, place: Callable[[int], int]
) -> WireError:
    offset = place(fault.offset)
    return WireError(
        fault.reason(offset),
        offset=offset,
        path=fault.path,
        expected=fault.expected,
        got=fault.got,
        sensor=sensor.id,
        frame=name,
        data=data,
    )


def _parse_unverified(sensor: Sensor, name: str, data: bytes) -> Any:
    """Return the values of a frame whatever is wrong with it.

    Raises:
        WireError: if its bytes end, or lead to no layout.
    """
    frame = sensor.frames[name]
    if isinstance(frame_layouts(frame), NotCompilable):
        try:
            return parse_plain(frame, data, verify=False)[0]
        except Exception:
            raise plain_fault(sensor, name, data) from None
    decoded = frame_coder(frame).decode(data)
    examined = examine(frame.tree, decoded.struct, frame.room)
    shortage = _search(sensor, name, diagnose.find_shortage, examined)
    if shortage is not None or examined.layout is None:
        assert shortage is not None
        raise _wire_error(sensor, name, data, shortage, decoded.offset)
    return unpacked(frame.tree, examined.layout, decoded.struct[: examined.layout.size])


def _physical(fields: Mapping[str, FieldInfo], value: Any, path: str) -> Any:
    """Values with those of scaled fields in their units."""
    if isinstance(value, dict):
        return Container(
            (name, _physical(fields, part, f"{path}.{name}".strip(".")))
            for name, part in value.items()
        )
    if isinstance(value, list):
        return ListContainer(_physical(fields, part, path) for part in value)
    if value is not None and path in fields and fields[path].scaled:
        return fields[path].physical(value)
    return value


def unpacked(root: Node, layout: Layout, frame: bytes) -> Any:
    """The Container of raw values of a sound frame of this layout."""
    reader = layout.notes.get(_reader) or layout.notes.setdefault(
        _reader, _reader(root, "", layout, 1)
    )
    return reader(frame)[0]


#: the byte orders in which a bit block is a number.
ENDS: tuple[Literal["little"], Literal["big"]] = ("little", "big")

#: from the bytes of a frame (below a bit block: from the numbers in its place) to the values of a
#: part of it, one for each element of the arrays that it is in, row by row.
Reader = Callable[[Any], Sequence[Any]]


def _reader(node: Node, path: str, layout: Layout, count: int) -> Reader:
    """What reads a part of frames of a layout; `count`: how often it is in one."""
    if count == 0:
        return _no_values
    match node:
        case Sealed():
            return _reader(node.body, path, layout, count)
        case Struct():
            members = [
                (member.name, f"{node.path}.{member.name}".strip("."), member)
                for member in node.members
                if member.name
            ]
            readers = tuple(
                (name, _reader(member, below, layout, count)) for name, below, member in members
            )
            return functools.partial(_containers, readers, count)
        case Repeat():
            if not isinstance(node.count, int):
                length = layout.lengths[node.axis]
            else:
                length = node.count
            return functools.partial(
                _lists, _reader(node.element, path, layout, count * length), count, length
            )
        case Parts():
            return functools.partial(_parts_of, layout.regions[node.axis])
        case When() | Select():
            return _reader(layout.branches[node], path, layout, count)
        case Number() | Blob():
            return _words(node, layout.leaves[path])
        case Block():
            return _bits(node, path, layout, count)
    return functools.partial(_nothing, count)


def _no_values(frame: bytes) -> Sequence[Any]:
    return ()


def _nothing(count: int, frame: bytes) -> Sequence[None]:
    return (None,) * count


def _containers(
    members: Sequence[tuple[str, Reader]], count: int, frame: bytes
) -> Sequence[Container]:
    containers = [
        Container() for _ in range(count)
    ]  # made empty and filled by name, which takes half the time
    if count == 1:
        for name, reader in members:
            containers[0][name] = reader(frame)[0]
        return containers
    for name, reader in members:
        for container, value in zip(containers, reader(frame), strict=True):
            container[name] = value
    return containers


def _lists(elements: Reader, count: int, length: int, frame: bytes) -> Sequence[ListContainer]:
    values = elements(frame)
    if length:
        return [
            ListContainer(values[start : start + length])
            for start in range(0, count * length, length)
        ]
    return [ListContainer() for _ in range(count)]


def _parts_of(region: Region, frame: bytes) -> Sequence[ListContainer]:
    return [
        ListContainer(
            unpacked(kind.node.root, layout, part) for kind, layout, part in region.listed(frame)
        )
    ]


def _unpack(offsets: Sequence[int], order: str, code: str) -> Reader:
    """What unpacks a value of this format code at each offset; they ascend."""
    form = list[str]()
    size = struct.calcsize(order + code)
    end = offsets[0]
    for offset in offsets:
        form.append(f"{offset - end}x{code}" if offset > end else code)
        end = offset + size
    return functools.partial(struct.Struct(order + "".join(form)).unpack_from, offset=offsets[0])


def _words(node: Number | Blob, leaf: Leaf) -> Reader:
    if isinstance(node, Blob):
        return _unpack(leaf.offsets(len(leaf.shape) - 1), "<", f"{leaf.size}s")
    offsets = leaf.offsets()
    order = "<" if node.order == "little" else ">"
    if leaf.wire is None:
        raw = _unpack(offsets, order, f"{leaf.size}s")
        return _labelled(
            leaf.info, functools.partial(_integers, raw, node.order, node.kind == "int")
        )
    if node.kind == "float":
        return functools.partial(
            _floats, _unpack(offsets, order, leaf.wire.char), offsets, node.size
        )
    return _labelled(
        leaf.info,
        _unpack(
            offsets, order, leaf.wire.char if node.size < 8 else "Q" if node.kind == "uint" else "q"
        ),
    )


def _integers(
    raw: Reader, order: Literal["little", "big"], signed: bool, frame: bytes
) -> Sequence[int]:
    return [int.from_bytes(value, order, signed=signed) for value in raw(frame)]


def _floats(numbers: Reader, offsets: Sequence[int], size: int, frame: bytes) -> Sequence[float]:
    """Floats, of which a NaN keeps its bits."""
    values = numbers(frame)
    if all(value == value for value in values):
        return values
    return [
        value if value == value else WireNaN(frame[at : at + size])
        for value, at in zip(values, offsets, strict=True)
    ]


def _labelled(info: FieldInfo, numbers: Reader) -> Reader:
    if info.labels:
        return functools.partial(_names, _Names(info), numbers)
    return numbers


class _Names(dict[int, Any]):
    """The results of an Enum by raw value.

    construct makes a new object for each value; these are made once.
    """

    def __init__(self, info: FieldInfo) -> None:
        super().__init__({raw: seen(info, raw) for raw in info.labels})

    def __missing__(self, raw: int) -> Any:
        return unnamed(raw)


def _names(names: _Names, numbers: Reader, frame: bytes) -> Sequence[Any]:
    return [names[value] for value in numbers(frame)]


def _bits(node: Block, path: str, layout: Layout, count: int) -> Reader:
    """Return a reader of bit blocks, which returns the parts of each block.

    A block is read as one number, in the byte order that leaves fewer runs of bits.
    """
    leaf = layout.leaves[".".join(name for name in (path, *node.parts[0].names) if name)]
    offsets = leaf.offsets()
    orders = [
        (order, [_runs(part.bits, node.size, order) for part in node.parts]) for order in ENDS
    ]
    order, numbers = min(orders, key=lambda each: sum(len(runs) for runs in each[1]))
    readers = [
        _labelled(part.info, _part(part.bits, runs))
        for part, runs in zip(node.parts, numbers, strict=True)
    ]
    parts = _grouped(
        [(part.bits.keys, reader) for part, reader in zip(node.parts, readers, strict=True)], count
    )
    code = {1: "B", 2: "H", 4: "I", 8: "Q"}.get(node.size)
    if code is not None:
        blocks = _unpack(offsets, "<" if order == "little" else ">", code)
    else:
        blocks = functools.partial(_integers, _unpack(offsets, "<", f"{node.size}s"), order, False)
    return functools.partial(_parts, parts, blocks)


def _parts(parts: Reader, blocks: Reader, frame: bytes) -> Sequence[Any]:
    return parts(blocks(frame))


def _runs(
    field: BitField, size: int, order: Literal["little", "big"]
) -> list[tuple[int, int, int]]:
    """Return the runs of bits of a part, if its block is read as one number.

    Each run is (lowest bit in the block, mask, lowest bit of the value).
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


def _part(field: BitField, runs: Sequence[tuple[int, int, int]]) -> Reader:
    """What takes the values of a part out of its blocks."""
    low, mask, target = runs[0]
    if len(runs) > 1 or field.signed or field.flag or target:
        return functools.partial(_joined, field, runs)
    return functools.partial(_masked, low, mask)


def _masked(low: int, mask: int, blocks: Sequence[int]) -> Sequence[int]:
    return [block >> low & mask for block in blocks]


def _joined(
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


def _grouped(parts: Sequence[tuple[tuple[str | int, ...], Reader]], count: int) -> Reader:
    """The structs and arrays of a bit block around its parts."""
    if not parts[0][0]:
        return parts[0][1]
    groups: dict[str | int, list[tuple[tuple[str | int, ...], Reader]]] = {}
    for (key, *below), reader in parts:
        groups.setdefault(key, []).append((tuple(below), reader))
    readers = tuple((key, _grouped(group, count)) for key, group in groups.items())
    if isinstance(readers[0][0], str):
        return functools.partial(_containers, readers, count)  # type: ignore[arg-type]
    return functools.partial(_rows, tuple(reader for _, reader in readers))


def _rows(readers: Sequence[Reader], frame: bytes) -> Sequence[ListContainer]:
    return [ListContainer(row) for row in zip(*(reader(frame) for reader in readers), strict=True)]


def layout_of(sensor: Sensor, name: str, data: bytes) -> Layout | Refused | None:
    """Return the layout that the header of this frame leads to.

    Returns None if the type is not compiled, or if the header is incomplete.
    """
    layouts = frame_layouts(sensor.frames[name])
    if isinstance(layouts, NotCompilable):
        return None
    return layouts.layout(data)


def _progress(sensor: Sensor, fault: WireError) -> tuple[int, int]:
    """Return how far a frame type matched before it failed.

    A frame of exactly this size, or one at the start, precedes all others.
    """
    if sensor.frames[fault.frame].wire is not None:
        return 0, fault.offset
    layout = layout_of(sensor, fault.frame, fault.data)
    fits = isinstance(layout, Layout) and layout.size == len(fault.data)
    whole = fault.reason.find("after the frame") >= 0 or (
        fits and fault.reason.find("checksum") >= 0
    )
    if whole:
        return (1, len(fault.data))
    return (0, fault.offset)


def _likeliest(sensor: Sensor, data: bytes, faults: list[WireError]) -> WireError:
    best = max(faults, key=functools.partial(_progress, sensor))
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
        f"no frame type fits: the data {begins}, expected {', '.join(starts)}",
        sensor=sensor.id,
        expected=starts,
        got=data[:4],
        data=data,
    )

"""One frame from bytes: as its layout says where it is sound, else as construct does, whose faults
become a `WireError` with a place.

Most frames are sound, and their layout is known: then all values of a field are unpacked at once,
for all elements of the arrays that it is in, and the containers and lists around them are made from
the innermost ones outwards (`unpacked`).
"""

from __future__ import annotations

import functools
import io
import re
import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import construct
import numpy as np
from construct import Container, ListContainer

from lidarspec.errors import SpecError, UnknownFrame, WireError, refuse_text
from lidarspec.frames.compilability import NotCompilable
from lidarspec.frames.layout import Layout, Leaf, Refused
from lidarspec.frames.layout_tree import frame_layouts, prefix_of
from lidarspec.frames.parts import Region
from lidarspec.frames.schema import schema
from lidarspec.frames.slots import SPELLING, Recoder, recoder
from lidarspec.spec.bits import BitField
from lidarspec.spec.description import Spec
from lidarspec.spec.syntax import Mismatch, WireNaN, clean, field_path, seen, unnamed
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
    sensor: Spec, data: bytes, *, frame: str | None = None, verify: bool = True, units: bool = False
) -> Any:
    """The Container of raw values of one frame, exactly.

    Args:
        frame: its type; found out where left out.
        verify: False accepts wrong constants, a wrong checksum and trailing bytes.
        units: scaled values in the units of their fields.

    Raises:
        WireError: for bytes that are no such frame.
        UnknownFrame: for a type that the sensor does not have.
    """
    if not isinstance(data, bytes):
        refuse_text(data)
        data = bytes(data)
    found = _compiled(sensor, data, frame)
    if found is None:
        name, values = parse_typed(sensor, data, frame=frame, verify=verify)
        found = name, clean(values)
    name, values = found
    return _physical(schema(sensor.frames[name].tree).all_fields, values, "") if units else values


def _compiled(sensor: Spec, data: bytes, frame: str | None) -> tuple[str, Any] | None:
    """The type and values of a frame that is sound, by its layout; None where construct has to read
    it.
    """
    try:
        for name in sensor.frames if frame is None or frame not in sensor.frames else (frame,):
            recoding = recoder(sensor.frames[name])
            if recoding is not None:
                if (found := recoding.row(data)) is not None and found[0].sound(found[1]):
                    return name, spelled(
                        unpacked(sensor.frames[name].tree, *found), recoding, *found, data
                    )
                continue
            layouts = frame_layouts(sensor.frames[name])
            if isinstance(layouts, NotCompilable):
                break  # it may be of this type, which comes first
            layout = layouts.layout(data)
            if isinstance(layout, Layout) and layout.sound(data):
                return name, unpacked(sensor.frames[name].tree, layout, data)
    except SpecError:
        raise
    # a plugin's expression, checksum or wire form may raise anything: construct meets it again, and
    # tells the place
    except Exception:
        pass
    return None


def spelled(values: Any, recoding: Recoder, layout: Layout, row: bytes, data: bytes) -> Any:
    """Values of a frame with a wire form, with the frame itself as `SPELLING` where `build` would
    write them otherwise.
    """
    if recoding.written(np.frombuffer(row, np.uint8).reshape(1, -1), layout) != [data]:
        values[SPELLING] = data
    return values


def _physical(fields: Mapping[str, FieldInfo], value: Any, path: str) -> Any:
    """Values with those of scaled fields in their units."""
    if isinstance(value, dict):
        return Container(
            (name, _physical(fields, part, f"{path}.{name}".strip(".")))
            for name, part in value.items()
        )
    if isinstance(value, list):
        return ListContainer(_physical(fields, part, path) for part in value)
    return (
        fields[path].physical(value)
        if value is not None and path in fields and fields[path].scaled
        else value
    )


def unpacked(root: Node, layout: Layout, frame: bytes) -> Any:
    """The Container of raw values of a sound frame of this layout."""
    reader = layout.notes.get(_reader) or layout.notes.setdefault(
        _reader, _reader(root, "", layout, 1)
    )
    return reader(frame)[0]


#: the byte orders in which a bit block is a number.
ENDS: tuple[Literal["little"], Literal["big"]] = ("little", "big")

#: bytes that are shown of what cannot be read.
SHOWN = 12

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
            length = layout.lengths[node.axis] if not isinstance(node.count, int) else node.count
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
    return (
        [
            ListContainer(values[start : start + length])
            for start in range(0, count * length, length)
        ]
        if length
        else [ListContainer() for _ in range(count)]
    )


def _parts_of(region: Region, frame: bytes) -> Sequence[ListContainer]:
    return [
        ListContainer(
            unpacked(kind.node.root, layout, part) for kind, layout, part in region.listed(frame)
        )
    ]


def _offsets(leaf: Leaf, shape: Sequence[int]) -> list[int]:
    """Where each element of a field begins, row by row."""
    offsets = [leaf.offset]
    for length, stride in zip(shape, leaf.strides, strict=False):
        offsets = [offset + stride * index for offset in offsets for index in range(length)]
    return offsets


def _unpack(offsets: Sequence[int], order: str, code: str) -> Reader:
    """What unpacks a value of this format code at each offset; they ascend."""
    form, size, end = list[str](), struct.calcsize(order + code), offsets[0]
    for offset in offsets:
        form.append(f"{offset - end}x{code}" if offset > end else code)
        end = offset + size
    return functools.partial(struct.Struct(order + "".join(form)).unpack_from, offset=offsets[0])


def _words(node: Number | Blob, leaf: Leaf) -> Reader:
    if isinstance(node, Blob):
        return _unpack(_offsets(leaf, leaf.shape[:-1]), "<", f"{leaf.size}s")
    offsets, order = _offsets(leaf, leaf.shape), "<" if node.order == "little" else ">"
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
    return functools.partial(_names, _Names(info), numbers) if info.labels else numbers


class _Names(dict[int, Any]):
    """What an Enum makes of a number; construct makes a new one each time, and they are all alike."""

    def __init__(self, info: FieldInfo) -> None:
        super().__init__({raw: seen(info, raw) for raw in info.labels})

    def __missing__(self, raw: int) -> Any:
        return unnamed(raw)


def _names(names: _Names, numbers: Reader, frame: bytes) -> Sequence[Any]:
    return [names[value] for value in numbers(frame)]


def _bits(node: Block, path: str, layout: Layout, count: int) -> Reader:
    """What reads a bit block: each as one number, in the order that leaves fewer runs of bits, and
    its parts where construct has them.
    """
    leaf = layout.leaves[".".join(name for name in (path, *node.parts[0].names) if name)]
    offsets = _offsets(leaf, leaf.shape[: len(leaf.strides)])
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
    """The bits of a part in its block as one number: lowest bit, mask and lowest bit of the value,
    of each run.
    """
    runs = list[tuple[int, int, int]]()
    for segment in sorted(field.segments, key=lambda segment: segment.target):
        low = 8 * (segment.byte if order == "little" else size - 1 - segment.byte) + segment.low
        first, mask, target = runs[-1] if runs else (low, 0, segment.target)
        if runs and (
            low - first != segment.target - target or mask.bit_length() != segment.target - target
        ):
            first, mask, target = low, 0, segment.target
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
    return [value == 1 for value in values] if field.flag else values


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


def parse_typed(
    sensor: Spec, data: bytes, *, frame: str | None = None, verify: bool = True
) -> tuple[str, Any]:
    """The name of the frame type, and the frame as construct parses it.

    Raises:
        WireError: for bytes that are no such frame.
        UnknownFrame: for a type that the sensor does not have.
    """
    if not isinstance(data, bytes):
        refuse_text(data)
        data = bytes(data)
    if frame is not None:
        if frame not in sensor.frames:
            raise UnknownFrame(frame, sensor.frames, place=sensor.id)
        return frame, _parse_as(sensor, frame, data, verify=verify)
    if not sensor.frames:
        raise UnknownFrame(
            "data", (), place=sensor.id, hint="; configure the sensor with its file first"
        )
    faults: list[WireError] = []
    for name in sensor.frames:
        try:
            return name, _parse_as(sensor, name, data, verify=True)
        except WireError as fault:
            faults.append(fault)
    if not verify:
        for likely in sorted(faults, key=functools.partial(_progress, sensor), reverse=True):
            try:
                return likely.frame, _parse_as(sensor, likely.frame, data, verify=False)
            except WireError:
                continue
    raise _likeliest(sensor, data, faults)


def _parse_as(sensor: Spec, name: str, data: bytes, *, verify: bool) -> Any:
    recoding, where = (
        recoder(sensor.frames[name]),
        {"sensor": sensor.id, "frame": name, "data": data},
    )
    if recoding is None:
        return _parse_row(sensor, name, data, where, int, verify=verify)
    found = recoding.row(data)
    if verify and found is None:
        raise _unreadable(recoding, data, where)
    row = recoding.legible(data).row if found is None else found[1]
    parsed = _parse_row(
        sensor, name, row, where, functools.partial(recoding.place, data), verify=verify
    )
    return parsed if found is None else spelled(parsed, recoding, *found, data)


def _unreadable(recoding: Recoder, data: bytes, where: Mapping[str, Any]) -> WireError:
    """Why bytes are no frame of a wire form, with the place of the first slot that cannot be read."""
    begins = recoding.begins
    if not data or not data.startswith(begins):
        reason = (
            f"begins with {data[: len(begins)].hex(' ') or 'nothing'}, expected {begins.hex(' ')}"
        )
        return WireError(reason, offset=0, expected=begins, got=data[: len(begins)], **where)
    reading = recoding.reading(np.frombuffer(data, np.uint8), np.zeros(1, np.intp))
    size, legible = reading.sizes.item(0), recoding.legible(data)
    start, path, wanted = legible.stop, legible.path, legible.wanted
    if 0 < size < len(data):
        return WireError(
            f"{len(data) - size} more bytes after the frame's {size}",
            offset=size,
            expected=size,
            got=len(data),
            **where,
        )
    if size <= 0:
        return WireError(
            f"frame has no end in its {len(data)} bytes", offset=len(data), got=len(data), **where
        )
    if reading.intact is not None and not reading.intact[0]:
        return WireError("a check character of its lines is wrong", offset=start, **where)
    got = data[start : start + SHOWN]
    return WireError(
        f"{path or 'frame'} at byte {start}: {got!r} is not {wanted}",
        offset=start,
        path=path,
        expected=wanted,
        got=got,
        **where,
    )


def _parse_row(
    sensor: Spec,
    name: str,
    data: bytes,
    where: dict[str, Any],
    place: Callable[[int], int],
    *,
    verify: bool,
) -> Any:
    """The frame as construct parses it; `place`: from where a field is in it to where it is on the
    wire.
    """
    frame, stream = sensor.frames[name], io.BytesIO(data)
    try:
        parsed = frame.prepared.parse_stream(stream, _verify=verify)
    except Mismatch as fault:
        path = field_path(fault.path)
        offset = place(_first_byte(sensor, name, data, path, fault.offset))
        raise WireError(
            f"{path} at byte {offset}: {fault.reason} {fault.got}, expected {fault.expected}",
            offset=offset,
            path=path,
            expected=fault.expected,
            got=fault.got,
            **where,
        ) from None
    except construct.StreamError as fault:
        raise _truncated(sensor, name, data, field_path(fault.path)) from None
    except construct.ConstructError as fault:
        path = field_path(fault.path)
        reason = str(fault).partition("\n")[2].strip() or type(fault).__name__
        raise WireError(
            f"{path}: {reason}", offset=place(stream.tell()), path=path, **where
        ) from None
    except SpecError:
        raise
    except Exception as fault:
        raise SpecError(
            f"an expression of the struct failed: {type(fault).__name__}: {fault}",
            path=name,
            sensor=sensor.id,
        ) from fault
    size = stream.tell()
    if verify and size != len(data):
        raise WireError(
            f"{len(data) - size} more bytes after the frame's {size}",
            offset=size,
            expected=size,
            got=len(data),
            **where,
        )
    if size > frame.room:
        raise WireError(
            f"{size} bytes, and the longest is {frame.room}", expected=frame.room, got=size, **where
        )
    return parsed


def _first_byte(sensor: Spec, name: str, data: bytes, path: str, offset: int) -> int:
    """Where a field begins; within a bit block construct counts bits, and the layout knows the
    byte.
    """
    layout = layout_of(sensor, name, data)
    leaf = layout.leaves.get(_without_indices(path)) if isinstance(layout, Layout) else None
    if leaf is None or leaf.wire is not None or not leaf.elements:
        return offset
    indices = [int(part.partition("]")[0]) for part in path.split("[")[1:]]
    start = leaf.offset + sum(
        index * stride for index, stride in zip(indices, leaf.strides, strict=False)
    )
    return start + min(segment.byte for segment in leaf.elements[0].segments)


def _truncated(sensor: Spec, name: str, data: bytes, path: str) -> WireError:
    """Where the bytes end, and what the field there would have needed."""
    layout = layout_of(sensor, name, data)
    total = f" of {layout.size}" if isinstance(layout, Layout) else ""
    needs, left = "", 0
    if isinstance(layout, Layout):
        size, start = _at_end(layout, path, len(data))
        left = len(data) - start
        needs = f" needs {size} byte{'s' if size != 1 else ''}, {left} left"
    reason = (
        f"frame ends at byte {len(data)}{total}:"
        f" {path or 'the first field'}{needs or ' is cut off'}"
    )
    whole = layout.size if isinstance(layout, Layout) else None
    return WireError(
        reason,
        offset=len(data) - left,
        path=path,
        sensor=sensor.id,
        frame=name,
        expected=whole,
        got=len(data),
        data=data,
    )


def _at_end(layout: Layout, path: str, end: int) -> tuple[int, int]:
    """Size and start of the element that the end of the data falls into or precedes."""
    plain = _without_indices(path)
    for known, leaf in layout.leaves.items():
        if known == plain or known.startswith(f"{plain}."):
            starts = _offsets(leaf, leaf.shape[: len(leaf.shape) - (leaf.info.kind == "bytes")])
            return leaf.size, min(
                next((start for start in starts if start + leaf.size > end), end), end
            )
    return 0, end


def _without_indices(path: str) -> str:
    return re.sub(r"\[\d+\]", "", path)


def layout_of(sensor: Spec, name: str, data: bytes) -> Layout | Refused | None:
    """The layout that the header of this frame leads to; None where it is not compiled or not all
    there.
    """
    layouts = frame_layouts(sensor.frames[name])
    return None if isinstance(layouts, NotCompilable) else layouts.layout(data)


def _progress(sensor: Spec, fault: WireError) -> tuple[int, int]:
    """How far a type was right before it failed: a frame of this very size, or one in front, comes
    before all others.
    """
    if sensor.frames[fault.frame].wire is not None:
        return 0, fault.offset
    layout = layout_of(sensor, fault.frame, fault.data)
    fits = isinstance(layout, Layout) and layout.size == len(fault.data)
    whole = fault.reason.find("after the frame") >= 0 or (
        fits and fault.reason.find("checksum") >= 0
    )
    return (1, len(fault.data)) if whole else (0, fault.offset)


def _likeliest(sensor: Spec, data: bytes, faults: list[WireError]) -> WireError:
    best = max(faults, key=functools.partial(_progress, sensor))
    if best.offset > 0 or len(sensor.frames) == 1:
        return best
    starts = []
    for name, frame in sensor.frames.items():
        prefix, recoding = prefix_of(frame.tree, frame.room), recoder(frame)
        run = bytes(
            prefix[spot][1] for spot in range(len(prefix)) if prefix.get(spot, (0, 0))[0] == 0xFF
        )
        starts.append(f"{name} {(run if recoding is None else recoding.begins).hex(' ')}".strip())
    begins = f"begins with {data[:4].hex(' ')}" if data else "is empty"
    return WireError(
        f"no frame type fits: the data {begins}, expected {', '.join(starts)}",
        sensor=sensor.id,
        expected=starts,
        got=data[:4],
        data=data,
    )

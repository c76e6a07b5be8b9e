"""One frame from bytes: construct does it, and what it says of a fault becomes a `WireError` with its place."""

from __future__ import annotations

import functools
import io
from typing import Any

import construct

from lidarspec.errors import SpecError, UnknownFrame, WireError, refuse_text
from lidarspec.framing.frame_engine import CompiledCodec, codec
from lidarspec.spec.construct_layer import Mismatch, clean, field_path
from lidarspec.spec.description import Spec
from lidarspec.wire.layout import Layout
from lidarspec.wire.layout_tree import Refused
from lidarspec.wire.single_frames import Unpack


def parse(sensor: Spec, data: bytes, *, frame: str | None = None, verify: bool = True) -> Any:
    """See `Sensor.parse`."""
    if not isinstance(data, bytes):
        refuse_text(data)
        data = bytes(data)
    try:
        for parser in _parsers(sensor, frame, len(data)):
            found = parser(data)
            if found is not None:
                return found
    except SpecError:
        raise
    except Exception:  # out of a plugin: construct meets it again, and it is told with its place
        pass
    return clean(parse_typed(sensor, data, frame=frame, verify=verify)[1])


@functools.lru_cache(maxsize=4096)
def _parsers(sensor: Spec, frame: str | None, size: int) -> list[Unpack]:
    """Generated code for each frame type that a frame of this size can be, up to the first that only construct can tell."""
    found = []
    for name in sensor.frames if frame is None or frame not in sensor.frames else (frame,):
        engine = codec(sensor.frames[name])
        if not isinstance(engine, CompiledCodec):
            break  # it may be of this type, which comes first
        if engine.size in (None, size):
            found.append(engine.parse)
    return found


def parse_typed(sensor: Spec, data: bytes, *, frame: str | None = None, verify: bool = True) -> tuple[str, Any]:
    """The name of the frame type, and the parsed frame."""
    if not isinstance(data, bytes):
        refuse_text(data)
        data = bytes(data)
    if frame is not None:
        if frame not in sensor.frames:
            raise UnknownFrame(frame, sensor.frames, place=sensor.id)
        return frame, _parse_as(sensor, frame, data, verify=verify)
    if not sensor.frames:
        raise UnknownFrame("data", (), place=sensor.id, hint="; configure the sensor with its file first")
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
    frame = sensor.frames[name]
    stream = io.BytesIO(data)
    where: dict[str, Any] = {"sensor": sensor.id, "frame": name, "data": data}
    try:
        parsed = frame.prepared.parse_stream(stream, _verify=verify)
    except Mismatch as fault:
        path = field_path(fault.path)
        offset = _first_byte(sensor, name, data, path, fault.offset)
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
        raise WireError(f"{path}: {reason}", offset=stream.tell(), path=path, **where) from None
    except SpecError:
        raise
    except Exception as fault:
        raise SpecError(f"an expression of the struct failed: {type(fault).__name__}: {fault}", path=name, sensor=sensor.id) from fault
    size = stream.tell()
    if verify and size != len(data):
        raise WireError(f"{len(data) - size} more bytes after the frame's {size}", offset=size, expected=size, got=len(data), **where)
    if size > frame.max_length:
        raise WireError(f"{size} bytes, and the longest is {frame.max_length}", expected=frame.max_length, got=size, **where)
    return parsed


def _first_byte(sensor: Spec, name: str, data: bytes, path: str, offset: int) -> int:
    """Where a field begins; within a bit block construct counts bits, and the layout knows the byte."""
    layout = layout_of(sensor, name, data)
    leaf = layout.leaves.get("".join(_without_indices(path))) if isinstance(layout, Layout) else None
    if leaf is None or leaf.wire is not None or not leaf.elements:
        return offset
    indices = [int(part.partition("]")[0]) for part in path.split("[")[1:]]
    start = leaf.offset + sum(index * stride for index, stride in zip(indices, leaf.strides, strict=False))
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
    reason = f"frame ends at byte {len(data)}{total}: {path or 'the first field'}{needs or ' is cut off'}"
    whole = layout.size if isinstance(layout, Layout) else None
    return WireError(reason, offset=len(data) - left, path=path, sensor=sensor.id, frame=name, expected=whole, got=len(data), data=data)


def _at_end(layout: Layout, path: str, end: int) -> tuple[int, int]:
    """Size and start of the element that the end of the data falls into or precedes."""
    plain = "".join(part for part in _without_indices(path))
    for known, leaf in layout.leaves.items():
        if known == plain or known.startswith(f"{plain}."):
            starts, arrays = [leaf.offset], len(leaf.shape) - (leaf.info.kind == "bytes")
            for length, stride in list(zip(leaf.shape, leaf.strides, strict=False))[:arrays]:
                starts = [start + stride * index for start in starts for index in range(length)]
            inside = [start for start in starts if start + leaf.size > end]
            size = leaf.size
            return (size, inside[0]) if inside and inside[0] <= end else (size, min(inside[0] if inside else end, end))
    return 0, end


def _without_indices(path: str) -> str:
    parts = path.split("[")
    return parts[0] + "".join(part.partition("]")[2] for part in parts[1:])


def layout_of(sensor: Spec, name: str, data: bytes) -> Layout | Refused | None:
    """The layout that the header of this frame leads to; None where it is not compiled or not all there."""
    engine = codec(sensor.frames[name])
    return engine.tree.layout(data) if hasattr(engine, "tree") else None


def _progress(sensor: Spec, fault: WireError) -> tuple[int, int]:
    """How far a type was right before it failed: a frame of this very size, or one in front, comes before all others."""
    layout = layout_of(sensor, fault.frame, fault.data)
    fits = isinstance(layout, Layout) and layout.size == len(fault.data)
    whole = fault.reason.find("after the frame") >= 0 or (fits and fault.reason.find("checksum") >= 0)
    return (1, len(fault.data)) if whole else (0, fault.offset)


def _likeliest(sensor: Spec, data: bytes, faults: list[WireError]) -> WireError:
    best = max(faults, key=functools.partial(_progress, sensor))
    if best.offset > 0 or len(sensor.frames) == 1:
        return best
    starts = []
    for name, frame in sensor.frames.items():
        prefix = codec(frame).prefix
        run = [prefix[spot][1] for spot in range(len(prefix)) if prefix.get(spot, (0, 0))[0] == 0xFF]
        starts.append(f"{name} {bytes(run).hex(' ')}".strip())
    begins = f"begins with {data[:4].hex(' ')}" if data else "is empty"
    return WireError(
        f"no frame type fits: the data {begins}, expected {', '.join(starts)}",
        sensor=sensor.id,
        expected=starts,
        got=data[:4],
        data=data,
    )

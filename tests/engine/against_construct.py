"""Compare our parsing of an author's struct with construct's own.

The comparison is by frame, and by column on both paths. The expected values come from construct
with the tree as the author wrote it, without any part of the engine.
"""

from __future__ import annotations

import dataclasses
import functools
import io
from collections.abc import Iterable, Sequence
from typing import Any

import construct
import numpy as np
import pytest
from construct import Construct

from lidarspec import Packets, Sensor, SpecError, WireError
from lidarspec.frames.schema import make_schema
from lidarspec.spec import Every, Fields, Frame, Polar, Udp
from lidarspec.spec.enum_values import EnumValue
from tests.by_construct import reader

BACKENDS = ("auto", "construct")
#: what puts every 16-bit number among the ranges that are returns.
AWAY = 100_000


def points(f: Fields) -> Polar:
    return Polar(range=1, azimuth=0)


def sensor(struct: Construct, *, max_length: int = 200) -> Sensor:
    """Return a sensor with this struct as its datagram."""
    return Sensor(
        "test-alike",
        vendor="Test",
        model="Alike",
        frames={"data": Frame(struct, data=True, max_length=max_length)},
        points=points,
        scan=Every(0.1),
        links={"data": Udp(7000)},
        range_limits=(0.1, 10.0),
        status="manual",
        source="invented for the tests",
    )


def parse_by_construct(struct: Construct, data: bytes, *, max_length: int = 200) -> Any:
    """Return construct's value of the author's struct.

    Returns None if construct does not read exactly these bytes.
    """
    stream = io.BytesIO(data)
    try:
        parsed = struct.parse_stream(stream)
    except construct.ConstructError:
        return None
    return plain(parsed) if stream.tell() == len(data) <= max_length else None


def plain(value: Any) -> Any:
    """Return a parsed value as dicts, lists, numbers and bytes.

    Values of construct's Enum become those of our own class.
    """
    if isinstance(value, dict):
        return {name: plain(part) for name, part in value.items() if not name.startswith("_")}
    if isinstance(value, list):
        return [plain(part) for part in value]
    if isinstance(value, construct.EnumIntegerString):
        return EnumValue(value.intvalue, str(value))
    return value


def agree(
    struct: Construct,
    frames: Iterable[bytes],
    *,
    max_length: int = 200,
    kept: bool = True,
    has_hidden_fields: bool = False,
) -> int:
    """Fail unless every engine reads the input as construct does.

    Args:
        kept: require that a built value gives the same bytes; False if `Rebuild` replaces a value.
        has_hidden_fields: whether our frames may have fields that construct hides.

    Returns:
        The number of valid frames.
    """
    ours = sensor(struct, max_length=max_length)
    whole = list[tuple[bytes, Any]]()
    invalid = list[bytes]()
    for data in frames:
        wanted = parse_by_construct(struct, data, max_length=max_length)
        if wanted is None:
            with pytest.raises(WireError):
                ours.parse(data)
            invalid.append(data)
            continue
        if not data:
            continue  # a frame without a byte has no place in any input
        whole.append((data, wanted))
        found = ours.parse(data)
        if has_hidden_fields:
            assert has_all(plain(found), wanted), data.hex()
        else:
            assert repr(plain(found)) == repr(wanted), data.hex()
        if kept:
            assert ours.build("data", found) == data
    for backend in BACKENDS:
        accepted = reader(ours, backend).decode(invalid)
        assert len(accepted) == 0, (
            f"{backend}: frame at byte {accepted.offset[0]} of {b''.join(invalid).hex()}"
        )
        packets = reader(ours, backend).decode([data for data, _ in whole])
        assert len(packets) == len(whole), backend
        assert packets.stats.plugin_errors == 0, packets.stats.tracebacks
        for path in packets.table.schema.columns:
            names = path.split(".")
            if has_hidden_fields and not any(has_path(wanted, names) for _, wanted in whole):
                continue
            column = column_of(packets, path)
            for one, (data, wanted) in zip(column, whole, strict=len(column) > 0):
                same(one, at(wanted, path.split(".")), f"{backend} {path} {data.hex()}")
    return len(whole)


def has_all(found: Any, wanted: Any) -> bool:
    """Return whether a value has all fields of construct's; it may have more."""
    if isinstance(wanted, dict):
        return all(name in found and has_all(found[name], wanted[name]) for name in wanted)
    if isinstance(wanted, list):
        return len(found) == len(wanted) and all(map(has_all, found, wanted))
    return repr(found) == repr(wanted)


def has_path(value: Any, names: Sequence[str]) -> bool:
    """Return whether a value, or an element of nested lists, has the path."""
    if isinstance(value, list):
        return any(has_path(part, names) for part in value)
    if not names:
        return True
    return isinstance(value, dict) and names[0] in value and has_path(value[names[0]], names[1:])


def column_of(packets: Packets, path: str) -> Sequence[Any]:
    """Return the raw values of a field; () if its branches have no common column."""
    try:
        return packets.table.raw(path)
    except SpecError as error:
        if error.path != path:
            raise
        return ()


def has_raw_form(packets: Packets) -> bool:
    """Return whether every name has the same kind of part in all its branches."""
    try:
        return packets.raw is not None
    except SpecError:
        return False


def clouds_agree(
    struct: Construct,
    frames: Iterable[bytes],
    *,
    max_length: int = 200,
    backends: Sequence[str] = BACKENDS,
) -> int:
    """Fail unless a cloud has all elements of a field in order, without padding.

    The fields are in the deepest arrays with the same lengths within each frame.

    Returns:
        The number of compared fields.
    """
    plain_sensor = sensor(struct, max_length=max_length)
    whole = [(data, parse_by_construct(struct, data, max_length=max_length)) for data in frames]
    kept = [(data, wanted) for data, wanted in whole if wanted is not None]
    if not has_raw_form(plain_sensor.decode([data for data, _ in kept])):
        return 0  # what is an array in one branch alone has no length in the others
    table, tried = make_schema(plain_sensor.frames["data"].tree), 0
    for path, info in table.fields.items():
        is_small = info.kind == "int" and info.bits <= 16 and not info.scaled
        if (
            not is_small
            or not info.axes
            or info.axes != table.deepest_axes
            or any(path.startswith(f"{other}.") for other in table.fields)
        ):
            continue
        if any(table.find_sequence(axis) not in {None, axis} for axis in info.axes):
            continue  # the lengths of an array in elements of different size may differ in a frame
        ours = dataclasses.replace(plain_sensor, points=functools.partial(_ranges, path=path))
        values = [
            value
            for _, wanted in kept
            for value in flat(at(wanted, path.split(".")), len(info.axes))
        ]
        for backend in backends:
            cloud = reader(ours, backend).decode([data for data, _ in kept]).points()
            np.testing.assert_array_equal(
                cloud.range, np.array(values, np.float32) + AWAY, err_msg=f"{backend} {path}"
            )
        tried += 1
    return tried


def _ranges(f: Fields, path: str) -> Polar:
    return Polar(range=functools.reduce(getattr, path.split("."), f) + AWAY, azimuth=0)


def flat(value: Any, depth: int) -> Iterable[float]:
    """Return the numbers in nested lists; NaN for missing values."""
    if isinstance(value, list):
        for part in value:
            yield from flat(part, depth - 1)
    elif value is not None or depth == 0:
        yield np.nan if value is None else int(value)


def at(value: Any, names: Sequence[str]) -> Any:
    """Return the value at a path; nested lists if it passes arrays; None if missing."""
    if isinstance(value, list):
        return [at(part, names) for part in value]
    if not names:
        return (
            list(value) if isinstance(value, bytes) else None if isinstance(value, dict) else value
        )
    return at(value.get(names[0]), names[1:]) if isinstance(value, dict) else None


def same(column: Any, wanted: Any, where: str) -> None:
    """Fail unless a padded column holds the value; missing elements must be 0."""
    if is_nothing(wanted):
        assert not np.any(column), where
    elif isinstance(wanted, list):
        assert is_array(column), where
        assert is_nothing(wanted[len(column) :]), where
        for one, part in zip(column, wanted, strict=False):
            same(one, part, where)
        assert not np.any(column[len(wanted) :]), where
    else:
        assert not is_array(column), where
        assert (
            column == wanted or (column != column and wanted != wanted) or column == float(wanted)
        ), where


def is_array(column: Any) -> bool:
    """Return whether a value of a column is an array, or a list whose elements may differ."""
    return isinstance(column, list) or np.ndim(column) > 0


def is_nothing(wanted: Any) -> bool:
    """Return whether a value, or everything in nested lists, is None."""
    return all(map(is_nothing, wanted)) if isinstance(wanted, list) else wanted is None

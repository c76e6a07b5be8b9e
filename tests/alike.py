"""Whether construct's own parse of an author's struct and ours agree: frame by frame, and as columns on both paths.

The judge here is construct itself with the tree as the author wrote it; nothing of the engine takes part in what is expected.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from typing import Any

import construct
import numpy as np
import pytest
from construct import Construct

from lidarspec import Every, Fields, Frame, Polar, Sensor, Udp, WireError

BACKENDS = ("auto", "construct")


def points(f: Fields) -> Polar:
    return Polar(range=1, azimuth=0)


def sensor(struct: Construct, *, max_length: int = 200) -> Sensor:
    """A sensor whose datagrams are such structs."""
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


def expected(struct: Construct, data: bytes, *, max_length: int = 200) -> Any:
    """What construct reads from the author's struct; None where it does not read exactly these bytes."""
    stream = io.BytesIO(data)
    try:
        parsed = struct.parse_stream(stream)
    except construct.ConstructError:
        return None
    return plain(parsed) if stream.tell() == len(data) <= max_length else None


def plain(value: Any) -> Any:
    """A parsed value as dicts, lists, numbers and bytes."""
    if isinstance(value, dict):
        return {name: plain(part) for name, part in value.items() if not name.startswith("_")}
    if isinstance(value, list):
        return [plain(part) for part in value]
    return value


def agree(struct: Construct, frames: Iterable[bytes], *, max_length: int = 200) -> int:
    """Assert that every engine reads these bytes as construct does; the number of those that are frames."""
    ours, kept = sensor(struct, max_length=max_length), []
    for data in frames:
        wanted = expected(struct, data, max_length=max_length)
        if wanted is None:
            with pytest.raises(WireError):
                ours.parse(data)
            for backend in BACKENDS:
                assert len(ours.decode([data], backend=backend)) == 0, data.hex()
            continue
        kept.append((data, wanted))
        found = ours.parse(data)
        assert repr(plain(found)) == repr(wanted), data.hex()
        assert ours.build("data", found) == data
    for backend in BACKENDS:
        packets = ours.decode([data for data, _ in kept], backend=backend)
        assert len(packets) == len(kept), backend
        assert packets.stats.plugin_errors == 0, packets.stats.tracebacks
        raw = packets.raw
        for path in packets.table.schema.fields:
            column = raw
            for name in path.split("."):
                column = column[name]
            for one, (data, wanted) in zip(column, kept, strict=True):
                same(one, at(wanted, path.split(".")), f"{backend} {path} {data.hex()}")
    return len(kept)


def at(value: Any, names: Sequence[str]) -> Any:
    """The value under a path, nested lists of them where arrays are passed; None where there is none."""
    if isinstance(value, list):
        return [at(part, names) for part in value]
    if not names:
        return list(value) if isinstance(value, bytes) else value
    return at(value.get(names[0]), names[1:]) if isinstance(value, dict) else None


def same(column: Any, wanted: Any, where: str) -> None:
    """Assert that a padded column holds the value: what is not there is 0."""
    if wanted is None:
        assert not np.any(column), where
    elif isinstance(wanted, list):
        assert len(wanted) <= len(column), where
        for one, part in zip(column, wanted, strict=False):
            same(one, part, where)
        assert not np.any(column[len(wanted) :]), where
    else:
        number = int(wanted) if isinstance(wanted, construct.EnumIntegerString) else wanted
        assert column == number or (column != column and number != number), where

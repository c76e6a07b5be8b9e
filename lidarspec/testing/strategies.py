"""Hypothesis strategies for the frames, commands, streams and scans of a sensor.

    from hypothesis import given
    from lidarspec.testing.strategies import values

    @given(values("acme-x1", "data"))
    def test_distances_are_positive(value): ...

Each field is drawn separately, so that a failure is reported with the smallest value of each field.
Constants, lengths and checksums are filled in.
"""

from __future__ import annotations

import functools
import math
import random
from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np
from hypothesis import reject, strategies as st
from hypothesis.strategies import DrawFn, SearchStrategy
from numpy.typing import NDArray

from lidarspec.errors import SpecError, UnknownCommand, UnknownFrame, UsageError
from lidarspec.frames.commands import ArgumentSlot, find_argument_slot
from lidarspec.frames.layout import Leaf
from lidarspec.frames.layout_tree import InvalidLengthError, UnknownSelectorError, find_layout
from lidarspec.frames.parse import parse
from lidarspec.frames.wire_coder import frame_coder
from lidarspec.framing.example_frames import LOW_NUMBERS, draw_frame, iter_switch_keys
from lidarspec.framing.frame_engine import get_codec
from lidarspec.packets.stream import PacketStream
from lidarspec.plugins import sensor as named_sensor
from lidarspec.scans.scan import Scan
from lidarspec.scans.stream import iter_scans
from lidarspec.sensor_operations import Sensor
from lidarspec.simulation.scenes import Box, Room
from lidarspec.simulation.simulator import frame_simulation, make_opening_frame, simulate
from lidarspec.spec.arguments import Address, Choice, Range, Taken, Text
from lidarspec.spec.syntax import check_bound
from lidarspec.spec.tree import FieldInfo
from lidarspec.testing.value_ranges import (
    LayoutRanges,
    find_headers,
    find_ranges,
    find_valid_frames,
    find_value_ranges,
    is_often_valid,
)

__all__ = ["commands", "frames", "scans", "streams", "values"]

#: Field path -> a strategy of its raw value.
Fields = Mapping[str, SearchStrategy[Any]]
#: Maximum number of elements of an array that are drawn separately. In a longer array, all elements
#: have one value except at most `MAX_EXCEPTIONS` elements.
MAX_SINGLE_DRAWS = 12
MAX_EXCEPTIONS = 6
#: Number of tries to draw a frame without a layout in one example.
TRIES = 4
#: Maximum number of elements of nested arrays of such a frame, which construct builds one by one.
MAX_BUILT_ELEMENTS = 400

#: Maximum length in bytes of an argument if its field has no fixed size.
MAX_OCTETS = 16
#: Maximum number of runs of frames in a stream, and maximum length of the noise between two runs.
MAX_RUNS = 6
MAX_NOISE_BYTES = 16
#: Initial and maximum number of packets that are simulated to find a complete scan.
FIRST_PACKETS = 16
MAX_PACKETS = 8192
#: Maximum values for a drawn scan: distance of a wall in metres, number of boxes, and number of
#: scans since power-on.
MAX_WALL_M = 6
MAX_BOXES = 2
MAX_SCANS = 3

Header = tuple[tuple[str, int], ...]
#: The name of a command and its arguments.
Command = tuple[str, dict[str, Any]]


def frames(sensor: str | Sensor, frame: str, fields: Fields | None = None) -> SearchStrategy[bytes]:
    """Return a strategy for valid frames of a type.

    Args:
        sensor: an id or a Sensor.
        frame: the name of the frame type, incoming or outgoing.
        fields: field path -> a strategy for the raw value of the field, or of each element if the
            field is in an array.

    Raises:
        UnknownFrame: for a frame type that the sensor does not have.
    """
    resolved = _find_sensor(sensor)
    if frame not in resolved.frames:
        raise UnknownFrame(frame, resolved.frames, place=resolved.id)
    engine = get_codec(resolved.frames[frame])
    if engine.is_compiled and not engine.schema.has_measured_sizes:
        return _compiled_frames(resolved, frame, dict(fields or {}))
    return _plain_frames(resolved, frame, dict(fields or {}))


def values(
    sensor: str | Sensor, frame: str, fields: Fields | None = None
) -> SearchStrategy[dict[str, Any]]:
    """Return a strategy for the values of valid frames, as plain dicts and lists.

    The values are raw values of all fields, with constants, counts and checksums, as returned by
    `Sensor.parse` and accepted by `Sensor.build`.

    Args:
        sensor: an id or a Sensor.
        frame: the name of the frame type, incoming or outgoing.
        fields: field path -> a strategy for the raw value of the field, or of each element if the
            field is in an array.

    Raises:
        UnknownFrame: for a frame type that the sensor does not have.
    """
    resolved = _find_sensor(sensor)
    return _parsed_values(resolved, frame, frames(resolved, frame, fields))


# Hypothesis shows a mapped strategy as a call of the function; `composite` shows the value.
@st.composite
def _parsed_values(
    draw: DrawFn, sensor: Sensor, frame: str, drawn: SearchStrategy[bytes]
) -> dict[str, Any]:
    parsed: dict[str, Any] = _to_plain(parse(sensor, draw(drawn), frame=frame))
    return parsed


def commands(sensor: str | Sensor, name: str | None = None) -> SearchStrategy[Command]:
    """Return a strategy for commands with arguments within their ranges.

    Each value is a pair (name, arguments) for ``sensor.command(name, **arguments)`` and
    ``device.send(name, **arguments)``. Numbers are in the unit of their field.

    Args:
        sensor: an id or a Sensor.
        name: the name of the command; by default any command of the sensor.

    Raises:
        UnknownCommand: for a command that the sensor does not have.
        UsageError: for a sensor without commands.
    """
    resolved = _find_sensor(sensor)
    if name is not None and name not in resolved.commands:
        raise UnknownCommand(name, resolved.commands, place=resolved.id)
    if not resolved.commands:
        raise UsageError(f"{resolved.id} has no commands")
    names = resolved.commands if name is None else [name]
    return st.one_of(*(_command(resolved, each) for each in names))


def _command(sensor: Sensor, name: str) -> SearchStrategy[Command]:
    arguments = {
        argument: _argument_values(find_argument_slot(sensor, name, argument), declared.kind)
        for argument, declared in sensor.commands[name].arguments.items()
    }
    return st.tuples(st.just(name), st.fixed_dictionaries(arguments))


def _argument_values(slot: ArgumentSlot, kind: Taken) -> SearchStrategy[Any]:
    """Return a strategy for an argument of a command."""
    match kind:
        case Choice(names=names):
            return st.sampled_from(sorted(names.values()))
        case Range(low, high) if slot.info.kind == "float":
            return st.floats(low, high)
        case Range(low, high):
            ends = sorted([slot.info.raw(float(low)), slot.info.raw(float(high))])
            limits = slot.info.limits
            raw = st.integers(max(ends[0], limits[0]), min(ends[1], limits[1]))
            return _physical_values(slot.info, raw, low, high)
        case Text(size) if slot.is_in_template:
            return st.text("abcXYZ019_.-", max_size=size)
        case Text(size):
            longest = min(size, slot.length or size)
            return st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=longest)
        case Address():
            return _addresses(6 if slot.length == 16 else 4)
    if slot.length is None:
        return st.binary(max_size=MAX_OCTETS)
    return st.binary(min_size=slot.length, max_size=slot.length)


@st.composite
def _physical_values(
    draw: DrawFn, info: FieldInfo, raw: SearchStrategy[int], low: float, high: float
) -> float:
    """Draw a raw value, and return the value in the unit of its field."""
    physical: float = info.physical(draw(raw))
    return min(max(physical, low), high)


@st.composite
def _addresses(draw: DrawFn, version: Literal[4, 6]) -> str:
    return str(draw(st.ip_addresses(v=version)))


def streams(
    sensor: str | Sensor, *, noise: bool | SearchStrategy[bytes] = False
) -> SearchStrategy[Any]:
    """Return a strategy for input that `Sensor.decode`, `split` and `scans` accept.

    The input consists of valid frames of all incoming types: bytes, or a list of datagrams if the
    sensor sends datagrams.

    Args:
        sensor: an id or a Sensor.
        noise: True to insert random bytes and truncated frames; or a strategy for the bytes to
            insert.
    """
    resolved = _find_sensor(sensor)
    runs = [_consecutive_frames(resolved, name) for name in resolved.incoming]
    if noise is True:
        noise = st.binary(min_size=1, max_size=MAX_NOISE_BYTES)
        runs.append(_truncated(resolved))
    if noise is not False:
        runs.append(noise.map(lambda data: [data]))
    sequences = st.lists(st.one_of(*runs), max_size=MAX_RUNS)
    return _joined_runs(sequences, is_stream=not resolved.datagrams)


@st.composite
def _joined_runs(
    draw: DrawFn, runs: SearchStrategy[list[list[bytes]]], *, is_stream: bool
) -> bytes | list[bytes]:
    pieces = [data for run in draw(runs) for data in run]
    if is_stream:
        return b"".join(pieces)
    return pieces


@st.composite
def _consecutive_frames(draw: DrawFn, sensor: Sensor, frame: str) -> list[bytes]:
    """Draw consecutive frames of a type.

    If the type can be decoded only after another frame (`Frame.after`), the result begins with a
    frame of the other type.
    """
    declared = sensor.frames[frame]
    before = [] if declared.after is None else [draw(frames(sensor, declared.after))]
    count = draw(_integers(declared.confirm, declared.confirm + 2))
    return before + [draw(frames(sensor, frame)) for _ in range(count)]


@st.composite
def _truncated(draw: DrawFn, sensor: Sensor) -> list[bytes]:
    """Draw the beginning of a frame."""
    data = draw(frames(sensor, draw(st.sampled_from(list(sensor.incoming)))))
    return [data[: draw(st.integers(1, max(len(data) - 1, 1)))]]


def scans(sensor: str | Sensor, *, lost: int = 3) -> SearchStrategy[Scan]:
    """Return a strategy for scans of a simulated sensor in a room.

    The walls, the boxes in the room, the number of the scan since power-on, and the lost packets
    are drawn.

    Args:
        sensor: an id or a Sensor.
        lost: maximum number of lost packets; 0 for complete scans only.

    Raises:
        UsageError: for a sensor that declares no `sweep`.
        SpecError: if the fields that the ranges are calculated from cannot be found, or if the
            simulated sensor sends no complete scan.
    """
    resolved = _find_sensor(sensor)
    return _scans(resolved, _count_packets_until_scan(resolved), lost)


@functools.lru_cache(maxsize=64)
def _count_packets_until_scan(sensor: Sensor) -> int:
    """Return a number of packets, from power-on, that contain a complete scan."""
    count = FIRST_PACKETS
    while count <= MAX_PACKETS:
        sent = dict(enumerate(simulate(sensor, count)))
        if any(scan.complete for scan in _find_scans(sensor, sent)):
            return count
        count *= 2
    raise SpecError(
        f"{MAX_PACKETS} simulated packets contain no complete scan", path="scan", sensor=sensor.id
    )


@st.composite
def _scans(draw: DrawFn, sensor: Sensor, packets: int, lost: int) -> Scan:
    sides = st.integers(1, MAX_WALL_M)
    walls = Box(
        (-float(draw(sides)), -float(draw(sides)), -1.0),
        (float(draw(sides)), float(draw(sides)), 1.0),
    )
    room = Room(walls, tuple(draw(st.lists(_boxes(), max_size=MAX_BOXES))))
    start = draw(st.integers(0, MAX_SCANS)) * packets
    sent = dict(enumerate(simulate(sensor, packets, start=start, scene=room)))
    for index in draw(st.sets(st.integers(0, packets - 1), max_size=lost)):
        del sent[index]
    all_scans = _find_scans(sensor, sent)
    complete = [scan for scan in all_scans if scan.complete]
    if not all_scans:
        reject()
    return max(complete or all_scans, key=len)


@st.composite
def _boxes(draw: DrawFn) -> Box:
    """Draw a box of up to 1 m near the sensor; all lengths are multiples of 0.1 m."""
    low = [draw(st.integers(2, 10 * MAX_WALL_M)) / 10 for _ in range(2)]
    size = [draw(st.integers(1, 10)) / 10 for _ in range(2)]
    sides = [draw(st.sampled_from((1, -1))) for _ in range(2)]
    x, y = (
        [side * end for end in (start, start + width)]
        for start, width, side in zip(low, size, sides, strict=True)
    )
    return Box((min(x), min(y), -1.0), (max(x), max(y), draw(st.integers(-9, 10)) / 10))


def _find_scans(sensor: Sensor, packets: Mapping[int, bytes]) -> list[Scan]:
    """Return the scans of data frames.

    Args:
        packets: number -> data frame, in order; numbers of lost frames are missing.
    """
    opening = make_opening_frame(sensor)
    if sensor.clock is None:
        return _find_scans_by_arrival(sensor, opening, packets)
    announced = [opening, *packets.values()]
    if sensor.datagrams:
        return list(sensor.scans([data for data in announced if data]))
    return list(sensor.scans(b"".join(announced)))


def _find_scans_by_arrival(
    sensor: Sensor, opening: bytes, packets: Mapping[int, bytes]
) -> list[Scan]:
    """Return the scans of data frames that arrive at the rate of the simulated sensor."""
    interval_ns = frame_simulation(sensor, sensor.data_frame).interval
    decoder = sensor.decoder()
    found = decoder.frames(opening, 0) if opening else []
    for number, data in packets.items():
        found += decoder.frames(data, round(number * interval_ns))
    found += decoder.take_pending()
    stream = PacketStream(sensor, sensor.data_frame, decoder.stats)
    return list(iter_scans(sensor, [stream.add(found, whole=True)]))


def _find_sensor(sensor: str | Sensor) -> Sensor:
    if isinstance(sensor, Sensor):
        return sensor
    return named_sensor(sensor)


def _to_plain(parsed: Any) -> Any:
    """Return a parsed frame with dicts and lists in place of construct's containers."""
    if isinstance(parsed, dict):
        return {name: _to_plain(value) for name, value in parsed.items()}
    if isinstance(parsed, list):
        return [_to_plain(value) for value in parsed]
    return parsed


@st.composite
def _compiled_frames(draw: DrawFn, sensor: Sensor, frame: str, fields: Fields) -> bytes:
    """Draw a frame of a compiled type: first its header fields, then all other fields."""
    ranges = find_ranges(sensor, frame, draw(_headers(sensor, frame, fields)))
    if ranges is None:
        # No plausible frame has this header.
        ranges = find_ranges(sensor, frame, draw(st.sampled_from(find_headers(sensor, frame))))
        assert ranges is not None
    drawn = {
        leaf.info.path: _draw_leaf(draw, leaf, _element_values(leaf.info, ranges, fields))
        for leaf in ranges.free
    }
    struct = ranges.make_struct(drawn, fixed=fields)
    if struct is None:
        reject()
    data = frame_coder(sensor.frames[frame]).encode(struct)
    assert data is not None
    return data


@st.composite
def _headers(draw: DrawFn, sensor: Sensor, frame: str, fields: Fields) -> Header:
    """Draw the fields that the layout depends on, in the order of their use."""
    declared = sensor.frames[frame]
    header: dict[str, int] = {}
    asked = ""
    while True:
        try:
            find_layout(declared.tree, header, declared.max_struct_bytes)
        except UnknownSelectorError as unknown:
            info = unknown.leaf.info
            asked = info.path
            if asked in fields:
                header[asked] = draw(fields[asked])
            else:
                header[asked] = draw(_header_values(sensor, frame, info))
        except (InvalidLengthError, ArithmeticError, LookupError, TypeError, ValueError):
            # The last drawn value is invalid: with the values before it, there was a next field.
            if not header.get(asked):
                return draw(st.sampled_from(find_headers(sensor, frame)))
            header[asked] = int(header[asked] / 2)
        else:
            return tuple(header.items())


@functools.lru_cache(maxsize=4096)
def _header_values(sensor: Sensor, frame: str, info: FieldInfo) -> SearchStrategy[int]:
    """Return a strategy for the raw value of a field that determines the layout."""
    if info.const is not None:
        return st.just(int(info.const))
    if info.allowed:
        return st.sampled_from(info.allowed)
    low, high = info.limits
    keys = iter_switch_keys(sensor.frames[frame].tree)
    named = sorted({key for key in (*info.labels, *keys) if low <= key <= high})
    numbers = _mostly_low(low, high)
    if named:
        return st.sampled_from(named) | numbers
    return numbers


def _element_values(info: FieldInfo, ranges: LayoutRanges, fields: Fields) -> SearchStrategy[Any]:
    """Return a strategy for the raw value of a field, an array element or a byte."""
    if info.path in fields:
        return fields[info.path]
    if info.kind == "float":
        assert info.dtype is not None
        return _floats(8 * info.dtype.itemsize)
    if info.allowed is not None:
        return st.sampled_from(info.allowed)
    low, high = ranges.ranges.get(info.path, (0, 255))
    named = tuple(raw for raw in info.labels if low <= raw <= high)
    return _integers(low, high, named)


@functools.lru_cache(maxsize=4096)
def _integers(low: int, high: int, named: tuple[int, ...] = ()) -> SearchStrategy[int]:
    if named:
        return st.sampled_from(named) | st.integers(low, high)
    return st.integers(low, high)


@functools.lru_cache
def _floats(width: int) -> SearchStrategy[float]:
    """Return a strategy for floats of a width in bits, without NaN."""
    return st.floats(width=width, allow_nan=False)  # type: ignore[arg-type]


def _draw_leaf(draw: DrawFn, leaf: Leaf, element: SearchStrategy[Any]) -> NDArray[Any]:
    """Draw the values of a field as an array of the shape (1, *leaf.shape)."""
    count = math.prod(leaf.shape)
    drawn = _draw_array(draw, count, functools.partial(draw, element))
    return np.array(drawn, leaf.info.dtype).reshape(1, *leaf.shape)


def _draw_array(draw: DrawFn, count: int, draw_one: Callable[[], Any]) -> list[Any]:
    """Draw the elements of an array."""
    if count <= MAX_SINGLE_DRAWS:
        return [draw_one() for _ in range(count)]
    drawn = [draw_one()] * count
    for index in draw(st.lists(_integers(0, count - 1), max_size=MAX_EXCEPTIONS)):
        drawn[index] = draw_one()
    return drawn


class _DrawnNumbers(random.Random):
    """A random generator that takes its numbers from Hypothesis."""

    def __init__(self, draw: DrawFn, ranges: Mapping[str, tuple[int, int]]) -> None:
        super().__init__(0)
        self._draw = draw
        self._ranges = ranges
        #: product of the numbers of elements of the arrays around the current value
        self._elements = 1

    def draw(self, strategy: SearchStrategy[Any]) -> Any:
        """Draw a value of a strategy."""
        return self._draw(strategy)

    def draw_number(self, path: str, bits: int, kind: str) -> Any:
        """Draw a raw value of a field.

        Args:
            bits: the width of the field.
            kind: "u" or "i" for an integer, "f" for a float.
        """
        if kind == "f":
            return self.draw(_floats(bits))
        if path in self._ranges:
            return self.draw(_integers(*self._ranges[path]))
        if kind == "i":
            return self.draw(_mostly_low(-(1 << bits - 1), (1 << bits - 1) - 1))
        return self.draw(_mostly_low(0, (1 << bits) - 1))

    def draw_elements(self, count: int, draw_one: Callable[[], Any]) -> list[Any]:
        """Draw the elements of an array.

        Raises:
            RangeError: if construct would build too many elements.
        """
        around = self._elements
        self._elements *= max(count, 1)
        try:
            check_bound(self._elements, MAX_BUILT_ELEMENTS, "number of elements", "")
            return _draw_array(self._draw, count, draw_one)
        finally:
            self._elements = around

    def random(self) -> float:
        return self._draw(st.floats(0, 1, exclude_max=True))

    def getrandbits(self, k: int) -> int:
        return self._draw(_integers(0, (1 << k) - 1))

    def randint(self, a: int, b: int) -> int:
        return self._draw(_integers(a, b))

    def randbytes(self, n: int) -> bytes:
        if n <= MAX_SINGLE_DRAWS:
            return self._draw(st.binary(min_size=n, max_size=n))
        return self._draw(st.binary(min_size=1, max_size=1)) * n

    def choice(self, seq: Any) -> Any:
        return self.draw(st.sampled_from(seq))


@functools.lru_cache(maxsize=1024)
def _mostly_low(low: int, high: int) -> SearchStrategy[int]:
    """Return a strategy for numbers that may be counts: mostly low numbers."""
    low_numbers = [st.integers(max(low, 0), min(high, top)) for top in LOW_NUMBERS]
    return st.one_of(*low_numbers, st.integers(low, high))


@st.composite
def _plain_frames(draw: DrawFn, sensor: Sensor, frame: str, fields: Fields) -> bytes:
    """Draw a frame of a type that has parts or is not compiled, value by value."""
    source = _DrawnNumbers(draw, find_value_ranges(sensor, frame))
    drawn = {path: functools.partial(_draw_own, strategy) for path, strategy in fields.items()}
    try:
        return draw_frame(sensor, frame, source, drawn, tries=TRIES)
    except SpecError:
        if fields or is_often_valid(sensor, frame):
            reject()
        examples = find_valid_frames(sensor, frame)
        if not examples:
            reject()
        return draw(st.sampled_from(examples))


def _draw_own(strategy: SearchStrategy[Any], source: random.Random) -> Any:
    assert isinstance(source, _DrawnNumbers)
    return source.draw(strategy)

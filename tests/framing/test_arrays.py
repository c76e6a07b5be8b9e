"""Tests of frames in arrays and in one buffer, compared with single datagrams."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from construct import Const, Int8ul, Int16ub, Struct
from numpy.typing import NDArray

import lidarspec
from lidarspec import Counters
from lidarspec.expressions.columns import Batch
from lidarspec.frames.arrays import repeat
from lidarspec.frames.frame_table import CompiledTable
from lidarspec.framing.frame_engine import get_codec
from lidarspec.framing.results import Frames
from lidarspec.packets.clocks import Unwrapper, clock_ns
from lidarspec.packets.packets import Packets, join_packets
from lidarspec.packets.stream import PacketStream
from lidarspec.spec import Fields, Frame
from tests.engine.engines import is_compiled
from tests.representatives import each_sensor, each_shape, load_sensor
from tests.shapes import SHAPES

EXAMPLES = 10


@functools.cache
def make_damaged_frames(name: str) -> NDArray[np.uint8]:
    """Return frames of one length, (n, size), with one byte changed in every fifth.

    The changed bytes are spread over the frame.
    """
    sensor = load_sensor(name)
    frames = [sensor.example(sensor.data_frame, seed=seed) for seed in range(EXAMPLES)]
    size = max(map(len, frames), key=[len(frame) for frame in frames].count)
    rows = (
        np.frombuffer(b"".join(frame for frame in frames if len(frame) == size), np.uint8)
        .reshape(-1, size)
        .copy()
    )
    for row in range(0, len(rows), 5):
        rows[row, row * size // len(rows)] ^= 0x41
    return rows


def facts(spans: Frames) -> list[tuple[str, int, bytes, int]]:
    return [(found.frame, found.offset, found.data, found.gap) for found in spans.to_found()]


@each_shape
@pytest.mark.parametrize(
    "distance",
    ["uneven", *(pytest.param(name, marks=pytest.mark.slow) for name in ("none", "even"))],
)
def test_datagrams_in_one_buffer_are_those_one_after_another(name: str, distance: str) -> None:
    sensor = load_sensor(name)
    rows = make_damaged_frames(name)
    count, size = rows.shape
    one_by_one, together = sensor.decoder(stream=False), sensor.decoder(stream=False)
    wanted = [
        (f.frame, f.offset, f.data, f.gap) for row in rows for f in one_by_one.feed(row.tobytes())
    ]
    spare = {"none": 0, "even": 58, "uneven": np.random.default_rng(1).integers(0, 30, count)}[
        distance
    ]
    starts = np.cumsum(np.full(count, size) + spare) - size
    buffer = np.random.default_rng(2).integers(0, 256, int(starts[-1]) + size, np.uint8)
    for start, row in zip(starts, rows, strict=True):
        buffer[start : start + size] = row
    found = together.decode_placed(
        buffer, starts.astype(np.intp), np.full(count, size, np.intp), np.full(count, -1, np.int64)
    )
    assert facts(found) == wanted
    assert together.stats == one_by_one.stats


def read_rows(packets: Packets) -> Any:
    """Return the raw values of packets in a form that can be compared, also with texts."""
    if packets.raw.dtype.hasobject:
        return repr(packets.raw.tolist())
    return packets.raw.tobytes()


@each_shape
def test_the_rows_of_an_array_are_those_datagrams(name: str) -> None:
    sensor = load_sensor(name)
    rows = make_damaged_frames(name)
    array, listed = sensor.decode(rows), sensor.decode([row.tobytes() for row in rows])
    assert array.stats == listed.stats
    assert read_rows(array) == read_rows(listed)
    for column in ("offset", "time_ns", "host_ns", "index", "breaks"):
        np.testing.assert_array_equal(getattr(array, column), getattr(listed, column))


@each_shape
def test_arrays_of_sound_frames_alone_and_with_damaged_ones_in_turn(name: str) -> None:
    sensor = load_sensor(name)
    mixed = make_damaged_frames(name)
    judge = sensor.decoder(stream=False)
    sound = np.array([row for row in mixed if judge.feed(row.tobytes())]).reshape(
        -1, mixed.shape[1]
    )
    arrays = [sound, mixed, sound, sound, mixed[:1], sound[:1], mixed[-1:], sound[::-1], mixed[:0]]
    together, one_by_one = sensor.decoder(stream=False), sensor.decoder(stream=False)
    found = [together.datagrams(array) for array in arrays]
    listed = [one_by_one.datagrams([row.tobytes()]) for array in arrays for row in array]
    assert [fact for spans in found for fact in facts(spans)] == [
        fact for spans in listed for fact in facts(spans)
    ]
    assert together.stats == one_by_one.stats
    assert not len(sound) or (found[5].layout is not None) == is_compiled(
        sensor.frames[sensor.data_frame]
    )
    streams = [PacketStream(sensor, sensor.data_frame, Counters()) for _ in range(3)]
    whole, wanted = streams[0].add(found, whole=True), streams[1].add(listed, whole=True)
    parts = join_packets([streams[2].add([spans], whole=True) for spans in found])
    for packets in (whole, parts):
        assert read_rows(packets) == read_rows(wanted)
        for column in ("offset", "time_ns", "host_ns", "index", "breaks"):
            assert getattr(packets, column).dtype == getattr(wanted, column).dtype
            np.testing.assert_array_equal(getattr(packets, column), getattr(wanted, column))


def test_a_large_array_is_not_copied() -> None:
    sensor = lidarspec.sensor("robosense-m1")
    rows = np.tile(np.frombuffer(sensor.example("data"), np.uint8), (15_000, 1))
    table = sensor.decode(rows, frame="data").table
    assert isinstance(table, CompiledTable)
    assert len(table) == len(rows)
    assert np.shares_memory(table.groups[0].rows, rows)
    assert (table.groups[0].rows == rows).all()


@pytest.mark.parametrize("wraps_at", [0.065536, 30.0, 3600.0])
def test_clocks_run_on_over_wraps_and_steps_back(wraps_at: float) -> None:
    turn = round(wraps_at * 1e9)
    source = np.random.default_rng(3)
    true = 5 * turn + np.cumsum(source.integers(-turn // 20, turn // 4, 5000))
    whole, parts = Unwrapper(wraps_at), Unwrapper(wraps_at)
    nobody = np.zeros(len(true), np.int64)
    found = whole.push(true % turn, nobody)
    np.testing.assert_array_equal(found - found[0], true - true[0])
    cuts = [0, 1, 2, 77, 4000, 5000]
    pieces = [parts.push(true[a:b] % turn, nobody[a:b]) for a, b in pairwise(cuts)]
    np.testing.assert_array_equal(np.concatenate(pieces), found)
    silent = Unwrapper(wraps_at)
    pieces = [
        silent.push(true[a:b] % turn, repeat(0, b - a))
        for a, b in pairwise([*range(0, 5000, 3), 5000])
    ]
    np.testing.assert_array_equal(np.concatenate(pieces), found)


@pytest.mark.parametrize("spread", [1, 3, 40, 400])
def test_a_clock_can_be_a_function(spread: int) -> None:
    sensor = lidarspec.sensor("hesai-xt32")
    assert sensor.clock is not None
    assert callable(sensor.clock.source)
    random = np.random.default_rng(spread)
    rows = np.tile(np.frombuffer(sensor.example("data"), np.uint8), (400, 1))
    start, _ = get_codec(sensor.frames["data"]).tree.layout(rows[0].tobytes()).places["utc"]
    dates = random.integers(1, 60, (spread, 6), np.uint8)
    rows[:, start : start + 6] = dates[np.sort(random.integers(0, spread, len(rows)))]
    table = get_codec(sensor.frames["data"]).table([row.tobytes() for row in rows])
    for some in (np.arange(400), np.arange(1), np.arange(150, 250)):
        batch = Batch(table.take(some), np.zeros(len(some), np.bool_))
        seconds = [
            np.broadcast_to(np.asarray(term).reshape(-1), len(some))
            for term in sensor.clock.source(Fields(batch))
        ]
        assert (
            clock_ns(sensor, batch).tolist()
            == sum(np.rint(term * 1e9).astype(np.int64) for term in seconds).tolist()
        )


@pytest.mark.parametrize(
    "plausible",
    [
        lambda f: f.mode < 17,
        lambda f: (f.mode >= 3) & (f.mode <= 9) & (f.angle < 36_000),
        lambda f: f.mode % 2 == 1,
        lambda f: f.mode % 4 != f.mode // 64,
        lambda f: (f.mode % 4 == 1) | (f.mode % 4 == 2),
        lambda f: (f.mode == 0) | (f.mode == 255),
        lambda f: (f.mode == 7) & ((f.angle == 5) | (f.angle == 1029)),
        lambda f: f.angle % 1024 == 3,
        lambda f: f.angle * 0 + f.mode * 0 < -1,
        lambda f: (f.angle > 7) | (f.mode == 1),
    ],
)
def test_plausible_frames_of_an_array_are_those_that_the_function_says(
    plausible: Callable[[Any], Any],
) -> None:
    frame = Frame(
        Struct("sync" / Const(b"\xa5"), "mode" / Int8ul, "angle" / Int16ub),
        data=True,
        max_length=4,
        plausible=plausible,
    )
    sensor = dataclasses.replace(SHAPES["shape-bits"], frames={"data": frame})
    rows = np.random.default_rng(5).integers(0, 256, (70_000, 4), np.uint8)
    rows[:, 0] = 0xA5
    rows[:65536, 2:] = np.arange(65536, dtype=">u2").view(np.uint8).reshape(-1, 2)
    rows[::9, 1] = np.arange(len(rows[::9])) % 256
    columns = SimpleNamespace(mode=rows[:, 1].astype(float), angle=rows[:, 2] * 256.0 + rows[:, 3])
    wanted = np.flatnonzero(np.broadcast_to(plausible(columns), len(rows)))
    assert sensor.decode(rows).offset.tolist() == (4 * wanted).tolist()


@each_sensor
def test_no_datagrams_have_no_points(name: str) -> None:
    sensor = load_sensor(name)
    if sensor.data_frame is not None:
        assert len(sensor.decode([]).points()) == 0

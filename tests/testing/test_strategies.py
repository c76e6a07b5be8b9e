"""Tests of the strategies: drawn values are consistent and shrink.

They reach every layout. The sensor itself judges a drawn frame: `build`, `parse` and `decode`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from construct import Array, Byte, Check, Const, If, Int8ul, Int16ul, Struct, Switch, this
from hypothesis import HealthCheck, Phase, find, given, settings, strategies as st

from lidarspec import Sensor
from lidarspec.errors import UnknownCommand, UnknownFrame, UsageError
from lidarspec.spec import Checksummed, Crc, Frame
from lidarspec.testing.strategies import commands, frames, scans, streams, values
from tests.by_construct import by_construct
from tests.representatives import each_shape, load_sensor
from tests.shapes import SHAPES, commands as commands_shape, count

EXAMPLES = 5
_QUIET: dict[str, Any] = {
    "deadline": None,
    "database": None,
    "derandomize": True,
    "suppress_health_check": list(HealthCheck),
}
#: Shapes of which construct reads a variant here: counts, bits, branches, checksums, a condition.
PLAIN = ("shape-count", "shape-bits", "shape-choices", "shape-nested", "shape-lengths")

#: A frame whose parts depend on each other in every way that a struct can express.
DEPENDENT = Checksummed(
    Struct(
        "start" / Const(b"\xa5"),
        "kind" / Int8ul,
        "count" / Int16ul,
        "body"
        / Switch(this.kind, {1: Struct("a" / Int8ul), 7: Struct("b" / Int16ul)}, Array(2, Byte)),
        "extra" / If(this.kind > 200, Int16ul),
        "samples" / Array(this.count, Int16ul),
        "low" / Int8ul,
        "high" / Int8ul,
        "ordered" / Check(this.low < this.high),
        "crc" / Int8ul,
    ),
    field="crc",
    algorithm=Crc(8, 0x07),
)


def _dependent(**more: Any) -> Sensor:
    """Return a sensor whose frame has dependent parts, and at most 200 bytes."""
    frame = Frame(DEPENDENT, max_length=200, data=True, **more)
    return Sensor(
        "test-dependent",
        vendor="Test",
        model="Dependent",
        frames={"data": frame},
        points=count.SENSOR.points,
        scan=count.SENSOR.scan,
        links=count.SENSOR.links,
        range_limits=(0.1, 10.0),
        status="manual",
        source="invented",
    )


def draw_examples(strategy: st.SearchStrategy[Any], number: int = EXAMPLES) -> list[Any]:
    """Return examples of a strategy, the same in every run."""
    found: list[Any] = []

    @settings(max_examples=number, phases=[Phase.generate], **_QUIET)
    @given(strategy)
    def collect(drawn: Any) -> None:
        found.append(drawn)

    collect()
    return found


def find_smallest(strategy: st.SearchStrategy[Any], fails: Callable[[Any], bool]) -> Any:
    """Return the minimal failing example."""
    return find(strategy, fails, settings=settings(max_examples=2000, **_QUIET))


@each_shape
def test_every_drawn_value_builds_and_parses_back(name: str) -> None:
    sensor = load_sensor(name)
    for frame in sensor.frames:
        for drawn in draw_examples(values(sensor, frame)):
            parsed = sensor.parse(sensor.build(frame, drawn), frame=frame)
            assert parsed == drawn, frame


@pytest.mark.parametrize("name", PLAIN)
def test_values_of_frames_through_plain_construct_parse_back(name: str) -> None:
    sensor = by_construct(SHAPES[name])
    for frame in sensor.frames:
        for drawn in draw_examples(values(sensor, frame)):
            assert sensor.parse(sensor.build(frame, drawn), frame=frame) == drawn, frame


def test_dependent_fields_are_drawn_together() -> None:
    sensor = _dependent(plausible=lambda f: (f.kind != 3) & (f.count >= 1) & (f.low >= 5))
    drawn = draw_examples(values(sensor, "data"), 150)
    assert {1, 7} < {value["kind"] for value in drawn}
    assert any(value["extra"] is not None for value in drawn)
    assert len({value["count"] for value in drawn}) > 10
    longest = max(len(sensor.build("data", value)) for value in drawn)
    assert 150 < longest <= sensor.frames["data"].max_length
    for value in drawn:
        assert value["count"] == len(value["samples"]) >= 1
        assert 5 <= value["low"] < value["high"]
        stats = sensor.decode(sensor.build("data", value)).stats
        assert (stats.frames["data"], stats.bytes_skipped) == (1, 0)


def test_a_failure_shows_the_smallest_value_of_each_field() -> None:
    sensor = _dependent(plausible=lambda f: f.low >= 5)
    smallest = find_smallest(
        values(sensor, "data"), lambda value: any(distance > 999 for distance in value["samples"])
    )
    assert smallest["count"] == 1
    assert smallest["samples"] == [1000]
    assert (smallest["kind"], smallest["low"], smallest["high"]) in ((0, 5, 6), (1, 5, 6))


def test_a_failure_prints_values() -> None:
    @settings(**_QUIET)
    @given(values(_dependent(), "data"))
    def check(value: Any) -> None:
        assert value["low"] < 20

    with pytest.raises(AssertionError) as raised:
        check()
    printed = " ".join(str(getattr(raised.value, "__notes__", "")).split())
    assert "value={'start':" in printed
    assert "'low': 20" in printed


def test_values_of_plain_construct_shrink_by_field() -> None:
    sensor = by_construct(SHAPES["shape-count"])
    smallest = find_smallest(
        values(sensor, "data"),
        lambda value: any(sample["distance"] > 999 for sample in value["samples"]),
    )
    assert [sample["distance"] for sample in smallest["samples"]] == [1000]


def test_of_a_long_array_single_elements_differ() -> None:
    sensor = load_sensor("velodyne-vlp16")
    smallest = find_smallest(
        values(sensor, "data"),
        lambda value: value["blocks"][7]["channels"][5]["distance"] > 999,
    )
    distances = [
        channel["distance"] for block in smallest["blocks"] for channel in block["channels"]
    ]
    assert sorted(set(distances)) in ([0, 1000], [1000])


def test_strategies_of_an_author_replace_those_of_fields() -> None:
    sensor = _dependent()
    own = {"kind": st.just(7), "samples": st.integers(5, 6), "low": st.just(9)}
    for value in draw_examples(values(sensor, "data", own), 30):
        assert (value["kind"], value["low"]) == (7, 9)
        assert set(value["samples"]) <= {5, 6}


def test_frames_are_the_bytes_of_values() -> None:
    sensor = _dependent()
    drawn = draw_examples(frames(sensor, "data"), 30)
    assert all(sensor.build("data", sensor.parse(data)) == data for data in drawn)
    assert len(set(drawn)) > 15


@pytest.mark.filterwarnings("ignore:Generating overly large repr")  # in a note of Hypothesis
@each_shape
def test_a_stream_without_noise_has_frames_alone(name: str) -> None:
    sensor = load_sensor(name)
    for data in draw_examples(streams(sensor), 3):
        stats = sensor.decode(data).stats
        assert (stats.bytes_skipped, stats.pending) == (0, 0)


def test_a_noisy_stream_has_other_bytes_too() -> None:
    sensor = SHAPES["shape-count"]
    skipped = [
        sensor.decode(data).stats.bytes_skipped
        for data in draw_examples(streams(sensor, noise=True), 30)
    ]
    assert 0 in skipped
    assert max(skipped) > 0
    own = draw_examples(streams(sensor, noise=st.just(b"boot")), 30)
    assert any(b"boot" in data for data in own)
    datagrams = draw_examples(streams(SHAPES["shape-datagrams"], noise=True), 30)
    assert all(isinstance(each, list) for each in datagrams)


@pytest.mark.parametrize("name", [name for name, sensor in SHAPES.items() if sensor.commands])
def test_drawn_commands_are_within_their_ranges(name: str) -> None:
    sensor = SHAPES[name]
    drawn = draw_examples(commands(sensor), 40)
    assert all(isinstance(sensor.command(each, **given), bytes) for each, given in drawn)
    assert {each for each, _ in drawn} == set(sensor.commands)


def test_a_command_can_be_named() -> None:
    sensor = commands_shape.SENSOR
    name = next(name for name, command in sensor.commands.items() if command.args)
    ((found, arguments),) = {
        (each, tuple(sorted(given))) for each, given in draw_examples(commands(sensor, name))
    }
    assert (found, set(arguments)) == (name, set(sensor.commands[name].args))


def test_a_choice_is_one_of_its_numbers() -> None:
    drawn = draw_examples(commands(commands_shape.SENSOR, "mode"), 20)
    assert {given["mode"] for _, given in drawn} == {4, 9}


def test_the_simplest_scan_is_an_empty_room() -> None:
    sensor = load_sensor("ldrobot-stl27l")
    scan = draw_examples(scans(sensor), 1)[0]  # the first example is the simplest one
    assert scan.complete
    assert scan.points.range.max() < 1.5  # walls at one metre
    assert all(len(scan) for scan in draw_examples(scans(sensor), 3))


def test_scans_without_a_clock_end_by_arrival_times() -> None:
    sensor = load_sensor("benewake-tfmini")  # sends one point every 10 ms
    (scan,) = draw_examples(scans(sensor, lost=0), 1)
    assert scan.complete
    assert len(scan) == 10
    assert all(len(scan) for scan in draw_examples(scans(sensor), 3))


def test_unknown_names_are_refused_at_once() -> None:
    sensor = commands_shape.SENSOR
    with pytest.raises(UnknownFrame):
        values(sensor, "dta")
    with pytest.raises(UnknownCommand):
        commands(sensor, "strt")
    with pytest.raises(UsageError, match="no commands"):
        commands(_dependent())

"""Tests of the framing rule (P1, P2, P18) on the shapes, against an oracle.

Parsers with a deliberate mistake must fail.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import pytest

from lidarspec.testing.sensor_under_test import SensorUnderTest
from tests.engine import framing_rule as rule, mutants
from tests.engine.streams import LENGTH
from tests.installed import distinct_sensors_in, sensor_modules
from tests.representatives import STREAM_REPRESENTATIVES, load_sensor
from tests.shapes import SHAPES

STREAM_SHAPES = [name for name, sensor in SHAPES.items() if not sensor.datagrams]
#: Shapes that differ in how their frames are found; the others differ in what is in them.
FRAMING_SHAPES = (
    "shape-count",
    "shape-bits",
    "shape-middle",
    "shape-weak",
    "shape-twins",
    "shape-modes",
    "shape-text",
    "shape-commands",
    "shape-options",
    "shape-measured",
    "shape-tags",
    "shape-tokens",
    "shape-lines",
    "shape-escaped",
)
#: Shapes that are held to all rules on long streams: counts, options, weak frames, switched types,
#: tags, text and escapes.
LONG_SHAPES = (
    "shape-count",
    "shape-options",
    "shape-weak",
    "shape-modes",
    "shape-tags",
    "shape-tokens",
    "shape-escaped",
)
#: Shapes whose large frames take the oracle long.
LARGE_SHAPES = ("shape-joined", "shape-channels")
#: Rules that every shape is held to in the quick tier.
QUICK_RULES = (
    rule.any_split_gives_the_same,
    rule.every_recoverable_frame_is_recovered,
    rule.idle_gives_up_pending_bytes,
)
#: Bytes of a stream in the quick tier.
QUICK_LENGTH = 200

#: Representatives whose frames take the oracle long.
LONG_FRAMES = ("hokuyo-ust10lx",)

MUTANTS = {
    mutants.PartialHeaderDropped: rule.any_split_gives_the_same,
    mutants.ClaimedLengthSkipped: rule.a_claimed_length_costs_no_frame,
    mutants.MismatchingByteLost: rule.a_header_may_start_at_every_byte,
    mutants.LongestRefused: rule.the_longest_frame_is_a_frame,
    mutants.BufferOfTheClass: rule.decoders_are_independent,
    mutants.HeldOverSilence: rule.idle_gives_up_pending_bytes,
    mutants.ExceptionSwallowed: rule.any_split_gives_the_same,
}


@functools.cache
def subject_of(name: str) -> SensorUnderTest:
    """Return the subject of a shape.

    All rules use the same subject, because it caches examples.
    """
    return SensorUnderTest(SHAPES[name])


each_rule = pytest.mark.parametrize("holds", rule.RULES, ids=lambda holds: holds.__name__)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name in LARGE_SHAPES else ())
        for name in STREAM_SHAPES
    ],
)
def test_the_rule_holds_on_every_shape(name: str) -> None:
    for holds in rule.RULES if name in FRAMING_SHAPES else QUICK_RULES:
        holds(subject_of(name), QUICK_LENGTH)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in STREAM_SHAPES if name not in FRAMING_SHAPES])
def test_the_remaining_rules_hold_on_shapes_that_differ_in_their_content(name: str) -> None:
    for holds in rule.RULES:
        if holds not in QUICK_RULES:
            holds(subject_of(name), QUICK_LENGTH)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in LONG_SHAPES else pytest.mark.soak)
        for name in STREAM_SHAPES
    ],
)
def test_the_rule_holds_on_long_streams(name: str) -> None:
    for holds in rule.RULES:
        holds(subject_of(name), LENGTH)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name in LONG_FRAMES else ())
        for name in STREAM_REPRESENTATIVES
    ],
)
def test_every_recoverable_frame_of_a_representative_is_recovered(name: str) -> None:
    sensor = load_sensor(name)
    longest = len(sensor.example(sensor.main_frames[0]))
    rule.every_recoverable_frame_is_recovered(
        SensorUnderTest(sensor), max(2 * QUICK_LENGTH, 5 * longest // 2)
    )


@pytest.mark.soak
@pytest.mark.parametrize("module", sensor_modules())
def test_every_recoverable_frame_of_every_sensor_is_recovered(module: str) -> None:
    for sensor in distinct_sensors_in(module):
        if not sensor.datagrams:
            rule.every_recoverable_frame_is_recovered(SensorUnderTest(sensor), 2 * QUICK_LENGTH)


def test_representatives_that_send_streams_are_known() -> None:
    assert not any(load_sensor(name).datagrams for name in STREAM_REPRESENTATIVES)


@pytest.mark.slow
def test_an_announcement_may_change_with_every_frame_of_a_representative() -> None:
    rule.announcements_may_change_with_every_frame(
        SensorUnderTest(load_sensor("slamtec-rplidar-a1")), 1500
    )


@each_rule
def test_a_parser_without_a_mistake_keeps_the_rule(
    holds: Callable[[SensorUnderTest, int], None],
) -> None:
    holds(SensorUnderTest(mutants.read_by(mutants.Parser)), QUICK_LENGTH)


@pytest.mark.parametrize("parser", MUTANTS, ids=lambda parser: parser.__name__)
def test_a_parser_with_a_mistake_is_caught(parser: type[mutants.Parser]) -> None:
    with pytest.raises(AssertionError):
        MUTANTS[parser](SensorUnderTest(mutants.read_by(parser)), LENGTH)

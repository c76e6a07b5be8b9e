"""The framing rule on the invented shapes, and against the oracle on every sensor; parsers with a mistake put in on purpose are caught."""

from __future__ import annotations

from collections.abc import Callable

import pytest

import lidarspec
from lidarspec import Sensor
from lidarspec.testing.subject import Subject
from tests.all_sensors import STREAMS, streams
from tests.engine import framing_rule as rule, mutants
from tests.shapes import SHAPES

SHAPED = streams(SHAPES)
INSTALLED = {name: sensor for name, sensor in STREAMS.items() if name not in SHAPES}
#: bytes of a stream for a sensor whose mechanisms the shapes have one by one.
FEW = 800

MUTANTS = {
    mutants.PartialHeaderDropped: rule.any_split_gives_the_same,
    mutants.ClaimedLengthSkipped: rule.a_claimed_length_is_not_believed,
    mutants.MismatchingByteLost: rule.the_start_of_a_header_is_looked_for_at_every_byte,
    mutants.LongestRefused: rule.the_longest_frame_is_a_frame,
    mutants.BufferOfTheClass: rule.decoders_do_not_know_of_each_other,
    mutants.HeldOverSilence: rule.idle_gives_up_what_waits,
    mutants.ExceptionSwallowed: rule.any_split_gives_the_same,
}


@pytest.mark.parametrize("holds", rule.RULES, ids=lambda holds: holds.__name__)
@pytest.mark.parametrize("sensor", SHAPED.values(), ids=SHAPED)
def test_the_rule_holds_on_every_shape(sensor: Sensor, holds: Callable[[Subject], None]) -> None:
    holds(Subject(sensor))


@pytest.mark.parametrize("sensor", INSTALLED.values(), ids=INSTALLED)
def test_every_recoverable_frame_of_every_sensor_is_recovered(sensor: Sensor) -> None:
    rule.every_recoverable_frame_is_recovered(Subject(sensor), FEW)


def test_what_a_sensor_announces_may_change_with_every_frame() -> None:
    rule.what_is_looked_for_may_change_with_every_frame(Subject(lidarspec.sensors()["slamtec-rplidar-s2"]), 4000)


@pytest.mark.parametrize("holds", rule.RULES, ids=lambda holds: holds.__name__)
def test_a_parser_without_a_mistake_keeps_the_rule(holds: Callable[[Subject], None]) -> None:
    holds(Subject(mutants.read_by(mutants.Parser)))


@pytest.mark.parametrize("parser", MUTANTS, ids=lambda parser: parser.__name__)
def test_a_parser_with_a_mistake_is_caught(parser: type[mutants.Parser]) -> None:
    with pytest.raises(AssertionError):
        MUTANTS[parser](Subject(mutants.read_by(parser)))

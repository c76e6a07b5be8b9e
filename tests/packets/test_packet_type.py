"""Tests of the timing and order of a frame type's packets."""

from __future__ import annotations

import pickle

import pytest

import lidarspec as ls
from lidarspec.errors import UnknownFrame
from lidarspec.packets.packet_type import get_packet_type


@pytest.mark.parametrize(
    ("name", "is_counted", "is_ordered_by_clock"),
    [
        ("robosense-m1", True, False),
        ("velodyne-vlp16", False, True),
        ("ldrobot-stl27l", False, False),  # a stream keeps the order
    ],
)
def test_a_counter_comes_before_the_clock_of_datagrams(
    name: str, *, is_counted: bool, is_ordered_by_clock: bool
) -> None:
    sensor = ls.sensor(name)
    found = get_packet_type(sensor, sensor.data_frame)
    assert (found.is_counted, found.is_ordered_by_clock) == (is_counted, is_ordered_by_clock)
    assert found.clock is sensor.clock
    assert found.timed_sensor is sensor


def test_a_type_is_worked_out_once_and_pickled_by_its_name() -> None:
    sensor = ls.sensor("velodyne-vlp16")
    found = get_packet_type(sensor, "data")
    assert get_packet_type(sensor, "data") is found
    again = pickle.loads(pickle.dumps(found))
    assert (again.sensor.id, again.frame) == (sensor.id, "data")
    assert "position" in again.other_types


def test_an_unknown_type_is_an_error() -> None:
    with pytest.raises(UnknownFrame, match="nothing"):
        get_packet_type(ls.sensor("velodyne-vlp16"), "nothing")

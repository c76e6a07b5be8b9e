"""Tests of the status of a clock, in packets and in frames of another type."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.packets.clock_status import read_clock_status
from lidarspec.packets.stream import PacketStream
from lidarspec.spec import ClockStatus
from tests.shapes import SHAPES
from tests.shapes.synced import FREE, HOLDOVER, LOCKED, STATES

SYNCED = SHAPES["shape-synced"]


def data(sync: int, number: int) -> bytes:
    return SYNCED.build("data", number=number, sync=sync, time=0, azimuth=0, distances=[0] * 4)


def with_status(status: ClockStatus) -> ls.Sensor:
    assert SYNCED.clock is not None
    return replace(SYNCED, clock=replace(SYNCED.clock, status=status))


@pytest.mark.parametrize("source", ["sync", lambda f: f.sync])
def test_packets_have_the_status_in_their_field(source: object) -> None:
    sensor = with_status(ClockStatus(source, STATES))  # type: ignore[arg-type]
    packets = sensor.decode([data(sync, i) for i, sync in enumerate((FREE, LOCKED, HOLDOVER))])
    np.testing.assert_array_equal(read_clock_status(packets), [FREE, LOCKED, HOLDOVER])


def test_a_report_applies_to_the_packets_after_it() -> None:
    sensor = with_status(ClockStatus("sync", STATES, frame="report"))
    reports = [SYNCED.build("report", sync=sync, load=0) for sync in (FREE, LOCKED)]
    datagrams = [data(HOLDOVER, 0), reports[0], data(HOLDOVER, 1), reports[1], data(HOLDOVER, 2)]
    with_reports = read_clock_status(sensor.decode(datagrams))
    np.testing.assert_array_equal(with_reports[1:], [FREE, LOCKED])
    without = read_clock_status(sensor.decode(datagrams[:1]))
    assert np.isnan(without).all()


def test_the_state_is_unknown_before_the_first_report() -> None:
    sensor = with_status(ClockStatus("sync", STATES, frame="report"))
    decoder = sensor.decoder()
    stream = PacketStream(sensor, "data", decoder.stats)
    report = SYNCED.build("report", sync=LOCKED, load=0)
    packets = stream.add([decoder.datagrams([data(FREE, 0), report, data(FREE, 1)])])
    np.testing.assert_array_equal(read_clock_status(packets), [np.nan, LOCKED])


def test_the_frame_of_a_status_must_exist() -> None:
    with pytest.raises(ls.errors.SpecError) as refused:
        with_status(ClockStatus("sync", STATES, frame="reports"))
    assert refused.value.path == "clock.status.frame"

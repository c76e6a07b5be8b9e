"""Tests of a simulated sensor on a real port: virtual time, faults, steps of the clock."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.errors import SourceError, UsageError
from lidarspec.simulation.faults import Faults
from lidarspec.spec import Clock, Simulation
from lidarspec.testing.fixtures import virtual_port
from lidarspec.transports import serving
from tests.lines import TIMEOUT_S, free_port, read_until
from tests.shapes import SHAPES

posix = pytest.mark.skipif(os.name != "posix", reason="pseudo terminals are POSIX")
STL = "ldrobot-stl27l"
#: Data frames of the STL-27L a second: 21600 points, 12 in each.
STL_RATE = 1800


PLACES = [
    pytest.param(STL, "pty", STL_RATE, marks=posix),
    (STL, "tcp://127.0.0.1:0", STL_RATE),
    ("velodyne-vlp16", "udp", 754),
]


@contextlib.contextmanager
def open_simulated(
    sensor: ls.Sensor, to: str, **settings: Any
) -> Iterator[tuple[serving.ServedSensor, ls.Device]]:
    """Yield a simulated sensor in virtual time, and a device that reads its port."""
    if to == "udp":
        to = f"udp://127.0.0.1:{free_port()}"
    with (
        virtual_port(sensor, to=to, virtual_time=True, **settings) as port,
        ls.open(port.path, sensor) as device,
    ):
        yield port, device


@pytest.mark.parametrize(("name", "to", "rate"), PLACES)
def test_in_virtual_time_a_second_of_data_comes_at_once(name: str, to: str, rate: int) -> None:
    sensor = ls.sensor(name)
    with open_simulated(sensor, to) as (port, device):
        port.advance(1.0)
        sent = port.device.sent[sensor.data_frame]
        assert abs(sent - rate) <= 2
        read_until(device, lambda: device.stats.frames[sensor.data_frame] == sent)
        assert device.stats.bytes_skipped == 0


@pytest.mark.parametrize(("name", "to", "rate"), PLACES)
def test_late_data_come_at_once(name: str, to: str, rate: int) -> None:
    sensor = ls.sensor(name)
    with open_simulated(sensor, to) as (port, device):
        frames = device.stats.frames
        port.advance(0.5)
        in_time = port.device.sent[sensor.data_frame]
        read_until(device, lambda: frames[sensor.data_frame] == in_time)
        port.delay(1.0)
        port.advance(0.8)
        assert not len(next(device.packets(wait=0.2)))
        assert frames[sensor.data_frame] == in_time
        port.advance(0.4)
        sent = port.device.sent[sensor.data_frame]
        assert sent - in_time > rate
        read_until(device, lambda: frames[sensor.data_frame] == sent)


@pytest.mark.parametrize(("name", "to", "rate"), PLACES)
def test_an_unplugged_sensor_comes_back(name: str, to: str, rate: int) -> None:
    sensor = ls.sensor(name)
    with open_simulated(sensor, to) as (port, device):
        port.advance(0.2)
        port.unplug()
        port.advance(1.0)
        port.plug()
        port.advance(0.5)
        read_until(device, lambda: device.stats.frames[sensor.data_frame] > rate * 0.6)
        assert device.stats.frames[sensor.data_frame] < rate


def test_datagrams_are_lost_and_late() -> None:
    sensor = ls.sensor("robosense-m1")
    faults = Faults(loss=0.02, reorder=3)
    with open_simulated(sensor, "udp", faults=faults) as (port, device):
        port.advance(0.5)
        read_until(device, lambda: device.stats.lost > 10 and device.stats.late > 10)


@posix
def test_time_stands_still_without_advance() -> None:
    with virtual_port(STL, virtual_time=True) as port, ls.open(port.path, STL) as device:
        port.advance(0.1)
        sent = port.device.sent["data"]
        assert next(iter(device.packets(wait=0.3))) is not None
        assert port.device.sent["data"] == sent


@posix
def test_replies_after_a_pause_come_without_advance() -> None:
    paused = replace(
        ls.sensor("slamtec-rplidar-a1"),
        simulation=Simulation(answers={"get_info": (5.0, ("info", {"hardware": 9}))}),
    )
    with (
        virtual_port(paused, virtual_time=True) as port,
        ls.open(port.path, paused, start=False) as device,
    ):
        assert device.send("get_info", timeout=TIMEOUT_S).values.hardware == 9
        assert device.send("scan", timeout=TIMEOUT_S).confirmed
        port.advance(0.5)
        read_until(device, lambda: device.stats.frames["node"] > 500)


@posix
def test_faults_and_an_unplugged_port_in_virtual_time() -> None:
    faults = Faults(errors=0.001, loss=0.01, unplug=1.0, absent=1.0)
    with (
        virtual_port(STL, faults=faults, virtual_time=True) as port,
        ls.open(port.path, STL) as device,
    ):
        port.advance(2.9)
        read_until(device, lambda: device.stats.disconnects == 1)
        read_until(device, lambda: device.stats.frames["data"] > STL_RATE * 1.2)
        assert device.stats.bad_checksum > 0


@posix
@pytest.mark.parametrize("seconds", [5.0, -5.0])
def test_the_clock_of_the_sensor_jumps(seconds: float) -> None:
    with virtual_port(STL, virtual_time=True) as port, ls.open(port.path, STL) as device:
        port.advance(0.2)
        port.jump_clock(seconds)
        port.advance(0.6)
        times = list[float]()
        for packets in device.packets(wait=0.1):
            times += packets["timestamp"].tolist()
            if len(times) >= port.device.sent["data"]:
                break
    steps = np.diff(times)
    (jump,) = np.flatnonzero(abs(steps) > 1)
    # The clock of this sensor wraps at 30 s.
    assert (steps[jump] + 15) % 30 - 15 == pytest.approx(seconds, abs=0.01)
    assert 0.2 * STL_RATE - 2 <= jump <= 0.46 * STL_RATE


def test_a_clock_that_cannot_be_written_cannot_jump() -> None:
    shape = SHAPES["shape-synced"]
    sensor = replace(
        shape,
        clock=Clock(lambda f: f.distances[0]),
        simulation=replace(shape.simulation, rate=500),
    )
    to = f"udp://127.0.0.1:{free_port()}"
    with (
        virtual_port(sensor, to=to, virtual_time=True) as port,
        pytest.raises(UsageError, match="cannot be written"),
    ):
        port.jump_clock(1.0)


@posix
def test_advance_needs_virtual_time_and_a_program(monkeypatch: pytest.MonkeyPatch) -> None:
    with virtual_port(STL) as port, pytest.raises(UsageError, match="virtual_time=True"):
        port.advance(1.0)
    monkeypatch.setattr(serving, "_LISTENER_TIMEOUT_S", 0.05)
    with (
        virtual_port(STL, virtual_time=True) as port,
        pytest.raises(SourceError, match="no program has opened"),
    ):
        port.advance(1.0)


@posix
def test_scans_without_a_clock_do_not_end_in_virtual_time() -> None:
    with contextlib.ExitStack() as stack:
        with pytest.warns(UserWarning, match="benewake-tfmini has no clock, so its scans end by"):
            port = stack.enter_context(virtual_port("benewake-tfmini", virtual_time=True))
        device = stack.enter_context(ls.open(port.path, "benewake-tfmini"))
        port.advance(1.0)
        assert len(next(device.packets())) > 0


@posix
def test_a_test_waits_for_the_commands_of_a_program() -> None:
    with virtual_port("cspc-m1c1-mini") as port:
        port.wait_for_commands([], timeout=0)
        with ls.open(port.path, "cspc-m1c1-mini") as device:
            device.latest(timeout=TIMEOUT_S)
        port.wait_for_commands(["start", "stop"])
        port.device.commands_received.append("stop")  # repeated, as if the reply had been late
        port.wait_for_commands(["start", "stop"], timeout=0)
        with pytest.raises(
            AssertionError, match=r"mini received start, stop.*; expected start within 0.01 s"
        ):
            port.wait_for_commands(["start"], timeout=0.01)
        with pytest.raises(AssertionError, match="expected start, stop, start within"):
            port.wait_for_commands(["start", "stop", "start"], timeout=0.01)

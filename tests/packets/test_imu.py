"""Tests of IMU samples: decoded in bulk and live, in SI units and the points' axes.

They also cover their times, and the scans that they belong to.
"""

from __future__ import annotations

import asyncio
import dataclasses
import functools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.errors import SpecError
from lidarspec.packets.imu import ImuSamples, WaitingSamples, join_samples
from lidarspec.points.mount import Mount
from lidarspec.simulation.device import SimulatedDevice
from lidarspec.simulation.faults import Faults
from lidarspec.spec import Cartesian, Clock, Fields, Frame, Imu
from tests.by_construct import reader
from tests.shapes import SHAPES, inertia
from tests.shapes.inertia import RATE, SAMPLES

SENSOR = SHAPES["shape-inertia"]
AT_REST = [0, 0, 9.80665]


@functools.cache
def simulate_datagrams(shake: float = 0.0, sensor: ls.Sensor = SENSOR) -> list[bytes]:
    """Return the datagrams of two seconds of a simulated sensor."""
    device = SimulatedDevice(sensor, rate=float("inf"), faults=Faults(shake=shake))
    device.start(0)
    return [data for _ in range(8) for _, data in device.outgoing(0)]


def sample(time: int, *values: float) -> bytes:
    names = [f"{what}_{axis}" for what in ("gyro", "force") for axis in "xyz"]
    return SENSOR.build(
        "imu", status=0, felt_at=time, units=True, **dict(zip(names, values, strict=True))
    )


def test_values_are_in_si_and_the_axes_of_the_points() -> None:
    found = SENSOR.decode([sample(70, 1, 2, 3, 9.80665, -19.6133, 0)], "imu").imu()
    assert (found.time_ns.tolist(), len(found)) == ([70], 1)
    np.testing.assert_allclose(found.angular_velocity, [[1, 2, 3]])
    np.testing.assert_allclose(found.linear_acceleration, [[9.80665, -19.6133, 0]])
    one = dict(
        zip(
            [f"{what}_{axis}" for what in ("gyro", "force") for axis in "xyz"],
            [100, 200, -300, 2048, 1024, -2048],
            strict=True,
        )
    )
    data = SENSOR.build(
        "data", number=0, time=1000, block=0, distances=[500] * 8, samples=[one] * SAMPLES
    )
    beside = SENSOR.decode([data]).imu()
    assert beside.time_ns.tolist() == [1000, 1000 + 1_666_667, 1000 + 3_333_333]
    np.testing.assert_allclose(beside.angular_velocity, np.deg2rad([[1, -2, 3]] * SAMPLES))
    np.testing.assert_allclose(
        beside.linear_acceleration, np.array([[1, -0.5, 1]] * SAMPLES) * 9.80665
    )
    assert list(beside.columns)[:2] == ["time_ns", "angular_velocity_x"]


@pytest.mark.parametrize("frame", ["data", "imu"])
def test_both_engines_and_single_packets_agree(frame: str) -> None:
    data = [SENSOR.example(frame, seed=seed) for seed in range(30)]
    bulk = SENSOR.decode(data, frame).imu()
    ways = [
        reader(SENSOR, "construct").decode(data, frame).imu(),
        join_samples([SENSOR.decode([each], frame).imu() for each in data]),
    ]
    for other in ways:
        for name in ("time_ns", "angular_velocity", "linear_acceleration"):
            np.testing.assert_array_equal(getattr(bulk, name), getattr(other, name))


@pytest.mark.slow
def test_a_simulated_imu_is_at_rest_unless_shaken() -> None:
    for frame, number in (("imu", 2 * RATE), ("data", 400 * SAMPLES)):
        found = SENSOR.decode(simulate_datagrams(), frame).imu()
        assert number <= len(found) <= number + SAMPLES
        assert (np.abs(found.linear_acceleration - AT_REST) < 1e-5).all()
        assert (found.angular_velocity == 0).all()
        shaken = SENSOR.decode(simulate_datagrams(0.1), frame).imu()
        assert (np.abs(shaken.linear_acceleration.mean(axis=0) - AT_REST) < 0.05).all()
        assert (
            (shaken.linear_acceleration.std(axis=0) > 0.05)
            & (shaken.angular_velocity.std(axis=0) > 0.05)
        ).all()


def assert_in_their_scans(scans: list[ls.Scan], number: int) -> None:
    """Fail unless every sample is in one scan, between its first point and that of the next."""
    stamps = [scan.stamp_ns for scan in scans]
    assert len(scans) > 10
    assert sum(len(scan.imu) for scan in scans if scan.imu is not None) == number
    for index, scan in enumerate(scans):
        assert scan.imu is not None
        assert (np.diff(scan.imu.time_ns) >= 0).all()
        assert index == 0 or scan.imu.time_ns[0] >= stamps[index]
        assert index + 1 == len(scans) or scan.imu.time_ns[-1] < stamps[index + 1]


@pytest.mark.slow
def test_scans_have_their_imu_samples(tmp_path: Path) -> None:
    data = simulate_datagrams()
    number = len(SENSOR.decode(data, "imu").imu()) + len(SENSOR.decode(data).imu())
    assert_in_their_scans(list(SENSOR.scans(data)), number)
    with ls.open(
        f"sim:{inertia.__file__}?rate=max", inertia.__file__, record=str(tmp_path / "a.lsr")
    ) as device:
        live = next(iter(device.scans()))
        assert live.imu is not None
        assert (np.abs(live.imu.linear_acceleration - AT_REST) < 1e-5).all()
        for packets in device.packets():
            if packets.time_ns[-1] > 2_000_000_000:
                break
    with ls.open(tmp_path / "a.lsr", inertia.__file__) as device:
        recorded = join_samples(list(device.imu()))
        assert device.stats.frames["imu"] > RATE
        assert len(recorded) == device.stats.frames["imu"] + SAMPLES * device.stats.frames["data"]
    with ls.open(tmp_path / "a.lsr", inertia.__file__) as device:
        assert_in_their_scans(list(device.scans()), len(recorded))

    async def felt() -> int:
        async with ls.open_async(tmp_path / "a.lsr", inertia.__file__) as device:
            return sum([len(samples) async for samples in device.imu()])

    assert asyncio.run(felt()) == len(recorded)


def test_a_mount_and_the_axes_of_the_vendor_turn_it() -> None:
    found = SENSOR.decode([sample(0, 1, 2, 3, 4, 5, 6)], "imu").imu()
    turned = found.turn(Mount(yaw_deg=90.0).rotation)
    np.testing.assert_allclose(turned.linear_acceleration, [[-5, 4, 6]], atol=1e-6)
    vendor = dataclasses.replace(SENSOR, vendor_axes=("right", "forward", "up")).configure(
        frame="vendor"
    )
    np.testing.assert_allclose(
        vendor.decode([sample(0, 1, 2, 3, 4, 5, 6)], "imu").imu().angular_velocity,
        [[-2, 1, 3]],
        rtol=1e-6,
    )


def test_an_imu_by_another_clock_than_the_points_is_in_no_scan() -> None:
    frames = {**SENSOR.frames, "imu": dataclasses.replace(SENSOR.frames["imu"], clock=None)}
    hosts = dataclasses.replace(SENSOR, frames=frames)
    assert all(scan.imu is None for scan in hosts.scans(simulate_datagrams(sensor=hosts)))
    assert (hosts.decode([sample(70, *[0] * 6)], "imu").imu().time_ns == 0).all()
    assert all(
        scan.imu is None
        for scan in SHAPES["shape-extras"].scans(ls.simulate(SHAPES["shape-extras"], 30))
    )


def test_samples_that_no_scan_asks_for_are_let_go() -> None:
    waiting = WaitingSamples()
    for start in range(0, 100, 10):
        waiting.add(ImuSamples(np.arange(start, start + 10), np.zeros((10, 3)), np.zeros((10, 3))))
        waiting.keep_newest(20)
    assert waiting.take_until(None).time_ns.tolist()[-20:] == list(range(80, 100))
    assert len(waiting.take_until(None)) == 0


def test_mistakes_are_named() -> None:
    with pytest.raises(SpecError, match=r"Imu.linear_acceleration"):
        Imu((0, 0, 0), 1)  # type: ignore[arg-type]
    with pytest.raises(SpecError, match="clock"):
        dataclasses.replace(SENSOR.frames["data"], clock=Clock("time"))
    extras = SHAPES["shape-extras"]
    with pytest.raises(SpecError, match="no frame"):
        extras.decode([extras.example("data")]).imu()
    only = dataclasses.replace(
        SENSOR,
        frames={**SENSOR.frames, "data": dataclasses.replace(SENSOR.frames["data"], imu=None)},
    )
    with pytest.raises(SpecError, match="imu"):
        only.decode([only.example("data")]).imu()

    def wrong(f: Fields) -> Any:
        return Cartesian(0, 0, 0)

    failing = dataclasses.replace(
        SENSOR, frames={**SENSOR.frames, "imu": Frame(SENSOR.frames["imu"].struct, imu=wrong)}
    )
    with pytest.raises(SpecError, match="Imu"):
        failing.decode([failing.example("imu")], "imu").imu()

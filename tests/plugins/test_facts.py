"""Tests that declarations agree among all plugins.

They cover related models, device information and scan rates.
"""

from __future__ import annotations

import functools

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.expressions.columns import Fields
from lidarspec.frames.schema import make_schema
from lidarspec.spec import Frame
from tests.installed import sensor_modules, sensors_in

pytestmark = pytest.mark.slow

EACH_MODULE = pytest.mark.parametrize("module", sensor_modules())

#: packets of three frames of an RS-LiDAR-M1, which has the most packets per frame, and of an M2.
PACKETS = 3 * 630
PACKETS_OF_M2 = 3 * 1260


@functools.cache
def _sensors() -> dict[str, ls.Sensor]:
    return {name: sensor for name, sensor in ls.sensors().items() if sensor.has_points}


def _data(sensor: ls.Sensor) -> Frame:
    return sensor.frames[sensor.data_frame]


@functools.cache
def _simulated_bytes(frame: Frame) -> bytes:
    """Return simulated data of the first sensor that has this data frame."""
    sensor = next(sensor for sensor in _sensors().values() if _data(sensor) is frame)
    return b"".join(ls.simulate(sensor, 2))


def _accepts(sensor: ls.Sensor, other: ls.Sensor) -> bool:
    """Return whether data of one sensor is accepted as data by another."""
    found = sensor.split(_simulated_bytes(_data(other)))
    return bool(found) and found[0].frame == sensor.data_frame


@EACH_MODULE
def test_device_information_is_a_field_of_an_incoming_frame(module: str) -> None:
    for sensor in sensors_in(module):
        paths = [(role, path) for role, fact in sensor.reported.items() for path in fact.paths]
        for role, path in paths:
            name, _, field = path.partition(".")
            assert name in sensor.incoming, f"{sensor.id} {role}: {path}"
            assert field in make_schema(sensor.frames[name].tree).scan_names, (
                f"{sensor.id} {role}: {path}"
            )


@EACH_MODULE
def test_related_models_name_each_other(module: str) -> None:
    sensors = _sensors()
    for sensor in sensors_in(module):
        for related, difference in sensor.relatives.items():
            assert related != sensor.id
            assert related not in sensors or sensor.id in sensors[related].relatives
            assert difference if isinstance(difference, str) else difference.difference


@EACH_MODULE
def test_packet_does_not_match_related_models(module: str) -> None:
    for sensor in sensors_in(module):
        if not sensor.relatives:
            continue
        data = ls.simulate(sensor, 5)
        packets = sensor.decode(data if sensor.datagrams else b"".join(data))
        fields = Fields(packets.batch())
        for related in sensor.relatives.values():
            assert isinstance(related, str) or not np.any(np.asarray(related.sends(fields)))


@EACH_MODULE
def test_sensors_with_the_same_incoming_frames_are_related(module: str) -> None:
    sensors = _sensors()
    for sensor in sensors_in(module):
        incoming = dict(sensor.incoming)
        same = {
            other.id
            for other in sensors.values()
            if other.id != sensor.id and dict(other.incoming) == incoming
        }
        named = {name for name in sensor.relatives if name in sensors}
        assert same <= named, sensor.id
        for name in named - same:
            other = sensors[name]
            assert _accepts(sensor, other) or _accepts(other, sensor), f"{sensor.id} {name}"


@EACH_MODULE
def test_simulated_scan_rate_is_within_the_declared_one(module: str) -> None:
    for sensor in sensors_in(module):
        if not sensor.turn or not sensor.clock:
            continue
        packets = PACKETS_OF_M2 if sensor.id == "robosense-m2" else PACKETS
        data = ls.simulate(sensor, packets)
        scans = sensor.scans(data if sensor.datagrams else b"".join(data))
        rates = [scan.rate_hz for scan in scans if scan.complete]
        slowest, fastest = sensor.turn
        assert rates, sensor.id
        assert slowest - 0.01 <= min(rates), sensor.id
        assert max(rates) <= fastest + 0.01, sensor.id

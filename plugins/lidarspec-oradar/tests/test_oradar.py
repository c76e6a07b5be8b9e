"""Tests of the ORADAR MS200: times of points, and commands on a simulated sensor."""

from __future__ import annotations

import numpy as np

import lidarspec as ls
from lidarspec.testing.fixtures import virtual_port
from tests.lines import TIMEOUT_S

MS200 = ls.sensor("oradar-ms200")


def test_the_time_of_a_point_follows_from_speed_and_angles() -> None:
    cloud = MS200.decode(ls.simulate(MS200, 1)).points()
    # 0.8 degrees a point at 3600 degrees a second
    np.testing.assert_allclose(cloud.time, np.arange(12) * 0.8 / 3600, rtol=1e-6)


def test_a_frame_without_rotation_has_times() -> None:
    values = MS200.parse(ls.simulate(MS200, 1)[0])
    cloud = MS200.decode(MS200.build("data", {**values, "speed": 0})).points()
    assert np.isfinite(cloud.time).all()


def test_the_simulated_sensor_is_started_and_stopped() -> None:
    with virtual_port(MS200) as port:
        with ls.open(port.path, MS200) as device:
            assert device.latest(TIMEOUT_S).complete
            device.send("set_speed", rate=7)
        port.wait_for_commands(["start", "set_speed", "stop"])

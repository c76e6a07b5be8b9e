"""Tests of the Benewake CE30-D: columns, invalid pixels, and the start by a command over UDP."""

from __future__ import annotations

import dataclasses

import numpy as np

import lidarspec as ls
from lidarspec.spec import Udp
from lidarspec.testing.fixtures import virtual_port
from tests.lines import TIMEOUT_S, free_port

CE30D = ls.sensor("benewake-ce30d")


def test_columns_beyond_the_field_of_view_are_invalid() -> None:
    packets = ls.simulate(CE30D, 27)
    cloud = CE30D.decode(packets).points()
    assert len(cloud) == 27 * 12 * 20
    assert cloud.valid.sum() == 320 * 20
    assert not cloud.valid[-4 * 20 :].any()
    np.testing.assert_allclose(np.rad2deg(cloud.azimuth[0]), -30.0, atol=1e-5)
    np.testing.assert_allclose(
        np.rad2deg(cloud.elevation[:20]), 1.9 - 0.2 * np.arange(20), atol=1e-5
    )


def test_a_pixel_with_another_state_is_invalid() -> None:
    values = CE30D.parse(ls.simulate(CE30D, 1)[0])
    for state in range(1, 5):
        values.columns[0].pixels[state].state = state
    cloud = CE30D.decode(CE30D.build("data", values)).points()
    assert cloud.valid[:6].tolist() == [True, False, False, False, False, True]


def test_grey_images_are_no_frames() -> None:
    data = bytearray(ls.simulate(CE30D, 1)[0])
    assert len(CE30D.decode(bytes(data))) == 1
    data[16] |= 0x02  # the bit in IsGreyImage of packet.cpp
    assert len(CE30D.decode(bytes(data))) == 0


def test_the_simulated_sensor_sends_to_the_port_of_the_command() -> None:
    sensor = dataclasses.replace(CE30D, links={"data": Udp(free_port())})
    with virtual_port(sensor, to=f"udp://127.0.0.1:{sensor.links['data'].ports[0]}") as port:
        with ls.open(port.path, sensor) as device:
            assert len(device.latest(TIMEOUT_S).points) == 27 * 12 * 20
        port.wait_for_commands(["start", "stop"])

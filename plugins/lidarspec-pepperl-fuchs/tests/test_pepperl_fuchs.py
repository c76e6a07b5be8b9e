"""Tests of the Pepperl+Fuchs R2000: packets, handles, and a simulated scanner on real sockets."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

import lidarspec as ls
import lidarspec_pepperl_fuchs
from lidarspec.errors import CommandError, WireError
from lidarspec.spec import Http, Tcp
from lidarspec.testing.fixtures import virtual_port
from tests.lines import TIMEOUT_S, free_port

R2000 = ls.sensor("pepperl-fuchs-r2000")
VECTORS = json.loads((Path(lidarspec_pepperl_fuchs.__file__).parent / "vectors.json").read_text())
PACKETS = {one["frame"]: bytes.fromhex(one["hex"]) for one in VECTORS if "frame" in one}


@pytest.mark.parametrize("frame", PACKETS)
def test_a_sample_without_an_echo_is_invalid(frame: str) -> None:
    cloud = R2000.decode(PACKETS[frame], frame=frame).points()
    assert cloud.valid.tolist() == [True] * 4 + [False]
    # 4 samples of 90 degrees later, at 20 Hz
    np.testing.assert_allclose(cloud.time[4], 4 * 90 / 360 / 20)


def test_a_low_amplitude_is_an_error() -> None:
    values = R2000.parse(PACKETS["packet_b"])
    values.samples[1].amplitude = 31
    cloud = R2000.decode(R2000.build("packet_b", values), frame="packet_b").points()
    assert cloud.valid.tolist() == [True, False, True, True, False]


def test_a_longer_header_is_read() -> None:
    """The header of a model with inputs and outputs has 76 bytes (PFR2000Header.msg)."""
    values = R2000.parse(PACKETS["packet_c"])
    longer = {**values, "header_size": 76, "more": bytes(range(24)), "packet_size": 96}
    data = R2000.build("packet_c", longer)
    assert (len(data), R2000.decode(data).points().x[0]) == (96, pytest.approx(1.7320508))
    with pytest.raises(WireError):
        R2000.parse(data[:4] + b"\x5f" + data[5:])


@pytest.mark.parametrize(
    ("transport", "to"), [("udp", "udp://127.0.0.1"), ("tcp", "tcp://127.0.0.1")]
)
@pytest.mark.parametrize("packet", "ABC")
def test_the_simulated_scanner_sends_what_it_is_asked_for(
    transport: str, to: str, packet: str
) -> None:
    configured = R2000.configure(packet=packet, transport=transport)
    assert isinstance(configured.links["data"], Tcp) is (transport == "tcp")
    sensor = dataclasses.replace(configured, links={**configured.links, "http": Http(free_port())})
    with virtual_port(sensor, to=to) as port:
        with ls.open(port.path, sensor) as device:
            scan = device.latest(TIMEOUT_S)
            assert scan.complete
            assert len(scan.points) == 1440
            assert set(device.stats.frames) == {f"packet_{packet.lower()}"}
            device.send("set_scan_frequency", value=30)
        port.wait_for_commands(
            [
                "request_handle",
                "start",
                "feed_watchdog",
                "set_scan_frequency",
                "stop",
                "release_handle",
            ]
        )


def test_a_gap_of_the_clock_is_a_loss() -> None:
    packets = ls.simulate(R2000, 40)
    assert R2000.decode(packets).stats.lost == 0
    assert R2000.decode(packets[:10] + packets[12:]).stats.lost == 2
    # In a masked scan, the pause until the next scan is no loss.
    half = [data for i, data in enumerate(packets) if i % 8 < 4]
    masked = []
    for data in half:
        values = R2000.parse(data)
        masked.append(R2000.build("packet_c", {**values, "num_points_scan": 720}))
    assert R2000.decode(masked).stats.lost == 0


def test_a_shorter_last_packet_is_no_loss() -> None:
    packets = ls.simulate(R2000, 40)
    shorter = []
    for number, data in enumerate(packets):
        values = {**R2000.parse(data), "num_points_scan": 7 * 180 + 20}
        if number % 8 == 7:
            values |= {"num_points_packet": 20, "samples": values["samples"][:20]}
        values["packet_size"] = 60 + 4 * values["num_points_packet"]
        shorter.append(R2000.build("packet_c", values))
    assert R2000.decode(shorter).stats.lost == 0
    assert R2000.decode(shorter[:7] + shorter[8:]).stats.lost == 1


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (
            b'{"error_code": 120, "error_text": "Invalid handle"}',
            r"start: Invalid handle \(error 120\)",
        ),
        (b'{"port": 80}', "expected a JSON object with error_code, got HTTP status 400"),
    ],
)
def test_an_error_of_the_scanner_is_reported(body: bytes, message: str) -> None:
    answers = {**R2000.simulation.answers, "start": [("reply", {"status": 400, "body": body})]}
    sensor = dataclasses.replace(
        R2000,
        links={**R2000.links, "http": Http(free_port())},
        simulation=dataclasses.replace(R2000.simulation, answers=answers),
    )
    with (
        virtual_port(sensor, to="udp://127.0.0.1") as port,
        pytest.raises(CommandError, match=message),
    ):
        ls.open(port.path, sensor)

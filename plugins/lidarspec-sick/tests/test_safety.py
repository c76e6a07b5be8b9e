"""Tests of SICK microScan3: messages in several datagrams, echoes and times."""

from __future__ import annotations

import dataclasses
import json
import struct
from pathlib import Path

import numpy as np

import lidarspec as ls
import lidarspec_sick
from lidarspec.spec import Udp
from lidarspec.testing.fixtures import virtual_port
from tests.lines import TIMEOUT_S, free_port

MICROSCAN3 = ls.sensor("sick-microscan3")
VECTORS = json.loads((Path(lidarspec_sick.__file__).parent / "vectors.json").read_text())
MESSAGE = next(bytes.fromhex(one["hex"]) for one in VECTORS if one["sensor"] == MICROSCAN3.id)


def split(message: bytes, number: int, size: int) -> list[bytes]:
    """Return the datagrams of a message, each with up to `size` bytes of it.

    Their header of 24 bytes is that of ParseDatagramHeader.
    """
    return [
        b"MS3 "
        + struct.pack(">HBB", 0x4D44, 1, 0)
        + struct.pack("<IIII", len(message), number, offset, 0)
        + message[offset : offset + size]
        for offset in range(0, len(message), size)
    ]


def test_a_message_is_joined_from_its_datagrams_in_any_order() -> None:
    datagrams = split(MESSAGE, 5, 40)
    packets = MICROSCAN3.decode([*datagrams[::-1], *split(MESSAGE, 6, 1000)])
    assert len(packets) == 2
    assert packets.time_ns[0] == 1_791_072_001 * 10**9  # 2026-10-04 00:00:01
    lost = MICROSCAN3.decode([*datagrams[1:], *split(MESSAGE, 6, 40)])
    assert len(lost) == 1


def test_a_beam_without_an_echo_and_an_invalid_beam_differ() -> None:
    values = MICROSCAN3.parse(MESSAGE)
    values.beams[0].status.valid = 0
    cloud = MICROSCAN3.decode([MICROSCAN3.build("data", values)]).points()
    assert cloud.valid.tolist() == [False, True, True, True, False]
    assert np.isnan(cloud.range[0])
    assert cloud.range[4] == np.inf


def test_distances_are_multiplied() -> None:
    values = MICROSCAN3.parse(MESSAGE)
    values.derived.factor = 2
    cloud = MICROSCAN3.decode([MICROSCAN3.build("data", values)]).points()
    np.testing.assert_allclose(cloud.range[:4], [4, 6, 8, 10])


def test_padding_between_blocks_is_skipped() -> None:
    data = bytearray(MESSAGE)
    struct.pack_into("<6H", data, 32, 52, 16, 72, 20, 96, 24)
    data[88:88] = bytes(4)
    data[68:68] = bytes(4)
    assert MICROSCAN3.decode([bytes(data)]).points().valid.sum() == 4


def test_the_simulated_scanner_sends_several_datagrams(tmp_path: Path) -> None:
    link = MICROSCAN3.links["data"]
    assert isinstance(link, Udp)
    sensor = dataclasses.replace(
        MICROSCAN3, links={"data": Udp(free_port(), assembled=link.assembled)}
    )
    path = tmp_path / "scans.lsr"
    with (
        virtual_port(sensor, to=f"udp://127.0.0.1:{sensor.links['data'].ports[0]}") as port,
        ls.open(port.path, sensor, record=path) as device,
    ):
        scan = device.latest(TIMEOUT_S)
        assert (len(scan.points), scan.complete) == (551, True)
        # 2 datagrams for 72 + 4 + 551 * 4 bytes
        assert device.stats.bytes_in % (2 * 24 + 72 + 4 + 551 * 4) in (0, 24 + 1400)
    with ls.open(path, sensor) as recording:
        assert len(next(recording.scans()).points) == 551

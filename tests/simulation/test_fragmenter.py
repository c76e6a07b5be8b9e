"""Tests of simulated messages that are split into datagrams."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
from construct import Bytes, Const, Int8ub, Int16ub, Int32ub, Struct, this

from lidarspec import simulate
from lidarspec.simulation import fragmenter
from lidarspec.simulation.device import SimulatedDevice
from lidarspec.spec import Assembled, Checksummed, Udp, Xor
from tests.shapes.fragments import FRAGMENT, SENSOR

NUMBERED = Assembled(FRAGMENT, key="message", index="index", count="count")
FROM_ONE = Assembled(
    Checksummed(
        Struct(
            "magic" / Const(b"\x7a\xa8"), "key" / Int8ub, "at" / Int8ub, "of" / Int8ub, "x" / Int8ub
        ),
        field="x",
        algorithm=Xor(),
    ),
    key="key",
    index="at",
    count="of",
    first=1,
)
IN_BYTES = Assembled(
    Struct(
        "magic" / Const(b"\x7a\xa7\x02"),
        "message" / Int8ub,
        "size" / Int16ub,
        "at" / Int32ub,
        "total" / Int32ub,
        "data" / Bytes(this.size),
    ),
    key="message",
    index="at",
    count="total",
    payload="data",
    in_bytes=True,
)


@pytest.mark.parametrize("rule", [NUMBERED, FROM_ONE, IN_BYTES])
def test_split_messages_are_joined_again(rule: Assembled, monkeypatch: Any) -> None:
    monkeypatch.setattr(fragmenter, "MAX_PART_BYTES", 30)
    sensor = dataclasses.replace(SENSOR, links={"data": Udp(7780, assembled=rule)})
    messages = simulate(sensor, 300)  # more than the key can number
    splitter = fragmenter.Fragmenter(sensor.id, rule)
    datagrams = [part for message in messages for part in splitter.split(message)]
    assert len(datagrams) == sum(-(-len(message) // 30) for message in messages)
    packets = sensor.decode(datagrams)
    assert packets["counter"].astype(int).tolist() == [i % 256 for i in range(300)]
    assert packets.stats.fragments_lost == 0


def test_a_simulated_device_sends_datagrams(monkeypatch: Any) -> None:
    monkeypatch.setattr(fragmenter, "MAX_PART_BYTES", 30)
    simulation = dataclasses.replace(SENSOR.simulation, rate=100)
    device = SimulatedDevice(dataclasses.replace(SENSOR, simulation=simulation))
    device.start(0)
    sent = [data for _, data in device.outgoing(500_000_000)]
    assert all(data.startswith(b"\x7a\xa7\x01") for data in sent)
    assert len(SENSOR.decode(sent)) == device.sent["data"]

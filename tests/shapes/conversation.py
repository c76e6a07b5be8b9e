"""Commands with texts, addresses, bytes and elements of arrays, and with a running number that the reply repeats."""

from __future__ import annotations

import numpy as np
from construct import Array, Bytes, Const, Int8ul, Int16ub, Int16ul, Struct

from lidarspec import Sensor
from lidarspec.spec import Address, Checksummed, Command, Count, Crc, Fields, Frame, OnWrap, Polar, Scaled, Simulation, Text, Udp

SAMPLES = 4
CRC = Crc(16, 0x1021, init=0xFFFF, order="big")

ORDER = Checksummed(
    Struct(
        "header" / Const(b"\x2a\xc0"),
        "head" / Struct("number" / Int16ub, "code" / Int8ul),
        "host" / Array(4, Int8ul),
        "ports" / Array(2, Int16ub),
        "name" / Bytes(8),
        "key" / Bytes(2),
        "crc" / Int16ub,
    ),
    field="crc",
    algorithm=CRC,
)
ACK = Checksummed(
    Struct("header" / Const(b"\x2a\xc1"), "head" / Struct("number" / Int16ub, "code" / Int8ul), "result" / Int8ul, "crc" / Int16ub),
    field="crc",
    algorithm=CRC,
)
DATA = Checksummed(
    Struct(
        "header" / Const(b"\x2a\xc2"),
        "angle" / Scaled(Int16ul, 0.01, "deg"),
        "distances" / Array(SAMPLES, Scaled(Int16ul, 0.001, "m")),
        "crc" / Int16ub,
    ),
    field="crc",
    algorithm=CRC,
)
ECHOES = ("head.number", "head.code")


def points(f: Fields) -> Polar:
    return Polar(range=f.distances, azimuth=np.deg2rad(f.angle + np.arange(SAMPLES)))


def sweep(i: int) -> dict[str, float]:
    return {"angle": i * SAMPLES % 360}


def order(code: int) -> dict[str, object]:
    """The values of an order of its own code, in which nothing else is said."""
    return {"head.number": Count(16, 7), "head.code": code, "host": [0] * 4, "ports": [7020, 0], "name": bytes(8), "key": bytes(2)}


SENSOR = Sensor(
    "shape-conversation",
    vendor="Shapes",
    model="Conversation",
    frames={
        "data": Frame(DATA, data=True, plausible=lambda f: f.angle < 360),
        "ack": Frame(ACK),
        "order": Frame(ORDER, direction="out"),
    },
    points=points,
    scan=OnWrap("azimuth"),
    links={"data": Udp(7020), "control": Udp(7021)},
    commands={
        "hello": Command("order", {**order(1), "host": Address()}, reply="ack", echoes=ECHOES, link="control"),
        "send_to": Command(
            "order",
            order(2),
            args={"host": ("host", Address()), "port": ("ports[1]", 1024, 65535)},
            reply="ack",
            echoes=ECHOES,
            link="control",
        ),
        "call": Command("order", order(3), args={"name": ("name", Text(8))}, reply="ack", echoes=ECHOES, link="control"),
        "unlock": Command("order", order(4), args={"key": ("key", bytes)}, reply="ack", echoes=ECHOES, link="control"),
    },
    simulation=Simulation(sweep, rate=900),
    range_limits=(0.05, 30.0),
    status="manual",
    source="invented for the tests: a conversation over a link of its own",
)

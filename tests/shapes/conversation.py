"""Commands with texts, addresses, bytes and array elements.

Replies repeat a sequence number, and one reply contains a table that the device keeps. The sensors
of `make_handle_sensor` return a handle over HTTP. They send their data to the address in a request
(UDP), or from a port that a reply reports (TCP).
"""

from __future__ import annotations

import dataclasses
import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from construct import Array, Bytes, Const, Int8ul, Int16ub, Int16ul, Struct, this

from lidarspec import Sensor, UsageError
from lidarspec.spec import (
    Address,
    Checksummed,
    Command,
    Count,
    Crc,
    Fields,
    Frame,
    Http,
    HttpReply,
    HttpRequest,
    Learned,
    OnWrap,
    Polar,
    Port,
    Scaled,
    Simulation,
    Tcp,
    Template,
    Text,
    Udp,
)

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
    Struct(
        "header" / Const(b"\x2a\xc1"),
        "head" / Struct("number" / Int16ub, "code" / Int8ul),
        "result" / Int8ul,
        "crc" / Int16ub,
    ),
    field="crc",
    algorithm=CRC,
)
TABLE = Checksummed(
    Struct(
        "header" / Const(b"\x2a\xc3"),
        "head" / Struct("number" / Int16ub, "code" / Int8ul),
        "size" / Int8ul,
        "angles" / Bytes(this.size),
        "crc" / Int16ub,
    ),
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


def points(
    f: Fields, angles: tuple[float, ...] = (0.0, 1.0, 2.0, 3.0), *, nominal: bool = True
) -> Polar:
    return Polar(range=f.distances, azimuth=np.deg2rad(f.angle + np.array(angles)), nominal=nominal)


def configure(sensor: Sensor, *, table: str | Path | Learned) -> Sensor:
    """Return the sensor with the angles of a unit: degrees, separated by spaces."""
    try:
        angles = tuple(map(float, Learned.content(table).split()))
    except ValueError as error:
        raise UsageError(f"{table}: no table of angles: {error}") from None
    if len(angles) != SAMPLES:
        raise UsageError(f"{len(angles)} angles, and there are {SAMPLES} samples")
    return dataclasses.replace(sensor, points=partial(points, angles=angles, nominal=False))


def sweep(i: int) -> dict[str, float]:
    return {"angle": i * SAMPLES % 360}


def order(code: int) -> dict[str, object]:
    """Return the values of an order with this code and no arguments."""
    return {
        "head.number": Count(16, 7),
        "head.code": code,
        "host": [0] * 4,
        "ports": [7020, 0],
        "name": bytes(8),
        "key": bytes(2),
    }


SENSOR = Sensor(
    "shape-conversation",
    vendor="Shapes",
    model="Conversation",
    frames={
        "data": Frame(DATA, data=True, plausible=lambda f: f.angle < 360),
        "ack": Frame(ACK),
        "table": Frame(TABLE, max_length=64),
        "order": Frame(ORDER, direction="out"),
    },
    points=points,
    scan=OnWrap("azimuth"),
    links={"data": Udp(7020), "control": Udp(7021)},
    commands={
        "get_table": Command(
            "order",
            order(5),
            reply="table",
            echoes=ECHOES,
            link="control",
            learns=lambda reply: {"table": reply.angles},
            timeout=5.0,
        ),
        "hello": Command(
            "order", {**order(1), "host": Address()}, reply="ack", echoes=ECHOES, link="control"
        ),
        "send_to": Command(
            "order",
            order(2),
            args={"host": ("host", Address()), "port": ("ports[1]", Port())},
            reply="ack",
            echoes=ECHOES,
            link="control",
        ),
        "call": Command(
            "order",
            order(3),
            args={"name": ("name", Text(8))},
            reply="ack",
            echoes=ECHOES,
            link="control",
        ),
        "unlock": Command(
            "order",
            order(4),
            args={"key": ("key", bytes)},
            reply="ack",
            echoes=ECHOES,
            link="control",
        ),
    },
    simulation=Simulation(
        sweep, rate=900, answers={"get_table": [("table", {"angles": b"0.5 1 1.5 2"})]}
    ),
    configure=configure,
    range_limits=(0.05, 30.0),
    status="manual",
    source="invented for the tests: a conversation over a link of its own",
)


def read_page(reply: Any) -> dict[str, Any]:
    """Return the values of a page; ValueError if the sensor refuses."""
    page = json.loads(reply.body)
    if page["error"]:
        raise ValueError(f"the sensor reports {page['error']!r}")
    return {name: value for name, value in page.items() if name != "error"}


def page(**values: Any) -> list[Any]:
    """Return a simulated page."""
    return [("page", {"status": 200, "body": json.dumps({"error": "", **values}).encode()})]


def ask(path: str, **more: Any) -> Command:
    """Return the command for a request to the web server."""
    return Command(
        "ask",
        {"method": "GET", "path": Template(path) if "{" in path else path.encode(), "body": b""},
        reply="page",
        matches={"status": 200},
        link="web",
        provides=read_page,
        **more,
    )


def start_page(request: dict[str, Any]) -> list[Any]:
    """Return the page for a start with a valid handle only."""
    return page(error="" if request["{handle}"] == "s10" else "no such handle")


def make_handle_sensor(data: Udp | Tcp, web_port: int = 7022) -> Sensor:
    """Return a sensor that is started with a handle, and sends its data over this link."""
    if isinstance(data, Udp):
        request_handle = ask("/handle?to={own_address}&port={own_port}")
    else:
        request_handle = ask("/handle")
    commands = {
        "request_handle": request_handle,
        "start": ask("/start?handle={handle}", starts=True, timeout=5.0),
        "stop": ask("/stop?handle={handle}", stops=True),
        "set_rate": ask("/rate?hz={rate}", args={"rate": ("path", 5, 20)}),
        "set_name": ask("/set?name={name}", args={"name": ("path", Text(8))}),
        "get_any": ask("/{what}", args={"what": ("path", Text(8))}),
    }
    answers = {
        "request_handle": lambda request: page(handle="s10", data_port=request["{data_port}"]),
        "start": start_page,
        "stop": page(),
        "set_rate": lambda request: page(rate=float(request["{rate}"])),
        "set_name": page(),
        "get_any": page(),
    }
    return dataclasses.replace(
        SENSOR,
        id="shape-handles",
        model="Handles",
        frames={
            "data": SENSOR.frames["data"],
            "page": Frame(HttpReply, max_length=4096),
            "ask": Frame(HttpRequest, direction="out", max_length=4096),
        },
        links={"data": data, "web": Http(web_port)},
        commands=commands,
        configure=None,
        on_open=("request_handle", "start"),
        on_close=("stop",),
        simulation=Simulation(sweep, rate=900, answers=answers),
    )


#: The sensor sends to the address and port in the request.
HANDLES = make_handle_sensor(Udp())
#: The reply contains the port of the data.
REPORTED = dataclasses.replace(
    make_handle_sensor(Tcp(reported="data_port")), id="shape-reported-port", model="ReportedPort"
)

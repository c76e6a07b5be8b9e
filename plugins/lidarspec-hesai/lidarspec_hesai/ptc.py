"""PTC, the big-endian commands of the family over TCP port 9347.

    47 74  code  result | length(4) | payload

The angles of a sensor are requested when it is opened. Sensors that support only TLS or PTC 2.0
(57 75) do not reply.

Source: HesaiLidar_SDK_2.0 (ptc_client.h, ptc_1_0_parser.h: frame and codes); tier4/nebula
(hesai_common.hpp: numbers of the return modes).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from construct import Bytes, Const, Construct, Enum, Int8ub, Int16ub, Int32ub, Struct, Switch, this

from lidarspec.spec import Address, Command, Fields, Frame, Scaled, SizeOf, Tcp

CONTROL = Tcp(9347)
MAX_PAYLOAD_BYTES = 1 << 16  # the longest known payload, the angles of an AT128, has 47,176

RESULTS = {
    "done": 0,
    "bad_parameter": 1,
    "connection": 2,
    "data": 3,
    "memory": 4,
    "not_supported": 5,
    "fpga": 6,
    "other": 7,
}
CODES = {
    "get_calibration": 0x05,
    "get_inventory": 0x07,
    "get_status": 0x09,
    "reboot": 0x10,
    "speed": 0x17,
    "standby": 0x1C,
    "return_mode": 0x1E,
    "send_to": 0x20,
    "get_firing_times": 0xA9,
}
RETURN_SETTINGS = {
    "last": 0,
    "strongest": 1,
    "both": 2,
    "first": 3,
    "first_and_last": 4,
    "first_and_strongest": 5,
}
SETTINGS = {
    "speed": Struct("rate" / Scaled(Int16ub, 1, "rpm")),
    "standby": Struct("standby" / Enum(Int8ub, run=0, stop=1) * "stop: the motor stands still"),
    "return_mode": Struct(
        "mode" / Enum(Int8ub, **RETURN_SETTINGS) * "must be a return mode that the model supports"
    ),
    "send_to": Struct(
        "host" / Bytes(4), "port" / Int16ub * "destination port of data", "gps_port" / Int16ub
    ),
}


def make_message(payload: Construct) -> Struct:
    """Return the struct of a request or a reply with this payload."""
    return Struct(
        "sync" / Const(b"\x47\x74"),
        "code" / Enum(Int8ub, **CODES),
        "result" / Enum(Int8ub, **RESULTS),
        "length" / SizeOf(Int32ub, "payload"),
        "payload" / payload,
    )


def plausible(f: Fields) -> Any:
    """Return whether the result is known and the payload is not too long."""
    return (f.result <= 7) & (f.length <= MAX_PAYLOAD_BYTES)


FRAMES = {
    "answer": Frame(
        make_message(Bytes(this.length)),
        max_length=8 + MAX_PAYLOAD_BYTES,
        plausible=plausible,
    ),
    "request": Frame(
        make_message(Switch(this.code, SETTINGS, default=Bytes(0))), direction="out", max_length=16
    ),
}


def make_command(code: str, **more: Any) -> Command:
    fixed = {"code": code, "result": 0, **({} if code in SETTINGS else {"payload": b""})}
    return Command(
        "request",
        fixed,
        reply="answer",
        matches={"result": 0},
        echoes=("code",),
        timeout=3.0,
        link="control",
        **more,
    )


def make_commands(rates: tuple[int, int]) -> Mapping[str, Command]:
    """Return the commands of a sensor; `rates` are the lowest and highest speed in rpm."""
    return {
        "get_calibration": make_command(
            "get_calibration", learns=lambda reply: {"calibration": bytes(reply.payload)}
        ),
        "get_firing_times": make_command("get_firing_times"),
        "get_inventory": make_command("get_inventory"),
        "get_status": make_command("get_status"),
        "reboot": make_command("reboot"),
        "speed": make_command("speed", args={"rate": ("payload.rate", *rates)}),
        "standby": make_command("standby", args={"standby": ("payload.standby", 0, 1)}),
        "return_mode": make_command("return_mode", args={"mode": ("payload.mode", 0, 5)}),
        "send_to": make_command(
            "send_to",
            args={
                "host": ("payload.host", Address()),
                "port": ("payload.port", 1, 65535),
                "gps_port": ("payload.gps_port", 1, 65535),
            },
        ),
    }

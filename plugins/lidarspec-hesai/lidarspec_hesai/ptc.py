"""PTC, the commands of the family, over TCP port 9347, big-endian.

    47 74  code  result | length(4) | payload

The angles of a unit are requested when it is opened. Units with only TLS or PTC 2.0 (57 75) do not
reply.

Source: HesaiLidar_SDK_2.0 (ptc_client.h, ptc_1_0_parser.h: frame and codes); tier4/nebula
(hesai_common.hpp: numbers of the return modes).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from construct import Bytes, Const, Construct, Int8ub, Int16ub, Int32ub, Struct, Switch, this

from lidarspec.spec import Address, Command, Fields, Frame, Scaled, SizeOf, Tcp

CONTROL = Tcp(9347)
MAX_PAYLOAD_BYTES = 1 << 16  # the longest known payload, the angles of an AT128, has 47,176

RESULTS = (
    "0 done, 1 bad parameter, 2 connection, 3 data, 4 memory, 5 not supported, 6 FPGA, 7 other"
)
SETTINGS = {
    0x17: Struct("rate" / Scaled(Int16ub, 1, "rpm")),
    0x1C: Struct("standby" / Int8ub * "1: the motor is stopped"),
    0x1E: Struct(
        "mode"
        / Int8ub
        * (
            "0 last, 1 strongest, 2 both, 3 first, 4 first and last, 5 first and strongest, if"
            " the model supports it"
        )
    ),
    0x20: Struct(
        "host" / Bytes(4), "port" / Int16ub * "destination port of data", "gps_port" / Int16ub
    ),
}


def make_message(payload: Construct) -> Struct:
    """Return the struct of a request or a reply with this payload."""
    return Struct(
        "sync" / Const(b"\x47\x74"),
        "code" / Int8ub,
        "result" / Int8ub * RESULTS,
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


def make_command(code: int, **more: Any) -> Command:
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
    """Return the commands of a unit; `rates` are its lowest and highest speed in rpm."""
    return {
        "get_calibration": make_command(
            0x05, learns=lambda reply: {"calibration": bytes(reply.payload)}
        ),
        "get_firing_times": make_command(0xA9),
        "get_inventory": make_command(0x07),
        "get_status": make_command(0x09),
        "reboot": make_command(0x10),
        "speed": make_command(0x17, args={"rate": ("payload.rate", *rates)}),
        "standby": make_command(0x1C, args={"standby": ("payload.standby", 0, 1)}),
        "return_mode": make_command(0x1E, args={"mode": ("payload.mode", 0, 5)}),
        "send_to": make_command(
            0x20,
            args={
                "host": ("payload.host", Address()),
                "port": ("payload.port", 1, 65535),
                "gps_port": ("payload.gps_port", 1, 65535),
            },
        ),
    }

"""Requests of the host, ``A5 cmd``, and replies of a YDLIDAR.

Source: YDLIDAR SDK, "YDLidar-SDK Communication Protocol" (system commands);
core/common/ydlidar_protocol.h (the frame `stamp`). The sources disagree about two requests. The
request for the health is 92 (hexadecimal) in the SDK, and 91 in older manuals; the request for a
reset is 80 in some sources, and 40 in others. This module sends 92 and 80. The order of the two
bytes of the firmware version differs between manuals (for a T-mini, 00 01 is 1.0). Commands that
only some models have (low power, constant frequency, heartbeat, zero offset, pitch) are omitted.
"""

from __future__ import annotations

from typing import Any

from construct import Bytes, Const, Construct, Enum, Int8ul, Int16ul, Int32ul, Struct

from lidarspec.spec import Checksummed, Command, Frame, Scaled, Xor
from lidarspec_ydlidar.models import MODELS

STOP_DELAY_S = 0.03  # SDK, stop
MOTOR_START_DELAY_S = 0.5  # SDK, startMotor


def make_reply(kind: int, *fields: Construct, size: int) -> Frame:
    """Return the frame of a reply, which begins with its descriptor."""
    header = b"\xa5\x5a" + size.to_bytes(4, "little") + bytes([kind])
    return Frame(Struct("descriptor" / Const(header), *fields))


SCAN_START = Frame(
    Struct(
        "descriptor"
        / Const(b"\xa5\x5a\x05\x00\x00\x40\x81")
        * "packets follow until the command stop"
    )
)
ANSWERS = {
    "scan_start": SCAN_START,
    "info": make_reply(
        0x04,
        "model"
        / Enum(Int8ul, **{name: model.number for name, model in MODELS.items() if model.number}),
        "firmware" / Struct("minor" / Int8ul, "major" / Int8ul),
        "hardware" / Int8ul,
        "serial" / Bytes(16) * "each byte contains one digit",
        size=20,
    ),
    "health": make_reply(
        0x06, "status" / Enum(Int8ul, good=0, warning=1, error=2), "error" / Int16ul, size=3
    ),
    "speed": make_reply(
        0x04, "frequency" / Scaled(Int32ul, 0.01, "Hz") * "scans per second", size=4
    ),
    "setting": make_reply(
        0x04,
        "value" / Int8ul * "code of the sampling rate, or of the direction of rotation",
        size=1,
    ),
    "stamp": Frame(
        Checksummed(
            Struct(
                "header" / Const(b"\xaa\x66"),
                "cs" / Int8ul,
                "time" / Scaled(Int32ul, 0.001, "s"),
                "reserved" / Bytes(1),
            ),
            field="cs",
            algorithm=Xor(),
        ),
    ),
}
CODES = {
    "rotate_forward": 0x06,
    "rotate_back": 0x07,
    "faster": 0x09,
    "slower": 0x0A,
    "faster_1hz": 0x0B,
    "slower_1hz": 0x0C,
    "get_speed": 0x0D,
    "scan": 0x60,
    "force_scan": 0x61,
    "stop": 0x65,
    "reset": 0x80,
    "get_info": 0x90,
    "get_health": 0x92,
    "next_rate": 0xD0,
    "get_rate": 0xD1,
}
REQUEST = Frame(Struct("start" / Const(b"\xa5"), "cmd" / Enum(Int8ul, **CODES)), direction="out")


def make_request(cmd: str, reply: str | None = None, **more: Any) -> Command:
    """Return a command that sends a request without payload."""
    return Command("request", {"cmd": cmd}, reply=reply, **more)


COMMANDS = {
    "start_motor": Command(lines={"dtr": True}, settle=MOTOR_START_DELAY_S),
    "stop_motor": Command(lines={"dtr": False}),
    "scan": make_request("scan", "scan_start", retries=1, starts=True),
    "force_scan": make_request("force_scan", "scan_start", retries=1, starts=True),
    "stop": make_request("stop", stops=True, settle=STOP_DELAY_S),
    "get_info": make_request("get_info", "info", retries=1, only_stopped=True),
    "get_health": make_request("get_health", "health", retries=1, only_stopped=True),
    "reset": make_request("reset", stops=True),
    "faster": make_request("faster", "speed", only_stopped=True),
    "slower": make_request("slower", "speed", only_stopped=True),
    "faster_1hz": make_request("faster_1hz", "speed", only_stopped=True),
    "slower_1hz": make_request("slower_1hz", "speed", only_stopped=True),
    "get_speed": make_request("get_speed", "speed", retries=1, only_stopped=True),
    "rotate_forward": make_request("rotate_forward", "setting", retries=1, only_stopped=True),
    "rotate_back": make_request("rotate_back", "setting", retries=1, only_stopped=True),
    "next_rate": make_request("next_rate", "setting", only_stopped=True),
    "get_rate": make_request("get_rate", "setting", retries=1, only_stopped=True),
}

"""Requests of the host: ``A5 cmd``, with ``size payload xor8`` if bit 7 of the command is set.

Source: RPLIDAR interface protocol, "request packets"; A8, F0 and FF from the vendor's SDK
(sl_lidar_cmd.h).
"""

from __future__ import annotations

from construct import (
    BitsInteger,
    BitStruct,
    Bytes,
    Const,
    Construct,
    Enum,
    Int8ul,
    Int16ul,
    Int32ul,
    Struct,
    this,
)

from lidarspec.spec import Checksummed, Frame, Scaled, Xor
from lidarspec_slamtec.answers import KEY

START = Const(b"\xa5")
#: The codes of requests without a payload, and of requests with a payload.
PLAIN_CODES = {
    "scan": 0x20,
    "force_scan": 0x21,
    "stop": 0x25,
    "reset": 0x40,
    "get_info": 0x50,
    "get_health": 0x52,
    "get_samplerate": 0x59,
}
PAYLOAD_CODES = {
    "express_scan": 0x82,
    "get_config": 0x84,
    "motor_speed": 0xA8,
    "motor_duty": 0xF0,
    "get_accessory": 0xFF,
}


def make_request(*fields: Construct) -> Checksummed:
    """Return the struct of a request: start byte, fields, and their XOR."""
    return Checksummed(
        Struct("start" / START, *fields, "checksum" / Int8ul), field="checksum", algorithm=Xor()
    )


def make_payload_request(cmd: int, size: int, *payload: Construct) -> Frame:
    """Return the frame of a command with a payload of `size` bytes."""
    return Frame(
        make_request("cmd" / Const(cmd, Int8ul), "size" / Const(size, Int8ul), *payload),
        direction="out",
    )


PLAIN = Struct(
    "start" / START,
    "cmd"
    / BitStruct(
        "payload" / Const(0, BitsInteger(1)) * "0: no payload follows",
        "number" / Enum(BitsInteger(7), **PLAIN_CODES),
    ),
)
PAYLOAD = make_request(
    "cmd" / Enum(Int8ul, **PAYLOAD_CODES) * "code of the command, 80 or more",
    "size" / Int8ul * "number of bytes of the payload",
    "payload" / Bytes(this.size),
)

REQUESTS = {
    "request": Frame(PLAIN, direction="out"),
    "express_request": make_payload_request(
        0x82,
        5,
        "mode" / Int8ul * "0: express scan; other values: a scan mode (see get_mode_count)",
        "flags" / Int16ul,
        "param" / Int16ul,
    ),
    "config_request": make_payload_request(0x84, 4, "key" / KEY),
    "mode_config_request": make_payload_request(
        0x84, 6, "key" / KEY, "mode" / Int16ul * "requested scan mode"
    ),
    "rpm_request": make_payload_request(0xA8, 2, "speed" / Scaled(Int16ul, 1, "rpm") * "0: stop"),
    "pwm_request": make_payload_request(0xF0, 2, "duty" / Int16ul * "0: stop, 1023: full speed"),
    "accessory_request": make_payload_request(0xFF, 4, "reserved" / Int32ul),
    "payload_request": Frame(
        PAYLOAD, direction="out", max_length=4 + 255, plausible=lambda f: f.cmd >= 0x80
    ),
}

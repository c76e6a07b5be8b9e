"""What the host asks, ``A5 cmd``, and what a YDLIDAR answers.

Source: YDLIDAR SDK, "YDLidar-SDK Communication Protocol" (system commands);
core/common/ydlidar_protocol.h (stamps). Health is asked with 92 in the SDK and with 91 in older
manuals, a reset with 80 and 40; the order of the two bytes of the firmware differs between manuals
(a T-mini's 00 01 is 1.0). Commands that only some models know (low power, constant frequency,
heartbeat, zero offset, pitch) are left out.
"""

from __future__ import annotations

from typing import Any

from construct import Bytes, Const, Construct, Int8ul, Int16ul, Int32ul, Struct

from lidarspec.spec import Checksummed, Command, Frame, Scaled, Xor
from lidarspec_ydlidar.models import MODELS

AFTER_STOP = 0.03  # seconds (SDK, stop)
AFTER_MOTOR = 0.5  # seconds (SDK, startMotor)


def answer(kind: int, *fields: Construct, size: int) -> Frame:
    """Return the answer to a request, with its descriptor in front."""
    header = b"\xa5\x5a" + size.to_bytes(4, "little") + bytes([kind])
    return Frame(Struct("descriptor" / Const(header), *fields))


SCAN_START = Frame(
    Struct("descriptor" / Const(b"\xa5\x5a\x05\x00\x00\x40\x81") * "packets follow without end")
)
ANSWERS = {
    "scan_start": SCAN_START,
    "info": answer(
        0x04,
        "model"
        / Int8ul
        * ", ".join(f"{model.number} {name}" for name, model in MODELS.items() if model.number),
        "firmware" / Struct("minor" / Int8ul, "major" / Int8ul),
        "hardware" / Int8ul,
        "serial" / Bytes(16) * "a digit a byte",
        size=20,
    ),
    "health": answer(
        0x06, "status" / Int8ul * "0 good, 1 warning, 2 error", "error" / Int16ul, size=3
    ),
    "speed": answer(0x04, "frequency" / Scaled(Int32ul, 0.01, "Hz") * "of scans", size=4),
    "setting": answer(
        0x04,
        "value" / Int8ul * "number of the sampling rate, or of the direction of rotation",
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
REQUEST = Frame(Struct("start" / Const(b"\xa5"), "cmd" / Int8ul), direction="out")


def asking(cmd: int, reply: str | None = None, **more: Any) -> Command:
    """Return a request without payload."""
    return Command("request", {"cmd": cmd}, reply=reply, **more)


COMMANDS = {
    "start_motor": Command(lines={"dtr": True}, settle=AFTER_MOTOR),
    "stop_motor": Command(lines={"dtr": False}),
    "scan": asking(0x60, "scan_start", retries=1, starts=True),
    "force_scan": asking(0x61, "scan_start", retries=1, starts=True),
    "stop": asking(0x65, stops=True, settle=AFTER_STOP),
    "get_info": asking(0x90, "info", retries=1, only_stopped=True),
    "get_health": asking(0x92, "health", retries=1, only_stopped=True),
    "reset": asking(0x80, stops=True),
    "faster": asking(0x09, "speed", only_stopped=True),
    "slower": asking(0x0A, "speed", only_stopped=True),
    "faster_1hz": asking(0x0B, "speed", only_stopped=True),
    "slower_1hz": asking(0x0C, "speed", only_stopped=True),
    "get_speed": asking(0x0D, "speed", retries=1, only_stopped=True),
    "rotate_forward": asking(0x06, "setting", retries=1, only_stopped=True),
    "rotate_back": asking(0x07, "setting", retries=1, only_stopped=True),
    "next_rate": asking(0xD0, "setting", only_stopped=True),
    "get_rate": asking(0xD1, "setting", retries=1, only_stopped=True),
}

"""Commands and their replies.

A reply consists of an echo of the command, a status and optional lines, each with a name and a
value. Commands end with a line feed.

Source: SCIP 2.0, C-42-03320B, section 8 (BM, QT, RS, TM, SS, CR, HS, VV, PP, II).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

from construct import Bytes, Const, Construct, GreedyBytes, Int8ub, Int32ub, NullTerminated, Struct

from lidarspec.spec import Checksum, Checksummed, Command, Frame, Lines, Scaled, Scip, SixBits, Text
from lidarspec_hokuyo.scans import SCAN_COMMANDS

STATUS = (
    "status"
    / Bytes(2)
    * "00: success; 02 in the reply to BM: the laser is already on; other values: an error"
    " code"
)
#: The values that a scanner reports, by reply: the command, and the first four letters of each line
#: by name.
REPORTED_VALUES: dict[str, tuple[bytes, dict[str, str]]] = {
    "version": (
        b"VV",
        {
            "vendor": "VEND",
            "product": "PROD",
            "firmware": "FIRM",
            "protocol": "PROT",
            "serial": "SERI",
        },
    ),
    "parameters": (
        b"PP",
        {
            "model": "MODL",
            "shortest": "DMIN",
            "longest": "DMAX",
            "division": "ARES",
            "first": "AMIN",
            "last": "AMAX",
            "ahead": "AFRT",
            "speed": "SCAN",
        },
    ),
    "state": (
        b"II",
        {
            "model": "MODL",
            "laser": "LASR",
            "speed": "SCSP",
            "mode": "MESM",
            "bit_rate": "SBPS",
            "time": "TIME",
            "status_text": "STAT",
        },
    ),
}
#: Command -> the reply with its lines.
VALUE_REPLIES = {f"get_{name}": name for name in REPORTED_VALUES}


@dataclass(frozen=True)
class LineCheck(Checksum):
    """The check character of a line: 0x30 plus the lowest six bits of a sum.

    The sum covers all characters before the semicolon.
    """

    width: int = 8
    order: Literal["little", "big"] = "little"

    def __call__(self, data: bytes | bytearray | memoryview) -> int:
        return (sum(data[:-1]) & 0x3F) + 0x30

    def describe(self) -> str:
        return "low six bits of the sum of the characters before the semicolon, plus 0x30"


def make_line(name: str, letters: str) -> Construct:
    """Return the struct of a line: name, colon, text, semicolon, check character."""
    text = "text" / NullTerminated(GreedyBytes, term=b";")
    struct = Struct(
        "name" / Const(f"{letters}:".encode()), text, "check" / Int8ub, "end" / Const(b"\n")
    )
    return name / Checksummed(struct, field="check", algorithm=LineCheck(), over=("name", "text"))


def make_reply(command: bytes, lines: Mapping[str, str]) -> Frame:
    """Return the frame of a reply with lines of text.

    `lines` maps the field name of each line to the four letters with which the line begins.
    """
    struct = Struct(
        "head" / Const(command + b"\n00P\n"),
        *(make_line(*item) for item in lines.items()),
        "end" / Const(b"\n"),
    )
    return Frame(
        struct,
        max_length=1000,
        acknowledged={
            "LS310": "the check character contains only the low six bits of the sum, so it does not"
            " detect every error"
        },
    )


def make_value_lines(name: str, values: Mapping[str, str]) -> bytes:
    """Return the bytes of a simulated reply; missing values are empty."""
    command, lines = REPORTED_VALUES[name]
    texts = [f"{letters}:{values.get(line, '')};".encode() for line, letters in lines.items()]
    return (
        command
        + b"\n00P\n"
        + b"".join(text + bytes([LineCheck()(text)]) + b"\n" for text in texts)
        + b"\n"
    )


def make_status_reply(
    command: bytes, *fields: Construct, size: int = 0, line_sizes: tuple[int, ...] = ()
) -> Frame:
    """Return the frame of a reply with the echo of a command and a status.

    Args:
        command: the letters of the command.
        fields: the fields of the lines after the status.
        size: the number of characters of the command's argument.
        line_sizes: the number of characters of each line after the status.
    """
    value = ("value" / Bytes(size),) if size else ()
    wire = Lines(64, head=(len(command) + size, 2, *line_sizes), bare=1, check=Scip()) | SixBits()
    return Frame(
        Struct("command" / Const(command), *value, STATUS, *fields), max_length=40, wire=wire
    )


def make_command_frame(command: bytes, size: int) -> Frame:
    """Return the frame of a command with an argument of `size` characters."""
    value = ("value" / Bytes(size),) if size else ()
    return Frame(Struct("command" / Const(command), *value, "end" / Const(b"\n")), direction="out")


#: Name -> the letters of the command, the number of characters of its argument, and further
#: arguments of `Command`.
ORDERS: dict[str, tuple[bytes, int, dict[str, Any]]] = {
    "stop": (b"QT", 0, {"stops": True}),
    "laser_on": (b"BM", 0, {}),
    "reset": (b"RS", 0, {"stops": True}),
    "timing_on": (b"TM0", 0, {"stops": True}),
    "get_time": (b"TM1", 0, {}),
    "timing_off": (b"TM2", 0, {}),
    **{f"get_{name}": (command, 0, {}) for name, (command, _) in REPORTED_VALUES.items()},
}
URG_ORDERS: dict[str, tuple[bytes, int, dict[str, Any]]] = {
    "set_baud": (b"SS", 6, {}),
    "set_speed": (b"CR", 2, {}),
    "more_sensitive": (b"HS1", 0, {}),
    "less_sensitive": (b"HS0", 0, {}),
}


def list_command_formats(
    kind: str, *, is_urg: bool
) -> dict[str, tuple[bytes, int, dict[str, Any]]]:
    """Return the formats of the commands of a scanner that sends scans of this kind.

    Returns:
        name -> (letters of the command, number of characters after the letters, arguments of
        `Command`).
    """
    scans = {
        "start": (SCAN_COMMANDS[kind][0].encode(), 13, {"starts": True}),
        "get_scan": (SCAN_COMMANDS[kind][1].encode(), 10, {}),
    }
    return scans | ORDERS | (URG_ORDERS if is_urg else {})


@cache
def make_messages(kind: str, *, is_urg: bool) -> dict[str, Frame]:
    """Return the frames of all commands and replies except scans."""
    rows = list_command_formats(kind, is_urg=is_urg)
    frames = dict[str, Frame]()
    for name, (command, size, _) in rows.items():
        frames[f"{name}_order"] = make_command_frame(command, size)
        if name not in VALUE_REPLIES:
            clock: tuple[Any, ...] = ()
            if name == "get_time":
                clock = ("time" / Scaled(Int32ub, 0.001, "s") * "24 bits",)
            frames[f"{name}_answer"] = make_status_reply(
                command, *clock, size=size, line_sizes=(4,) if clock else ()
            )
    return frames | {name: make_reply(*row) for name, row in REPORTED_VALUES.items()}


def make_commands(kind: str, steps: bytes, *, is_urg: bool) -> dict[str, Command]:
    """Return the commands of a scanner.

    Args:
        kind: a key of `SCAN_COMMANDS`.
        steps: the first step, the last step and the cluster size, as in a command.
    """
    values = {"start": {"value": steps + b"000"}, "get_scan": {"value": steps}}
    commands = dict[str, Command]()
    for name, (_, size, more) in list_command_formats(kind, is_urg=is_urg).items():
        reply = VALUE_REPLIES.get(name, f"{name}_answer")
        arguments: dict[str, Any] = {"reply": reply, "retries": 1, **more}
        if name not in VALUE_REPLIES and name != "laser_on":
            arguments["matches"] = {"status": b"00"}
        if size:
            arguments["echoes"] = ("value",)
            arguments |= (
                {"values": values[name]}
                if name in values
                else {"args": {"value": ("value", Text(size))}}
            )
        if name == "get_scan":
            arguments |= {"reply": f"one_{kind}", "matches": {}, "echoes": ()}
        commands[name] = Command(f"{name}_order", **arguments)
    return commands

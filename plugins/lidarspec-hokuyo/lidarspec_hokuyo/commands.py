"""What can be asked of a scanner, and what it answers: an echo, a status and, where it tells
something, lines with a name and a value each.

Source: SCIP 2.0, C-42-03320B, section 8: BM, QT, RS, TM, SS, CR, HS, VV, PP, II; the lines of VV,
PP and II have their check character over what stands before the semicolon. Commands end with a line
feed. No text is sent behind a command, though a scanner would repeat it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

from construct import Bytes, Const, Construct, GreedyBytes, Int8ub, Int32ub, NullTerminated, Struct

from lidarspec.spec import Checksum, Checksummed, Command, Frame, Lines, Scaled, Scip, SixBits, Text
from lidarspec_hokuyo.scans import KINDS

STATUS = "status" / Bytes(2) * "00 done; of BM 02: the laser is on already; else what is wrong"
#: what a scanner tells of itself: reply -> command, its lines by name, the first four letters of
#: each.
TOLD: dict[str, tuple[bytes, dict[str, str]]] = {
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
#: command -> the frame that answers it with such lines.
TOLD_BY = {f"get_{name}": name for name in TOLD}


@dataclass(frozen=True)
class LineCheck(Checksum):
    """Six bits of the sum of a line's characters without the semicolon at its end, from "0" on."""

    width: int = 8
    order: Literal["little", "big"] = "little"

    def __call__(self, data: bytes | bytearray | memoryview) -> int:
        return (sum(data[:-1]) & 0x3F) + 0x30

    def describe(self) -> str:
        return "six bits of the sum before the semicolon"


def line(name: str, begin: str) -> Construct:
    """A line of a value behind a name: its text ends with a semicolon, behind which the check
    character stands.
    """
    text = "text" / NullTerminated(GreedyBytes, term=b";")
    struct = Struct(
        "name" / Const(f"{begin}:".encode()), text, "check" / Int8ub, "end" / Const(b"\n")
    )
    return name / Checksummed(struct, field="check", algorithm=LineCheck(), over=("name", "text"))


def make_reply(command: bytes, lines: Mapping[str, str]) -> Frame:
    """Return an answer in such lines."""
    struct = Struct(
        "head" / Const(command + b"\n00P\n"),
        *(line(*one) for one in lines.items()),
        "end" / Const(b"\n"),
    )
    return Frame(struct, max_length=1000)


def telling(name: str, values: Mapping[str, str]) -> bytes:
    """Such an answer, of a simulated scanner; what is not given is empty."""
    command, lines = TOLD[name]
    texts = [f"{begin}:{values.get(line, '')};".encode() for line, begin in lines.items()]
    return (
        command
        + b"\n00P\n"
        + b"".join(text + bytes([LineCheck()(text)]) + b"\n" for text in texts)
        + b"\n"
    )


def answer(command: bytes, *more: Construct, size: int = 0, told: tuple[int, ...] = ()) -> Frame:
    """The echo of a command with an argument of so many characters, and a status; what else is told
    stands in a line of its own.
    """
    value = ("value" / Bytes(size),) if size else ()
    wire = Lines(64, head=(len(command) + size, 2, *told), bare=1, check=Scip()) | SixBits()
    return Frame(
        Struct("command" / Const(command), *value, STATUS, *more), max_length=40, wire=wire
    )


def order(command: bytes, size: int) -> Frame:
    """Return a command with an argument of so many characters."""
    value = ("value" / Bytes(size),) if size else ()
    return Frame(Struct("command" / Const(command), *value, "end" / Const(b"\n")), direction="out")


#: name -> what is sent, the characters of its argument, and what the command does besides.
ORDERS: dict[str, tuple[bytes, int, dict[str, Any]]] = {
    "stop": (b"QT", 0, {"stops": True}),
    "laser_on": (b"BM", 0, {}),
    "reset": (b"RS", 0, {"stops": True}),
    "timing_on": (b"TM0", 0, {"stops": True}),
    "get_time": (b"TM1", 0, {}),
    "timing_off": (b"TM2", 0, {}),
    **{f"get_{name}": (command, 0, {}) for name, (command, _) in TOLD.items()},
}
OF_URG: dict[str, tuple[bytes, int, dict[str, Any]]] = {
    "set_baud": (b"SS", 6, {}),
    "set_speed": (b"CR", 2, {}),
    "more_sensitive": (b"HS1", 0, {}),
    "less_sensitive": (b"HS0", 0, {}),
}


def orders(kind: str, *, is_urg: bool) -> dict[str, tuple[bytes, int, dict[str, Any]]]:
    """Return all that a scanner takes whose scans are of this kind."""
    scans = {
        "start": (KINDS[kind][0].encode(), 13, {"starts": True}),
        "get_scan": (KINDS[kind][1].encode(), 10, {}),
    }
    return scans | ORDERS | (OF_URG if is_urg else {})


@cache
def messages(kind: str, *, is_urg: bool) -> dict[str, Frame]:
    """Return all commands and answers, but for scans."""
    rows = orders(kind, is_urg=is_urg)
    found = dict[str, Frame]()
    for name, (command, size, _) in rows.items():
        found[f"{name}_order"] = order(command, size)
        if name not in TOLD_BY:
            clock: tuple[Any, ...] = ()
            if name == "get_time":
                clock = ("time" / Scaled(Int32ub, 0.001, "s") * "24 bits",)
            found[f"{name}_answer"] = answer(command, *clock, size=size, told=(4,) if clock else ())
    return found | {name: make_reply(*row) for name, row in TOLD.items()}


def commands(kind: str, steps: bytes, *, is_urg: bool) -> dict[str, Command]:
    """The commands of a scanner that is asked for these steps: the first, the last and how many
    come as one distance.
    """
    given = {"start": {"value": steps + b"000"}, "get_scan": {"value": steps}}
    found = dict[str, Command]()
    for name, (_, size, more) in orders(kind, is_urg=is_urg).items():
        reply = TOLD_BY.get(name, f"{name}_answer")
        own: dict[str, Any] = {"reply": reply, "retries": 1, **more}
        if name not in TOLD_BY and name != "laser_on":
            own["matches"] = {"status": b"00"}
        if size:
            own["echoes"] = ("value",)
            own |= (
                {"values": given[name]}
                if name in given
                else {"args": {"value": ("value", Text(size))}}
            )
        if name == "get_scan":
            own |= {"reply": f"one_{kind}", "matches": {}, "echoes": ()}
        found[name] = Command(f"{name}_order", **own)
    return found

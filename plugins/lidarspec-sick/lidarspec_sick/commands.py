"""What can be asked of a scanner, and what it answers, in CoLa B or CoLa A.

Source: the telegram listing 8014631; 8023202 (LMS4000), tables 14 to 16, prints how a stream is
started. `login` is needed before anything is changed, and `run` afterwards; what is set is lost
with the power unless it is saved.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

from construct import Bytes, Const, Construct, Enum, Int8ub, Int16ub, Int32sb, Int32ub, this

from lidarspec.spec import Command, Frame, Scaled
from lidarspec_sick.telegrams import binary, text

CLIENT = 3
PASSWORD = 0xF472_4744  # the user level "authorised client", and the hash of its password
MOST_TEXT = 200  # bytes of an answer with texts in it
STRING = ("size" / Int16ub, "text" / Bytes(this.size))
RANGE = (
    "sectors" / Int16ub,
    "step" / Scaled(Int32ub, 1e-4, "deg"),
    "start" / Scaled(Int32sb, 1e-4, "deg") * "counter-clockwise; 90 is straight ahead",
    "stop" / Scaled(Int32sb, 1e-4, "deg"),
)
CONTENT = (
    "echoes" / Int8ub * "sum of 1: DIST1, 2: DIST2, 4: DIST3, and so on",
    "reserved" / Int8ub,
    "strength" / Int8ub * "1: with RSSI",
    "wide" / Int8ub * "1: 16-bit RSSI",
    "unit" / Int8ub,
    "encoders" / Int16ub,
    *(name / Int8ub for name in ("position", "name", "comment", "time")),
    "interval" / Int16ub * "1: each scan, 2: every second scan",
)
#: what a scanner may refuse a command for, from 1 on (8014631, error codes).
ERRORS = (
    "access_denied",
    "method_unknown",
    "variable_unknown",
    "value_not_allowed",
    "data_invalid",
    "unknown",
    "buffer_overflow",
    "buffer_underflow",
    "type_unknown",
    "write_denied",
    "name_server_command_unknown",
    "command_unknown",
    "busy",
    "array_out_of_bounds",
    "event_unknown",
    "value_overflow",
    "character_invalid",
    "no_message",
    "no_answer",
    "internal",
    "hub_address_corrupted",
    "hub_address_undecodable",
    "hub_address_exceeded",
    "hub_address_blank_expected",
    "asynchronous_methods_off",
    "complex_arrays_unsupported",
)
#: frame -> kind, method, content. What is asked is called ask_ or set_.
MESSAGES: dict[str, tuple[str, str, tuple[Construct, ...]]] = {
    "login": ("sMN", "SetAccessMode", ("level" / Int8ub, "password" / Int32ub)),
    "logged_in": ("sAN", "SetAccessMode", ("done" / Int8ub,)),
    "set_stream": ("sEN", "LMDscandata", ("active" / Int8ub,)),
    "stream": ("sEA", "LMDscandata", ("active" / Int8ub,)),
    "ask_scan": ("sRN", "LMDscandata", ()),
    "measure": ("sMN", "LMCstartmeas", ()),
    "measuring": ("sAN", "LMCstartmeas", ("error" / Int8ub,)),
    "halt": ("sMN", "LMCstopmeas", ()),
    "halted": ("sAN", "LMCstopmeas", ("error" / Int8ub,)),
    "run": ("sMN", "Run", ()),
    "running": ("sAN", "Run", ("done" / Int8ub,)),
    "ask_state": ("sRN", "SCdevicestate", ()),
    "state": (
        "sRA",
        "SCdevicestate",
        ("readiness" / Int8ub * "0 busy, 1 ready, 2 error, 3 standby",),
    ),
    "ask_identity": ("sRN", "DeviceIdent", ()),
    "identity": (
        "sRA",
        "DeviceIdent",
        (*STRING, "version_size" / Int16ub, "version" / Bytes(this.version_size)),
    ),
    "ask_firmware": ("sRN", "FirmwareVersion", ()),
    "firmware": ("sRA", "FirmwareVersion", STRING),
    "ask_range": ("sRN", "LMPoutputRange", ()),
    "range": ("sRA", "LMPoutputRange", RANGE),
    "set_range": ("sWN", "LMPoutputRange", RANGE),
    "range_set": ("sWA", "LMPoutputRange", ()),
    "set_content": ("sWN", "LMDscandatacfg", CONTENT),
    "content_set": ("sWA", "LMDscandatacfg", ()),
    "save": ("sMN", "mEEwriteall", ()),
    "saved": ("sAN", "mEEwriteall", ("done" / Int8ub,)),
    "refused": (
        "sFA",
        "",
        ("error" / Enum(Int16ub, **{name: number for number, name in enumerate(ERRORS, 1)}),),
    ),
}
ASKED = ("sMN", "sRN", "sWN", "sEN")


def message(cola: str, kind: str, method: str, content: tuple[Construct, ...]) -> Frame:
    """One message; in CoLa B what the scanner answers has a space behind the method even where
    nothing follows.
    """
    out = kind in ASKED
    direction = "out" if out else "in"
    most = MOST_TEXT if set(STRING) & set(content) else 0
    if cola == "A":
        names = [
            "kind" / Const(kind.encode()),
            *(["method" / Const(method.encode())] if method else []),
        ]
        return text(*names, *content, direction=direction)
    head = f"{kind} {method} " if method else f"{kind} "
    return binary(
        "method" / Const(head.rstrip(" " if out and not content else "").encode()),
        *content,
        direction=direction,
        max_length=most,
    )


@cache
def messages(cola: str) -> Mapping[str, Frame]:
    """Return all messages in CoLa "A" or "B"."""
    return {name: message(cola, *row) for name, row in MESSAGES.items()}


def asking(frame: str, reply: str, values: Mapping[str, Any] | None = None, **more: Any) -> Command:
    """What may be asked twice, and what answers it."""
    return Command(frame, values or {}, reply=reply, refusal="refused", retries=1, **more)


def commands(scan: str) -> dict[str, Command]:
    """Return all commands of a scanner whose scans are such frames."""
    content = {
        "reserved": 0,
        "wide": 1,
        "unit": 0,
        "encoders": 0,
        "position": 0,
        "name": 0,
        "comment": 0,
        "time": 1,
    }
    return {
        "start": asking("set_stream", "stream", {"active": 1}, echoes=("active",), starts=True),
        "stop": asking("set_stream", "stream", {"active": 0}, echoes=("active",), stops=True),
        "get_scan": asking("ask_scan", scan),
        "login": asking(
            "login", "logged_in", {"level": CLIENT, "password": PASSWORD}, matches={"done": 1}
        ),
        "run": asking("run", "running", matches={"done": 1}),
        "start_measuring": asking("measure", "measuring", matches={"error": 0}),
        "stop_measuring": asking("halt", "halted", matches={"error": 0}),
        "get_state": asking("ask_state", "state"),
        "get_identity": asking("ask_identity", "identity"),
        "get_firmware": asking("ask_firmware", "firmware"),
        "get_range": asking("ask_range", "range"),
        "set_range": asking(
            "set_range",
            "range_set",
            {"sectors": 1},
            args={
                "step": ("step", 0.0833, 1.0),
                "start": ("start", -47.5, 227.5),
                "stop": ("stop", -47.5, 227.5),
            },
        ),
        "set_content": asking(
            "set_content",
            "content_set",
            content,
            args={
                "echoes": ("echoes", 1, 31),
                "strength": ("strength", 0, 1),
                "interval": ("interval", 1, 50_000),
            },
        ),
        "save": asking("save", "saved", matches={"done": 1}),
    }


#: what a simulated scanner answers, where that is more than the reply as it stands.
ANSWERS: dict[str, Any] = {
    "get_state": (("state", {"readiness": 1}),),
    "get_firmware": (("firmware", {"text": b"V1.0"}),),
}

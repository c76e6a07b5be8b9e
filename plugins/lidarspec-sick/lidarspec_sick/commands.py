"""Commands that a scanner accepts, and its replies, in SICK's protocols CoLa B and CoLa A.

CoLa B is binary, and CoLa A is text. Send `login` before and `run` after a change of settings. The
settings are lost at power-off, unless the command `save` saves them.

Source: the telegram listing 8014631; 8023202 (LMS4000), tables 14 to 16, for starting a stream.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

from construct import Bytes, Const, Construct, Enum, Int8ub, Int16ub, Int32sb, Int32ub, this

from lidarspec.spec import Command, Frame, Scaled
from lidarspec_sick.telegrams import make_binary_frame, make_text_frame

CLIENT_LEVEL = 3  # the user level "authorised client"
CLIENT_PASSWORD_HASH = 0xF472_4744
MAX_TEXT_REPLY_BYTES = 200
STRING = ("size" / Int16ub, "text" / Bytes(this.size))
RANGE = (
    "sectors" / Int16ub,
    "step" / Scaled(Int32ub, 1e-4, "deg"),
    "start"
    / Scaled(Int32sb, 1e-4, "deg")
    * "first angle, counter-clockwise; 90 degrees is straight ahead",
    "stop" / Scaled(Int32sb, 1e-4, "deg"),
)
CONTENT = (
    "echoes" / Int8ub * "bit 0: DIST1, bit 1: DIST2, bit 2: DIST3, and so on",
    "reserved" / Int8ub,
    "strength" / Int8ub * "1: scans contain RSSI",
    "wide" / Int8ub * "1: RSSI has 16 bits",
    "unit" / Int8ub,
    "encoders" / Int16ub,
    *(name / Int8ub for name in ("position", "name", "comment", "time")),
    "interval" / Int16ub * "1: every scan is sent; 2: every second scan is sent",
)
#: The reasons for a refused command, numbered from 1 (8014631, error codes).
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
#: Frame -> kind, method, content. The names of most requests begin with ask_ or set_.
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
        ("readiness" / Enum(Int8ub, busy=0, ready=1, error=2, standby=3),),
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
REQUEST_KINDS = ("sMN", "sRN", "sWN", "sEN")


def make_message(cola: str, kind: str, method: str, content: tuple[Construct, ...]) -> Frame:
    """Return the frame of a message.

    Args:
        cola: "A" or "B".
        kind: the three letters of the message kind.
        method: the name of the method; "" without a method.
        content: the fields after the method.
    """
    out = kind in REQUEST_KINDS
    direction = "out" if out else "in"
    max_length = MAX_TEXT_REPLY_BYTES if set(STRING) & set(content) else 0
    if cola == "A":
        names = [
            "kind" / Const(kind.encode()),
            *(["method" / Const(method.encode())] if method else []),
        ]
        return make_text_frame(*names, *content, direction=direction)
    prefix = f"{kind} {method} " if method else f"{kind} "
    return make_binary_frame(
        "method" / Const(prefix.rstrip(" " if out and not content else "").encode()),
        *content,
        direction=direction,
        max_length=max_length,
    )


@cache
def make_messages(cola: str) -> Mapping[str, Frame]:
    """Return the frames of all messages in CoLa "A" or "B"."""
    return {name: make_message(cola, *row) for name, row in MESSAGES.items()}


def make_request(
    frame: str, reply: str, values: Mapping[str, Any] | None = None, **more: Any
) -> Command:
    """Return a command that sends a request, and repeats it if no reply arrives.

    Args:
        frame: the frame type of the request.
        reply: the frame type of the expected reply.
        values: the field values of the request.
        more: other arguments of `Command`.
    """
    return Command(frame, values or {}, reply=reply, refusal="refused", retries=1, **more)


def make_commands(scan: str) -> dict[str, Command]:
    """Return all commands of a scanner; `scan` is the frame type of its scans."""
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
        "start": make_request(
            "set_stream", "stream", {"active": 1}, echoes=("active",), starts=True
        ),
        "stop": make_request("set_stream", "stream", {"active": 0}, echoes=("active",), stops=True),
        "get_scan": make_request("ask_scan", scan),
        "login": make_request(
            "login",
            "logged_in",
            {"level": CLIENT_LEVEL, "password": CLIENT_PASSWORD_HASH},
            matches={"done": 1},
        ),
        "run": make_request("run", "running", matches={"done": 1}),
        "start_measuring": make_request("measure", "measuring", matches={"error": 0}),
        "stop_measuring": make_request("halt", "halted", matches={"error": 0}),
        "get_state": make_request("ask_state", "state"),
        "get_identity": make_request("ask_identity", "identity"),
        "get_firmware": make_request("ask_firmware", "firmware"),
        "get_range": make_request("ask_range", "range"),
        "set_range": make_request(
            "set_range",
            "range_set",
            {"sectors": 1},
            args={
                "step": ("step", 0.0833, 1.0),
                "start": ("start", -47.5, 227.5),
                "stop": ("stop", -47.5, 227.5),
            },
        ),
        "set_content": make_request(
            "set_content",
            "content_set",
            content,
            args={
                "echoes": ("echoes", 1, 31),
                "strength": ("strength", 0, 1),
                "interval": ("interval", 1, 50_000),
            },
        ),
        "save": make_request("save", "saved", matches={"done": 1}),
    }


#: Simulated replies that do not depend on the request.
SIMULATED_ANSWERS: dict[str, Any] = {
    "get_state": (("state", {"readiness": 1}),),
    "get_firmware": (("firmware", {"text": b"V1.0"}),),
}

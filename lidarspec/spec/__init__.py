"""The vocabulary of sensor plugins: everything needed to describe a sensor.

    from lidarspec.spec import Checksummed, Clock, Crc, Fields, Frame, OnWrap, Polar, Scaled,
    Sensor, Serial, Simulation, hookimpl, spread

A plugin imports only from this package and from `lidarspec`. It makes a `Sensor` from the facts in
a manual. Modules in reading order:

* `description`: `Frame`, `Command`, `Simulation`, `Relative`, `Reported`.
* `sensor`: `SensorDescription`, which combines these values.
* `enum_values`: the values of enum fields, with their names.
* `options`: the accepted values of options.
* `arguments`: arguments of commands, and values that are filled in when a command is sent.
* `fields`: members of a struct that add units, checksums and parts.
* `checksums`: checksum algorithms as values.
* `wire_forms`: the encodings of frames without fixed field offsets: tokens, lines, escapes.
* `links`: the connections of a sensor.
* `timing`: clocks, dates, counters, and the rules that end scans.
* `results`: the values that `points` functions return.
* `vocabulary`: functions that `points` functions can call.
* `tree`: a frame type as a tree of nodes.
* `syntax`: converts a construct struct to the tree.
* `bits`: finds the layout of bit blocks by probing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lidarspec.expressions.columns import Column as Column, Fields as Fields
    from lidarspec.plugins import hookimpl as hookimpl
    from lidarspec.sensor_operations import Sensor as Sensor
    from lidarspec.spec.arguments import (
        Address as Address,
        Choice as Choice,
        Count as Count,
        Port as Port,
        Template as Template,
        Text as Text,
    )
    from lidarspec.spec.checksums import (
        Checksum as Checksum,
        Crc as Crc,
        Fletcher as Fletcher,
        Fold15 as Fold15,
        Sum as Sum,
        WordXor as WordXor,
        Xor as Xor,
        ZeroPadded as ZeroPadded,
    )
    from lidarspec.spec.description import (
        Command as Command,
        Frame as Frame,
        Relative as Relative,
        Reported as Reported,
        Simulation as Simulation,
    )
    from lidarspec.spec.enum_values import EnumValue as EnumValue
    from lidarspec.spec.fields import (
        Checksummed as Checksummed,
        HttpReply as HttpReply,
        HttpRequest as HttpRequest,
        Parts as Parts,
        Scaled as Scaled,
        SizeOf as SizeOf,
    )
    from lidarspec.spec.links import (
        Assembled as Assembled,
        Http as Http,
        Link as Link,
        Serial as Serial,
        Tcp as Tcp,
        Udp as Udp,
    )
    from lidarspec.spec.options import Learned as Learned
    from lidarspec.spec.results import (
        Cartesian as Cartesian,
        Extra as Extra,
        Imu as Imu,
        Points as Points,
        Polar as Polar,
    )
    from lidarspec.spec.timing import (
        Clock as Clock,
        ClockState as ClockState,
        ClockStatus as ClockStatus,
        Every as Every,
        OnChange as OnChange,
        OnFlag as OnFlag,
        OnJump as OnJump,
        OnRewind as OnRewind,
        OnWrap as OnWrap,
        PacketCounter as PacketCounter,
        unix_time as unix_time,
    )
    from lidarspec.spec.vocabulary import (
        along as along,
        between_blocks as between_blocks,
        following as following,
        last as last,
        previous as previous,
        running as running,
        spread as spread,
        stack as stack,
        steps as steps,
        take as take,
        wrap as wrap,
    )
    from lidarspec.spec.wire_forms import (
        Decoded as Decoded,
        Echoes as Echoes,
        Escaped as Escaped,
        HexCheck as HexCheck,
        Lines as Lines,
        NumberRun as NumberRun,
        Problem as Problem,
        Scip as Scip,
        SixBits as SixBits,
        TextRun as TextRun,
        Tokens as Tokens,
        WireForm as WireForm,
        decode_runs as decode_runs,
    )
    from lidarspec.transports.protocol import (
        Chunk as Chunk,
        Disconnected as Disconnected,
        Format as Format,
        LiveTransport as LiveTransport,
        Transport as Transport,
    )

_NAMES = {
    "sensor_operations": ("Sensor",),
    "spec.options": ("Learned",),
    "spec.description": ("Frame", "Command", "Relative", "Reported", "Simulation"),
    "spec.enum_values": ("EnumValue",),
    "spec.arguments": ("Text", "Address", "Port", "Choice", "Count", "Template"),
    "spec.fields": ("Scaled", "Checksummed", "Parts", "SizeOf", "HttpRequest", "HttpReply"),
    "spec.checksums": (
        "Checksum",
        "Crc",
        "Xor",
        "Sum",
        "WordXor",
        "Fletcher",
        "Fold15",
        "ZeroPadded",
    ),
    "spec.links": ("Assembled", "Serial", "Udp", "Tcp", "Http", "Link"),
    "spec.timing": (
        "Clock",
        "ClockState",
        "ClockStatus",
        "PacketCounter",
        "OnWrap",
        "OnFlag",
        "OnChange",
        "OnJump",
        "OnRewind",
        "Every",
        "unix_time",
    ),
    "expressions.columns": ("Fields", "Column"),
    "spec.results": ("Points", "Polar", "Cartesian", "Extra", "Imu"),
    "spec.vocabulary": (
        "along",
        "spread",
        "wrap",
        "following",
        "previous",
        "between_blocks",
        "last",
        "running",
        "stack",
        "steps",
        "take",
    ),
    "spec.wire_forms": (
        "Tokens",
        "Lines",
        "SixBits",
        "Echoes",
        "Scip",
        "Escaped",
        "HexCheck",
        "WireForm",
        "Decoded",
        "Problem",
        "TextRun",
        "NumberRun",
        "decode_runs",
    ),
    "plugins": ("hookimpl",),
    "transports.protocol": ("Format", "Transport", "LiveTransport", "Chunk", "Disconnected"),
}
_HOMES = {name: module for module, names in _NAMES.items() for name in names}

__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'lidarspec.spec' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"lidarspec.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)

"""lidarspec: every lidar's wire protocol written down once, and everything else a function of that.

    import lidarspec as ls

    s = ls.sensor("vendor-model")
    s.parse(frame), s.build("data", ...), s.decode(data).points(), s.scans(data), ls.open(source, s)

The names below are the public interface; plugins use nothing else. They are imported when they are first used, so that
``lidarspec --help`` is quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from lidarspec._version import __version__ as __version__
from lidarspec.spec import description as abilities

if TYPE_CHECKING:
    from lidarspec.columns.columns import Column as Column, Fields as Fields
    from lidarspec.device.async_device import AsyncDevice as AsyncDevice, open_async as open_async
    from lidarspec.device.device import Device as Device, open as open
    from lidarspec.device.session import Reply as Reply, Session as Session
    from lidarspec.errors import (
        CommandError as CommandError,
        LidarSpecError as LidarSpecError,
        MissingField as MissingField,
        OutOfRange as OutOfRange,
        ReplyTimeout as ReplyTimeout,
        SourceError as SourceError,
        SpecError as SpecError,
        UnknownCommand as UnknownCommand,
        UnknownField as UnknownField,
        UnknownFormat as UnknownFormat,
        UnknownFrame as UnknownFrame,
        UnknownOption as UnknownOption,
        UnknownSensor as UnknownSensor,
        UsageError as UsageError,
        WireError as WireError,
    )
    from lidarspec.framing.decoder import Decoder as Decoder
    from lidarspec.framing.results import Counters as Counters, Found as Found
    from lidarspec.packets.packets import Packets as Packets
    from lidarspec.plugins import hookimpl as hookimpl, sensor as sensor, sensors as sensors
    from lidarspec.points.cloud import PointCloud as PointCloud
    from lidarspec.scans.scans import LaserScan as LaserScan, Scan as Scan
    from lidarspec.spec.checksums import (
        Checksum as Checksum,
        Crc as Crc,
        Fold15 as Fold15,
        Sum as Sum,
        WordXor as WordXor,
        Xor as Xor,
        ZeroPadded as ZeroPadded,
    )
    from lidarspec.spec.description import Command as Command, Frame as Frame, Sensor as Sensor
    from lidarspec.spec.fields import Checksummed as Checksummed, Scaled as Scaled
    from lidarspec.spec.links import Serial as Serial, Tcp as Tcp, Udp as Udp
    from lidarspec.spec.results import Cartesian as Cartesian, Points as Points, Polar as Polar
    from lidarspec.spec.timing import (
        Clock as Clock,
        Every as Every,
        OnChange as OnChange,
        OnFlag as OnFlag,
        OnRewind as OnRewind,
        OnWrap as OnWrap,
        Sequence as Sequence,
    )
    from lidarspec.spec.vocabulary import (
        following as following,
        last as last,
        previous as previous,
        spread as spread,
        stack as stack,
        take as take,
        wrap as wrap,
    )
    from lidarspec.transports.protocol import Chunk as Chunk, Format as Format, Transport as Transport


_HOMES: dict[str, tuple[str, ...]] = {
    "spec.description": ("Sensor", "Frame", "Command"),
    "spec.links": ("Serial", "Udp", "Tcp"),
    "spec.timing": ("Clock", "Sequence", "OnWrap", "OnFlag", "OnChange", "OnRewind", "Every"),
    "spec.fields": ("Scaled", "Checksummed"),
    "spec.checksums": ("Checksum", "Crc", "Xor", "Sum", "WordXor", "Fold15", "ZeroPadded"),
    "spec.results": ("Points", "Polar", "Cartesian"),
    "columns.columns": ("Fields", "Column"),
    "spec.vocabulary": ("spread", "wrap", "following", "previous", "last", "stack", "take"),
    "transports.protocol": ("Format", "Transport", "Chunk"),
    "plugins": ("hookimpl", "sensor", "sensors"),
    "device.device": ("open", "Device"),
    "device.async_device": ("open_async", "AsyncDevice"),
    "framing.decoder": ("Decoder",),
    "framing.results": ("Counters", "Found"),
    "packets.packets": ("Packets",),
    "points.cloud": ("PointCloud",),
    "scans.scans": ("Scan", "LaserScan"),
    "device.session": ("Session", "Reply"),
    "errors": (
        "LidarSpecError",
        "SpecError",
        "WireError",
        "UsageError",
        "UnknownSensor",
        "UnknownFrame",
        "UnknownField",
        "UnknownCommand",
        "UnknownOption",
        "UnknownFormat",
        "MissingField",
        "OutOfRange",
        "SourceError",
        "CommandError",
        "ReplyTimeout",
    ),
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}

__all__ = list(_HOME)

abilities.install(lambda: importlib.import_module("lidarspec.spec.sensor").StandardEngine())


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'lidarspec' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"lidarspec.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)

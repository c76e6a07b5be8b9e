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

from lidarspec import abilities
from lidarspec._version import __version__ as __version__

if TYPE_CHECKING:
    from lidarspec.angles import (
        following as following,
        last as last,
        previous as previous,
        spread as spread,
        stack as stack,
        take as take,
        wrap as wrap,
    )
    from lidarspec.async_device import AsyncDevice as AsyncDevice, open_async as open_async
    from lidarspec.checksums import (
        Checksum as Checksum,
        Crc as Crc,
        Fold15 as Fold15,
        Sum as Sum,
        WordXor as WordXor,
        Xor as Xor,
        ZeroPadded as ZeroPadded,
    )
    from lidarspec.clouds import PointCloud as PointCloud
    from lidarspec.decoder import Counters as Counters, Decoder as Decoder, Found as Found
    from lidarspec.device import Device as Device, open as open
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
    from lidarspec.fields import Checksummed as Checksummed, Scaled as Scaled
    from lidarspec.files import Chunk as Chunk, Format as Format, Transport as Transport
    from lidarspec.frames.access import Fields as Fields
    from lidarspec.frames.columns import Column as Column
    from lidarspec.geometry import Cartesian as Cartesian, Points as Points, Polar as Polar
    from lidarspec.hookspecs import hookimpl as hookimpl
    from lidarspec.links import Serial as Serial, Tcp as Tcp, Udp as Udp
    from lidarspec.packets import Packets as Packets
    from lidarspec.plugins import sensor as sensor, sensors as sensors
    from lidarspec.replies import Reply as Reply
    from lidarspec.scans import LaserScan as LaserScan, Scan as Scan
    from lidarspec.session import Session as Session
    from lidarspec.spec import Command as Command, Frame as Frame, Sensor as Sensor
    from lidarspec.splits import (
        Clock as Clock,
        Every as Every,
        OnChange as OnChange,
        OnFlag as OnFlag,
        OnRewind as OnRewind,
        OnWrap as OnWrap,
        Sequence as Sequence,
    )


_HOMES = {
    # what a sensor is
    "spec": ("Sensor", "Frame", "Command"),
    "links": ("Serial", "Udp", "Tcp"),
    "splits": ("Clock", "Sequence", "OnWrap", "OnFlag", "OnChange", "OnRewind", "Every"),
    "fields": ("Scaled", "Checksummed"),
    "checksums": ("Checksum", "Crc", "Xor", "Sum", "WordXor", "Fold15", "ZeroPadded"),
    "geometry": ("Points", "Polar", "Cartesian"),
    "frames.access": ("Fields",),
    "frames.columns": ("Column",),
    "angles": ("spread", "wrap", "following", "previous", "last", "stack", "take"),
    "files": ("Format", "Transport", "Chunk"),
    "hookspecs": ("hookimpl",),
    # what can be done with it
    "plugins": ("sensor", "sensors"),
    "device": ("open", "Device"),
    "async_device": ("open_async", "AsyncDevice"),
    "decoder": ("Decoder", "Found", "Counters"),
    "packets": ("Packets",),
    "clouds": ("PointCloud",),
    "scans": ("Scan", "LaserScan"),
    "session": ("Session",),
    "replies": ("Reply",),
    # what can go wrong
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

abilities.install(lambda: importlib.import_module("lidarspec.engine").StandardEngine())


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'lidarspec' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"lidarspec.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)

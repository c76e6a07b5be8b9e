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
    from lidarspec.access import Fields as Fields
    from lidarspec.angles import (
        following as following,
    )
    from lidarspec.angles import (
        last as last,
    )
    from lidarspec.angles import (
        previous as previous,
    )
    from lidarspec.angles import (
        spread as spread,
    )
    from lidarspec.angles import (
        stack as stack,
    )
    from lidarspec.angles import (
        take as take,
    )
    from lidarspec.angles import (
        wrap as wrap,
    )
    from lidarspec.async_device import AsyncDevice as AsyncDevice
    from lidarspec.async_device import open_async as open_async
    from lidarspec.checksums import Checksum as Checksum
    from lidarspec.checksums import Crc as Crc
    from lidarspec.checksums import Fold15 as Fold15
    from lidarspec.checksums import Sum as Sum
    from lidarspec.checksums import WordXor as WordXor
    from lidarspec.checksums import Xor as Xor
    from lidarspec.clouds import PointCloud as PointCloud
    from lidarspec.columns import Column as Column
    from lidarspec.decoder import Counters as Counters
    from lidarspec.decoder import Decoder as Decoder
    from lidarspec.decoder import Found as Found
    from lidarspec.device import Device as Device
    from lidarspec.device import open as open
    from lidarspec.errors import (
        CommandError as CommandError,
    )
    from lidarspec.errors import (
        LidarSpecError as LidarSpecError,
    )
    from lidarspec.errors import (
        MissingField as MissingField,
    )
    from lidarspec.errors import (
        OutOfRange as OutOfRange,
    )
    from lidarspec.errors import (
        ReplyTimeout as ReplyTimeout,
    )
    from lidarspec.errors import (
        SourceError as SourceError,
    )
    from lidarspec.errors import (
        SpecError as SpecError,
    )
    from lidarspec.errors import (
        UnknownCommand as UnknownCommand,
    )
    from lidarspec.errors import (
        UnknownField as UnknownField,
    )
    from lidarspec.errors import (
        UnknownFormat as UnknownFormat,
    )
    from lidarspec.errors import (
        UnknownFrame as UnknownFrame,
    )
    from lidarspec.errors import (
        UnknownOption as UnknownOption,
    )
    from lidarspec.errors import (
        UnknownSensor as UnknownSensor,
    )
    from lidarspec.errors import (
        UsageError as UsageError,
    )
    from lidarspec.errors import (
        WireError as WireError,
    )
    from lidarspec.fields import Checksummed as Checksummed
    from lidarspec.fields import Scaled as Scaled
    from lidarspec.files import Format as Format
    from lidarspec.files import Transport as Transport
    from lidarspec.geometry import Cartesian as Cartesian
    from lidarspec.geometry import Points as Points
    from lidarspec.geometry import Polar as Polar
    from lidarspec.hookspecs import hookimpl as hookimpl
    from lidarspec.links import Serial as Serial
    from lidarspec.links import Tcp as Tcp
    from lidarspec.links import Udp as Udp
    from lidarspec.packets import Packets as Packets
    from lidarspec.plugins import sensor as sensor
    from lidarspec.plugins import sensors as sensors
    from lidarspec.replies import Reply as Reply
    from lidarspec.scans import LaserScan as LaserScan
    from lidarspec.scans import Scan as Scan
    from lidarspec.session import Session as Session
    from lidarspec.spec import Command as Command
    from lidarspec.spec import Frame as Frame
    from lidarspec.spec import Sensor as Sensor
    from lidarspec.splits import (
        Clock as Clock,
    )
    from lidarspec.splits import (
        Every as Every,
    )
    from lidarspec.splits import (
        OnChange as OnChange,
    )
    from lidarspec.splits import (
        OnFlag as OnFlag,
    )
    from lidarspec.splits import (
        OnRewind as OnRewind,
    )
    from lidarspec.splits import (
        OnWrap as OnWrap,
    )
    from lidarspec.splits import (
        Sequence as Sequence,
    )


_HOMES = {
    # what a sensor is
    "spec": ("Sensor", "Frame", "Command"),
    "links": ("Serial", "Udp", "Tcp"),
    "splits": ("Clock", "Sequence", "OnWrap", "OnFlag", "OnChange", "OnRewind", "Every"),
    "fields": ("Scaled", "Checksummed"),
    "checksums": ("Checksum", "Crc", "Xor", "Sum", "WordXor", "Fold15"),
    "geometry": ("Points", "Polar", "Cartesian"),
    "access": ("Fields",),
    "columns": ("Column",),
    "angles": ("spread", "wrap", "following", "previous", "last", "stack", "take"),
    "files": ("Format", "Transport"),
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

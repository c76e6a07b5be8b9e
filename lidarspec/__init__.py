"""lidarspec: every lidar's wire protocol written down once, and everything else a function of that.

    import lidarspec as ls

    s = ls.sensor("vendor-model")
    s.parse(frame), s.build("data", ...), s.decode(data).points(), s.scans(data), ls.open(source, s)

Here are the names of those who read a lidar; those who write a sensor find theirs in
`lidarspec.spec`, and every error is in `lidarspec.errors`. They are imported when they are first
used, so that ``lidarspec --help`` is quick.

The packages are stations on the way of a byte, and import each other in one direction; each says
what comes in and what goes out:

    spec        what a sensor is               packets     frames of one type, in order, in time
    frames      a frame and its bytes          points      packets as point clouds
    expressions columns given to plugins       scans       the end of a revolution
    framing     where frames are in bytes      device      a sensor on a source

    transports  where bytes come from, go to   simulation  a sensor that is not there, from its spec
    captures    pcap files of other tools      recording   all that came over a link, with its time
    explaining  a frame, byte by byte          detect      which sensor, what is wrong
    exports     a spec for other tools         drafting    the spec of an unknown format
    view        scans drawn                    formats     scans as files
    plugins     what is installed, its hooks   testing     the test kit for authors
    cli         the command line, on top

`Sensor` is in `sensor_operations`: a description from `spec` whose methods call these engines.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from lidarspec._version import __version__ as __version__

if TYPE_CHECKING:
    from lidarspec.device.async_device import AsyncDevice as AsyncDevice, open_async as open_async
    from lidarspec.device.device import Device as Device, open as open
    from lidarspec.device.session import Reply as Reply, Session as Session
    from lidarspec.errors import (
        CommandError as CommandError,
        LidarSpecError as LidarSpecError,
        SourceError as SourceError,
        SpecError as SpecError,
        UsageError as UsageError,
        WireError as WireError,
    )
    from lidarspec.explaining.explanation import explain as explain
    from lidarspec.exports import export as export
    from lidarspec.framing.decoder import Decoder as Decoder
    from lidarspec.framing.results import Counters as Counters, Found as Found
    from lidarspec.packets.imu import ImuSamples as ImuSamples
    from lidarspec.packets.packets import Packets as Packets
    from lidarspec.plugins import sensor as sensor, sensors as sensors
    from lidarspec.points.cloud import PointCloud as PointCloud
    from lidarspec.recording.recorders import Recorder as Recorder
    from lidarspec.scans.laserscan import LaserScan as LaserScan
    from lidarspec.scans.scan import Scan as Scan
    from lidarspec.scans.selection import Selection as Selection
    from lidarspec.sensor_operations import Sensor as Sensor
    from lidarspec.simulation.simulator import simulate as simulate

_NAMES = {
    "plugins": ("sensor", "sensors"),
    "sensor_operations": ("Sensor",),
    "device.device": ("open", "Device"),
    "device.async_device": ("open_async", "AsyncDevice"),
    "device.session": ("Session", "Reply"),
    "framing.decoder": ("Decoder",),
    "framing.results": ("Found", "Counters"),
    "packets.imu": ("ImuSamples",),
    "packets.packets": ("Packets",),
    "points.cloud": ("PointCloud",),
    "scans.laserscan": ("LaserScan",),
    "scans.scan": ("Scan",),
    "scans.selection": ("Selection",),
    "explaining.explanation": ("explain",),
    "exports": ("export",),
    "simulation.simulator": ("simulate",),
    "recording.recorders": ("Recorder",),
    "errors": (
        "LidarSpecError",
        "SpecError",
        "WireError",
        "UsageError",
        "SourceError",
        "CommandError",
    ),
}
_HOMES = {name: module for module, names in _NAMES.items() for name in names}

__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'lidarspec' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"lidarspec.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)

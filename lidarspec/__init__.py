"""Read, simulate and convert lidar data, from descriptions of wire protocols.

    import lidarspec as ls

    s = ls.sensor("vendor-model")
    s.parse(frame), s.build("data", ...), s.decode(data).points(), s.scans(data), ls.open(source, s)

This module has the functions and classes for reading a lidar. The classes for describing a sensor
are in `lidarspec.spec`, and the exceptions in `lidarspec.errors`. All are imported on first use, so
that ``lidarspec --help`` starts quickly.

These packages lead from the description of a sensor to its scans:

    spec         description of a sensor
    frames       parsing and building a frame
    framing      finding frames in bytes
    expressions  evaluation of plugin functions on columns of values
    packets      frames of one type as columns
    points       packets as point clouds
    scans        revolutions of points
    device       a sensor on a source

The other packages use them, or give them bytes:

    transports  serial ports, sockets, files   simulation  simulated sensors
    captures    pcap files of other tools      recording   received bytes with arrival times
    explaining  a frame, byte by byte          detect      identification, diagnosis
    exports     a spec for other tools         drafting    draft of an unknown format
    view        pictures of scans              formats     scans as files
    plugins     installed sensors and hooks    testing     test kit for sensors
    cli         command line

The class `Sensor`, a description with methods, is in `sensor_operations`.
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

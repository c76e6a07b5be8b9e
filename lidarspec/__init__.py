"""lidarspec: every lidar's wire protocol written down once, and everything else a function of that.

    >>> import lidarspec as ls
    >>> sorted(ls.sensors())[:1]
    ['cspc-coin-d4']

The names below are the public interface; plugins use nothing else.
"""

from __future__ import annotations

from lidarspec.angles import following, last, previous, spread, stack, take, wrap
from lidarspec.checksums import Checksum, Crc, Fold15, Sum, WordXor, Xor
from lidarspec.clouds import PointCloud
from lidarspec.columns import Column, Fields
from lidarspec.decoder import Counters, Decoder, Found
from lidarspec.errors import (
    CommandError,
    LidarSpecError,
    MissingField,
    OutOfRange,
    ReplyTimeout,
    SourceError,
    SpecError,
    UnknownCommand,
    UnknownField,
    UnknownFormat,
    UnknownFrame,
    UnknownOption,
    UnknownSensor,
    UsageError,
    WireError,
)
from lidarspec.fields import Checksummed, Scaled
from lidarspec.geometry import Cartesian, Points, Polar
from lidarspec.hookspecs import hookimpl
from lidarspec.links import Serial, Tcp, Udp
from lidarspec.packets import Packets
from lidarspec.plugins import sensor, sensors
from lidarspec.scans import LaserScan, Scan
from lidarspec.spec import Command, Frame, Sensor
from lidarspec.splits import Clock, Every, OnChange, OnFlag, OnRewind, OnWrap, Sequence

from lidarspec import engine as _engine  # noqa: F401  installs what the methods of Sensor call

__version__ = "0.1.0"

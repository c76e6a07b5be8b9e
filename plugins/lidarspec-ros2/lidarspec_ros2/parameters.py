"""The parameters of the node: one table, of which their declaration, their checks and their
documentation are made.

`Settings` are the values of one configuration, checked by what checks the words of the command
line, and refused in its words.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from lidarspec.cli.options import configure_sensor
from lidarspec.detect.identification import detect, find_declared_sensor
from lidarspec.device.device import Device
from lidarspec.device.settings import find_device
from lidarspec.errors import UsageError
from lidarspec.plugins import sensor as named_sensor
from lidarspec.points.mount import Mount
from lidarspec.recording.background_writer import TrafficLog
from lidarspec.scans.beams import Planes
from lidarspec.scans.laserscan import LaserScan
from lidarspec.scans.selection import Selection
from lidarspec.sensor_operations import Sensor
from lidarspec.transports.protocol import Transport


@dataclass(frozen=True)
class Parameter:
    """One parameter.

    Attributes:
        name: as ROS knows it.
        default: its value where nobody gives one, which says its type too.
        text: what it is.
        low, high: the span of a number.
        live: whether it is changed while the node is configured; the others are read on
            configuring.
    """

    name: str
    default: bool | int | float | str | list[str]
    text: str
    low: float | None = None
    high: float | None = None
    live: bool = False

    @property
    def kind(self) -> str:
        """Its type, in ROS's words."""
        kinds = {bool: "bool", int: "integer", float: "double", str: "string", list: "string_array"}
        return kinds[type(self.default)]


#: what the fields of `Mount` are.
_MOUNT = {
    **{
        axis: f"The sensor's origin, metres {way} of the carrier's."
        for axis, way in (("x", "forward"), ("y", "left"), ("z", "up"))
    },
    **{
        f"{turn}_deg": f"How it is turned about {axis}, degrees."
        for turn, axis in (("roll", "x"), ("pitch", "y"), ("yaw", "z"))
    },
    "inverted": "Whether it hangs upside down.",
}
_SIDE, _FAR, _TURN = 1e4, 1e6, 360.0
PARAMETERS = (
    Parameter(
        "source",
        "",
        "A port, an address, a file, a simulated sensor, or a name of lidarspec.toml: SOURCE of the"
        " command line.",
    ),
    Parameter(
        "sensor",
        "",
        "The sensor: an id, an alias, or a file; found out where it is left out. As -s.",
    ),
    Parameter("options", [""], "What the sensor is configured with: NAME=VALUE each. As -O."),
    Parameter("calibration", "", "The unit's own calibration, a file. As --calibration."),
    Parameter(
        "autostart",
        True,
        "Whether the node configures and activates itself; else a manager of lifecycles does.",
    ),
    *(
        Parameter(
            f"mount.{field.name}",
            getattr(Mount(), field.name),
            f"{_MOUNT[field.name]} Points are turned so, unless publish_tf is set.",
        )
        for field in fields(Mount)
    ),
    Parameter("frame_id", "laser", "The frame of the points.", live=True),
    Parameter(
        "publish_tf",
        False,
        "Whether the mount is published on /tf_static, from parent_frame to frame_id; points stay"
        " as measured.",
    ),
    Parameter("parent_frame", "base_link", "The frame of the carrier, for publish_tf."),
    Parameter(
        "beams",
        0,
        "Ranges of a LaserScan: always so many. 0: as many as the sensor has.",
        0,
        1 << 20,
        live=True,
    ),
    Parameter(
        "angle_min",
        0.0,
        "Where the first beam of scan looks, radians. The same as angle_max: all that is seen.",
        -10,
        10,
        live=True,
    ),
    Parameter(
        "angle_max",
        0.0,
        "Where the last beam of scan looks, radians; below angle_min it is a turn on.",
        -10,
        10,
        live=True,
    ),
    Parameter("range_min", 0.0, "Metres; nearer returns are none.", 0, _FAR, live=True),
    Parameter(
        "range_max",
        0.0,
        "Metres; farther returns are none. 0: no limit but the sensor's.",
        0,
        _FAR,
        live=True,
    ),
    Parameter(
        "scan_ring",
        -1,
        "Of a sensor of several rings the one that scan has. -1: none.",
        -1,
        1 << 16,
        live=True,
    ),
    Parameter(
        "scan_z_min",
        0.0,
        "Of a sensor of several rings scan has the points from this z on, metres.",
        -_SIDE,
        _SIDE,
        live=True,
    ),
    Parameter(
        "scan_z_max",
        0.0,
        "And up to this one. The same as scan_z_min: none.",
        -_SIDE,
        _SIDE,
        live=True,
    ),
    Parameter(
        "organized",
        True,
        "Whether clouds keep the sensor's rows and columns, with nan for what is missing.",
        live=True,
    ),
    Parameter(
        "use_device_time",
        True,
        "Whether stamps are by the sensor's clock, in the host's time; else by the arrival.",
        live=True,
    ),
    Parameter(
        "device_time_is_ros_time",
        False,
        "Whether the sensor's clock is right, by PTP or GPS: stamps are what it says.",
        live=True,
    ),
    Parameter(
        "time_offset",
        0.0,
        "Seconds added to every stamp: below 0 for a delay that is always there.",
        -_SIDE,
        _SIDE,
        live=True,
    ),
    Parameter("publish_packets", False, "Whether packets has what the sensor sends, as it comes."),
    Parameter(
        "qos",
        "best_effort",
        "Of the topics with data: best_effort, as for sensor data, or reliable.",
    ),
    Parameter(
        "replay_speed",
        1.0,
        "How many times faster than it was recorded a file is played. 0: as fast as it can be"
        " read.",
        0,
        1000,
    ),
)
NAMED = {parameter.name: parameter for parameter in PARAMETERS}
#: seconds from decoding to decoding when a scan is expected to end.
PERIOD = 0.002
#: the name of the node, unless it is renamed.
NODE_NAME = "lidar"
QUALITIES = ("best_effort", "reliable")


@dataclass(frozen=True)
class Settings:
    """The values of the parameters, by name.

    Raises:
        UsageError: for what cannot be, as far as it is known before a sensor is.
    """

    values: Mapping[str, Any]

    def __post_init__(self) -> None:
        if self["qos"] not in QUALITIES:
            raise UsageError(f"qos is {' or '.join(QUALITIES)}, not {self['qos']!r}")
        self.selection()
        if self["scan_z_min"] > self["scan_z_max"]:
            raise UsageError(
                f"from scan_z_min {self['scan_z_min']} up to scan_z_max {self['scan_z_max']} there"
                " is nothing"
            )

    def __getitem__(self, name: str) -> Any:
        return self.values[name]

    def selection(self) -> Selection:
        """What is wanted of each scan."""
        far = self["range_max"] or math.inf
        return Selection(
            ranges=(self["range_min"], far), beams=self["beams"] or None, frame_id=self["frame_id"]
        )

    def planes(self) -> Planes:
        """What makes planar scans."""
        first, seen = self["angle_min"], (self["angle_max"] - self["angle_min"]) % (2 * math.pi)
        low, high = self["scan_z_min"], self["scan_z_max"]
        return Planes(
            field=(first, first + seen) if seen else None,
            ring=self["scan_ring"] if self["scan_ring"] >= 0 else None,
            heights=(low, high) if low < high else None,
        )

    def narrowed(self, planar: LaserScan) -> LaserScan:
        """A planar scan that says of its ranges what is wanted of them, where that is less than the
        sensor has.
        """
        far = min(planar.range_max, self["range_max"] or math.inf)
        return replace(planar, range_min=max(planar.range_min, self["range_min"]), range_max=far)

    def sensor(self) -> Sensor:
        """The sensor, configured; detected where none is named.

        Raises:
            UsageError, WireError, SourceError: as the command line.
        """
        sensor = self._configured_sensor()
        return detect(self["source"]) if sensor is None else sensor

    def known_sensor(self) -> Sensor | None:
        """Return the sensor that the parameters or the source name; None if it must be detected.

        Raises:
            UsageError: for a sensor that is not installed, or an option that it does not take.
            SourceError: for a file that cannot be opened.
        """
        sensor = self._configured_sensor()
        return find_declared_sensor(self["source"]) if sensor is None else sensor

    def _configured_sensor(self) -> Sensor | None:
        """Return the sensor that the parameters name, with its options; None if they name none."""
        options = [option for option in self["options"] if option]
        sensor = configure_sensor(self["sensor"] or None, options, self["calibration"] or None)
        return None if sensor is None else named_sensor(sensor)

    def mount(self) -> Mount | None:
        """How the sensor is mounted: by the parameters, or else as `lidarspec.toml` says."""
        given = Mount(**{field.name: self[f"mount.{field.name}"] for field in fields(Mount)})
        device = find_device(self["source"])
        return given if given != Mount() else None if device is None else device.mount

    def device(self, record: Callable[[Transport], TrafficLog]) -> Device:
        """The open device.

        Args:
            record: makes what takes the packets, where they are published.

        Raises:
            LidarSpecError: as the command line.
        """
        if not self["source"]:
            raise UsageError("source is missing, such as /dev/ttyUSB0, udp:// or sim:ID")
        mount = None if self["publish_tf"] else self.mount()
        record_to = record if self["publish_packets"] else None
        return Device(self["source"], self.sensor(), record=record_to, period=PERIOD, mount=mount)

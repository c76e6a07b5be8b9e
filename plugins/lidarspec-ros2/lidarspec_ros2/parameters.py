"""The parameters of the node, and a table to declare, check and document them.

`Settings` has the values of all parameters at one time. The values are checked by the same
functions as the options of the command line, and with the same messages.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from lidarspec.cli.options import configure_sensor
from lidarspec.detect.identification import detect, find_declared_sensor
from lidarspec.device.device import Device
from lidarspec.device.named_devices import find_device
from lidarspec.errors import UsageError
from lidarspec.plugins import sensor as named_sensor
from lidarspec.points.mount import Mount
from lidarspec.recording.background_writer import TrafficLog
from lidarspec.scans.beams import PlanarScans
from lidarspec.scans.laserscan import LaserScan
from lidarspec.scans.selection import Selection
from lidarspec.sensor_operations import Sensor
from lidarspec.transports.protocol import Transport


@dataclass(frozen=True)
class Parameter:
    """One parameter.

    Attributes:
        default: the default value, which also defines the type.
        low, high: the limits of a number.
        live: whether a change takes effect without configuring the node again.
    """

    name: str
    default: bool | int | float | str | list[str]
    text: str
    low: float | None = None
    high: float | None = None
    live: bool = False

    @property
    def kind(self) -> str:
        """The type, as ROS names it."""
        kinds = {bool: "bool", int: "integer", float: "double", str: "string", list: "string_array"}
        return kinds[type(self.default)]


#: Descriptions of the fields of `Mount`.
_MOUNT_TEXTS = {
    **{
        axis: f"Distance of the sensor {way} the origin of the robot or vehicle, metres."
        for axis, way in (("x", "in front of"), ("y", "left of"), ("z", "above"))
    },
    **{
        f"{turn}_deg": f"Rotation of the sensor about the axis {axis}, degrees."
        for turn, axis in (("roll", "x"), ("pitch", "y"), ("yaw", "z"))
    },
    "inverted": "Whether the sensor is mounted upside down.",
}
_MAX_OFFSET = 1e4  # metres, or seconds
_MAX_RANGE_M = 1e6
PARAMETERS = (
    Parameter(
        "source",
        "",
        "The source, as on the command line: a port, an address, a file, a simulated sensor, or"
        " a name in lidarspec.toml.",
    ),
    Parameter(
        "sensor",
        "",
        "Id, alias or file of the sensor, as with -s. If empty, the sensor is detected.",
    ),
    Parameter("options", [""], "Options of the sensor, each NAME=VALUE, as with -O."),
    Parameter("calibration", "", "Calibration file of this unit, as with --calibration."),
    Parameter(
        "autostart",
        True,
        "Configure and activate the node when it starts. If false, a lifecycle manager does this.",
    ),
    *(
        Parameter(
            f"mount.{field.name}",
            getattr(Mount(), field.name),
            _MOUNT_TEXTS[field.name],
        )
        for field in fields(Mount)
    ),
    Parameter("frame_id", "laser", "The frame_id in the header of all messages.", live=True),
    Parameter(
        "publish_tf",
        False,
        "Publish the mount as the transform from parent_frame to frame_id on /tf_static, instead"
        " of transforming the points.",
    ),
    Parameter("parent_frame", "base_link", "The frame_id of the robot or vehicle, for publish_tf."),
    Parameter(
        "beams",
        0,
        "Number of ranges in each LaserScan. 0: the number that the sensor declares.",
        0,
        1 << 20,
        live=True,
    ),
    Parameter(
        "angle_min",
        0.0,
        "First angle of each LaserScan, radians. If it equals angle_max, all angles are published.",
        -10,
        10,
        live=True,
    ),
    Parameter(
        "angle_max",
        0.0,
        "Last angle of each LaserScan, radians. If it is below angle_min, one revolution is added"
        " to it, so that the angles can cross pi.",
        -10,
        10,
        live=True,
    ),
    Parameter(
        "returns",
        "all",
        "Which return of each firing to keep: first, last, strongest or all.",
        live=True,
    ),
    Parameter(
        "range_min",
        0.0,
        "Shortest range, metres. Nearer returns are dropped.",
        0,
        _MAX_RANGE_M,
        live=True,
    ),
    Parameter(
        "range_max",
        0.0,
        "Longest range, metres. Farther returns are dropped. 0: the sensor's range limit.",
        0,
        _MAX_RANGE_M,
        live=True,
    ),
    Parameter(
        "scan_ring",
        -1,
        "The ring that is published as LaserScan, if the sensor has several rings. -1: the points"
        " between scan_z_min and scan_z_max; if these are equal, only planar sensors have LaserScan"
        " messages.",
        -1,
        1 << 16,
        live=True,
    ),
    Parameter(
        "scan_z_min",
        0.0,
        "Lowest z of the points in each LaserScan, metres. Ignored for sensors with a single ring.",
        -_MAX_OFFSET,
        _MAX_OFFSET,
        live=True,
    ),
    Parameter(
        "scan_z_max",
        0.0,
        "Highest z of the points in each LaserScan, metres. If it equals scan_z_min, both limits"
        " are ignored.",
        -_MAX_OFFSET,
        _MAX_OFFSET,
        live=True,
    ),
    Parameter(
        "organized",
        True,
        "Publish clouds in rows and columns. A missing point is nan.",
        live=True,
    ),
    Parameter(
        "use_device_time",
        True,
        "Stamp messages with the sensor's time, converted to the host's time. If false, with the"
        " arrival time.",
        live=True,
    ),
    Parameter(
        "device_time_is_ros_time",
        False,
        "Stamp messages with the sensor's time, without conversion. PTP or GPS must set the"
        " sensor's clock. Ignored if use_device_time is false.",
        live=True,
    ),
    Parameter(
        "time_offset",
        0.0,
        "Seconds that are added to every stamp. A negative number compensates for a constant"
        " delay.",
        -_MAX_OFFSET,
        _MAX_OFFSET,
        live=True,
    ),
    Parameter(
        "publish_packets", False, "Publish each received packet, unchanged, on the topic packets."
    ),
    Parameter(
        "qos",
        "best_effort",
        "Reliability of the topics with data: best_effort or reliable.",
    ),
    Parameter(
        "replay_speed",
        1.0,
        "Replay speed of a file. 1: the recorded speed. 0: as fast as possible.",
        0,
        1000,
    ),
)
NAMED = {parameter.name: parameter for parameter in PARAMETERS}
DECODING_PERIOD_S = 0.002  # near the expected end of a scan
#: The default name of the node.
NODE_NAME = "lidar"
QOS_NAMES = ("best_effort", "reliable")


@dataclass(frozen=True)
class Settings:
    """The values of the parameters, by name.

    Raises:
        UsageError: if a value is invalid for every sensor. Values that only some sensors accept
            are checked later.
    """

    values: Mapping[str, Any]

    def __post_init__(self) -> None:
        if self["qos"] not in QOS_NAMES:
            raise UsageError(f"qos: expected {' or '.join(QOS_NAMES)}, got {self['qos']!r}")
        self.make_selection()
        if self["scan_z_min"] > self["scan_z_max"]:
            raise UsageError(
                f"scan_z_min {self['scan_z_min']} is above scan_z_max {self['scan_z_max']}"
            )

    def __getitem__(self, name: str) -> Any:
        return self.values[name]

    def make_selection(self) -> Selection:
        """Return the selection of points in each scan."""
        far = self["range_max"] or math.inf
        return Selection(
            ranges=(self["range_min"], far),
            returns=self["returns"],
            beams=self["beams"] or None,
            frame_id=self["frame_id"],
        )

    def make_planar_scans(self) -> PlanarScans:
        """Return the projection of clouds to planar scans, as set by the parameters."""
        first = self["angle_min"]
        width = (self["angle_max"] - self["angle_min"]) % (2 * math.pi)
        low = self["scan_z_min"]
        high = self["scan_z_max"]
        return PlanarScans(
            field=(first, first + width) if width else None,
            ring=self["scan_ring"] if self["scan_ring"] >= 0 else None,
            heights=(low, high) if low < high else None,
        )

    def narrow_range_limits(self, planar: LaserScan) -> LaserScan:
        """Return a planar scan with its range limits narrowed by the parameters."""
        far = min(planar.range_max, self["range_max"] or math.inf)
        return replace(planar, range_min=max(planar.range_min, self["range_min"]), range_max=far)

    def find_sensor(self) -> Sensor:
        """Return the sensor with its options; detect it if the parameters do not name one.

        Raises:
            UsageError, WireError, SourceError: if the sensor is not installed, does not accept an
                option, or cannot be detected.
        """
        sensor = self._configure_sensor()
        return detect(self["source"]) if sensor is None else sensor

    def find_known_sensor(self) -> Sensor | None:
        """Return the sensor that the parameters or the source name; None if neither does.

        Raises:
            UsageError: if a sensor is not installed, or does not accept an option.
            SourceError: if a file cannot be opened.
        """
        sensor = self._configure_sensor()
        return find_declared_sensor(self["source"]) if sensor is None else sensor

    def _configure_sensor(self) -> Sensor | None:
        """Return the sensor in the parameters, with its options; None if unset."""
        options = [option for option in self["options"] if option]
        sensor = configure_sensor(self["sensor"] or None, options, self["calibration"] or None)
        return None if sensor is None else named_sensor(sensor)

    def find_mount(self) -> Mount | None:
        """Return the mount from the parameters, else from `lidarspec.toml`; None if unset."""
        mount = Mount(**{field.name: self[f"mount.{field.name}"] for field in fields(Mount)})
        if mount != Mount():
            return mount
        device = find_device(self["source"])
        return None if device is None else device.mount

    def open_device(self, make_log: Callable[[Transport], TrafficLog]) -> Device:
        """Open the source that the parameter `source` names, and return the device.

        Args:
            make_log: a function that returns the log for the received packets; called only if the
                parameter `publish_packets` is set.

        Raises:
            LidarSpecError: if a parameter is invalid, or the source cannot be opened.
        """
        if not self["source"]:
            raise UsageError(
                "the parameter source is missing: set it, for example to /dev/ttyUSB0, udp:// or"
                " sim:ID"
            )
        mount = None if self["publish_tf"] else self.find_mount()
        record = make_log if self["publish_packets"] else None
        return Device(
            self["source"],
            self.find_sensor(),
            record=record,
            period=DECODING_PERIOD_S,
            mount=mount,
        )

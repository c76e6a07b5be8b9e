"""The start of a sensor's reference page: commands to copy, a program, and installation notes.

The SOURCE in the commands is typical for the links of the sensor. The notes of a sensor are the
file `notes/ID.md` in the package of its plugin.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

from lidarspec.entry_points import SENSORS, entry_points
from lidarspec.frames.wire_table import wire_table
from lidarspec.spec import Sensor
from lidarspec.spec.links import Serial, Tcp, Udp


def list_commands(sensor: Sensor, source: str = "") -> list[tuple[str, str]]:
    """Return the first shell commands to use with a sensor, as (command, purpose).

    Args:
        source: the SOURCE in the commands; by default a typical one for the links of the sensor.
    """
    source = source or typical_source(sensor)
    sensor_option = f"-s {sensor.id}"
    detect = (f"lidarspec detect {source}", "identify the sensor")
    record = (f"lidarspec record {source} {sensor_option} -t 10s -o a.lsr", "record ten seconds")
    if not sensor.has_points:
        frame = sensor.main_frames[0]
        return [
            detect,
            (f"lidarspec read {source} {sensor_option} -f {frame}", f"print {frame} frames"),
            record,
            (
                f"lidarspec convert a.lsr a.csv -f {frame}",
                "write the fields of these frames as a table",
            ),
            ("lidarspec stats a.lsr", "count frames and losses"),
        ]
    return [
        detect,
        (f"lidarspec view {source} {sensor_option}", "draw its scans; with --web, on a web page"),
        record,
        ("lidarspec convert a.lsr a.foxglove.mcap", "open the result in Foxglove"),
        (f"lidarspec ros2 {source} {sensor_option}", "publish it in ROS 2"),
    ]


def write_python(sensor: Sensor, source: str = "") -> str:
    """Return a Python program that prints the points of one scan.

    For a sensor without points, the program prints a field of its first frame type.
    """
    source = source or typical_source(sensor)
    if not sensor.has_points:
        frame = sensor.main_frames[0]
        rows = list(wire_table(sensor.frames[frame]))
        field = next((row.field for row in rows if row.unit), rows[0].field)
        return f"""\
import lidarspec as ls

with ls.open("{source}", "{sensor.id}") as device:
    packets = next(device.packets("{frame}"))
print(packets["{field}"])    # float64, one value for each packet"""
    return f"""\
import lidarspec as ls

with ls.open("{source}", "{sensor.id}") as device:
    scan = next(device.scans())
print(scan.points.xyz)    # float32, shape (N, 3), in metres"""


def typical_source(sensor: Sensor) -> str:
    """Return a SOURCE for the data link of a sensor, with an address to be replaced."""
    link = sensor.links["data"]
    if isinstance(link, Serial):
        return "/dev/ttyUSB0"
    if isinstance(link, Tcp) and link.reported:
        return "tcp://192.168.0.10"
    if isinstance(link, Tcp):
        return f"tcp://192.168.0.10:{link.port}"
    is_found_by_broadcast = any(
        isinstance(other, Udp) and other.broadcast for other in sensor.links.values()
    )
    if sensor.on_open and not is_found_by_broadcast:
        return "udp://?src=192.168.0.10"
    return "udp://"


def read_notes(sensor_id: str) -> str:
    """Return the notes on an installed sensor from its plugin; "" if it has no notes."""
    for entry in entry_points(SENSORS):
        if entry.name != sensor_id:
            continue
        package = importlib.util.find_spec(entry.module.partition(".")[0])
        for folder in (package and package.submodule_search_locations) or ():
            path = Path(folder, "notes", f"{sensor_id}.md")
            if path.is_file():
                return path.read_text(encoding="utf-8").strip()
    return ""

"""Write logs for Foxglove: scans as Foxglove Protobuf messages in an MCAP file.

The topic /points has each scan as foxglove.PointCloud. For planar sensors, /scan has each scan as
foxglove.LaserScan.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from lidarspec.errors import UsageError
from lidarspec.formats.bags import CHUNK_BYTES, TOPICS
from lidarspec.formats.messages import CLOUD, SCAN, describe_fields, make_records
from lidarspec.optional_libraries import import_library
from lidarspec.points.cloud import PointCloud
from lidarspec.scans.beams import PlanarScans
from lidarspec.scans.laserscan import LaserScan
from lidarspec.scans.scan import Scan
from lidarspec.transports.protocol import Format

#: The number of each NumPy type in foxglove.PackedElementField.
FIELD_TYPES = {"u1": 1, "b1": 1, "i1": 2, "u2": 3, "i2": 4, "u4": 5, "i4": 6, "f4": 7, "f8": 8}


def write_foxglove(path: Path, scans: Iterable[Scan], *, every_point: bool) -> None:
    """Write an MCAP file.

    Raises:
        UsageError: for a stamp before 1970.
    """
    mcap = import_library("mcap.writer", "foxglove")
    support = import_library("mcap_protobuf.writer", "foxglove")
    planes = PlanarScans()
    units = dict[str, str]()
    with path.open("wb") as file:
        log = support.Writer(file, chunk_size=CHUNK_BYTES, compression=mcap.CompressionType.NONE)
        for scan in scans:
            if scan.stamp_ns < 0:
                raise UsageError(
                    f"the stamp of a scan is {scan.stamp_ns} ns, which is before 1970: an MCAP file"
                    " cannot store it"
                )
            units |= {name: unit for name, unit in scan.points.units.items() if unit}
            messages = {TOPICS[CLOUD]: _make_cloud(scan.points, every_point=every_point)}
            if (planar := planes.project(scan)) is not None:
                messages[TOPICS[SCAN]] = _make_planar(
                    planar, has_intensity=scan.points.intensity is not None
                )
            for topic, message in messages.items():
                message.timestamp.FromNanoseconds(scan.stamp_ns)
                message.frame_id = scan.frame_id
                message.pose.orientation.w = 1
                log.write_message(topic, message, scan.stamp_ns, scan.stamp_ns)
        if units:
            log.add_metadata("units", units)
        log.finish()


def _make_cloud(cloud: PointCloud, *, every_point: bool) -> Any:
    points = make_records(cloud, every_point=every_point)
    fields = [
        {"name": name, "offset": offset, "type": FIELD_TYPES[kind]}
        for name, offset, kind in describe_fields(cloud, points)
    ]
    message = import_library("foxglove_schemas_protobuf.PointCloud_pb2", "foxglove").PointCloud
    return message(point_stride=points.itemsize, fields=fields, data=points.tobytes())


def _make_planar(scan: LaserScan, *, has_intensity: bool) -> Any:
    message = import_library("foxglove_schemas_protobuf.LaserScan_pb2", "foxglove").LaserScan
    intensities = scan.intensities if has_intensity else ()
    return message(
        start_angle=scan.angle_min,
        end_angle=scan.angle_max,
        ranges=scan.ranges,
        intensities=intensities,
    )


FOXGLOVE = Format(
    ".foxglove.mcap", "an MCAP file with Foxglove's messages", write_foxglove, ("beams", "frame-id")
)

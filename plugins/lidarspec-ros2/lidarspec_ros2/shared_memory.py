"""Enlarge the shared memory of Fast DDS for the clouds of the sensor.

Fast DDS passes messages to other processes on the same computer in a segment of shared memory,
which the publisher owns. The segment has 512 KiB, unless a profile sets another size. A cloud of
several megabytes does not fit into this segment: it is sent in fragments, and later fragments
overwrite fragments that were not read yet. Most of these clouds are lost if subscribers use the
reliability "best effort". The node therefore provides a profile with a larger segment.

An environment variable names the file with the profile. Fast DDS reads this file once, when the
first participant of a process is created. `use_profile` is a context manager that sets the variable
while the node creates this participant.

A profile replaces the default transports of Fast DDS, so it has to list them: shared memory and
UDP.
"""

from __future__ import annotations

import contextlib
import math
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from lidarspec.errors import LidarSpecError
from lidarspec.formats.messages import make_records
from lidarspec.scans.limits import longest_scan_s
from lidarspec.sensor_operations import Sensor
from lidarspec.simulation.simulator import frame_simulation, make_opening_frame, simulate

#: The environment variable that names the file of profiles, for Fast DDS 3 (Kilted and later). The
#: next constant is the variable for Fast DDS 2.
PROFILE_VARIABLE = "FASTDDS_DEFAULT_PROFILES_FILE"
OLD_PROFILE_VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
#: Variables with which users configure the transports of Fast DDS.
USER_VARIABLES = (
    PROFILE_VARIABLE,
    OLD_PROFILE_VARIABLE,
    "FASTDDS_BUILTIN_TRANSPORTS",
    "FASTDDS_ENVIRONMENT_FILE",
    "RMW_FASTRTPS_USE_QOS_FROM_XML",
)
#: The files of profiles that Fast DDS reads from the working directory.
USER_FILES = ("DEFAULT_FASTDDS_PROFILES.xml", "DEFAULT_FASTRTPS_PROFILES.xml")
DEFAULT_SEGMENT_BYTES = 512 * 1024
MIN_SEGMENT_BYTES = 4_000_000
SEGMENT_STEP_BYTES = 1_000_000
#: Minimum number of clouds that must fit into a segment, because one cloud is read while the next
#: is written.
MIN_CLOUDS = 2
#: Number of single-return clouds that fit into a new segment; FEWER_CLOUDS if memory is short. With
#: dual return, half as many clouds fit.
CLOUDS = 8
FEWER_CLOUDS = 4
#: The assumed size of clouds if no sensor is named: 78,000 points a scan.
ASSUMED_CLOUD_BYTES = 2_500_000
#: Amount of free shared memory that is needed, in segments, because the node may open a second
#: participant.
FREE_SEGMENTS = 2
SHARED_MEMORY_DIR = "/dev/shm"
#: Number of packets from which the size of a cloud is calculated if the scan rate is declared.
PROBED_PACKETS = 16
#: Number of seconds, and maximum number of packets, that are simulated to find a scan if no scan
#: rate is declared.
PROBED_S = 0.25
MAX_PROBED_PACKETS = 1000


@dataclass(frozen=True)
class SharedMemory:
    """The node's settings for the shared memory of Fast DDS.

    Attributes:
        segment_bytes: size of the segment in the node's profile; 0 if the node provides no profile.
        max_cloud_bytes: the largest cloud that reaches subscribers with the reliability "best
            effort", in bytes; None if unknown.
        notice: a message for the log about the node's profile; "" if there is no profile.
        warning: a message for the log that clouds may be lost; "" if there is no such danger.
    """

    segment_bytes: int = 0
    max_cloud_bytes: int | None = None
    notice: str = ""
    warning: str = ""


def choose_shared_memory(
    rmw: str, find_sensor: Callable[[], Sensor | None], *, is_serial: bool
) -> SharedMemory:
    """Return the settings of shared memory for the clouds of a sensor.

    Args:
        rmw: identifier of the middleware, for example rmw_fastrtps_cpp.
        find_sensor: a function that returns the sensor, or None if the sensor is not known yet.
        is_serial: whether the sensor is on a serial line, which is too slow for large clouds.
    """
    free = find_free_bytes()
    if free is None or not rmw.startswith("rmw_fastrtps") or has_user_profile():
        return SharedMemory()
    try:
        sensor = find_sensor()
        cloud_bytes = None if sensor is None else find_largest_cloud_bytes(sensor)
    except LidarSpecError:  # the node reports it when it opens the sensor
        cloud_bytes = None
    if cloud_bytes is None and is_serial:
        cloud_bytes = 0
    return _fit_segment(cloud_bytes, free)


def _fit_segment(cloud_bytes: int | None, free: int) -> SharedMemory:
    """Choose the settings for the clouds of a sensor.

    Args:
        cloud_bytes: size of the largest cloud; None if unknown.
        free: free shared memory of the system, in bytes.
    """
    assumed = ASSUMED_CLOUD_BYTES if cloud_bytes is None else cloud_bytes
    if MIN_CLOUDS * assumed <= DEFAULT_SEGMENT_BYTES:
        return SharedMemory(max_cloud_bytes=DEFAULT_SEGMENT_BYTES // MIN_CLOUDS)
    size = format_megabytes(assumed)
    for clouds in (CLOUDS, FEWER_CLOUDS):
        segment_bytes = _round_segment_bytes(clouds * assumed)
        if free >= FREE_SEGMENTS * segment_bytes:
            reason = (
                ""
                if cloud_bytes is not None
                else " (assumed, because the size of this sensor's clouds is unknown)"
            )
            notice = (
                f"Fast DDS was configured to use {format_megabytes(segment_bytes)} of shared"
                f" memory, for clouds of up to {size}{reason}; to use your own profile instead, set"
                f" {find_profile_variable()} to the path of its file"
            )
            return SharedMemory(segment_bytes, segment_bytes // MIN_CLOUDS, notice)
    warning = (
        f"{SHARED_MEMORY_DIR} has only {format_megabytes(free)} free, but"
        f" {format_megabytes(FREE_SEGMENTS * segment_bytes)} are required: Fast DDS uses its"
        f" default transports, and clouds of {size} may be lost with best effort. Set"
        " qos:=reliable, or, in a container, use docker run --shm-size=512m or --ipc=host"
    )
    return SharedMemory(warning=warning)


def _round_segment_bytes(size: int) -> int:
    """Return a round size of a segment, bytes."""
    return max(MIN_SEGMENT_BYTES, math.ceil(size / SEGMENT_STEP_BYTES) * SEGMENT_STEP_BYTES)


def format_megabytes(size: int) -> str:
    """Return a number of bytes as text in megabytes, for example "2.5 MB"."""
    return f"{size / 1e6:.1f} MB".replace(".0 ", " ")


def find_free_bytes() -> int | None:
    """Return the bytes of free shared memory; None if the system does not report it."""
    try:
        status = os.statvfs(SHARED_MEMORY_DIR)
    except (AttributeError, OSError):
        return None
    return status.f_bavail * status.f_frsize


def has_user_profile() -> bool:
    """Return whether the user has configured the transports of Fast DDS."""
    has_variable = any(name in os.environ for name in USER_VARIABLES)
    return has_variable or any(Path(name).exists() for name in USER_FILES)


def find_profile_variable() -> str:
    """Return the name of the environment variable from which Fast DDS reads its profile."""
    libraries = Path("/proc/self/maps").read_text(encoding="utf-8")
    return OLD_PROFILE_VARIABLE if "libfastrtps.so" in libraries else PROFILE_VARIABLE


def find_largest_cloud_bytes(sensor: Sensor) -> int | None:
    """Return the size in bytes of the largest cloud of a sensor, from simulated packets.

    The result is None if the description of the sensor does not contain the rate of its packets.

    Raises:
        LidarSpecError: if the sensor cannot be simulated.
    """
    interval_s = frame_simulation(sensor, sensor.data_frame).interval * 1e-9
    if not interval_s:
        return None
    scan_s = longest_scan_s(sensor)
    if scan_s is None:
        count = min(math.ceil(PROBED_S / interval_s), MAX_PROBED_PACKETS)
        scans = sensor.scans(_simulate_packets(sensor, count))
        return max(
            (make_records(scan.points, every_point=True).nbytes for scan in scans), default=0
        )
    cloud = sensor.decode(_simulate_packets(sensor, PROBED_PACKETS)).points()
    packet_bytes = make_records(cloud, every_point=True).nbytes / PROBED_PACKETS
    return math.ceil(packet_bytes * scan_s / interval_s)


def _simulate_packets(sensor: Sensor, count: int) -> bytes | list[bytes]:
    """Return the first packets of a simulated sensor."""
    frames = [frame for frame in (make_opening_frame(sensor), *simulate(sensor, count)) if frame]
    return frames if sensor.datagrams else b"".join(frames)


def make_profile(segment_bytes: int, environment: Mapping[str, str]) -> str:
    """Return a profile of Fast DDS for the transports of this process, as XML.

    Args:
        segment_bytes: size of the segment of shared memory.
        environment: the environment variables, which may limit discovery to this computer.
    """
    # If discovery is limited to this computer, ROS adds its own UDP transport, and Fast DDS sends
    # with the first of two transports of the same kind.
    udp = "" if _is_local(environment) else "<transport_id>udp</transport_id>"
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<dds>
  <profiles xmlns="http://www.eprosima.com">
    <transport_descriptors>
      <transport_descriptor>
        <transport_id>shared_memory</transport_id>
        <type>SHM</type>
        <segment_size>{segment_bytes}</segment_size>
      </transport_descriptor>
      <transport_descriptor>
        <transport_id>udp</transport_id>
        <type>UDPv4</type>
      </transport_descriptor>
    </transport_descriptors>
    <participant profile_name="lidarspec" is_default_profile="true">
      <rtps>
        <userTransports><transport_id>shared_memory</transport_id>{udp}</userTransports>
        <useBuiltinTransports>false</useBuiltinTransports>
      </rtps>
    </participant>
  </profiles>
</dds>
"""


def _is_local(environment: Mapping[str, str]) -> bool:
    """Return whether discovery is limited to this computer."""
    discovery_range = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper()
    return environment.get("ROS_LOCALHOST_ONLY") == "1" or discovery_range == "LOCALHOST"


@contextlib.contextmanager
def use_profile(memory: SharedMemory) -> Iterator[None]:
    """Make Fast DDS read the profile when it creates its first participant.

    The participant has to be created within the context.
    """
    if not memory.segment_bytes:
        yield
        return
    with tempfile.TemporaryDirectory(prefix="lidarspec-") as folder:
        file = Path(folder, "profile.xml")
        file.write_text(make_profile(memory.segment_bytes, os.environ), encoding="utf-8")
        name = find_profile_variable()
        os.environ[name] = str(file)
        try:
            yield
        finally:
            del os.environ[name]

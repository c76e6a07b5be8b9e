"""Demonstrate a session with a simulated sensor, end to end.

The sensor is connected to a real line. It is started, read, recorded and read again.

A serial sensor uses a pseudo-terminal, or a TCP port if the system has none; others send UDP
datagrams on loopback. The line adds errors. The recording is decoded again, and has to give the
same points.
"""

from __future__ import annotations

import hashlib
import itertools
import socket
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lidarspec.device.device import Device, open as open_device
from lidarspec.device.session import Reply
from lidarspec.errors import SourceError
from lidarspec.framing.results import Counters
from lidarspec.scans.scan import Scan
from lidarspec.sensor_operations import Sensor
from lidarspec.simulation.device import SimulatedDevice
from lidarspec.simulation.faults import Faults
from lidarspec.spec.links import Serial
from lidarspec.transports.base import data_link
from lidarspec.transports.destinations import simulated_outlet
from lidarspec.transports.outlets import LOCALHOST, has_terminals
from lidarspec.transports.serving import Served

#: additional seconds that the scans may take.
PATIENCE = 15.0
#: seconds without a scan after which all sent data has arrived.
QUIET = 0.2


@dataclass(frozen=True, eq=False)
class Demonstration:
    """The results of the demonstration.

    Attributes:
        sensor, place: the sensor, and its address.
        replies: of the commands that opened it.
        scans: the received scans; the last one is complete.
        stats: the decoder's counters.
        sent, intact: numbers of packets sent, and of those without errors after the line.
        digest: SHA-256 of the points of the complete scans.
        again: SHA-256 of the points of the recording.
        recorded: bytes in the recording.
    """

    sensor: Sensor
    place: str
    replies: tuple[Reply, ...]
    scans: tuple[Scan, ...]
    stats: Counters
    sent: int
    intact: int
    digest: str
    again: str
    recorded: int


def demonstrate(
    sensor: Sensor, *, turns: int = 5, errors: float = 0.01, seed: int = 1
) -> Demonstration:
    """Run a simulated sensor until a number of complete scans has arrived.

    Args:
        turns: the number of complete scans.
        errors: share of the bytes of a stream that are damaged, at most one in each of the longest
            frames; for datagrams, the share of lost ones.

    Raises:
        SourceError: if no line is available, or the scans do not arrive.
        PluginError: if a function of the plugin raises.
    """
    longest = sensor.frames[sensor.data_frame].max_length
    if sensor.datagrams:
        faults = Faults(loss=errors)
    else:
        faults = Faults(errors=min(errors, 1 / longest))
    simulated = SimulatedDevice(sensor, seed=seed, faults=faults)
    with tempfile.TemporaryDirectory(prefix="lidarspec-demo-") as folder:
        path = Path(folder) / "demo.lsr"
        place, replies, scans, stats = _run_live(sensor, simulated, path, turns)
        line = simulated.lines["data"]
        recorded = path.stat().st_size
        with open_device(path, sensor) as recording:
            again = digest(
                list(itertools.islice((scan for scan in recording.scans() if scan.whole), turns))
            )
    digested = digest([scan for scan in scans if scan.whole])
    return Demonstration(
        sensor, place, replies, scans, stats, line.sent, line.intact, digested, again, recorded
    )


def digest(scans: Sequence[Scan]) -> str:
    """Return the SHA-256 of the coordinates, ranges and intensities of scans."""
    hasher = hashlib.sha256()
    for scan in scans:
        points = scan.points
        for column in (points.xyz, points.range, points.intensity):
            hasher.update(b"" if column is None else column.tobytes())
    return hasher.hexdigest()


def _run_live(
    sensor: Sensor, simulated: SimulatedDevice, path: Path, turns: int
) -> tuple[str, tuple[Reply, ...], tuple[Scan, ...], Counters]:
    """Return the address, replies, scans and counters of a live session.

    Everything that arrives is recorded.
    """
    if sensor.datagrams:
        port = _free_port()
        at = f"udp://{LOCALHOST}:{port}"
        with (
            open_device(at, sensor, start=False, record=path) as device,
            Served(simulated, simulated_outlet(sensor, at)) as served,
        ):
            return at, *_read(device, served, turns)
    if has_terminals() and data_link(sensor, Serial):
        to = "pty"
    else:
        to = f"tcp://{LOCALHOST}:0"
    with (
        Served(simulated, simulated_outlet(sensor, to), patient=True) as served,
        open_device(served.path, sensor, start=False, record=path) as device,
    ):
        return served.path, *_read(device, served, turns)


def _read(
    device: Device, served: Served, turns: int
) -> tuple[tuple[Reply, ...], tuple[Scan, ...], Counters]:
    replies = tuple(device.send(name) for name in device.sensor.on_open)
    limit = time.monotonic() + PATIENCE + turns
    scans: list[Scan] = []
    for scan in device.scans(wait=0.1):
        scans += [scan] if scan is not None else []
        if sum(one.whole for one in scans) >= turns:
            served.stop_sending()
            while device.newest(QUIET) is not None:
                pass  # data that is still on the way counts as sent, so it is read too
            break
        if time.monotonic() > limit:
            break
    if (failure := device.stats.failure(device.sensor.id)) is not None:
        raise failure
    if sum(one.whole for one in scans) >= turns:
        return replies, tuple(scans), device.stats
    number = f"{len(scans)} scans in {PATIENCE + turns:g} s, and not {turns}"
    raise SourceError(f"the simulated {device.sensor.id} gave {number}: {device.stats}")


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((LOCALHOST, 0))
        return int(probe.getsockname()[1])

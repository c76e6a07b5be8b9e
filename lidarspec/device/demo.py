"""Demonstrate a complete session with a simulated sensor.

A simulated sensor sends over a pseudo-terminal, TCP or UDP. Some of its data is damaged or dropped
on purpose. The demonstration starts the sensor, reads its scans and records them. Decoding the
recording has to give the same points.
"""

from __future__ import annotations

import contextlib
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
from lidarspec.spec.links import Serial, Tcp
from lidarspec.transports.base import find_data_link
from lidarspec.transports.destinations import make_simulated_outlet
from lidarspec.transports.outlets import LOCALHOST, has_terminals
from lidarspec.transports.serving import ServedSensor

#: The time limit for all scans is this time plus one second for each scan.
EXTRA_TIMEOUT_S = 15.0
#: After this time without a scan, all data that was sent is considered to have arrived.
DRAINED_AFTER_S = 0.2


@dataclass(frozen=True, eq=False)
class Demonstration:
    """The results of the demonstration.

    Attributes:
        error_share: the simulated share of lost datagrams, or of damaged bytes in a stream.
        intact: number of packets that arrived without a simulated error.
        digest: SHA-256 of the points of the complete scans.
        recorded_digest: SHA-256 of the points of the complete scans in the recording.
    """

    sensor: Sensor
    address: str
    error_share: float
    replies: tuple[Reply, ...]
    scans: tuple[Scan, ...]
    stats: Counters
    sent: int
    intact: int
    digest: str
    recorded_digest: str
    recorded_bytes: int


def demonstrate(
    sensor: Sensor, *, scan_count: int = 5, errors: float = 0.01, seed: int = 1
) -> Demonstration:
    """Run a simulated sensor until a number of complete scans has arrived.

    Args:
        errors: the share of lost datagrams, or of damaged bytes in a stream.
        seed: the seed of the errors and the scene.

    Raises:
        SourceError: if the port cannot be opened, or the scans do not arrive in time.
        PluginError: if a function of the plugin raises.
    """
    if sensor.datagrams:
        error_share = errors
        faults = Faults(loss=error_share)
    else:
        error_share = min(errors, 1 / sensor.frames[sensor.data_frame].max_length)
        faults = Faults(errors=error_share)
    simulated = SimulatedDevice(sensor, seed=seed, faults=faults)
    with tempfile.TemporaryDirectory(prefix="lidarspec-demo-") as folder:
        path = Path(folder) / "demo.lsr"
        address, replies, scans, stats = _run_live(sensor, simulated, path, scan_count)
        line = simulated.lines["data"]
        recorded_bytes = path.stat().st_size
        with open_device(path, sensor) as recording:
            whole_scans = (scan for scan in recording.scans() if scan.whole)
            recorded_digest = hash_points(list(itertools.islice(whole_scans, scan_count)))
    return Demonstration(
        sensor,
        address,
        error_share,
        replies,
        scans,
        stats,
        sent=line.sent,
        intact=line.intact,
        digest=hash_points([scan for scan in scans if scan.whole]),
        recorded_digest=recorded_digest,
        recorded_bytes=recorded_bytes,
    )


def hash_points(scans: Sequence[Scan]) -> str:
    """Return the SHA-256 of the coordinates, ranges and intensities of scans."""
    hasher = hashlib.sha256()
    for scan in scans:
        points = scan.points
        for column in (points.xyz, points.range, points.intensity):
            hasher.update(b"" if column is None else column.tobytes())
    return hasher.hexdigest()


def _run_live(
    sensor: Sensor, simulated: SimulatedDevice, path: Path, scan_count: int
) -> tuple[str, tuple[Reply, ...], tuple[Scan, ...], Counters]:
    """Run a live session and record it; return address, replies, scans and counters."""
    if sensor.datagrams:
        outlet = make_simulated_outlet(sensor, f"udp://{LOCALHOST}:{_free_port()}")
        with contextlib.ExitStack() as stack:
            stack.callback(outlet.close)
            device = stack.enter_context(
                open_device(outlet.source, sensor, start=False, record=path)
            )
            served = stack.enter_context(ServedSensor(simulated, outlet))
            return outlet.source, *_read(device, served, scan_count)
    if has_terminals() and find_data_link(sensor, Serial):
        destination = "pty"
    else:
        destination = f"tcp://{LOCALHOST}:0"
    # A connection whose port is reported is opened only after a command.
    link = find_data_link(sensor, Tcp)
    patient = link is None or not link.reported
    with (
        ServedSensor(
            simulated, make_simulated_outlet(sensor, destination), patient=patient
        ) as served,
        open_device(served.path, sensor, start=False, record=path) as device,
    ):
        return served.path, *_read(device, served, scan_count)


def _read(
    device: Device, served: ServedSensor, scan_count: int
) -> tuple[tuple[Reply, ...], tuple[Scan, ...], Counters]:
    replies = tuple(device.send(name) for name in device.sensor.on_open)
    limit = time.monotonic() + EXTRA_TIMEOUT_S + scan_count
    scans: list[Scan] = []
    for scan in device.scans(wait=0.1):
        scans += [scan] if scan is not None else []
        if sum(one.whole for one in scans) >= scan_count:
            served.stop_sending()
            while device.newest(DRAINED_AFTER_S) is not None:
                pass  # `sent` counts the data that is still on the way, so that it has to be read
            break
        if time.monotonic() > limit:
            break
    if (failure := device.stats.failure(device.sensor.id)) is not None:
        raise failure
    if sum(one.whole for one in scans) >= scan_count:
        return replies, tuple(scans), device.stats
    number = (
        f"{len(scans)} scans in {EXTRA_TIMEOUT_S + scan_count:g} s, but {scan_count} were expected"
    )
    raise SourceError(f"the simulated {device.sensor.id} sent {number}: {device.stats}")


def _free_port() -> int:
    """Return a UDP port that is not in use."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((LOCALHOST, 0))
        return int(probe.getsockname()[1])

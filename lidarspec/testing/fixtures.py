"""Simulated sensors on real ports, for tests of programs that talk to sensors."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

from lidarspec.plugins import sensor as named_sensor
from lidarspec.sensor_operations import Sensor
from lidarspec.simulation.device import SimulatedDevice
from lidarspec.simulation.faults import Faults
from lidarspec.simulation.scenes import Scene
from lidarspec.transports.destinations import simulated_outlet
from lidarspec.transports.serving import Served


@contextlib.contextmanager
def virtual_port(
    sensor: str | Sensor,
    *,
    to: str = "pty",
    link: str | Path | None = None,
    scene: Scene | None = None,
    seed: int = 0,
    rate: float = 1.0,
    faults: Faults | None = None,
) -> Iterator[Served]:
    """A simulated sensor on a real port, as a context: a pseudo-terminal, or a socket.

    Args:
        sensor: an id or a Sensor.
        to: "pty", "udp://127.0.0.1:PORT" or "tcp://127.0.0.1:PORT"; TCP port 0 takes one that is
            free.
        link: a symbolic link that leads to the pseudo-terminal, also after it was unplugged and
            came back; by default one in a folder of its own.
        scene: what it sees; by default a room of the seed's, in which somebody walks.
        seed: of the scene, the faults and the fillers.
        rate: how many times faster than in reality; inf: as fast as it is asked.
        faults: what goes wrong on its links.

    Yields:
        What has a `path` to open, the `device` with the names of the commands that it `heard`,
        `unplug` and `plug`.

    Raises:
        SourceError: where the port cannot be had.
    """
    if isinstance(sensor, Sensor):
        known = sensor
    else:
        known = named_sensor(sensor)
    device = SimulatedDevice(known, scene=scene, seed=seed, rate=rate, faults=faults)
    with contextlib.ExitStack() as stack:
        if to == "pty" and link is None:
            # The system names each pseudo-terminal anew, and may give the old name to somebody
            # else's meanwhile.
            link = (
                Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="lidarspec-port-")))
                / "port"
            )
        yield stack.enter_context(Served(device, simulated_outlet(known, to, link)))

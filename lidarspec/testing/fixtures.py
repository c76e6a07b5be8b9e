"""Simulated sensors on real ports, for tests of programs that talk to sensors."""

from __future__ import annotations

import contextlib
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path

from lidarspec.plugins import sensor as named_sensor
from lidarspec.sensor_operations import Sensor
from lidarspec.simulation.device import SimulatedDevice
from lidarspec.simulation.faults import Faults
from lidarspec.simulation.scenes import Scene
from lidarspec.spec.timing import Every
from lidarspec.transports.destinations import make_simulated_outlet
from lidarspec.transports.serving import ServedSensor, VirtualClock


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
    virtual_time: bool = False,
) -> Iterator[ServedSensor]:
    """Run a simulated sensor on a pseudo-terminal or a socket, in a context manager.

    Args:
        sensor: an id or a Sensor.
        to: "pty", "udp://127.0.0.1:PORT" or "tcp://127.0.0.1:PORT"; with TCP port 0, a free port is
            chosen.
        link: the name of a symbolic link to the pseudo-terminal, which stays valid when the sensor
            is unplugged; by default a link in a temporary folder.
        scene: the surroundings of the sensor; by default a random room with a walking person.
        seed: seed of the scene, the faults and the bytes that the sensor sends in pauses
            (`Sensor.fillers`).
        rate: speed relative to real time; with `inf`, the sensor sends as fast as the reader reads.
        faults: the faults to simulate on the links of the sensor.
        virtual_time: whether the sensor's time passes only in calls of `advance`. If the sensor has
            no clock and its scans end after a fixed time (`Every`), they still end by real time,
            and a Python warning is issued.

    Yields:
        An object with the attributes `path` (to open) and `device` (`device.commands_received`
        lists the received commands), and the methods `wait_for_commands(names)`, `unplug`, `plug`,
        `jump_clock(seconds)`, `delay(seconds)` and, with virtual time, `advance(seconds)`.

    Raises:
        SourceError: if the port cannot be opened.
    """
    if isinstance(sensor, Sensor):
        resolved = sensor
    else:
        resolved = named_sensor(sensor)
    if virtual_time and resolved.clock is None and isinstance(resolved.scan, Every):
        warnings.warn(
            f"{resolved.id} has no clock, so its scans end by arrival times, which are real times"
            " also with virtual_time=True: read packets, or leave virtual_time out",
            stacklevel=3,
        )
    device = SimulatedDevice(resolved, scene=scene, seed=seed, rate=rate, faults=faults)
    with contextlib.ExitStack() as stack:
        if to == "pty" and link is None:
            # After an unplug, the new pseudo-terminal has a new name, and the system may have given
            # the old name to another process.
            link = (
                Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="lidarspec-port-")))
                / "port"
            )
        outlet = make_simulated_outlet(resolved, to, link)
        clock = VirtualClock() if virtual_time else None
        yield stack.enter_context(ServedSensor(device, outlet, clock=clock))

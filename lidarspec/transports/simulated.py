"""``sim:ID``: a simulated sensor as a live source, in this process, in real time or any other."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Mapping

from lidarspec.errors import UsageError
from lidarspec.plugins import sensor as named_sensor
from lidarspec.simulation.device import SECOND, SimulatedDevice
from lidarspec.simulation.faults import FAULTS, faults_of
from lidarspec.simulation.scenes import read_scene
from lidarspec.spec.links import Serial, is_datagram
from lidarspec.spec.sensor import Sensor
from lidarspec.transports.base import Address, HostClock, failure
from lidarspec.transports.protocol import Chunk, Disconnected, LiveTransport

OPTIONS = ("rate", "scene", "seed", *FAULTS)
#: ns between two reads, in which a fast sensor gathers some packets.
PAUSE = 2_000_000


class SimulatedTransport(LiveTransport):
    """A link of a simulated device; that of the data switches it on, and reading it makes time pass
    for all.

    Args:
        name: of the link.
        data: the data link of the same device, for another one.

    Attributes:
        sensor, device: which is simulated.
        baud: of its serial line, None where it has none.
    """

    def __init__(
        self,
        label: str,
        sensor: Sensor,
        device: SimulatedDevice,
        name: str = "data",
        data: SimulatedTransport | None = None,
    ) -> None:
        self.label, self.device, self.sensor, self._name = label, device, sensor, name
        link = sensor.links.get(name)
        self.datagrams = is_datagram(link)
        self.baud = link.baud if isinstance(link, Serial) else None
        self.overflow = "block" if math.isinf(device.rate) else "drop_oldest"
        self._changed: threading.Condition = data._changed if data else threading.Condition()
        self._clock = HostClock()
        #: what has left the device on the links that are open, and was not read yet.
        self._left: dict[str, list[bytes]] = data._left if data else {}
        self._left[name] = []
        self._rested = 0
        if data is None:
            device.start(time.monotonic_ns())

    def link(self, name: str) -> SimulatedTransport:
        with self._changed:
            return SimulatedTransport(self.label, self.sensor, self.device, name, self)

    def read(self, timeout: float) -> list[Chunk]:
        end = time.monotonic_ns() + int(timeout * SECOND)
        with self._changed:
            while not self.closed:
                now = time.monotonic_ns()
                chunks = self._arrived(now) if now >= self._rested else []
                if chunks or now >= end:
                    return chunks
                due = self.device.deadline if self._name == "data" else None
                wake = end if due is None else min(end, max(due, self._rested))
                self._changed.wait(max(wake - now, 0) / SECOND)
        return []

    def write(self, data: bytes) -> None:
        with self._changed:
            if not self.device.present:
                raise Disconnected(f"{self.label}: the simulated sensor is unplugged")
            self.device.receive(data, time.monotonic_ns(), self._name)
            self._changed.notify_all()

    def reopen(self) -> None:
        with self._changed:
            self.device.outgoing(time.monotonic_ns())
            if not self.device.present:
                raise failure(f"{self.label}: the simulated sensor is unplugged", "wait")

    def lines(self, *, dtr: bool | None = None, rts: bool | None = None) -> None:
        """Control lines have no effect on a simulated device."""

    def close(self) -> None:
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    def _arrived(self, now: int) -> list[Chunk]:
        for link, data in self.device.outgoing(now) if self._name == "data" else ():
            if link in self._left:
                self._left[link].append(data)
                self._changed.notify_all()
        out, self._left[self._name] = self._left[self._name], []
        if not self.device.present:
            raise Disconnected(f"{self.label}: the simulated sensor was unplugged")
        self._rested = now + PAUSE if out and math.isfinite(self.device.rate) else now
        at = self._clock.now()
        return [Chunk(data, at) for data in out]


def simulated_device(sensor: Sensor, options: Mapping[str, str]) -> SimulatedDevice:
    """The device that options name by text: ``{"rate": "2", "scene": "hall.toml", "errors":
    "0.01"}``.

    Raises:
        UsageError: for a value that is not of its kind, and where the sensor cannot be simulated.
        SourceError: where the scene cannot be read.
    """
    scene = read_scene(options["scene"]) if "scene" in options else None
    faults = faults_of({name: text for name, text in options.items() if name in FAULTS})
    seed = options.get("seed", "0")
    if not seed.isdecimal():
        raise UsageError(f"seed is a whole number, not {seed!r}")
    return SimulatedDevice(
        sensor, scene=scene, seed=int(seed), rate=rate_of(options.get("rate", "1")), faults=faults
    )


def rate_of(text: str) -> float:
    """How many times faster than in reality; inf for "max" and 0.

    Raises:
        UsageError: for anything else but a number above 0.
    """
    try:
        rate = math.inf if text in ("max", "0") else float(text)
    except ValueError:
        rate = -1.0
    if not rate > 0:
        raise UsageError(f"rate is a number above 0, or max, not {text!r}")
    return rate


def connect(address: Address, sensor: Sensor | None = None) -> SimulatedTransport:
    """The open transport of ``sim:ID?rate=2&errors=0.01``.

    Args:
        sensor: who reads it; where it is the same sensor, it is simulated with the same options.

    Raises:
        UnknownSensor, UnknownOption, UsageError: for what the source says.
    """
    address.check(OPTIONS)
    if not address.place and sensor is None:
        raise UsageError(
            f"{address.text}: name the sensor, as in sim:ID; lidarspec sensors lists them"
        )
    if sensor is None or (address.place and named_sensor(address.place).id != sensor.id):
        sensor = named_sensor(address.place)
    return SimulatedTransport(address.text, sensor, simulated_device(sensor, address.options))

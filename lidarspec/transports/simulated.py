"""``sim:ID``: a simulated sensor in this process, as a live source."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Mapping

from lidarspec.errors import UsageError
from lidarspec.plugins import sensor as named_sensor
from lidarspec.sensor_operations import Sensor
from lidarspec.simulation.device import SECOND, SimulatedDevice
from lidarspec.simulation.faults import FAULTS, parse_faults
from lidarspec.simulation.scenes import read_scene
from lidarspec.spec.links import Serial, Udp, is_datagram
from lidarspec.transports.addresses import SourceAddress
from lidarspec.transports.base import source_error
from lidarspec.transports.host_clock import HostClock
from lidarspec.transports.outlets import LOCALHOST
from lidarspec.transports.protocol import Chunk, Disconnected, LiveTransport

#: options of a ``sim:`` SOURCE.
OPTIONS = ("rate", "scene", "seed", *FAULTS)
#: Minimum time between two reads, during which the packets of a fast sensor accumulate.
_MIN_READ_INTERVAL_NS = 2_000_000


class SimulatedTransport(LiveTransport):
    """One connection to a simulated device, that is one of the links in `Sensor.links`.

    The link "data" carries the data; another link may carry commands. Opening the link "data"
    starts the device. Reading the link "data" advances the time of the device.

    Args:
        name: the name of the link.
        data_link: the transport of the link "data" of the same device; None if this is that link.

    Attributes:
        baud: the baud rate of a serial link; None for other links.
    """

    def __init__(
        self,
        label: str,
        sensor: Sensor,
        device: SimulatedDevice,
        name: str = "data",
        data_link: SimulatedTransport | None = None,
    ) -> None:
        self.label = label
        self.sensor = sensor
        self.device = device
        self._name = name
        link = sensor.links.get(name)
        self.datagrams = is_datagram(link)
        self.baud = link.baud if isinstance(link, Serial) else None
        if math.isinf(device.rate):
            self.overflow = "block"
        else:
            self.overflow = "drop_oldest"
        self._clock = HostClock()
        self._next_read_ns = 0
        self._changed: threading.Condition
        # link -> bytes that the device has sent and that were not read yet
        self._unread: dict[str, list[bytes]]
        if data_link is None:
            self._changed = threading.Condition()
            self._unread = {}
            device.utc_offset_ns = self._clock.now() - time.monotonic_ns()
            device.start(time.monotonic_ns())
        else:
            self._changed = data_link._changed
            self._unread = data_link._unread
        self._unread[name] = []

    def link(self, name: str) -> SimulatedTransport:
        with self._changed:
            return SimulatedTransport(self.label, self.sensor, self.device, name, self)

    def read(self, timeout: float) -> list[Chunk]:
        deadline = time.monotonic_ns() + int(timeout * SECOND)
        with self._changed:
            while not self.closed:
                now = time.monotonic_ns()
                chunks = self._take(now) if now >= self._next_read_ns else []
                if chunks or now >= deadline:
                    return chunks
                wake_ns = min(deadline, self._next_data_ns())
                self._changed.wait(max(wake_ns - now, 0) / SECOND)
        return []

    def write(self, data: bytes) -> None:
        with self._changed:
            if not self.device.present:
                raise Disconnected(f"{self.label}: the simulated sensor is disconnected")
            self.device.receive(data, time.monotonic_ns(), self._name)
            self._changed.notify_all()

    def reopen(self) -> None:
        with self._changed:
            self.device.outgoing(time.monotonic_ns())
            if not self.device.present:
                raise source_error(f"{self.label}: the simulated sensor is disconnected", "wait")

    def lines(self, *, dtr: bool | None = None, rts: bool | None = None) -> None:
        """Do nothing, because control lines have no effect on a simulated device."""

    @property
    def own_port(self) -> int | None:
        """The port that the sensor declares for its data; None if it declares none."""
        link = self.sensor.links.get("data")
        return link.ports[0] if isinstance(link, Udp) and link.ports else None

    def peer(self) -> str | None:
        return LOCALHOST

    def close(self) -> None:
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    def _next_data_ns(self) -> float:
        """Return the time at which the device sends data again, ns; inf if unknown."""
        if self._name == "data":
            deadline = self.device.deadline
        else:
            deadline = None
        if deadline is None:
            return math.inf
        return max(deadline, self._next_read_ns)

    def _take(self, now: int) -> list[Chunk]:
        """Return the unread bytes of this link.

        If this is the link "data", advance the device to the time `now` first.
        """
        if self._name == "data":
            for link, data in self.device.outgoing(now):
                if link in self._unread:
                    self._unread[link].append(data)
                    self._changed.notify_all()
        unread = self._unread[self._name]
        self._unread[self._name] = []
        if not self.device.present:
            raise Disconnected(f"{self.label}: the simulated sensor was disconnected")
        self._next_read_ns = now
        if unread and math.isfinite(self.device.rate):
            self._next_read_ns += _MIN_READ_INTERVAL_NS
        at = self._clock.now()
        return [Chunk(data, at) for data in unread]


def connect(address: SourceAddress, sensor: Sensor | None = None) -> SimulatedTransport:
    """Open a simulated SOURCE, for example ``sim:ID?rate=2&errors=0.01``.

    Args:
        sensor: the sensor that decodes the data. If the SOURCE has no id, or the id of this
            sensor, this sensor is simulated.

    Raises:
        UnknownSensor, UnknownOption, UsageError: for an invalid source.
        SourceError: if the scene cannot be read.
    """
    address.check(OPTIONS)
    if not address.location and sensor is None:
        raise UsageError(
            f"{address.text}: expected the id of a sensor, as in sim:ID; lidarspec sensors lists"
            " all ids"
        )
    # The given sensor need not be registered.
    if sensor is None or address.location not in ("", sensor.id):
        named = named_sensor(address.location)
        if sensor is None or named.id != sensor.id:
            sensor = named
    return SimulatedTransport(address.text, sensor, _make_device(sensor, address.options))


def parse_rate(text: str) -> float:
    """Return the speed relative to real time; infinity for "max" and "0".

    Raises:
        UsageError: if the text is not a number above 0, "max" or "0".
    """
    if text in ("max", "0"):
        return math.inf
    try:
        rate = float(text)
    except ValueError:
        rate = math.nan
    if not rate > 0:
        raise UsageError(f"rate must be a number above 0, or max, not {text!r}")
    return rate


def _make_device(sensor: Sensor, options: Mapping[str, str]) -> SimulatedDevice:
    """Return the simulated device for the options of a SOURCE, such as {"rate": "2"}."""
    if "scene" in options:
        scene = read_scene(options["scene"])
    else:
        scene = None
    faults = parse_faults({name: text for name, text in options.items() if name in FAULTS})
    seed = options.get("seed", "0")
    if not seed.isdecimal():
        raise UsageError(f"seed must be an integer, not {seed!r}")
    rate = parse_rate(options.get("rate", "1"))
    return SimulatedDevice(sensor, scene=scene, seed=int(seed), rate=rate, faults=faults)

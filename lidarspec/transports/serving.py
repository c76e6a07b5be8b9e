"""A simulated sensor served to other programs, or written to a file: the loop that keeps its time."""

from __future__ import annotations

import math
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import TracebackType

from lidarspec.errors import UsageError
from lidarspec.recording.recorders import recorder
from lidarspec.simulation.device import SECOND, SimulatedDevice
from lidarspec.spec.links import Udp
from lidarspec.spec.sensor import Sensor
from lidarspec.transports.live_transport import POLL, Address, failure
from lidarspec.transports.outlets import HERE, Door, TcpDoor, UdpDoor
from lidarspec.transports.protocol import Chunk

#: seconds at least between two sendings.
PAUSE = 0.001
#: ns of data that are written to a file between two looks at its health.
PIECE = SECOND // 100


def serve(
    device: SimulatedDevice,
    door: Door,
    *,
    seconds: float | None = None,
    stop: threading.Event | None = None,
    turn: Callable[[], None] | None = None,
    patient: bool = False,
) -> None:
    """Let a device live at a door.

    Args:
        seconds: how long; for ever where left out.
        stop: ends it when it is set.
        turn: called again and again, every 50 ms at least.
        patient: switch the device on when somebody listens.

    Raises:
        SourceError: where nothing can be sent any more.
    """
    early: list[tuple[str, bytes]] = []
    while patient and not door.heard and not (stop is not None and stop.is_set()):
        early = door.receive(POLL)
    began, present = time.monotonic_ns(), True
    device.start(began)
    for link, data in early:
        device.receive(data, began, link)
    end = began + int(seconds * SECOND) if seconds is not None else None
    while not (stop is not None and stop.is_set()):
        if turn is not None:
            turn()
        now = time.monotonic_ns()
        if end is not None and now >= end:
            break
        if door.heard or math.isfinite(device.rate):
            door.send(device.sendings(now), patient=math.isinf(device.rate))
        if device.present != present:
            present = device.present
            door.plug() if present else door.unplug()
        due = device.deadline
        pause = PAUSE if math.isfinite(device.rate) or not door.heard else 0.0
        wait = POLL if due is None else min(POLL, max((due - time.monotonic_ns()) / SECOND, pause))
        for link, data in door.receive(wait):
            device.receive(data, time.monotonic_ns(), link)


class Served:
    """A simulated sensor at a door, in a thread of its own; a context manager.

    Attributes:
        device: what is simulated, with the names of the commands that it `heard`.
        door: what it is reached through.

    Args:
        patient: switch it on when somebody listens.
    """

    def __init__(self, device: SimulatedDevice, door: Door, *, patient: bool = False) -> None:
        self.device, self.door, self._patient = device, door, patient
        self._stop, self._failure = threading.Event(), list[BaseException]()
        self._orders, self._done = queue.SimpleQueue[Callable[[], None]](), threading.Semaphore(0)
        self._carried = 0
        self._thread = threading.Thread(target=self._run, name=f"simulated {device.sensor.id}", daemon=True)
        self._thread.start()

    @property
    def path(self) -> str:
        """What to open."""
        return self.door.where

    def unplug(self) -> None:
        """Pull the plug: the port hangs up and is gone."""
        self._order(self.device.unplug)

    def plug(self) -> None:
        """Put it in again: the port is back, and the sensor as after power-up."""
        self._order(lambda: self.device.start(time.monotonic_ns()))

    def rest(self) -> None:
        """Send nothing more; what was sent can still be read."""
        self._stop.set()
        self._thread.join()

    def close(self) -> None:
        """End it.

        Raises:
            Exception: what went wrong in its thread.
        """
        self.rest()
        self.door.close()
        if self._failure:
            raise self._failure[0]

    def __enter__(self) -> Served:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self.close()

    def _order(self, order: Callable[[], None]) -> None:
        """Have something done between two turns of the thread, and wait until it has taken effect."""
        self._orders.put(order)
        while not self._done.acquire(timeout=0.1):
            if not self._thread.is_alive():
                raise RuntimeError(f"the simulated {self.device.sensor.id} has ended")

    def _turn(self) -> None:
        """Called once a turn: what was ordered in the last one has taken effect by now."""
        if self._carried:
            self._done.release(self._carried)
        self._carried = 0
        while not self._orders.empty():
            self._orders.get()()
            self._carried += 1

    def _run(self) -> None:
        try:
            serve(self.device, self.door, stop=self._stop, turn=self._turn, patient=self._patient)
        except BaseException as error:
            self._failure.append(error)


def write_file(device: SimulatedDevice, path: str | Path, seconds: float, *, overwrite: bool = False) -> int:
    """The number of bytes written: what a device sends in so many seconds, from its start on, as a recording of it would be.

    Nothing waits: the times in the file are the device's. The commands that open the device are sent to it, and recorded too.

    Args:
        path: an .lsr, .pcap or .bin file.

    Raises:
        UnknownFormat, UsageError: for a file that cannot hold it, or exists.
        SourceError: where it cannot be written.
    """
    sensor, began = device.sensor, time.time_ns()
    device.start(0)
    link = sensor.links.get("data")
    ports = link.ports if isinstance(link, Udp) and link.ports else (0,)
    out = recorder(path, sensor, f"sim:{sensor.id}", datagrams=sensor.datagrams, overwrite=overwrite)
    written, now, opening = 0, 0, [name for name in sensor.on_open if sensor.commands[name].frame]
    try:
        while now < seconds * SECOND:
            if opening:
                name = opening.pop(0)
                out.write(Chunk(sensor.command(name), began + now), "out")
                device.receive(sensor.command(name), now, sensor.commands[name].link)
            now += PIECE
            for _, frame, data in device.sendings(now):
                port = ports[0] if not frame or sensor.frames[frame].data else ports[-1]
                out.write(Chunk(data, began + now, (HERE, port), (HERE, port)) if sensor.datagrams else Chunk(data, began + now))
                written += len(data)
            out.keep_up()
    finally:
        out.close()
    return written


def door(sensor: Sensor, text: str, link: str | Path | None = None) -> Door:
    """The door that a destination names: "pty", "udp://HOST:PORT" or "tcp://HOST:PORT"; TCP port 0 takes one that is free.

    Args:
        link: a path that leads to the pseudo-terminal.

    Raises:
        UsageError: for what is no destination.
        SourceError: where it cannot be had.
    """
    if text == "pty":
        try:
            from lidarspec.transports.outlets import PtyDoor
        except ImportError:
            raise failure("this system has no pseudo-terminals", "lidarspec sim SENSOR --to tcp://127.0.0.1:2111") from None
        return PtyDoor(sensor, link)
    address = Address.parse(text)
    if address.scheme not in ("udp", "tcp") or "://" not in text:
        raise UsageError(f"{text!r} is no destination: pty, udp://HOST:PORT, tcp://HOST:PORT, or a file (.lsr, .pcap, .bin)")
    if link is not None:
        raise UsageError("a link leads to a pseudo-terminal: it goes with pty alone")
    address.check(())
    free = address.scheme == "tcp" and address.place.endswith(":0")
    host, port = replace(address, place=address.place[:-2]).host_and_port() if free else address.host_and_port()
    if address.scheme == "udp":
        return UdpDoor(sensor, host or HERE, port)
    return TcpDoor(sensor, host or HERE, 0 if free else port)


def is_file(text: str) -> bool:
    """Whether a destination is a file, and not a pseudo-terminal or an address."""
    return text != "pty" and "://" not in text

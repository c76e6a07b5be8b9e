"""What sends through an outlet, by the clock: a simulated sensor, and the replay of a recording.

A simulated device is asked again and again what it sends by now, and told what has arrived. Of a
replay every chunk has a deadline on the monotonic clock, reckoned from the first one and not from
the one before, so that what a wait oversleeps is not added up; a chunk that is late goes out at
once. Into a file a device is written without waiting: the times in it are the device's own.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import math
import queue
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Literal

from lidarspec.errors import LidarSpecError, SpecError, UsageError, WireError
from lidarspec.frames.build import build_command
from lidarspec.recording.recorders import recorder
from lidarspec.scans.selection import Times, received
from lidarspec.simulation.device import SECOND, SimulatedDevice
from lidarspec.spec.links import Udp
from lidarspec.transports.open_url import transport
from lidarspec.transports.outlets import HERE, Outlet
from lidarspec.transports.protocol import (
    POLL,
    Chunk,
    Closing,
    Disconnected,
    Sender,
    Transport,
    sender_names,
)

#: seconds at least between two sendings.
PAUSE = 0.001
#: seconds between two looks at whether somebody asks over a link of its own.
ASKED = 0.01
#: ns of data that are written to a file between two looks at its health.
PIECE = SECOND // 100
#: ns; a chunk of a replay that goes out later than this is worth a word.
LATE = 20_000_000


class Turns:
    """Whose turn it is to compute, of the threads that simulate: one at a time, in the order in
    which they asked.

    Left to themselves a hundred of them hardly go on, and do not end: each waits for all others
    whenever it wants the interpreter back.
    """

    def __init__(self) -> None:
        self._lock, self._tickets = threading.Lock(), dict[threading.Event, threading.Event]()

    @contextlib.contextmanager
    def turn(self, stop: threading.Event) -> Iterator[bool]:
        """A turn, once it has come; whether it has, and one was not told to `end` meanwhile."""
        ticket = threading.Event()
        with self._lock:
            self._tickets[stop] = ticket
            self._call()
        ticket.wait()
        try:
            yield not stop.is_set()
        finally:
            with self._lock:
                del self._tickets[stop]
                self._call()

    def end(self, stop: threading.Event) -> None:
        """Tell somebody to stop, who may wait for his turn."""
        stop.set()
        with self._lock:
            if stop in self._tickets:
                self._tickets[stop].set()

    def _call(self) -> None:
        """Let the first one know."""
        for ticket in self._tickets.values():
            ticket.set()
            break


TURNS = Turns()


def serve(
    device: SimulatedDevice,
    outlet: Outlet,
    *,
    seconds: float | None = None,
    stop: threading.Event | None = None,
    turn: Callable[[], None] | None = None,
    patient: bool = False,
) -> None:
    """Let a device live at an outlet.

    Args:
        seconds: how long; for ever where left out.
        stop: ends it when it is set.
        turn: called again and again, every 50 ms at least.
        patient: switch the device on when somebody listens.

    Raises:
        SourceError: where nothing can be sent any more.
    """
    stop, early, outlets = (
        stop or threading.Event(),
        list[bytes](),
        {"data": outlet, **outlet.controls},
    )
    while patient and not outlet.heard and not stop.is_set():
        early = outlet.receive(POLL)
    began, present, endless = time.monotonic_ns(), True, math.isinf(device.rate)
    device.start(began)
    for data in early:
        device.receive(data, began)
    end = began + int(seconds * SECOND) if seconds is not None else None
    while not stop.is_set():
        if turn is not None:
            turn()
        now = time.monotonic_ns()
        if end is not None and now >= end:
            break
        if outlet.heard or not endless:
            with TURNS.turn(stop) as is_ours:
                chunks = _chunks(device, now) if is_ours else {}
            for name, end_of_link in outlets.items():
                end_of_link.send(chunks.get(name, []), patient=endless and name == "data")
        if device.present != present:
            present = device.present
            for end_of_link in outlets.values():
                end_of_link.plug() if present else end_of_link.unplug()
        due = device.deadline
        pause = 0.0 if endless and outlet.heard else PAUSE
        wait = POLL if due is None else min(POLL, max((due - time.monotonic_ns()) / SECOND, pause))
        for name, end_of_link in outlets.items():
            for data in end_of_link.receive(
                (min(wait, ASKED) if outlet.controls else wait) if name == "data" else 0.0
            ):
                device.receive(data, time.monotonic_ns(), name)


class Served(Closing):
    """A simulated sensor at an outlet, in a thread of its own; a context manager.

    Attributes:
        device: what is simulated, with the names of the commands that it `heard`.
        outlet: what it is reached through.

    Args:
        patient: switch it on when somebody listens.
    """

    def __init__(self, device: SimulatedDevice, outlet: Outlet, *, patient: bool = False) -> None:
        self.device, self.outlet, self._patient = device, outlet, patient
        self._stop, self._failure = threading.Event(), list[BaseException]()
        self._orders, self._done = queue.SimpleQueue[Callable[[], None]](), threading.Semaphore(0)
        self._carried = 0
        self._thread = threading.Thread(
            target=self._run, name=f"simulated {device.sensor.id}", daemon=True
        )
        self._thread.start()

    @property
    def path(self) -> str:
        """What to open."""
        return self.outlet.source

    def unplug(self) -> None:
        """Pull the plug: the port hangs up and is gone."""
        self._order(self.device.unplug)

    def plug(self) -> None:
        """Put it in again: the port is back, and the sensor as after power-up."""
        self._order(lambda: self.device.start(time.monotonic_ns()))

    def rest(self) -> None:
        """Send nothing more; what was sent can still be read."""
        TURNS.end(self._stop)
        self._thread.join()

    def close(self) -> None:
        """End it.

        Raises:
            Exception: what went wrong in its thread.
        """
        self.rest()
        self.outlet.close()
        if self._failure:
            raise self._failure[0]

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
            serve(self.device, self.outlet, stop=self._stop, turn=self._turn, patient=self._patient)
        except BaseException as error:
            self._failure.append(error)


def write_file(
    device: SimulatedDevice, path: str | Path, seconds: float, *, overwrite: bool = False
) -> int:
    """The number of bytes written: what a device sends in so many seconds, from its start on, as a
    recording of it would be.

    Nothing waits: the times in the file are the device's. The commands that open the device are
    sent to it, and recorded too. The file is made when there is something to write.

    Args:
        path: an .lsr, .pcap, .pcapng or .bin file.

    Raises:
        UnknownFormat, UsageError: for a file that cannot hold it, or exists; for a time in which
            nothing is sent.
        SpecError: if the sensor, as it is declared, never sends anything.
        SourceError: where it cannot be written.
    """
    chunks = _simulate_opened(device, seconds)
    first = list[tuple[Chunk, Literal["in", "out"]]]()
    for chunk, direction in chunks:
        first.append((chunk, direction))
        if direction == "in":
            break
    else:
        raise _nothing_sent(device, seconds)
    sensor = device.sensor
    written = 0
    with contextlib.closing(
        recorder(path, sensor, f"sim:{sensor.id}", datagrams=sensor.datagrams, overwrite=overwrite)
    ) as out:
        for chunk, direction in itertools.chain(first, chunks):
            out.write(chunk, direction)
            out.keep_up()
            written += len(chunk.data) if direction == "in" else 0
    return written


def _simulate_opened(
    device: SimulatedDevice, seconds: float
) -> Iterator[tuple[Chunk, Literal["in", "out"]]]:
    """Yield what goes over the data link of a device that is switched on and opened, with the
    commands that open it.
    """
    sensor = device.sensor
    began = time.time_ns()
    opening = [name for name in sensor.on_open if sensor.commands[name].frame]
    now = 0
    device.start(now)
    while now < seconds * SECOND:
        if opening:
            name = opening.pop(0)
            data = build_command(sensor, name, {})
            yield Chunk(data, began + now), "out"
            device.receive(data, now, sensor.commands[name].link)
        now += PIECE
        for chunk in _chunks(device, now, began + now).get("data", []):
            yield chunk, "in"


def _nothing_sent(device: SimulatedDevice, seconds: float) -> LidarSpecError:
    """Return the error that says why a device has sent nothing over its data link."""
    sensor = device.sensor
    sent = {name: device.sent[name] for name in sensor.data_frames if device.sent[name]}
    if sent:
        frames = ", ".join(f"{number} {name}" for name, number in sent.items())
        return UsageError(
            f"nothing was written: {frames} frames were sent, and all of them were lost"
        )
    if device.deadline is not None:
        due = f"its next frame is due after {device.deadline / SECOND:g} s"
        return UsageError(
            f"nothing was written: the simulated {sensor.id} sends nothing in the first {seconds:g}"
            f" s; {due}"
        )
    missed = [
        name for name in sensor.on_open if sensor.commands[name].frame and name not in device.heard
    ]
    heard = ", ".join(device.heard) or "no command"
    reason = (
        f"{missed[0]!r} was sent to it, and it recognized {heard}"
        if missed
        else f"nothing starts its data after {heard}"
    )
    return SpecError(
        f"nothing was written: the simulated sensor sends nothing; {reason}",
        path="on_open",
        sensor=sensor.id,
    )


def _chunks(device: SimulatedDevice, now: int, at: int | None = None) -> dict[str, list[Chunk]]:
    """What a device sends by now, by link; a datagram with the port that it goes to, the sensor's
    second one if it is no data frame.

    Args:
        at: the arrival time that is noted.
    """
    sensor, link = device.sensor, device.sensor.links.get("data")
    found: dict[str, list[Chunk]] = {}
    ports = link.ports[:2] if isinstance(link, Udp) and link.ports else (0,)
    ends = {True: (HERE, ports[0]), False: (HERE, ports[-1])}
    for name, frame, data in device.sendings(now):
        end = (
            ends[not frame or sensor.frames[frame].data]
            if sensor.datagrams and name == "data"
            else None
        )
        found.setdefault(name, []).append(Chunk(data, at, end, end))
    return found


class Deadlines:
    """When each chunk of a replay is due, in ns of the monotonic clock.

    Times that go back a little, as those of datagrams that overtook each other, are due at once;
    behind a step back of more than a second, as when a clock was set, time is reckoned on from
    there.

    Args:
        speed: 2.0 is twice as fast; None as fast as possible.
        start: when the first one is due.
    """

    def __init__(self, speed: float | None, start: int) -> None:
        self._speed, self._start = speed, start
        self._origin: int | None = None
        self._latest = 0

    def due(self, at: int | None) -> int:
        """When something that arrived at this time is due; at once, where nobody knows when that
        was.
        """
        if self._speed is None or at is None:
            return self._start
        if self._origin is None:
            self._origin = self._latest = at
        elif at < self._latest - SECOND:
            self._origin, self._latest = self._origin + at - self._latest, at
        self._latest = max(self._latest, at)
        return self._start + round((at - self._origin) / self._speed)


def replayed(
    chunks: Iterable[Chunk],
    outlet: Outlet,
    *,
    speed: float | None = 1.0,
    now: Callable[[], int] = time.monotonic_ns,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[tuple[Chunk, int]]:
    """Each chunk once it has been sent, and by how many ns it was late; what listeners send is
    passed over.

    Args:
        chunks: with their arrival times.
        speed: 2.0 is twice as fast; None as fast as possible.

    Raises:
        Disconnected: where nobody listens any more.
        SourceError: where it cannot be sent.
    """
    deadlines: Deadlines | None = None
    for chunk in chunks:
        deadlines = deadlines or Deadlines(speed, now())
        due = deadlines.due(chunk.at)
        while (left := due - now()) > 0:
            sleep(left / SECOND)
        outlet.receive(0.0)
        if outlet.heard:
            outlet.send([chunk], patient=True)
        if not outlet.heard:
            raise Disconnected(f"{outlet.place}: nobody reads any more")
        yield chunk, max(-left, 0) if speed is not None else 0


class Replay:
    """What was recorded, sent again byte for byte at the times of then, or faster or slower.

    Args:
        file: the SOURCE of the recording, capture or raw file.
        outlet: where it goes; it stays open.
        speed: 2.0 is twice as fast; None as fast as possible.
        needs_times: whether a file without times is refused, rather than sent as fast as it is
            taken.
        loop: begin again at the end, for every listener from the beginning.
        source: the file where it is open already, as standard input has to be; read first, and
            closed then.
        times: only what arrived then, as in `Selection`.

    Attributes:
        chunks, bytes: sent so far.
        late: how many chunks went out more than 20 ms late; `latest` by how many ns the latest did.
        senders: who sent the datagrams then.
        is_timed: whether the file has times.
        digest: SHA-256 of all bytes.
        seconds: since the first listener came.
    """

    def __init__(
        self,
        file: str,
        outlet: Outlet,
        *,
        speed: float | None = 1.0,
        needs_times: bool = False,
        loop: bool = False,
        source: Transport | None = None,
        times: Times = (None, None),
    ) -> None:
        self._file, self._outlet, self._speed, self._needs_times, self._loop = (
            file,
            outlet,
            speed,
            needs_times,
            loop,
        )
        self._times = times
        self.chunks = self.bytes = self.late = self.latest = 0
        self._ends, self.is_timed, self.digest = (
            set[tuple[Sender | None, Sender | None]](),
            True,
            hashlib.sha256(),
        )
        self._began, self._source = time.monotonic(), source

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._began

    def run(self) -> Iterator[str]:
        """Once through the file, or again and again; after each chunk what is to be said, or "".

        Raises:
            UsageError: for a file without times, where they are needed.
            WireError: for a file that holds nothing.
            SourceError: where it cannot be read, or nothing be sent.
        """
        while True:
            self._outlet.await_listener()
            if not self.chunks:
                self._began = time.monotonic()
            opened, self._source = self._source or transport(self._file), None
            with contextlib.closing(opened) as source:
                try:
                    for chunk, late in replayed(
                        self._checked(received(source, self._times, self._file)),
                        self._outlet,
                        speed=self._speed,
                    ):
                        self._count(chunk, late)
                        yield ""
                except Disconnected as gone:
                    yield str(gone)
                else:
                    yield from () if self._loop else source.warnings
            if not self.chunks:
                raise WireError(f"{self._file} holds nothing that was received")
            if not self._loop:
                return

    def _checked(self, chunks: Iterable[Chunk]) -> Iterator[Chunk]:
        """What was received; without times there is no speed to keep."""
        for chunk in chunks:
            if chunk.at is None and self._speed is not None and self.is_timed:
                if self._needs_times:
                    raise UsageError(
                        f"{self._file} does not say when its bytes arrived: only --speed max can be"
                        " kept"
                    )
                self.is_timed = False
            yield chunk

    def _count(self, chunk: Chunk, late: int) -> None:
        self.chunks += 1
        self.bytes += len(chunk.data)
        self.digest.update(chunk.data)
        self.late, self.latest = self.late + (late > LATE), max(self.latest, late)
        self._ends.add((chunk.sender, chunk.receiver))

    @property
    def senders(self) -> set[str]:
        """What the senders are called that datagrams came from then."""
        return set(sender_names(self._ends).values()) - {""}

"""Run a simulated sensor at an outlet, in real time or in virtual time.

An outlet is a port or socket of this computer to which other programs connect, as they connect to a
sensor. A loop sends the bytes of the simulated device to the outlet, and the commands from the
outlet to the device. `serve` runs the loop in the calling thread, and `ServedSensor` runs the loop
in a new thread.
"""

from __future__ import annotations

import contextlib
import math
import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence

from lidarspec.errors import SourceError, UsageError
from lidarspec.sensor_operations import Sensor
from lidarspec.simulation.device import SECOND, SimulatedDevice
from lidarspec.spec.links import Udp
from lidarspec.transports.host_clock import HostClock
from lidarspec.transports.outlets import LOCALHOST, Outlet
from lidarspec.transports.protocol import POLL_S, Chunk, ClosingContext, Sender

#: Minimum time between two passes of the loop, during which the frames of a fast sensor accumulate.
_MIN_PAUSE_S = 0.001
_PASS_TIMEOUT_S = 0.1
#: Maximum time that a virtual clock waits until a program opens the port.
_LISTENER_TIMEOUT_S = 10.0


#: Step of a virtual clock. It must be less than a second, because a simulated device skips longer
#: delays.
_VIRTUAL_STEP_NS = 20_000_000


class VirtualClock:
    """A clock that moves only as far as `advance` allows, for tests that do not wait.

    The serving thread moves the clock in steps of 20 ms, and sends the data that is due at each
    step.
    """

    def __init__(self) -> None:
        self._now_ns = 0
        self._end_ns = 0

    def __call__(self) -> int:
        """Return the time in ns."""
        return self._now_ns

    @property
    def is_behind(self) -> bool:
        """Whether the clock has not reached the time that `advance` allows."""
        return self._now_ns < self._end_ns

    def advance(self, seconds: float) -> None:
        """Allow the clock to move by another `seconds`; `step` moves the clock."""
        self.advance_to(self._end_ns + int(seconds * SECOND))

    def advance_to(self, end_ns: int) -> None:
        """Allow the clock to move to `end_ns`; `step` moves the clock."""
        self._end_ns = max(self._end_ns, end_ns)

    def step(self) -> None:
        """Move the clock by 20 ms, but at most to the time that `advance` allows."""
        self._now_ns = min(self._now_ns + _VIRTUAL_STEP_NS, self._end_ns)


class FairLock:
    """A lock that threads get in the order in which they request it.

    With an ordinary lock, a hundred threads that simulate sensors make hardly any progress.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._tickets: dict[threading.Event, threading.Event] = {}

    @contextlib.contextmanager
    def hold(self, stop: threading.Event) -> Iterator[bool]:
        """Hold the lock in the context; yield False if `cancel` ended the wait.

        Args:
            stop: the event that another thread passes to `cancel`.
        """
        ticket = threading.Event()
        with self._lock:
            self._tickets[stop] = ticket
            self._wake_first()
        ticket.wait()
        try:
            yield not stop.is_set()
        finally:
            with self._lock:
                del self._tickets[stop]
                self._wake_first()

    def cancel(self, stop: threading.Event) -> None:
        """Set `stop`, and end the waiting of the thread that called `hold` with `stop`."""
        stop.set()
        with self._lock:
            if stop in self._tickets:
                self._tickets[stop].set()

    def _wake_first(self) -> None:
        for ticket in self._tickets.values():
            ticket.set()
            break


_SIMULATION_LOCK = FairLock()


def serve(
    device: SimulatedDevice,
    outlet: Outlet,
    *,
    seconds: float | None = None,
    stop: threading.Event | None = None,
    on_pass: Callable[[], None] | None = None,
    patient: bool = False,
    clock: VirtualClock | None = None,
) -> None:
    """Run a device at an outlet.

    Args:
        seconds: the duration; None for no limit.
        stop: the loop ends when this event is set.
        on_pass: called in every pass of the loop, at least every 50 ms.
        patient: whether to start the device only when a program listens.
        clock: the clock of the device; None for real time.

    Raises:
        SourceError: if nothing can be sent any more.
    """
    stop = stop or threading.Event()
    get_now = clock or time.monotonic_ns
    early_commands = []
    while patient and not outlet.has_listener and not stop.is_set():
        early_commands += outlet.receive(POLL_S)
    start_ns = get_now()
    device.utc_offset_ns = HostClock().now() - start_ns
    device.start(start_ns)
    device.set_data_port(outlet.data.port)
    for link, data in early_commands:
        device.receive(data, start_ns, link)
    if seconds is None:
        end_ns = math.inf
    else:
        end_ns = start_ns + seconds * SECOND
    is_plugged_in = True
    while not stop.is_set():
        if on_pass is not None:
            on_pass()
        # In virtual time, nothing is sent until a program can receive it.
        is_waiting = clock is not None and device.present and not outlet.has_listener
        if clock is not None and not is_waiting:
            clock.step()
        now = get_now()
        if now >= end_ns:
            break
        if not is_waiting:
            _send_due(device, outlet, now, stop, patient=clock is not None)
        if device.present != is_plugged_in:
            is_plugged_in = device.present
            if is_plugged_in:
                outlet.plug()
            else:
                outlet.unplug()
        wait = _find_wait(device, outlet) if clock is None else _MIN_PAUSE_S
        for link, data in outlet.receive(wait):
            device.receive(data, get_now(), link)
            if device.destination is not None:
                outlet.data.redirect(*device.destination)
            if clock is not None and device.replied_at is not None:
                clock.advance_to(device.replied_at)


def _send_due(
    device: SimulatedDevice,
    outlet: Outlet,
    now: int,
    stop: threading.Event,
    *,
    patient: bool = False,
) -> None:
    """Send the frames that are due.

    With an infinite rate, frames are sent as fast as they are read.
    """
    is_unlimited = math.isinf(device.rate)
    if is_unlimited and not outlet.has_listener:
        return
    with _SIMULATION_LOCK.hold(stop) as is_held:
        chunks = advance_device(device, now) if is_held else {}
    for link, sent in chunks.items():
        outlet.send(link, sent, patient=(is_unlimited or patient) and link == "data")


def _find_wait(device: SimulatedDevice, outlet: Outlet) -> float:
    """Return the time until the device sends again, at most `POLL_S` seconds."""
    deadline = device.deadline
    if deadline is None:
        return POLL_S
    until_deadline = (deadline - time.monotonic_ns()) / SECOND
    if math.isinf(device.rate) and outlet.has_listener:
        return min(POLL_S, max(until_deadline, 0.0))
    return min(POLL_S, max(until_deadline, _MIN_PAUSE_S))


def advance_device(
    device: SimulatedDevice, now: int, arrival_ns: int | None = None
) -> dict[str, list[Chunk]]:
    """Advance a simulated device to the time `now`, and return the chunks that the device sends.

    Args:
        now: the device's time, ns.
        arrival_ns: the arrival time of all chunks, ns since 1970; None if unknown.

    Returns:
        Name of a link in `Sensor.links`, such as "data" -> the chunks sent over the link.
    """
    sensor = device.sensor
    chunks: dict[str, list[Chunk]] = {}
    for link, frame, data in device.outgoing_with_types(now):
        endpoint = None
        if sensor.datagrams and link == "data":
            endpoint = _find_endpoint(sensor, frame)
        chunks.setdefault(link, []).append(Chunk(data, arrival_ns, endpoint, endpoint))
    return chunks


def _find_endpoint(sensor: Sensor, frame: str) -> Sender:
    """Return the address and port to which datagrams of a frame type are sent."""
    link = sensor.links.get("data")
    ports = link.ports[:2] if isinstance(link, Udp) else ()
    if not ports:
        return LOCALHOST, 0
    is_data = not frame or sensor.frames[frame].data
    return LOCALHOST, ports[0] if is_data else ports[-1]


class ServedSensor(ClosingContext):
    """Runs a simulated sensor at an outlet in a separate thread; a context manager.

    Args:
        device: the simulated device.
        patient: whether to start the device only when a program listens.
    """

    def __init__(
        self,
        device: SimulatedDevice,
        outlet: Outlet,
        *,
        patient: bool = False,
        clock: VirtualClock | None = None,
    ) -> None:
        self.device = device
        self.outlet = outlet
        self._clock = clock
        self._patient = patient
        self._stop = threading.Event()
        self._failure: BaseException | None = None
        self._calls: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._calls_done = threading.Semaphore(0)
        self._calls_in_pass = 0
        self._thread = threading.Thread(
            target=self._run, name=f"simulated {device.sensor.id}", daemon=True
        )
        self._thread.start()

    @property
    def path(self) -> str:
        """The SOURCE to open."""
        return self.outlet.source

    def unplug(self) -> None:
        """Disconnect the sensor, so that its port disappears."""
        self._call_in_thread(self.device.unplug)

    def plug(self) -> None:
        """Connect the sensor again: its port reappears, and it starts as after power-up."""
        get_now = self._clock or time.monotonic_ns
        self._call_in_thread(lambda: self.device.start(get_now()))

    def jump_clock(self, seconds: float) -> None:
        """Let the sensor's clock jump by `seconds`.

        The jump happens at most a quarter of a second after the call.

        Args:
            seconds: size of the jump; negative to jump back.

        Raises:
            UsageError: if the sensor has no writable clock, or if no data is sent.
        """
        failures = list[UsageError]()

        def jump() -> None:
            try:
                self.device.jump_clock(seconds)
            except UsageError as error:
                failures.append(error)

        self._call_in_thread(jump)
        if failures:
            raise failures[0]

    def delay(self, seconds: float) -> None:
        """Send no data for `seconds`, and then send the delayed data all together."""
        get_now = self._clock or time.monotonic_ns
        self._call_in_thread(lambda: self.device.delay_output(seconds, get_now()))

    def advance(self, seconds: float) -> None:
        """Advance the virtual clock, and wait until all data that is due was sent.

        Waits first until a program has opened the port.

        Raises:
            UsageError: if the port runs in real time.
            SourceError: if no program opens the port.
        """
        if self._clock is None:
            raise UsageError(
                "the port runs in real time: to advance its time, open the port with"
                " virtual_time=True"
            )
        self._clock.advance(seconds)
        limit = time.monotonic() + _LISTENER_TIMEOUT_S
        while self._clock.is_behind:
            self._call_in_thread(lambda: None)
            if self.outlet.has_listener:
                limit = time.monotonic() + _LISTENER_TIMEOUT_S
            elif time.monotonic() > limit:
                raise SourceError(f"{self.path}: no program has opened the port")
        self._call_in_thread(lambda: None)

    def wait_for_commands(self, names: Sequence[str], *, timeout: float = 10.0) -> None:
        """Wait until the device has received exactly these commands, in this order.

        Use this method instead of a comparison with `device.commands_received`: when a test
        compares, the device may not have read the last command yet. Repeated commands count once.

        Args:
            names: the names of all commands since the port was opened.

        Raises:
            AssertionError: if other commands were received.
        """
        limit = time.monotonic() + timeout
        while not _match_commands(self.device.commands_received, names):
            if time.monotonic() > limit:
                expected = ", ".join(names) or "no command"
                received = ", ".join(self.device.commands_received) or "no command"
                raise AssertionError(
                    f"the simulated {self.device.sensor.id} received {received}; "
                    f"expected {expected} within {timeout:g} s"
                )
            time.sleep(_MIN_PAUSE_S)

    def stop_sending(self) -> None:
        """Stop sending; bytes that were already sent can still be read."""
        _SIMULATION_LOCK.cancel(self._stop)
        self._thread.join()

    def close(self) -> None:
        """Stop the device and close the outlet.

        Raises:
            Exception: the error that ended the thread.
        """
        self.stop_sending()
        self.outlet.close()
        if self._failure is not None:
            raise self._failure

    def _call_in_thread(self, function: Callable[[], None]) -> None:
        """Call a function in the serving thread, and wait until it was called."""
        self._calls.put(function)
        while not self._calls_done.acquire(timeout=_PASS_TIMEOUT_S):
            if not self._thread.is_alive():
                raise RuntimeError(f"the simulated {self.device.sensor.id} has ended")

    def _make_calls(self) -> None:
        """Call the queued functions."""
        # threads that wait for a call are released in the pass after it
        if self._calls_in_pass:
            self._calls_done.release(self._calls_in_pass)
        self._calls_in_pass = 0
        while not self._calls.empty():
            self._calls.get()()
            self._calls_in_pass += 1

    def _run(self) -> None:
        try:
            serve(
                self.device,
                self.outlet,
                stop=self._stop,
                on_pass=self._make_calls,
                patient=self._patient,
                clock=self._clock,
            )
        except BaseException as error:
            self._failure = error


def _match_commands(received: Sequence[str], expected: Sequence[str]) -> bool:
    """Return whether the received commands are the expected ones, apart from repetitions."""
    matched = 0
    for name in received:
        if matched < len(expected) and name == expected[matched]:
            matched += 1
        elif not matched or name != expected[matched - 1]:
            return False
    return matched == len(expected)

"""The input of a live source: decode queued chunks in the thread of the consumer.

The capture threads queue chunks. `LiveInput.next` decodes queued chunks every few milliseconds and
returns the frames. It also sends the requests of the `Session`, and passes replies to the session.

Only one thread may run the decoders at a time. If another thread calls `send` meanwhile, the
decoding thread also receives the reply to this command.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lidarspec.device.capture_thread import BoundedQueue, CaptureThread, Event, LinkEvent
from lidarspec.device.device_input import DeviceInput, FrameBatch, decode_chunks, select_frames
from lidarspec.device.link_state import LinkState
from lidarspec.device.sender_filter import SenderFilter, find_frame_senders
from lidarspec.device.session import OutgoingData, PendingReply, Reply, Session, learn_options
from lidarspec.errors import (
    CommandError,
    LidarSpecError,
    ReplyTimeout,
    SourceError,
    UsageError,
    refuse_text,
    suggest,
    suggestion,
)
from lidarspec.framing.decoder import Decoder, select_backend as backend_named
from lidarspec.framing.results import Counters, Frames
from lidarspec.recording.background_writer import TrafficLog
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.links import Http, Link, Tcp, Udp
from lidarspec.transports.addresses import find_own_address
from lidarspec.transports.host_clock import HostClock
from lidarspec.transports.open_url import has_control, open_control_link
from lidarspec.transports.protocol import Chunk, LiveTransport

#: time between two decodings of the data that has arrived.
PERIOD_S = 0.02
#: A thread waits for data at most this long before other threads may run the decoders.
MAX_PUMP_S = 0.05
#: how long `write` waits for a first datagram if the sensor's address is only known from it.
SENDER_TIMEOUT_S = 0.9
#: maximum number of chunks that are decoded together.
MAX_CHUNKS = 4096
#: maximum number of batches that are kept for `next` while `send` runs the decoders.
MAX_READY_BATCHES = 4096
#: pause before the opening commands are sent again, if no reply has reported the data port.
REPEAT_PAUSE_S = 1.0
#: time limit for all closing commands together.
SHUTDOWN_TIMEOUT_S = 4.0


class LiveInput(DeviceInput):
    """The input of a sensor on a live transport.

    Args:
        opened: the open transport of the data link.
        record: returns the recorder for the configured sensor, or None. The recorder gets all data
            that is sent or arrives.
        period: seconds between two decodings.
    """

    is_live = True

    def __init__(
        self,
        source: str | Path,
        sensor: Sensor,
        opened: LiveTransport,
        *,
        backend: str = "auto",
        policy: str = "drop_oldest",
        record: Callable[[Sensor], TrafficLog | None] = lambda sensor: None,
        will_begin: bool = False,
        period: float = PERIOD_S,
    ) -> None:
        self._source = source
        self.sensor = sensor
        self._record = record
        self._period = period
        self._learning_commands: list[str] = []
        if will_begin:
            self._learning_commands = [
                name for name in sensor.on_open if sensor.commands[name].learns is not None
            ]
        self._recorder = None if self._learning_commands else record(sensor)
        self.learned: dict[str, Any] = {}
        chosen = backend_named(backend)
        if chosen == "auto":
            self._backend = "numpy"  # compiling would delay the decoding of arriving data
        else:
            self._backend = chosen
        self.queue = BoundedQueue(policy)
        self._session = Session(sensor)
        self.decoder: Decoder = sensor.decoder(stream=not opened.datagrams, backend=self._backend)
        self._decoders = {"data": self.decoder}
        self._captures = {}
        self._senders = SenderFilter(source, sensor, datagrams=opened.datagrams)
        self._ready = deque[FrameBatch]()
        self._broadcast_senders: dict[str, SenderFilter] = {}  # link -> its replies' sender
        self._clock = HostClock()
        self._decoder_lock = threading.RLock()
        self._session_lock = threading.RLock()
        self._decode_due_s = 0.0  # time of the next decoding, by `time.monotonic`
        self._repeat_due_s = 0.0  # time of the next request for the port of the data
        self._was_opened = False  # whether the commands for opening were sent
        self._has_begun = False  # whether `begin` has returned
        self._closed = False
        self._failure: SourceError | None = None
        self.stays_on = False
        self._reported_warnings: list[str] = []
        self._captures["data"] = CaptureThread(opened, self.queue, log=self._recorder)
        self._restart_replies = list[PendingReply]()
        self._handled_silence = list[CommandError]()
        self._link_state = LinkState(
            source, sensor, opened, self._captures["data"], self.decoder, self._senders
        )

    @property
    def ended(self) -> bool:
        """Whether the input was closed and all batches were taken."""
        return self._closed and not self._ready

    @property
    def state(self) -> str:
        """The name of the `LinkState`; "closed" after `close`."""
        if self._closed:
            return "closed"
        return self._link_state.name

    @property
    def warnings(self) -> list[str]:
        warnings = [
            warning
            for capture in self._captures.values()
            for warning in (*capture.transport.warnings, *capture.warnings)
        ]
        for senders in (self._senders, *self._broadcast_senders.values()):
            warnings += senders.warnings
        warnings += self._reported_warnings
        if self._recorder is not None and self._recorder.error is not None:
            warnings.append(f"the recording has stopped: {self._recorder.error}")
        silent = [
            f"{self._source}: {error}; sending the command again"
            for error in list(self._session.unanswered.values())
        ]
        if self._closed:
            return warnings
        return warnings + silent + self._link_state.warnings

    @property
    def stats(self) -> Counters:
        stats = self.decoder.stats
        captures = list(self._captures.values())
        stats.kernel_drops = sum(capture.transport.kernel_drops for capture in captures)
        others = sum(sender_filter.foreign for sender_filter in self._broadcast_senders.values())
        stats.foreign = (
            self._senders.foreign + others + sum(capture.transport.foreign for capture in captures)
        )
        stats.disconnects = sum(capture.disconnects for capture in captures)
        stats.queue_dropped = self.queue.dropped
        return stats

    @property
    def queued(self) -> int:
        return len(self.queue)

    def begin(self) -> None:
        self._was_opened = bool(self.sensor.on_open)
        for name in self.sensor.on_open:
            try:
                reply = self.send(name)
            except CommandError as error:
                if (
                    name in self._learning_commands
                    and self.sensor.main_frames
                    and not self.sensor.commands[name].starts
                ):
                    self._reported_warnings.append(
                        f"{error}; reading continues without the values of the reply"
                    )
                elif isinstance(error, ReplyTimeout) and self._link_state.has_data:
                    self._reported_warnings.append(
                        f"{error}; reading continues, because the sensor sends data"
                    )
                else:
                    raise suggest(error, self._link_state.suggest_command()) from None
            else:
                self.learned |= learn_options(self.sensor, reply)
            if self._failure is not None:
                raise self._failure
            if self._learning_commands and name == self._learning_commands[-1]:
                self._apply_learned_options()
        self._has_begun = True

    def _apply_learned_options(self) -> None:
        """Configure the sensor with the reported options, and discard all earlier data."""
        try:
            self.sensor = self.sensor.configure(**self.learned)
        except UsageError as error:
            raise CommandError(
                f"{self.sensor.id}: the values that the sensor reported are invalid: {error}"
            ) from error
        with self._decoder_lock, self._session_lock:
            data = self._captures["data"]
            self._session.sensor = self.sensor
            self._senders.configure(self.sensor)
            self._decoders = {
                link: self.sensor.decoder(stream=decoder.stream, backend=self._backend)
                for link, decoder in self._decoders.items()
            }
            self.decoder = self._decoders["data"]
            self._recorder = self._record(self.sensor)
            data.record(self._recorder)
            self._ready.clear()
            self._link_state = LinkState(
                self._source, self.sensor, data.transport, data, self.decoder, self._senders
            )

    def next(self, wait: float) -> FrameBatch | None:
        deadline = time.monotonic() + wait
        while True:
            with self._decoder_lock:
                if self._ready:
                    return self._ready.popleft()
                if self._failure is not None:
                    raise self._failure
                left = deadline - time.monotonic()
                if self._closed or (left <= 0 and wait > 0):
                    return None
                self._pump(min(max(left, 0.0), MAX_PUMP_S))
                if wait <= 0 and not self._ready:
                    return None

    def delay_decoding(self, until: float) -> None:
        self._decode_due_s = max(self._decode_due_s, until)

    def read_ahead(self, size: int) -> None:
        """Do nothing: live data cannot be read ahead."""

    def count_arrived(self) -> int:
        return self.queue.produced

    def has_decoded_until(self, arrived: int) -> bool:
        return not self._ready and self.queue.consumed + self.queue.dropped >= arrived

    def send(self, name: str, /, *, timeout: float | None = None, **arguments: Any) -> Reply:
        if name in self.sensor.commands:
            command = self.sensor.commands[name]
            self._await_sender(
                command.link,
                command.timeout * (1 + command.retries) if timeout is None else timeout,
            )
        with self._session_lock:
            self._set_own_endpoint(name)
            pending = self._session.request(name, self._clock.now(), timeout=timeout, **arguments)
            failure = self._send_outgoing()
        if failure is not None and pending.done and pending.failure is None:
            # Without a reply, nothing else reports that the command was not sent.
            error = CommandError(f"{self.sensor.id} {name}: {failure}")
            raise suggest(error, suggestion(failure)) from None
        while not pending.done:
            if self._failure is not None:
                raise self._failure
            self._decode_if_idle(pending)
        try:
            return pending.result()
        except CommandError as error:
            link = self.sensor.commands[name].link
            # The warnings of a transport may explain why no reply arrived. The warnings of HTTP are
            # about this request, so they also explain a refusal.
            is_explained = isinstance(error, ReplyTimeout) or isinstance(
                self.sensor.links[link], Http
            )
            if is_explained:
                remarks = self._captures[link].transport.warnings
            else:
                remarks = []
            raise type(error)("; ".join([str(error), *remarks])) from None

    def _set_own_endpoint(self, name: str) -> None:
        """Pass this computer's address and port to the session, if a command needs them."""
        command = self.sensor.commands.get(name)
        if command is not None and command.has_own_port:
            self._session.port = self._captures["data"].transport.own_port
        if command is not None and command.has_own_address:
            peer = self._open_link(command.link).peer()
            self._session.host = find_own_address(peer) if peer else None

    def write(self, data: bytes, link: str = "data") -> None:
        refuse_text(data)
        if link not in self.sensor.links:
            raise UsageError(
                f"{self.sensor.id} has no link {link!r}: expected one of"
                f" {', '.join(self.sensor.links)}"
            )
        if self._closed:
            raise SourceError(f"{self._source}: the device is closed")
        self._await_sender(link, SENDER_TIMEOUT_S)
        with self._session_lock:
            self._write(OutgoingData(link, bytes(data)))

    def _await_sender(self, link: str, seconds: float) -> None:
        """Wait for a datagram of the sensor, unless the sensor's address is already known."""
        data = self._captures["data"].transport
        is_known = (
            link in self._captures
            or self._find_sensor_host()
            or has_control(self._source)
            or _is_broadcast(self.sensor.links.get(link))
        )
        if link != "data" and is_known:
            return
        limit = time.monotonic() + seconds
        while not data.addressed and self._failure is None and time.monotonic() < limit:
            self._decode_if_idle()

    def close(self) -> None:
        if self._closed:
            return
        try:
            self._shut_down()
        finally:
            self._closed = True
            self.queue.close()
            for capture in self._captures.values():
                capture.close()

    def _shut_down(self) -> None:
        """Send the commands for closing, if the device is connected and was started."""
        if self.stays_on:
            return
        if (
            self._failure is not None
            or not self._captures["data"].connected
            or not (self._was_opened or self._session.started)
        ):
            return
        # One command is enough to stop it.
        stopping = [
            name
            for name, command in self.sensor.commands.items()
            if command.stops and not command.args
        ][:1]
        with self._session_lock:
            self._session.abandon("the device is being closed")
            names = self.sensor.on_close or stopping
            waiting = [self._session.request(name, self._clock.now()) for name in names]
            self._send_outgoing()
        limit = time.monotonic() + SHUTDOWN_TIMEOUT_S
        while not all(pending.done for pending in waiting) and time.monotonic() < limit:
            self._decode_if_idle(next(pending for pending in waiting if not pending.done))
            self._ready.clear()
        for pending in waiting:
            with contextlib.suppress(LidarSpecError):
                pending.result()

    def _decode_if_idle(self, pending: PendingReply | None = None) -> None:
        """Run the decoders once, unless another thread runs them."""
        if not self._decoder_lock.acquire(timeout=MAX_PUMP_S / 5):
            return
        try:
            if pending is None or not pending.done:
                self._pump(MAX_PUMP_S)
        finally:
            self._decoder_lock.release()
        while len(self._ready) > MAX_READY_BATCHES:
            self._ready.popleft()

    def _pump(self, wait: float) -> None:
        """Decode data that arrives within `wait` seconds, and run the session."""
        # If the deadline passed more than `MAX_PUMP_S` ago, this computer is overloaded, and the
        # reply may be in data that was not read yet. Wait for the full time before the request
        # times out.
        with self._session_lock:
            deadline = self._session.deadline
        if deadline is None:
            left = wait
        else:
            left = (deadline - self._clock.now()) / 1e9
        wait = wait if left < -MAX_PUMP_S else min(wait, max(left, 0.0))
        events = self.queue.take(wait, until=self._decode_due_s, max_events=MAX_CHUNKS)
        if events:
            self._decode_due_s = time.monotonic() + self._period
        for link, item in _join_chunks(events):
            self._handle(link, item)
        if deadline is not None:
            with self._session_lock:
                self._session.tick(self._clock.now())
                self._send_outgoing()
        if self._restart_replies:
            self._warn_if_changed()
        elif self._captures["data"].transport.awaits_port and self._has_begun:
            self._request_port_again()
        elif (
            silent := list(self._session.unanswered.values())
        ) and silent != self._handled_silence:
            # Once for each unanswered heartbeat: the sensor may have restarted and lost its
            # settings.
            self._handled_silence = silent
            self._restart_sensor()

    def _handle(self, link: str, item: list[Chunk] | LinkEvent | BaseException) -> None:
        """Decode consecutive chunks of a link, or handle an event on it."""
        if isinstance(item, list):
            self._decode(link, item)
        elif isinstance(item, LinkEvent):
            self._deliver(
                link, self._decoders[link].take_pending(), interrupted=item is LinkEvent.LOST
            )
            if item is LinkEvent.LOST:
                with self._session_lock:
                    self._session.provided.pop(self._reported_port_name, None)
                    self._session.abandon(
                        "the connection was lost", None if link == "data" else link
                    )
            elif item is LinkEvent.BACK:
                self._restart_sensor()
        elif self._failure is None and not self._closed:
            if isinstance(item, SourceError):
                self._failure = item
                self._failure.__cause__ = None  # hides the context in the capture thread
            else:
                self._failure = SourceError(f"{self._source}: reading has stopped: {item}")
                self._failure.__cause__ = item

    def _decode(self, link: str, chunks: list[Chunk]) -> None:
        decoder = self._decoders[link]
        if chunks[0].gap:
            self._deliver(link, decoder.take_pending(), interrupted=True)
        if link == "data" and chunks[0].sender is not None:  # then all chunks have a sender
            self._decode_sensor_chunks(chunks)
            return
        if link in self._broadcast_senders:
            chunks = self._select_first_sender(link, chunks)
        if chunks:
            self._deliver(link, decode_chunks(decoder, chunks))

    def _decode_sensor_chunks(self, chunks: list[Chunk]) -> None:
        """Decode the chunks of the data link that the sensor sent, and drop all other chunks."""
        chunks = self._select_sensor_chunks(chunks)
        if not chunks:
            return
        decoder = self.decoder
        batches = decode_chunks(decoder, chunks)
        if not decoder.stream:
            senders = find_frame_senders(chunks, batches[0], decoder.stats.bytes_in)
            batches = [self._senders.select_frames(senders, batches[0])]
        if self._senders.address is not None:
            self._captures["data"].transport.accept(self._senders.address)
        self._deliver("data", batches)

    def _select_sensor_chunks(self, chunks: list[Chunk]) -> list[Chunk]:
        """Return the chunks that the sensor sent."""
        mine = self._senders.select(chunks)
        self._link_state.record_arrival(from_sensor=bool(mine))
        if self._senders.has_changed:
            self.decoder.take_pending()
            self._ready.append(FrameBatch(interrupted=True, replaced=True))
        return mine

    def _select_first_sender(self, link: str, chunks: list[Chunk]) -> list[Chunk]:
        """Return the chunks of the first sender that replied to a broadcast."""
        mine = self._broadcast_senders[link].select(chunks)
        if (address := self._broadcast_senders[link].address) is not None:
            self._captures[link].transport.accept(address)
            self._senders.choose(address)
        return mine

    def _find_sensor_host(self) -> str | None:
        """Return the address of the sensor; None if unknown."""
        replying_hosts = [
            sender_filter.address[0]
            for sender_filter in self._broadcast_senders.values()
            if sender_filter.address is not None
        ]
        return self._captures["data"].transport.peer() or next(iter(replying_hosts), None)

    def _deliver(self, link: str, batches: list[Frames], *, interrupted: bool = False) -> None:
        """Pass frames to the session, and queue frames of the data link for `next`."""
        self.store_info_frames(batches)
        with self._session_lock:
            awaited = self._session.awaited_frames(link)
            for item in select_frames(batches, awaited) if awaited else ():
                at = self._clock.now() if item.at is None else item.at
                self._session.receive([item], at, link=link)
            if awaited:
                self._connect_to_reported_port()
                self._send_outgoing()
        if link == "data":
            self._link_state.record_frames(batches)
            if interrupted or any(map(len, batches)):
                self._ready.append(FrameBatch(batches, interrupted=interrupted))

    @property
    def _reported_port_name(self) -> str:
        """The name under which replies report the data port; "" if the port is fixed."""
        link = self.sensor.links.get("data")
        return link.reported if isinstance(link, Tcp) else ""

    def _connect_to_reported_port(self) -> None:
        """Connect to the port of the data if a reply has reported the port."""
        # connect before the next command, which may start the data
        transport = self._captures["data"].transport
        port = self._session.provided.get(self._reported_port_name)
        if not transport.awaits_port or port is None:
            return
        try:
            transport.connect_to(port)
        except SourceError as error:
            self._session.provided.pop(self._reported_port_name)
            self._session.abandon(str(error))
            if not self._has_begun:
                self._failure = error

    def _request_port_again(self) -> None:
        """Send the opening commands again, so that the sensor reports its data port.

        After the connection was lost, the sensor may use another port.
        """
        if time.monotonic() >= self._repeat_due_s:
            self._repeat_due_s = time.monotonic() + REPEAT_PAUSE_S
            self._restart_sensor()

    def _restart_sensor(self) -> None:
        """Send the opening commands again, because the sensor may have lost its settings."""
        with self._session_lock:
            names = self.sensor.on_open if self._was_opened else ()
            for name in names:
                self._set_own_endpoint(name)
            self._restart_replies += [
                self._session.request(name, self._clock.now()) for name in names
            ]
            self._send_outgoing()

    def _warn_if_changed(self) -> None:
        """Warn if a reconnected sensor reports other options than before."""
        done = [pending for pending in self._restart_replies if pending.done]
        self._restart_replies = [pending for pending in self._restart_replies if not pending.done]
        for pending in done:
            with contextlib.suppress(CommandError):
                options = learn_options(self.sensor, pending.result())
                changed = [
                    name
                    for name, value in options.items()
                    if self.learned.get(name, value) != value
                ]
                self._reported_warnings += [
                    f"{self._source}: after reconnecting, the sensor reports another value of"
                    f" {name}: open the device again"
                    for name in changed
                ]

    def _send_outgoing(self) -> LidarSpecError | None:
        """Send the data that the session has queued.

        Returns:
            The error if sending failed; None otherwise. After an error, all requests of the session
            have failed.
        """
        failure: LidarSpecError | None = None
        for outgoing in self._session.take_outgoing():
            try:
                self._write(outgoing)
            except CommandError:
                raise
            except LidarSpecError as error:
                self._session.abandon(str(error))
                failure = error
        return failure

    def _write(self, outgoing: OutgoingData) -> None:
        transport = self._open_link(outgoing.link)
        if outgoing.lines:
            try:
                transport.lines(**outgoing.lines)
            except LidarSpecError as error:
                self._reported_warnings.append(str(error))
        if outgoing.data:
            transport.write(outgoing.data)
            if self._recorder is not None:
                self._recorder.write(Chunk(outgoing.data, self._clock.now()), "out")

    def _open_link(self, link: str) -> LiveTransport:
        """Return the transport of a link; open it on first use."""
        if link not in self._captures:
            data = self._captures["data"].transport
            opened = data.link(link) or open_control_link(
                self._source, link, self.sensor.links[link], self._find_sensor_host()
            )
            if _is_broadcast(self.sensor.links[link]):
                self._broadcast_senders[link] = SenderFilter(
                    self._source, self.sensor, datagrams=True
                )
            self._decoders[link] = self.sensor.decoder(
                stream=not opened.datagrams, backend=self._backend
            )
            self._captures[link] = CaptureThread(opened, self.queue, link=link)
        return self._captures[link].transport


def _is_broadcast(link: Link | None) -> bool:
    return isinstance(link, Udp) and bool(link.broadcast)


def _join_chunks(events: list[Event]) -> list[tuple[str, list[Chunk] | LinkEvent | BaseException]]:
    """Return the events, with consecutive chunks of a link joined in one list."""
    joined: list[tuple[str, list[Chunk] | LinkEvent | BaseException]] = []
    run: list[Chunk] = []  # the last list of chunks; empty after another event
    for link, item in events:
        if not isinstance(item, Chunk):
            run = []
            joined.append((link, item))
        elif run and joined[-1][0] == link and not item.gap:
            run.append(item)
        else:
            run = [item]
            joined.append((link, run))
    return joined

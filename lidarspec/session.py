"""Commands and their replies, sans-IO: requests in, what to send out; frames in, replies out.

All times are the caller's, in ns of one monotonic clock. On each link one request is under way at a time; the others wait in
a queue, also while the device settles. The reply is looked for among all frames that arrive on the link, data or not.

A late answer is never taken for the next one's. A sending that was not answered in time is *owed* an answer, until twice the
time that it may take has passed since. While one is owed that could be the reply to the next request as well (a type of frame
in common, and no field in which the two have to differ), that request is held back; an owed answer that does come is counted
in `late` and frees it. A frame that arrived before a request was sent is no answer to it. An answer that is later still can be
told from the next one's only by what the command `matches` or `echoes`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from lidarspec.decoder import Found
from lidarspec.errors import CommandError, ReplyTimeout
from lidarspec.frames.schema import FieldInfo, schema
from lidarspec.replies import Expected, Outgoing, Pending, Reply
from lidarspec.spec import Command, Sensor

SECOND = 1_000_000_000


@dataclass(eq=False)
class _Request:
    """A command on its way: the times of its sendings, and when it is given up."""

    name: str
    command: Command
    data: bytes
    expected: Expected | None
    timeout: int
    pending: Pending
    sent: list[int] = field(default_factory=list)
    wrong: str = ""

    @property
    def gives_up(self) -> int:
        return self.sent[0] + self.timeout

    @property
    def next_sending(self) -> int | None:
        """When it is sent once more, None where it is not."""
        again = self.sent[-1] + _ns(self.command.timeout)
        return again if len(self.sent) <= self.command.retries and again < self.gives_up else None

    @property
    def patience(self) -> int:
        """How long after a sending its answer is still thought possible."""
        return 2 * max(self.timeout, _ns(self.command.timeout))


@dataclass(frozen=True, eq=False)
class _Owed:
    """An answer that may still come."""

    expected: Expected
    until: int


@dataclass(eq=False)
class _Line:
    """What goes on on one link; nothing is sent before `quiet`."""

    queue: deque[_Request] = field(default_factory=deque)
    current: _Request | None = None
    owed: list[_Owed] = field(default_factory=list)
    quiet: int = 0

    def ready(self) -> int | None:
        """When the next request in the queue may be sent, None where there is none."""
        if self.current is not None or not self.queue:
            return None
        expected = self.queue[0].expected
        return max([self.quiet, *(owed.until for owed in self.owed if expected is not None and owed.expected.alike(expected))])


@dataclass(eq=False)
class _Beat:
    """A command that is repeated."""

    arguments: dict[str, Any]
    due: int
    pending: Pending


class Session:
    """The commands of one sensor on its links.

    Feed it every frame that arrives, those included that `Decoder.idle` finds when the line has fallen silent: a device that
    stops in the middle of a frame answers in what looks like the rest of it.

    Attributes:
        sensor: the sensor.
        started: whether a command that starts the sensor was sent, and none since that stops it.
        late: answers that came after they had been given up.
    """

    def __init__(self, sensor: Sensor) -> None:
        self.sensor, self.started, self.late = sensor, False, 0
        self._lines: dict[str, _Line] = {}
        self._beats: dict[str, _Beat] = {}
        self._out: list[Outgoing] = []
        self._tables: dict[str, dict[str, FieldInfo]] = {}

    def request(self, name: str, now: int, /, *, timeout: float | None = None, **arguments: Any) -> Pending:
        """The promise of a command's reply; the command is sent as soon as its link is free.

        Args:
            name: of the command.
            now: the time in ns.
            timeout: seconds to wait in all; by default the command's own for each time that it is sent.
            arguments: of the command, in units.

        Raises:
            UnknownCommand, UnknownField, MissingField, OutOfRange: for what the sensor does not take; nothing is sent.
        """
        data = self.sensor.command(name, **arguments)
        command = self.sensor.commands[name]
        tables = {reply: self._table(reply) for reply in command.replies}
        request = self.sensor.parse(data, command.frame) if command.echoes else None
        wait = _ns(command.timeout) * (1 + command.retries) if timeout is None else _ns(timeout)
        pending = Pending(f"{self.sensor.id} {name}")
        expected = Expected.of(command, tables, request) if tables else None
        self._line(command.link).queue.append(_Request(name, command, data, expected, wait, pending))
        if command.every:
            self._beats[name] = _Beat(arguments, now + _ns(command.every), pending)
        self._advance(command.link, now)
        return pending

    def outgoing(self) -> list[Outgoing]:
        """What is to be sent now, in order; each is given out once."""
        out, self._out = self._out, []
        return out

    def awaited(self, link: str = "data") -> frozenset[str]:
        """The types of frames that `receive` has to see on a link now; it passes over others."""
        line = self._lines.get(link)
        if line is None:
            return frozenset()
        expected = [owed.expected for owed in line.owed] + ([line.current.expected] if line.current and line.current.expected else [])
        return frozenset(name for one in expected for name in one.tables)

    def receive(self, found: Iterable[Found], now: int, *, link: str = "data") -> None:
        """Take frames that arrived on a link at the time `now`."""
        line = self._lines.get(link)
        if line is None:
            return
        for item in found:
            if (line.current is not None or line.owed) and item.frame in self.awaited(link):
                self._take(line, item, now)
        self._advance(link, now)

    def tick(self, now: int) -> None:
        """Send again, give up, end settling, and beat, as far as it is time to."""
        for name, beat in list(self._beats.items()):
            if now >= beat.due:
                beat.due = now + _ns(self.sensor.commands[name].every)
                if beat.pending.done:
                    self.request(name, now, **beat.arguments)
        for link, line in self._lines.items():
            current = line.current
            if current is not None and now >= current.gives_up:
                self._give_up(line, current, _silence(self.sensor, current))
            elif current is not None and current.next_sending is not None and now >= current.next_sending:
                self._send(line, current, now)
            self._advance(link, now)

    @property
    def deadline(self) -> int | None:
        """When `tick` is needed next; None where nothing is waited for."""
        times = [beat.due for beat in self._beats.values()]
        for line in self._lines.values():
            current = line.current
            if current is not None:
                times.append(min(current.gives_up, current.next_sending or current.gives_up))
            elif (ready := line.ready()) is not None:
                times.append(ready)
        return min(times, default=None)

    @property
    def busy(self) -> bool:
        """Whether a request waits to be sent or answered; heartbeats to come do not count."""
        return any(line.current is not None or line.queue for line in self._lines.values())

    def abandon(self, reason: str) -> None:
        """Give up every request and heartbeat, since the link was lost or nobody waits any more; what was sent stays owed."""
        self._beats.clear()
        for line in self._lines.values():
            waiting = list(line.queue)
            line.queue.clear()
            if line.current is not None:
                self._give_up(line, line.current, CommandError(f"{self.sensor.id} {line.current.name}: {reason}"))
            for request in waiting:
                request.pending.settle(CommandError(f"{self.sensor.id} {request.name}: {reason}"))

    def _line(self, link: str) -> _Line:
        return self._lines.setdefault(link, _Line())

    def _table(self, frame: str) -> dict[str, FieldInfo]:
        if frame not in self._tables:
            self._tables[frame] = dict(schema(self.sensor.frames[frame].prepared).fields)
        return self._tables[frame]

    def _advance(self, link: str, now: int) -> None:
        """Send what the queue has, up to the first request that is answered or held back."""
        line = self._lines[link]
        line.owed = [owed for owed in line.owed if owed.until > now]
        while (ready := line.ready()) is not None and now >= ready:
            request = line.queue.popleft()
            self._send(line, request, now)
            if request.expected is not None:
                line.current = request
            else:
                line.quiet = now + _ns(request.command.settle)
                request.pending.settle(Reply(request.name, None, None, False, now))

    def _send(self, line: _Line, request: _Request, now: int) -> None:
        command = request.command
        request.sent.append(now)
        self._out.append(Outgoing(command.link, request.data, command.lines))
        self.started = (self.started or command.starts) and not command.stops

    def _take(self, line: _Line, item: Found, now: int) -> None:
        """The reply to the current request, an answer that is owed, or neither."""
        values = self.sensor.parse(item.data, item.frame)
        current = line.current
        differs = ["not asked for"] if current is None or current.expected is None else current.expected.differs(item.frame, values)
        if current is not None and not differs and now >= current.sent[0]:
            reply = Reply(current.name, item.frame, values, True, now, item.data, self._table(item.frame))
            self._close(line, current, answers=1, since=now)
            current.pending.settle(reply)
            return
        for owed in line.owed:
            if not owed.expected.differs(item.frame, values):
                line.owed.remove(owed)
                self.late += 1
                return
        if current is not None and current.expected is not None and item.frame in current.expected.tables and now >= current.sent[0]:
            current.wrong = f"{item.frame} with {', '.join(differs)}"

    def _give_up(self, line: _Line, request: _Request, error: CommandError) -> None:
        self._close(line, request, answers=0, since=request.sent[-1])
        request.pending.settle(error)

    def _close(self, line: _Line, request: _Request, *, answers: int, since: int) -> None:
        """The link is free again; every sending but those answered is owed its answer."""
        line.current = None
        line.quiet = since + _ns(request.command.settle)
        if request.expected is not None:
            line.owed += [_Owed(request.expected, sent + request.patience) for sent in request.sent[answers:]]


def _silence(sensor: Sensor, request: _Request) -> CommandError:
    """What to say when the time is up."""
    place = f"{sensor.id} {request.name}"
    if request.wrong:
        return CommandError(f"{place}: the device answered with {request.wrong}")
    often = f", sent {len(request.sent)} times" if len(request.sent) > 1 else ""
    return ReplyTimeout(f"{place}: no {' or '.join(request.command.replies)} frame came within {request.timeout / SECOND:g} s{often}")


def _ns(seconds: float) -> int:
    return round(seconds * SECOND)

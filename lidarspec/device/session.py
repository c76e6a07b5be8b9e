"""Commands and their replies, without I/O.

Requests go in, and bytes to send come out; frames go in, and replies come out. All times are the
caller's, in ns of one monotonic clock. Each link has one request at a time. Others wait in a queue,
also while the device settles. All frames that arrive on the link, data or not, are compared with
the expected reply.

A late reply must not be used for the next request. If a sent command gets no reply in time, the
session still expects one, until twice the timeout has passed. If that late reply could also be the
reply to the next request (a common frame type, and no field in which the two have to differ), the
next request is held back. A late reply that does arrive is counted in `late`, and releases it. A
frame that arrived before a request was sent is not its reply. After twice the timeout, only the
fields in `matches` or `echoes` distinguish a late reply from the next one.

A running number (`Count`) is filled in when a request is made, so that a repeated command has the
same number; `echoes` then distinguishes its reply from all others. The owner of the session
configures the sensor with the options that a reply reports.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from lidarspec.errors import CommandError, ReplyTimeout, UnknownField, UsageError
from lidarspec.frames.field_paths import split_path
from lidarspec.framing.frame_engine import codec
from lidarspec.framing.results import Found
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.arguments import Address, Filled
from lidarspec.spec.description import Command
from lidarspec.spec.options import Learned
from lidarspec.spec.tree import FieldInfo

#: maximum number of fields in a reply's repr.
SHOWN = 6
_MISSING = object()
SECOND = 1_000_000_000


@dataclass(frozen=True)
class OutgoingData:
    """Bytes to send on a link, after setting its control lines."""

    link: str
    data: bytes
    lines: Mapping[str, bool] = field(default_factory=dict)


@dataclass(frozen=True, repr=False)
class Reply:
    """The answer to a command.

    Attributes:
        command: the name of the command.
        frame: the type of the frame that answered; None if no answer is documented.
        values: its fields, raw wire integers as `Sensor.parse` returns them; ``reply["path"]`` is
            the physical value.
        confirmed: whether the device answered.
        at: the arrival time by the session's clock; without a reply, the time when the command was
            sent.
        data: the bytes of the frame.
    """

    command: str
    frame: str | None
    values: Any
    confirmed: bool
    at: int
    data: bytes = b""
    fields: Mapping[str, FieldInfo] = field(default_factory=dict, compare=False)

    def __getitem__(self, path: str) -> Any:
        """Return the value of a field in its unit, a list if it is in an array.

        Raises:
            UnknownField: for a path that the frame does not have.
        """
        value = get_nested(self.values, path)
        if path not in self.fields or value is _MISSING:
            raise UnknownField(
                path, self.fields, place=f"{self.command} {self.frame or 'without a reply'}"
            )
        return _physical(self.fields[path], value)

    def __repr__(self) -> str:
        if not self.confirmed:
            return f"Reply({self.command}, not confirmed)"
        free = [
            info
            for info in self.fields.values()
            if info.const is None and get_nested(self.values, info.path) is not _MISSING
        ]
        texts = [
            f"{info.path} {self[info.path]}{' ' * bool(info.unit)}{info.unit}"
            for info in free[:SHOWN]
        ]
        more = ", ..." if len(free) > SHOWN else ""
        return f"Reply({self.command}, {self.frame}: {', '.join(texts)}{more})"


class PendingReply:
    """The future result of a command: its reply or its failure."""

    def __init__(self, place: str) -> None:
        self._place = place
        self._outcome: Reply | CommandError | None = None

    @property
    def done(self) -> bool:
        """Whether there is a result."""
        return self._outcome is not None

    @property
    def failure(self) -> CommandError | None:
        """The error if there is no reply; None for success, or if it is not done."""
        if isinstance(self._outcome, CommandError):
            return self._outcome
        return None

    def result(self) -> Reply:
        """Return the reply.

        Raises:
            ReplyTimeout: if none came in time.
            CommandError: if the device answered with something else, or the command was abandoned.
            UsageError: if it is not done.
        """
        if self._outcome is None:
            raise UsageError(f"{self._place} is not answered yet")
        if isinstance(self._outcome, CommandError):
            raise self._outcome
        return self._outcome

    def settle(self, outcome: Reply | CommandError) -> None:
        """Set the result; called by the session."""
        self._outcome = outcome


@dataclass(frozen=True)
class ExpectedReply:
    """The frames that can be the reply to one request.

    Attributes:
        tables: frame type -> fields by path.
        values: path -> required value; paths that a type does not have are ignored.
        refusal: the type of the frame that refuses; None if there is none.
    """

    tables: Mapping[str, Mapping[str, FieldInfo]]
    values: Mapping[str, Any]
    refusal: str | None = None

    def find_differences(self, frame: str, values: Any) -> list[str]:
        """Return the differences between a frame and the reply; empty if there are none."""
        if frame not in self.tables:
            return [f"a frame {frame}"]
        expected = {
            path: value for path, value in self.values.items() if path in self.tables[frame]
        }
        got = {path: get_nested(values, path) for path in expected}
        wrong = [
            (path, "missing" if got[path] is _MISSING else got[path])
            for path in expected
            if got[path] != expected[path]
        ]
        return [f"{path} {there} instead of {expected[path]}" for path, there in wrong]

    def overlaps(self, other: ExpectedReply) -> bool:
        """Return whether one frame could be the reply to both."""
        return any(
            all(
                other.values.get(path, value) == value
                for path, value in self.values.items()
                if path in self.tables[frame]
            )
            for frame in self.tables.keys() & other.tables.keys()
        )


def get_nested(values: Any, path: str) -> Any:
    """Return the value at a path of a parsed frame.

    Below an array without an index, it is a list of values. If there is no value, it is `_MISSING`.
    """
    for name in split_path(path):
        if isinstance(name, int):
            if isinstance(values, list) and name < len(values):
                values = values[name]
            else:
                values = _MISSING
        elif isinstance(values, list):
            values = [get_nested(element, name) for element in values]
        elif isinstance(values, Mapping) and name in values:
            values = values[name]
        else:
            return _MISSING
    return values


def _physical(info: FieldInfo, value: Any) -> Any:
    if isinstance(value, list):
        return [_physical(info, element) for element in value]
    if isinstance(value, int | float):
        return info.physical(value)
    return value


@dataclass(eq=False)
class _PendingCommand:
    """A command in progress.

    Attributes:
        timeout: ns from the first sending until it fails.
        sent: the times of its sendings.
        wrong: the differences of the last frame that was almost the reply.
    """

    name: str
    command: Command
    data: bytes
    expected: ExpectedReply | None
    timeout: int
    pending: PendingReply
    sent: list[int] = field(default_factory=list)
    wrong: str = ""

    @property
    def gives_up(self) -> int:
        return self.sent[0] + self.timeout

    @property
    def next_sending(self) -> int | None:
        """The time at which it is sent again, None if it is not."""
        again = self.sent[-1] + _ns(self.command.timeout)
        if len(self.sent) <= self.command.retries and again < self.gives_up:
            return again
        return None

    @property
    def patience(self) -> int:
        """The time after a sending in which a late reply is possible, in ns."""
        return 2 * max(self.timeout, _ns(self.command.timeout))


@dataclass(frozen=True, eq=False)
class _LateReply:
    """A reply that may still arrive."""

    expected: ExpectedReply
    until: int


@dataclass(eq=False)
class _LinkQueue:
    """The state of one link; nothing is sent before `quiet`."""

    queue: deque[_PendingCommand] = field(default_factory=deque)
    current: _PendingCommand | None = None
    late_replies: list[_LateReply] = field(default_factory=list)
    quiet: int = 0

    def ready(self) -> int | None:
        """Return the time at which the next request may be sent, None without one."""
        if self.current is not None or not self.queue:
            return None
        expected = self.queue[0].expected
        return max(
            [
                self.quiet,
                *(
                    owed.until
                    for owed in self.late_replies
                    if expected is not None and owed.expected.overlaps(expected)
                ),
            ]
        )


@dataclass(eq=False)
class _Heartbeat:
    """A command that is repeated."""

    arguments: dict[str, Any]
    due: int
    pending: PendingReply


class Session:
    """The commands of one sensor on its links.

    Pass every arriving frame to it, including those that `Decoder.idle` finds in silence: a device
    that stops in the middle of a frame replies in bytes that look like the rest of it.

    Attributes:
        sensor: the sensor.
        started: whether a command that starts the sensor was sent, and none since that stops it.
        late: number of replies that arrived after their timeout.
        unanswered: command -> error of a heartbeat that is not answered any more.
        host: the address of this computer as the sensor sees it, None if unknown.
    """

    def __init__(self, sensor: Sensor) -> None:
        self.sensor = sensor
        self.started = False
        self.late = 0
        self.host: str | None = None
        self.unanswered: dict[str, CommandError] = {}
        self._count = 0
        self._lines: dict[str, _LinkQueue] = {}
        self._heartbeats: dict[str, _Heartbeat] = {}
        self._out: list[OutgoingData] = []

    def request(
        self, name: str, now: int, /, *, timeout: float | None = None, **arguments: Any
    ) -> PendingReply:
        """Queue a command, and return its future reply.

        It is sent as soon as its link is free.

        Args:
            name: of the command.
            now: the time in ns.
            timeout: seconds to wait in total; by default the command's own timeout for each
                sending.
            arguments: of the command, in units.

        Raises:
            UnknownCommand, UnknownField, MissingField, OutOfRange: for an invalid command; nothing
                is sent.
        """
        filled = {
            path: self._fill_value(value)
            for path, value in self._fill_values(name).items()
            if path not in arguments
        }
        data = self.sensor.command(name, **arguments, **filled)
        command = self.sensor.commands[name]
        tables = {reply: self._table(reply) for reply in command.replies}
        if command.echoes:
            sent = self.sensor.parse(data, command.frame)
        else:
            sent = None
        values = {**command.matches, **{path: get_nested(sent, path) for path in command.echoes}}
        if timeout is None:
            wait = _ns(command.timeout) * (1 + command.retries)
        else:
            wait = _ns(timeout)
        pending = PendingReply(f"{self.sensor.id} {name}")
        if tables:
            expected = ExpectedReply(tables, values, command.refusal)
        else:
            expected = None
        self._lines.setdefault(command.link, _LinkQueue()).queue.append(
            _PendingCommand(name, command, data, expected, wait, pending)
        )
        if command.every:
            self._heartbeats[name] = _Heartbeat(arguments, now + _ns(command.every), pending)
        self._advance(command.link, now)
        return pending

    def outgoing(self) -> list[OutgoingData]:
        """Return everything that has to be sent now, in order, once."""
        out = self._out
        self._out = []
        return out

    def awaited_frames(self, link: str = "data") -> frozenset[str]:
        """Return the frame types that `receive` needs from a link; it ignores others."""
        line = self._lines.get(link)
        if line is None:
            return frozenset()
        expected = [owed.expected for owed in line.late_replies] + (
            [line.current.expected] if line.current and line.current.expected else []
        )
        return frozenset(name for one in expected for name in (*one.tables, one.refusal) if name)

    def receive(self, frames: Iterable[Found], now: int, *, link: str = "data") -> None:
        """Process frames that arrived on a link at the time `now`."""
        line = self._lines.get(link)
        if line is None:
            return
        for item in frames:
            if (
                line.current is not None or line.late_replies
            ) and item.frame in self.awaited_frames(link):
                self._take(line, item, now)
        self._advance(link, now)

    def tick(self, now: int) -> None:
        """Send again, time out, end settling, and send heartbeats that are due."""
        for name, beat in list(self._heartbeats.items()):
            if now >= beat.due:
                beat.due = now + _ns(self.sensor.commands[name].every)
                if beat.pending.done:
                    if beat.pending.failure is not None:
                        self.unanswered[name] = beat.pending.failure
                    self.request(name, now, **beat.arguments)
        for link, line in self._lines.items():
            current = line.current
            if current is not None and now >= current.gives_up:
                self._give_up(line, current, _silence(self.sensor, current))
            elif (
                current is not None
                and current.next_sending is not None
                and now >= current.next_sending
            ):
                self._send(current, now)
            self._advance(link, now)

    @property
    def deadline(self) -> int | None:
        """The time at which `tick` is needed next; None if there is none."""
        times = [beat.due for beat in self._heartbeats.values()]
        for line in self._lines.values():
            current = line.current
            if current is not None:
                times.append(min(current.gives_up, current.next_sending or current.gives_up))
            elif (ready := line.ready()) is not None:
                times.append(ready)
        return min(times, default=None)

    @property
    def busy(self) -> bool:
        """Whether a request waits to be sent or answered; future heartbeats do not count."""
        return any(line.current is not None or line.queue for line in self._lines.values())

    def abandon(self, reason: str, link: str | None = None) -> None:
        """Fail every request and stop every heartbeat, or those on one link.

        The link was lost, or no caller waits. Replies to commands that were sent are still
        expected.
        """
        for name in [
            name for name in self._heartbeats if link in (None, self.sensor.commands[name].link)
        ]:
            del self._heartbeats[name]
            self.unanswered.pop(name, None)
        for line in [line for name, line in self._lines.items() if link in (None, name)]:
            waiting = list(line.queue)
            line.queue.clear()
            if line.current is not None:
                self._give_up(
                    line,
                    line.current,
                    CommandError(f"{self.sensor.id} {line.current.name}: {reason}"),
                )
            for request in waiting:
                request.pending.settle(CommandError(f"{self.sensor.id} {request.name}: {reason}"))

    def _fill_values(self, name: str) -> Mapping[str, Filled]:
        if name in self.sensor.commands:
            return self.sensor.commands[name].filled
        return {}

    def _fill_value(self, value: Filled) -> Any:
        """Return a value that is known only when a command is sent.

        It is our own address, or the next number, which all commands of the session share.
        """
        if isinstance(value, Address):
            return self.host
        self._count += 1
        return value.at(self._count - 1)

    def _table(self, frame: str) -> Mapping[str, FieldInfo]:
        return codec(self.sensor.frames[frame]).schema.fields

    def _advance(self, link: str, now: int) -> None:
        """Send queued requests, up to the first that waits for a reply or is held back."""
        line = self._lines[link]
        line.late_replies = [owed for owed in line.late_replies if owed.until > now]
        while (ready := line.ready()) is not None and now >= ready:
            request = line.queue.popleft()
            self._send(request, now)
            if request.expected is not None:
                line.current = request
            else:
                line.quiet = now + _ns(request.command.settle)
                request.pending.settle(Reply(request.name, None, None, False, now))

    def _send(self, request: _PendingCommand, now: int) -> None:
        command = request.command
        request.sent.append(now)
        self._out.append(OutgoingData(command.link, request.data, command.lines))
        self.started = (self.started or command.starts) and not command.stops

    def _take(self, line: _LinkQueue, item: Found, now: int) -> None:
        """Use a frame as the reply to the current request, or as a late reply."""
        values = self.sensor.parse(item.data, item.frame)
        current = line.current
        if self._is_refusal(line, item, values, now):
            return
        if current is None or current.expected is None:
            differs = ["not asked for"]
        else:
            differs = current.expected.find_differences(item.frame, values)
        if current is not None and not differs and now >= current.sent[0]:
            reply = Reply(
                current.name, item.frame, values, True, now, item.data, self._table(item.frame)
            )
            self._close(line, current, answers=1, since=now)
            current.pending.settle(reply)
            self.unanswered.pop(current.name, None)
            return
        for owed in line.late_replies:
            if not owed.expected.find_differences(item.frame, values):
                line.late_replies.remove(owed)
                self.late += 1
                return
        if (
            current is not None
            and current.expected is not None
            and item.frame in current.expected.tables
            and now >= current.sent[0]
        ):
            current.wrong = f"{item.frame} with {', '.join(differs)}"

    def _is_refusal(self, line: _LinkQueue, item: Found, values: Any, now: int) -> bool:
        """Return whether a frame refuses the oldest request without a reply.

        The frame does not tell which request it refuses.
        """
        owed = next(
            (owed for owed in line.late_replies if owed.expected.refusal == item.frame), None
        )
        current = line.current
        if owed is not None:
            line.late_replies.remove(owed)
            self.late += 1
        elif (
            current is not None
            and current.expected is not None
            and current.expected.refusal == item.frame
            and now >= current.sent[0]
        ):
            self._close(line, current, answers=1, since=now)
            why = _reasons(self._table(item.frame), values) or repr(
                Reply(current.name, item.frame, values, True, now, fields=self._table(item.frame))
            )
            current.pending.settle(
                CommandError(f"{self.sensor.id} {current.name}: the sensor refuses it: {why}")
            )
        else:
            return False
        return True

    def _give_up(self, line: _LinkQueue, request: _PendingCommand, error: CommandError) -> None:
        self._close(line, request, answers=0, since=request.sent[-1])
        request.pending.settle(error)

    def _close(
        self, line: _LinkQueue, request: _PendingCommand, *, answers: int, since: int
    ) -> None:
        """Free the link; each sending without a reply may still get a late one."""
        line.current = None
        line.quiet = since + _ns(request.command.settle)
        if request.expected is not None:
            line.late_replies += [
                _LateReply(request.expected, sent + request.patience)
                for sent in request.sent[answers:]
            ]


def learn_options(sensor: Sensor, reply: Reply) -> dict[str, Any]:
    """Return the options that a reply reports, by name.

    Empty if the command learns nothing.

    Raises:
        CommandError: for a reply that cannot be learned from.
    """
    learns = sensor.commands[reply.command].learns
    if learns is None or not reply.confirmed:
        return {}
    place = f"{sensor.id} {reply.command}"
    try:
        options = {
            name: value.encode() if isinstance(value, str) else value
            for name, value in learns(reply.values).items()
        }
    except Exception as error:
        raise CommandError(
            f"{place}: nothing can be learned from the reply: {type(error).__name__}: {error}"
        ) from error
    for name, value in options.items():
        if not isinstance(value, bytes | int | float):
            raise CommandError(
                f"{place}: {name} is learned as a number, bytes or a text, not as"
                f" {type(value).__name__}"
            )
    return {
        name: Learned(value) if isinstance(value, bytes) else value
        for name, value in options.items()
    }


def _reasons(fields: Mapping[str, FieldInfo], values: Any) -> str:
    """Return the labels of the values of labelled fields, with their numbers.

    Returns "" if no value has a label.
    """
    reasons = [
        f"{path} {name} ({number})"
        for path, info in fields.items()
        for number, name in info.labels.items()
        if get_nested(values, path) == name
    ]
    return ", ".join(reasons)


def _silence(sensor: Sensor, request: _PendingCommand) -> CommandError:
    """Return the error for a request without a reply."""
    place = f"{sensor.id} {request.name}"
    if request.wrong:
        return CommandError(f"{place}: the device answered with {request.wrong}")
    if len(request.sent) > 1:
        often = f", sent {len(request.sent)} times"
    else:
        often = ""
    if request.command.only_stopped:
        stop = next((name for name, command in sensor.commands.items() if command.stops), "stop")
    else:
        stop = ""
    if stop:
        hint = f"; it is answered only while the sensor is stopped: send {stop!r} first"
    else:
        hint = ""
    waited = f"{request.timeout / SECOND:g} s{often}"
    return ReplyTimeout(
        f"{place}: no {' or '.join(request.command.replies)} frame came within {waited}{hint}"
    )


def _ns(seconds: float) -> int:
    return round(seconds * SECOND)

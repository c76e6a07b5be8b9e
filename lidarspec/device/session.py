"""Commands and their replies, without I/O.

The session takes requests and received frames, and returns bytes to send and replies. The caller
passes all times, in ns of one monotonic clock. Each link has at most one current request, and a
queue of further requests. Every frame that arrives on the link is compared with the expected reply.

A late reply must not be taken for the reply to the next request. After a timeout, the session
therefore waits for the late reply until twice the timeout has passed. Until then, it delays
requests whose reply could not be distinguished from the late reply. After that, only the fields in
`matches` or `echoes` distinguish the replies.

A running number (`Count`) is set when a request is made, so repetitions of the command have the
same number. A value from an earlier reply is set when the command is sent.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from lidarspec.errors import CommandError, ReplyTimeout, UnknownField, UsageError
from lidarspec.frames.field_paths import split_path
from lidarspec.frames.number_format import find_number_format
from lidarspec.framing.frame_engine import get_codec
from lidarspec.framing.results import Found
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.arguments import OWN_ADDRESS, OWN_PORT, Address, Count, Port
from lidarspec.spec.description import Command
from lidarspec.spec.enum_values import EnumValue, find_code, to_enum_value
from lidarspec.spec.options import Learned
from lidarspec.spec.tree import FieldInfo

#: maximum number of fields in the repr of a reply.
MAX_SHOWN_FIELDS = 6
_MISSING = object()
NS_PER_S = 1_000_000_000


@dataclass(frozen=True)
class OutgoingData:
    """Bytes to send on a link, after setting its control lines."""

    link: str
    data: bytes
    lines: Mapping[str, bool] = field(default_factory=dict)


@dataclass(frozen=True, repr=False)
class Reply:
    """The reply to a command.

    Attributes:
        command: the name of the command.
        frame: the frame type of the reply; None if the sensor sends no reply to this command.
        values: the fields of the frame as raw wire integers, as returned by `Sensor.parse`;
            ``reply["path"]`` is the physical value.
        confirmed: whether the device replied.
        at: the arrival time by the session's clock, ns; the time of sending if `confirmed` is
            False.
        data: the bytes of the frame.
        fields: the fields of the frame type, by path.
    """

    command: str
    frame: str | None
    values: Any
    confirmed: bool
    at: int
    data: bytes = b""
    fields: Mapping[str, FieldInfo] = field(default_factory=dict, compare=False)

    def __getitem__(self, path: str) -> Any:
        """Return the physical value of a field; a list if the field is in an array.

        Raises:
            UnknownField: for a path that the frame does not have.
        """
        value = get_nested(self.values, path)
        if path not in self.fields or value is _MISSING:
            raise UnknownField(
                path, self.fields, place=f"{self.command} {self.frame or 'without a reply'}"
            )
        return _to_physical(self.fields[path], value)

    def __repr__(self) -> str:
        if not self.confirmed:
            return f"Reply({self.command}, not confirmed)"
        free = [
            info
            for info in self.fields.values()
            if info.const is None and get_nested(self.values, info.path) is not _MISSING
        ]
        texts = [
            f"{info.path} {_format_physical(info, self[info.path])} {info.unit}".rstrip()
            for info in free[:MAX_SHOWN_FIELDS]
        ]
        more = ", ..." if len(free) > MAX_SHOWN_FIELDS else ""
        return f"Reply({self.command}, {self.frame}: {', '.join(texts)}{more})"


class PendingReply:
    """The future result of a command: a reply or an error."""

    def __init__(self, place: str) -> None:
        self._place = place
        self._outcome: Reply | CommandError | None = None

    @property
    def done(self) -> bool:
        """Whether there is a result."""
        return self._outcome is not None

    @property
    def failure(self) -> CommandError | None:
        """The error of the command; None if it succeeded or is not done."""
        if isinstance(self._outcome, CommandError):
            return self._outcome
        return None

    def result(self) -> Reply:
        """Return the reply.

        Raises:
            ReplyTimeout: if no reply arrived in time.
            CommandError: if the device refused or sent another reply, or if the command was
                abandoned.
            UsageError: if the command is not done.
        """
        if self._outcome is None:
            raise UsageError(f"{self._place} has no reply yet")
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
        tables: the fields of each possible reply: frame type -> path -> field.
        matches: the values that a reply must have: path -> value. Paths that its frame type does
            not have are ignored.
        echoes: the values that both a reply and a refusal must have: path -> value. Missing paths
            are ignored.
        refusal: the frame type of a refusal; None if the sensor sends no refusals.
    """

    tables: Mapping[str, Mapping[str, FieldInfo]]
    matches: Mapping[str, Any]
    echoes: Mapping[str, Any] = field(default_factory=dict)
    refusal: str | None = None

    @property
    def values(self) -> dict[str, Any]:
        """All values that the reply must have, from `matches` and `echoes`."""
        return {**self.matches, **self.echoes}

    def find_differences(self, frame: str, values: Any) -> list[str]:
        """Return texts that describe how a frame differs from the expected reply.

        The list is empty if the frame can be the reply.
        """
        if frame not in self.tables:
            return [f"a {frame} frame"]
        table = self.tables[frame]
        expected = {
            path: find_code(table[path], value)
            for path, value in self.values.items()
            if path in table
        }
        got = {path: get_nested(values, path) for path in expected}
        wrong = [
            (path, "missing" if got[path] is _MISSING else got[path])
            for path in expected
            if got[path] != expected[path]
        ]
        return [
            f"{path} {value} instead of {to_enum_value(table[path], expected[path])}"
            for path, value in wrong
        ]

    def is_refusal(self, frame: str, values: Any) -> bool:
        """Return whether a frame can be the refusal of the request."""
        return frame == self.refusal and all(
            get_nested(values, path) in (value, _MISSING) for path, value in self.echoes.items()
        )

    def overlaps(self, other: ExpectedReply) -> bool:
        """Return whether a frame could match both this and another expected reply."""
        return any(
            all(
                other.values.get(path, value) == value
                for path, value in self.values.items()
                if path in self.tables[frame]
            )
            for frame in self.tables.keys() & other.tables.keys()
        )


def get_nested(values: Any, path: str) -> Any:
    """Return the value at a path of a parsed frame; `_MISSING` if there is none."""
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


def _format_physical(info: FieldInfo, value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(_format_physical(info, element) for element in value)}]"
    if isinstance(value, float):
        return find_number_format(info).format(value)
    return str(value)


def _to_physical(info: FieldInfo, value: Any) -> Any:
    if isinstance(value, list):
        return [_to_physical(info, element) for element in value]
    if isinstance(value, int | float):
        return info.physical(value)
    return value


@dataclass(eq=False)
class _PendingCommand:
    """A command in progress.

    Attributes:
        data: the bytes of the command; values from earlier replies may be missing.
        timeout: time from the first sending to the failure of the command, ns.
        sent: the times of all sendings, ns.
        wrong: a description of the last frame with the type of the reply, but wrong values.
    """

    name: str
    command: Command
    data: bytes
    arguments: Mapping[str, Any]
    expected: ExpectedReply | None
    timeout: int
    pending: PendingReply
    sent: list[int] = field(default_factory=list)
    wrong: str = ""

    @property
    def fails_at(self) -> int:
        return self.sent[0] + self.timeout

    @property
    def next_sending(self) -> int | None:
        """The time at which the command is sent again, ns; None if it is not sent again."""
        next_time = self.sent[-1] + _to_ns(self.command.timeout)
        if len(self.sent) <= self.command.retries and next_time < self.fails_at:
            return next_time
        return None

    @property
    def max_reply_delay(self) -> int:
        """The maximum time between sending the command and a late reply, ns."""
        return 2 * max(self.timeout, _to_ns(self.command.timeout))


@dataclass(frozen=True, eq=False)
class _LateReply:
    """A reply that may still arrive."""

    expected: ExpectedReply
    until: int


@dataclass(eq=False)
class _LinkQueue:
    """The requests of one link.

    Attributes:
        late_replies: replies that may still arrive after their timeout.
        quiet_until: time until which nothing is sent, ns.
    """

    queue: deque[_PendingCommand] = field(default_factory=deque)
    current: _PendingCommand | None = None
    late_replies: list[_LateReply] = field(default_factory=list)
    quiet_until: int = 0

    def next_sending(self) -> int | None:
        """Return the time at which the next request may be sent; None if no request waits."""
        if self.current is not None or not self.queue:
            return None
        expected = self.queue[0].expected
        return max(
            [
                self.quiet_until,
                *(
                    late.until
                    for late in self.late_replies
                    if expected is not None and late.expected.overlaps(expected)
                ),
            ]
        )


@dataclass(eq=False)
class _Heartbeat:
    """A command that is sent regularly.

    Attributes:
        due: the time of the next sending, ns.
    """

    arguments: dict[str, Any]
    due: int
    pending: PendingReply


class Session:
    """The commands of one sensor on its links.

    Pass every arriving frame to `receive`, and the frames that `Decoder.idle` returns when the link
    falls silent. Without `idle`, a reply after an incomplete frame is not found.

    Attributes:
        started: whether the sensor was started, and not stopped since.
        late: number of replies that arrived after their timeout.
        unanswered: name of each heartbeat command that failed -> the error of its last failure. A
            later reply removes the entry.
        host: the address of this computer as seen by the sensor; None if unknown.
        port: the port at which this computer expects the data; None if unknown.
        provided: name in `Command.provides` -> value from a reply.
    """

    def __init__(self, sensor: Sensor) -> None:
        self.sensor = sensor
        self.started = False
        self.late = 0
        self.host: str | None = None
        self.port: int | None = None
        self.provided: dict[str, Any] = {}
        self.unanswered: dict[str, CommandError] = {}
        self._count = 0
        self._lines: dict[str, _LinkQueue] = {}
        self._heartbeats: dict[str, _Heartbeat] = {}
        self._out: list[OutgoingData] = []

    def request(
        self, name: str, now: int, /, *, timeout: float | None = None, **arguments: Any
    ) -> PendingReply:
        """Queue a command, and return its future reply.

        The command is sent as soon as its link is free.

        Args:
            name: the name of the command.
            now: the current time, ns.
            timeout: seconds to wait in total; by default, the command's timeout after each sending.
            arguments: the arguments of the command, in their units.

        Raises:
            UnknownCommand, UnknownField, MissingField, OutOfRange: for an invalid command; nothing
                is sent.
        """
        if name in self.sensor.commands:
            filled = {**self._make_own_values(self.sensor.commands[name]), **arguments}
        else:
            filled = arguments
        data = self.sensor.command(name, **filled)
        command = self.sensor.commands[name]
        tables = {reply: self._get_fields(reply) for reply in command.replies}
        if command.echoes:
            sent = self.sensor.parse(data, command.frame)
        else:
            sent = None
        echoes = {path: get_nested(sent, path) for path in command.echoes}
        if timeout is None:
            wait = _to_ns(command.timeout) * (1 + command.retries)
        else:
            wait = _to_ns(timeout)
        pending = PendingReply(f"{self.sensor.id} {name}")
        if tables:
            expected = ExpectedReply(tables, command.matches, echoes, command.refusal)
        else:
            expected = None
        self._lines.setdefault(command.link, _LinkQueue()).queue.append(
            _PendingCommand(name, command, data, filled, expected, wait, pending)
        )
        if command.every:
            self._heartbeats[name] = _Heartbeat(arguments, now + _to_ns(command.every), pending)
        self._advance(command.link, now)
        return pending

    def take_outgoing(self) -> list[OutgoingData]:
        """Return the data to send now, in order, and remove it from the session."""
        out = self._out
        self._out = []
        return out

    def awaited_frames(self, link: str = "data") -> frozenset[str]:
        """Return the frame types of a link that can be replies."""
        line = self._lines.get(link)
        if line is None:
            return frozenset()
        replies = [late.expected for late in line.late_replies]
        if line.current and line.current.expected:
            replies.append(line.current.expected)
        return frozenset(
            name for reply in replies for name in (*reply.tables, reply.refusal) if name
        )

    def receive(self, frames: Iterable[Found], now: int, *, link: str = "data") -> None:
        """Compare frames that arrived on a link at the time `now` with expected replies."""
        line = self._lines.get(link)
        if line is None:
            return
        for item in frames:
            if (
                line.current is not None or line.late_replies
            ) and item.frame in self.awaited_frames(link):
                self._use_frame(line, item, now)
        self._advance(link, now)

    def tick(self, now: int) -> None:
        """Do everything that is due: send commands again, fail requests, send heartbeats."""
        for name, beat in list(self._heartbeats.items()):
            if now >= beat.due:
                beat.due = now + _to_ns(self.sensor.commands[name].every)
                if beat.pending.done:
                    if beat.pending.failure is not None:
                        self.unanswered[name] = beat.pending.failure
                    self.request(name, now, **beat.arguments)
        for link, line in self._lines.items():
            current = line.current
            if current is not None and now >= current.fails_at:
                self._fail(line, current, _make_timeout_error(self.sensor, current))
            elif (
                current is not None
                and current.next_sending is not None
                and now >= current.next_sending
            ):
                self._send(current, now)
            self._advance(link, now)

    @property
    def deadline(self) -> int | None:
        """The time at which `tick` has to be called next, ns; None if nothing will be due."""
        times = [beat.due for beat in self._heartbeats.values()]
        for line in self._lines.values():
            current = line.current
            if current is not None:
                times.append(min(current.fails_at, current.next_sending or current.fails_at))
            elif (ready := line.next_sending()) is not None:
                times.append(ready)
        return min(times, default=None)

    @property
    def busy(self) -> bool:
        """Whether a request waits to be sent, or for its reply."""
        return any(line.current is not None or line.queue for line in self._lines.values())

    def abandon(self, reason: str, link: str | None = None) -> None:
        """Fail all requests and stop all heartbeats.

        Args:
            link: the link on which requests fail; None for all links.
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
                self._fail(
                    line,
                    line.current,
                    CommandError(f"{self.sensor.id} {line.current.name}: {reason}"),
                )
            for request in waiting:
                request.pending.settle(CommandError(f"{self.sensor.id} {request.name}: {reason}"))

    def _make_own_values(self, command: Command) -> dict[str, Any]:
        """Return the values of a command that the session knows: path or name -> value.

        These are running numbers, and the address and port of this computer.
        """
        filled: dict[str, Any] = {}
        for path, value in command.filled.items():
            if isinstance(value, Count):
                filled[path] = value.at(self._count)
                self._count += 1
            elif isinstance(value, Address):
                filled[path] = self.host
            elif isinstance(value, Port):
                filled[path] = self.port
        if OWN_ADDRESS in command.placeholders:
            filled[OWN_ADDRESS] = self.host or "0.0.0.0"
        if OWN_PORT in command.placeholders:
            filled[OWN_PORT] = self.port or 0
        return filled

    def _fill_in_provided(self, request: _PendingCommand) -> None:
        """Fill in the values that earlier replies have provided."""
        needed = request.command.needed - set(request.arguments)
        missing = needed - set(self.provided)
        if missing:
            raise CommandError(
                f"{self.sensor.id} {request.name}: {min(missing)} is unknown, because the sensor"
                " has not reported it"
            )
        if needed:
            provided = {name: self.provided[name] for name in needed}
            try:
                request.data = self.sensor.command(request.name, **request.arguments, **provided)
            except UsageError as error:
                raise CommandError(f"the sensor reported an invalid value: {error}") from None

    def _get_fields(self, frame: str) -> Mapping[str, FieldInfo]:
        return get_codec(self.sensor.frames[frame]).schema.fields

    def _advance(self, link: str, now: int) -> None:
        """Send the queued requests of a link, until a request has to wait."""
        line = self._lines[link]
        line.late_replies = [late for late in line.late_replies if late.until > now]
        while (ready := line.next_sending()) is not None and now >= ready:
            request = line.queue.popleft()
            try:
                self._fill_in_provided(request)
            except CommandError as error:
                request.pending.settle(error)
                continue
            self._send(request, now)
            if request.expected is not None:
                line.current = request
            else:
                line.quiet_until = now + _to_ns(request.command.settle)
                request.pending.settle(Reply(request.name, None, None, False, now))

    def _send(self, request: _PendingCommand, now: int) -> None:
        command = request.command
        request.sent.append(now)
        self._out.append(OutgoingData(command.link, request.data, command.lines))
        self.started = (self.started or command.starts) and not command.stops

    def _use_frame(self, line: _LinkQueue, item: Found, now: int) -> None:
        """Use a frame as the reply to the current request, or as a late reply."""
        values = self.sensor.parse(item.data, item.frame)
        current = line.current
        if self._use_refusal(line, item, values, now):
            return
        if current is None or current.expected is None:
            differs = ["no command waits for a reply"]
        else:
            differs = current.expected.find_differences(item.frame, values)
        if current is not None and not differs and now >= current.sent[0]:
            reply = Reply(
                current.name, item.frame, values, True, now, item.data, self._get_fields(item.frame)
            )
            self._free_link(line, current, reply_count=1, since=now)
            self.unanswered.pop(current.name, None)
            try:
                self.provided |= provided_values(self.sensor, reply)
            except CommandError as error:
                current.pending.settle(error)
            else:
                current.pending.settle(reply)
            return
        for late in line.late_replies:
            if not late.expected.find_differences(item.frame, values):
                line.late_replies.remove(late)
                self.late += 1
                return
        if (
            current is not None
            and current.expected is not None
            and item.frame in current.expected.tables
            and now >= current.sent[0]
        ):
            current.wrong = f"{item.frame} with {', '.join(differs)}"

    def _use_refusal(self, line: _LinkQueue, item: Found, values: Any, now: int) -> bool:
        """Fail the oldest request if a frame is a refusal; return whether it is one."""
        # a refusal may not identify its request: assume the oldest that it does not contradict
        refused = next(
            (late for late in line.late_replies if late.expected.is_refusal(item.frame, values)),
            None,
        )
        current = line.current
        if refused is not None:
            line.late_replies.remove(refused)
            self.late += 1
        elif (
            current is not None
            and current.expected is not None
            and current.expected.is_refusal(item.frame, values)
            and now >= current.sent[0]
        ):
            self._free_link(line, current, reply_count=1, since=now)
            why = _describe_labels(self._get_fields(item.frame), values) or repr(
                Reply(
                    current.name, item.frame, values, True, now, fields=self._get_fields(item.frame)
                )
            )
            current.pending.settle(
                CommandError(
                    f"{self.sensor.id} {current.name}: the sensor refused the command: {why}"
                )
            )
        else:
            return False
        return True

    def _fail(self, line: _LinkQueue, request: _PendingCommand, error: CommandError) -> None:
        self._free_link(line, request, reply_count=0, since=request.sent[-1])
        request.pending.settle(error)

    def _free_link(
        self, line: _LinkQueue, request: _PendingCommand, *, reply_count: int, since: int
    ) -> None:
        """End the current request of a link, and expect its missing replies later.

        Args:
            since: the start of the command's settling time, in which nothing is sent, ns.
        """
        line.current = None
        line.quiet_until = since + _to_ns(request.command.settle)
        if request.expected is not None:
            line.late_replies += [
                _LateReply(request.expected, sent + request.max_reply_delay)
                for sent in request.sent[reply_count:]
            ]


def learn_options(sensor: Sensor, reply: Reply) -> dict[str, Any]:
    """Return the options that a confirmed reply reports, by name.

    Raises:
        CommandError: if `learns` raises, or returns an invalid option.
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
            f"{place}: the reply could not be interpreted: {type(error).__name__}: {error}"
        ) from error
    for name, value in options.items():
        if not isinstance(value, bytes | int | float):
            raise CommandError(
                f"{place}: `learns` must return a number, bytes or a string for {name}, got"
                f" {type(value).__name__}"
            )
    return {
        name: Learned(value) if isinstance(value, bytes) else value
        for name, value in options.items()
    }


def provided_values(sensor: Sensor, reply: Reply) -> dict[str, Any]:
    """Return the values that a reply provides for later commands, by name.

    Raises:
        CommandError: if `provides` raises, or returns an invalid value.
    """
    provides = sensor.commands[reply.command].provides
    if provides is None:
        return {}
    place = f"{sensor.id} {reply.command}"
    try:
        values = dict(provides(reply.values))
    except ValueError as error:
        raise CommandError(f"{place}: {error}") from error
    except Exception as error:
        raise CommandError(
            f"{place}: the reply could not be interpreted: {type(error).__name__}: {error}"
        ) from error
    for name, value in values.items():
        if not isinstance(value, str | int | float):
            raise CommandError(
                f"{place}: `provides` must return a number or a string for {name}, got"
                f" {type(value).__name__}"
            )
    return values


def _describe_labels(fields: Mapping[str, FieldInfo], values: Any) -> str:
    """Return the fields whose values have names, as text; "" if there are none."""
    named = {path: get_nested(values, path) for path, info in fields.items() if info.labels}
    return ", ".join(
        f"{path} {value}"
        for path, value in named.items()
        if isinstance(value, EnumValue) and value.name
    )


def _make_timeout_error(sensor: Sensor, request: _PendingCommand) -> CommandError:
    place = f"{sensor.id} {request.name}"
    if request.wrong:
        return CommandError(f"{place}: unexpected reply: {request.wrong}")
    if len(request.sent) > 1:
        often = f", sent {len(request.sent)} times"
    else:
        often = ""
    if request.command.only_stopped:
        stop = next((name for name, command in sensor.commands.items() if command.stops), "stop")
    else:
        stop = ""
    if stop:
        hint = f"; the sensor replies only while it is stopped: send {stop!r} first"
    else:
        hint = ""
    waited = f"{request.timeout / NS_PER_S:g} s{often}"
    return ReplyTimeout(
        f"{place}: no {' or '.join(request.command.replies)} frame received within {waited}{hint}"
    )


def _to_ns(seconds: float) -> int:
    return round(seconds * NS_PER_S)

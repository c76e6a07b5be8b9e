"""What a session hands out: what to send, the promise of a reply, the reply; and which frames can be the reply to what."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from lidarspec.errors import CommandError, UnknownField, UsageError
from lidarspec.frames.schema import FieldInfo
from lidarspec.spec import Command

#: fields that a reply's repr shows.
SHOWN = 6
_MISSING = object()


@dataclass(frozen=True)
class Outgoing:
    """What is to be done on a link now: first the levels of its control lines, then the bytes."""

    link: str
    data: bytes
    lines: Mapping[str, bool] = field(default_factory=dict)


@dataclass(frozen=True, repr=False)
class Reply:
    """The answer to a command.

    Attributes:
        command: the name of the command.
        frame: the type of the frame that answered; None where no answer is documented.
        values: its fields, raw wire integers as `Sensor.parse` gives them; ``reply["path"]`` is the physical value.
        confirmed: whether the device answered.
        at: when, in the session's clock; for one that is not confirmed, when the command was sent.
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
        """The value of a field in its unit; a list where it is in an array.

        Raises:
            UnknownField: for a path that the frame does not have.
        """
        value = found_at(self.values, path)
        if path not in self.fields or value is _MISSING:
            raise UnknownField(path, self.fields, place=f"{self.command} {self.frame or 'without a reply'}")
        return _physical(self.fields[path], value)

    def __repr__(self) -> str:
        if not self.confirmed:
            return f"Reply({self.command}, not confirmed)"
        free = [info for info in self.fields.values() if info.const is None and found_at(self.values, info.path) is not _MISSING]
        told = [f"{info.path} {self[info.path]}{' ' * bool(info.unit)}{info.unit}" for info in free[:SHOWN]]
        return f"Reply({self.command}, {self.frame}: {', '.join(told)}{', ...' * (len(free) > SHOWN)})"


class Pending:
    """A command that was asked for, and becomes its reply or its failure."""

    def __init__(self, place: str) -> None:
        self._place = place
        self._outcome: Reply | CommandError | None = None

    @property
    def done(self) -> bool:
        """Whether there is a result."""
        return self._outcome is not None

    def result(self) -> Reply:
        """The reply.

        Raises:
            ReplyTimeout: if none came in time.
            CommandError: if the device answered with something else, or the command was given up.
            UsageError: if it is not done.
        """
        if self._outcome is None:
            raise UsageError(f"{self._place} is not answered yet")
        if isinstance(self._outcome, CommandError):
            raise self._outcome
        return self._outcome

    def settle(self, outcome: Reply | CommandError) -> None:
        """Make it done; for the session."""
        self._outcome = outcome


@dataclass(frozen=True)
class Expected:
    """The frames that can be the reply to one request.

    Attributes:
        tables: for each type of frame its fields.
        values: what its fields must be, those of them that the type has.
    """

    tables: Mapping[str, Mapping[str, FieldInfo]]
    values: Mapping[str, Any]

    @classmethod
    def of(cls, command: Command, tables: Mapping[str, Mapping[str, FieldInfo]], request: Any) -> Expected:
        """What answers a command of which `request` are the fields sent."""
        return cls(tables, {**command.matches, **{path: found_at(request, path) for path in command.echoes}})

    def differs(self, frame: str, values: Any) -> list[str]:
        """What is wrong with a frame as the reply, field by field; empty where it is the reply."""
        if frame not in self.tables:
            return [f"a frame {frame}"]
        asked = {path: value for path, value in self.values.items() if path in self.tables[frame]}
        got = {path: found_at(values, path) for path in asked}
        return [
            f"{path} {'missing' if got[path] is _MISSING else got[path]} instead of {value}"
            for path, value in asked.items()
            if got[path] != value
        ]

    def alike(self, other: Expected) -> bool:
        """Whether one frame could be the reply to both."""
        return any(
            all(other.values.get(path, value) == value for path, value in self.values.items() if path in self.tables[frame])
            for frame in self.tables.keys() & other.tables.keys()
        )


def found_at(values: Any, path: str) -> Any:
    """The value at a dotted path of a parsed frame, a list of them below an array, or a mark that there is none."""
    for name in path.split(".") if path else ():
        if isinstance(values, list):
            values = [found_at(element, name) for element in values]
        elif isinstance(values, Mapping) and name in values:
            values = values[name]
        else:
            return _MISSING
    return values


def _physical(info: FieldInfo, value: Any) -> Any:
    if isinstance(value, list):
        return [_physical(info, element) for element in value]
    return value * info.scale + info.offset if info.scaled and isinstance(value, int | float) else value

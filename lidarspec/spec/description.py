"""The frame types and commands of a sensor, with facts for its simulation."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from types import MappingProxyType
from typing import Any, Literal, TypeVar

from construct import Construct

import lidarspec.spec.fields  # noqa: F401  (prepare needs Checksummed, which is defined there)
from lidarspec.errors import SpecError, UnknownFrame, did_you_mean
from lidarspec.spec.arguments import (
    OWN_ADDRESS,
    OWN_PORT,
    Address,
    Argument,
    Filled,
    Port,
    Template,
    Text,
    argument,
)
from lidarspec.spec.results import Imu, Points
from lidarspec.spec.syntax import check_struct, fixed_size, frame_tree, prepare
from lidarspec.spec.timing import Clock
from lidarspec.spec.tree import ChecksummedStruct, Node, children
from lidarspec.spec.wire_forms import WireForm, check_wire_form

#: An item that a sensor sends after a command; see `Simulation.answers`.
Answer = str | tuple[str, Mapping[str, Any]] | bytes | float
#: a function of the number of a frame that returns the physical values of its fields, by path.
Sweep = Callable[[int], Mapping[str, Any]]
Answers = tuple[Answer, ...] | Callable[[Mapping[str, Any]], Iterable[Answer]]
_Described = TypeVar("_Described")


def reject_unknown_arguments(described: type[_Described]) -> type[_Described]:
    """Make a dataclass raise SpecError for an unknown keyword argument."""
    known = [one.name for one in fields(described) if one.init]  # type: ignore[arg-type]
    init = described.__init__

    @functools.wraps(init)
    def checked_init(self: Any, *args: Any, **arguments: Any) -> None:
        for name in arguments:
            if name not in known:
                raise SpecError(_describe_unknown_argument(type(self).__name__, name, known))
        init(self, *args, **arguments)

    described.__init__ = checked_init  # type: ignore[method-assign]
    return described


def _describe_unknown_argument(owner: str, name: str, known: Iterable[str]) -> str:
    """Return the error message for an argument that a class does not have."""
    if name in Simulation.__dataclass_fields__:
        suggestion = f"; write {owner}(simulation=Simulation({name}=...))"
    else:
        suggestion = did_you_mean(name, known)
    return f"{owner} has no argument {name!r}{suggestion}"


def check_simulation(simulation: object) -> None:
    """Raise SpecError unless the value is a `Simulation`."""
    if not isinstance(simulation, Simulation):
        raise SpecError(
            f"expected a Simulation(...), got {simulation!r}",
            path="simulation",
        )


@dataclass(frozen=True, eq=False)
class Simulation:
    """Additional facts for the simulation of a sensor, or of one of its frame types.

    Args:
        sweep: a function of the frame number i that returns the physical values, by path, of fields
            that do not depend on the scene, such as angles, counters and time.
        encode: a function that takes the simulated points of n frames as `Polar`, and returns the
            raw values of the fields, by path. Needed if no field contains only the range of a
            point.
        rate: the number of frames per second. Data frames need it only if it does not follow from
            the clock or from the times of the points. Other frames need it if the sensor sends them
            periodically.
        answers: for each command, a list of the items that the sensor sends before any data, or a
            function that returns this list, given the raw fields of the request. An item is the
            name of a frame, (name, physical values by path), bytes, or a pause in seconds. In a
            pause, the sensor sends `Sensor.fillers`. The raw fields also contain the values of a
            `Template` as texts, by the name in braces, such as "{handle}". "{data_port}" is the
            port at which the simulated sensor serves its data. By default, a command is answered
            with its `reply`. Only for a sensor, not for a frame type.
        directions: a function of the frame number i that returns the azimuths and elevations of the
            points of the frame, radians, as two arrays that broadcast to the points of a frame.
            Needed for `Cartesian` points.
        effects: for each command, a function that returns the sweep to use after the command. The
            arguments of the function are the current sweep, and the number that the next frame
            would have in this sweep. In the new sweep, the next frame has the number 0. Only for a
            sensor, not for a frame type.
        date: a function of seconds since 1970 that returns physical values, by path, of fields that
            contain a date in addition to the clock, such as an NMEA sentence. It is used if the
            simulated clock follows UTC.
    """

    sweep: Sweep | None = None
    encode: Callable[..., Mapping[str, Any]] | None = None
    rate: float = 0.0
    answers: Mapping[str, Answers] = field(default_factory=dict)
    directions: Callable[[int], tuple[Any, Any]] | None = None
    effects: Mapping[str, Callable[[Sweep, int], Sweep]] = field(default_factory=dict)
    date: Callable[[float], Mapping[str, Any]] | None = None

    def __post_init__(self) -> None:
        freeze(self, "answers", "effects")


@reject_unknown_arguments
@dataclass(frozen=True, eq=False)
class Frame:
    """One type of message.

    Args:
        struct: the construct struct of the message, usually in a `Checksummed`.
        direction: "in" if the sensor sends the message, "out" if the host sends it.
        data: whether the frame contains the points.
        points: the `points` function of this frame type, if the sensor has several data frames. If
            the points are in parts of the frame (`Parts`), a dict with the path of the parts and
            their function, such as {"modules": points} or {"tlvs.points": points}.
        imu: a function of `Fields` that returns the `Imu` samples of this frame type. If the
            samples are in parts of the frame, a dict as for `points`.
        clock: the clock of this frame type, if it is not the clock of the sensor; not for data
            frames.
        max_length: the maximum length in bytes. The default is the size of the struct, if this is
            fixed.
        plausible: a function of `Fields` that is False for values that no sensor sends. A packet is
            plausible if all values of the result are true.
        after: the name of another frame type, which announces frames of this type. Frames of this
            type are accepted only after such a frame, until a frame announces another type.
        confirm: the number of consecutive valid frames of this type that must arrive before any of
            them is accepted.
        simulation: facts for the simulation of this frame type. Needed if the sensor has several
            data frames, if `Sensor.example` cannot make a valid frame from random values, or if the
            sensor sends this frame periodically.
        acknowledged: the reasons why findings of `lidarspec check` are accepted, by finding. A
            finding is a code such as "LS204", or a code and the path of a field, such as "LS205
            path.of.a.field".
        wire: the wire form, if the frame is encoded so that its fields have no fixed offsets:
            `Tokens`, `Lines`, `Escaped`, or a wire form of a plugin. In this case, the struct
            describes the decoded content, and `max_length` is required, in encoded bytes.

    Raises:
        SpecError: if the struct cannot describe a frame, for example because it has two fields of
            one name.
    """

    struct: Construct
    direction: Literal["in", "out"] = field(default="in", kw_only=True)
    data: bool = field(default=False, kw_only=True)
    points: Callable[[Any], Points] | Mapping[str, Callable[[Any], Points]] | None = field(
        default=None, kw_only=True
    )
    imu: Callable[[Any], Imu] | Mapping[str, Callable[[Any], Imu]] | None = field(
        default=None, kw_only=True
    )
    clock: Clock | None = field(default=None, kw_only=True)
    max_length: int = field(default=0, kw_only=True)
    plausible: Callable[[Any], Any] | None = field(default=None, kw_only=True)
    after: str | None = field(default=None, kw_only=True)
    confirm: int = field(default=1, kw_only=True)
    simulation: Simulation = field(default_factory=Simulation, kw_only=True)
    acknowledged: Mapping[str, str] = field(default_factory=dict, kw_only=True)
    wire: WireForm | None = field(default=None, kw_only=True)
    prepared: Construct = field(init=False, repr=False)
    endless: SpecError | None = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if self.direction not in ("in", "out"):
            raise SpecError(f"direction must be 'in' or 'out', not {self.direction!r}")
        if self.max_length < 0 or self.confirm < 1:
            raise SpecError("max_length and confirm must each be at least 1")
        check_simulation(self.simulation)
        freeze(self, "acknowledged")
        for name in ("points", "imu"):
            if isinstance(own := getattr(self, name), Mapping) and len(own) != 1:
                raise SpecError(
                    f"a mapping for `{name}` must have one key, the path of a field with Parts; got"
                    f" {', '.join(own) or 'no key'}",
                    path=name,
                )
        if self.data and self.clock is not None:
            raise SpecError(
                "a data frame cannot have its own clock: pass clock= to the Sensor", path="clock"
            )
        if self.wire is not None:
            check_wire_form(self.wire)
        longest = self.max_length or (0 if self.wire is not None else fixed_size(self.struct))
        object.__setattr__(self, "max_length", longest)
        object.__setattr__(
            self, "prepared", prepare(self.struct, self.max_struct_bytes or sys.maxsize)
        )
        object.__setattr__(self, "endless", check_struct(self.prepared))
        if not longest:
            raise SpecError(
                "max_length is required, because the struct has no fixed size or has a wire form",
                rule="LS009",
            )

    def __repr__(self) -> str:
        if self.wire is not None:
            size = 0
        else:
            size = fixed_size(self.prepared)
        if self.data:
            kind = "data, "
        elif self.direction == "out":
            kind = "out, "
        else:
            kind = ""
        root = self.tree.struct if isinstance(self.tree, ChecksummedStruct) else self.tree
        names = [member.name for member in children(root) if member.name]
        return (
            f"Frame({kind}{size or f'up to {self.max_length}'}"
            f" bytes{': ' * bool(names)}{', '.join(names)})"
        )

    @property
    def max_struct_bytes(self) -> int:
        """The maximum size of the struct in bytes."""
        if self.wire is None:
            return self.max_length
        return self.max_length * 4

    @cached_property
    def tree(self) -> Node:
        """The struct of the frame as a tree of nodes; made on first use.

        Raises:
            SpecError: if the constant of an Enum field is a name that the Enum does not have.
        """
        return frame_tree(self.prepared)


@dataclass(frozen=True)
class Command:
    """A command that the sensor accepts.

    Args:
        frame: the outgoing frame; None for a command that only sets control lines.
        values: the values of fields of the frame, by path. `Count(16)` is a running number.
            `Address()` and `Port()` are this computer's own address and the port at which it
            expects the data. `Template(...)` is a text with arguments and values of earlier
            replies.
        args: the arguments by name. A number is (path of the field, lowest, highest), in the
            field's unit. Other arguments are (path, Text(16)), (path, Address()), (path, Port()) or
            (path, bytes). A path may have an index, such as "ports[1]", or may lead to a `Template`
            that contains the name of the argument.
        reply: the frame type of the reply, or a tuple of several possible types; None if no reply
            is documented.
        matches: the values, by path, that fields of the reply must have. If there are several frame
            types, only the fields that a reply has are compared.
        echoes: the paths of fields that have the same value in the request and in the reply. A
            refusal must also have these values, if its frame type has the fields.
        refusal: the frame type that the sensor sends instead of the reply if it refuses the
            command. The error message contains the labels of this frame's `Enum` fields.
        timeout: the seconds to wait for the reply, each time the command is sent.
        retries: how many times the command is sent again if there is no reply. Only for commands
            that do no harm if they arrive twice.
        settle: the seconds that the sensor needs between this command and the next.
        link: the name of the link that the command is sent on.
        lines: the levels of control lines that are set with the command, such as {"dtr": False}.
        starts: whether the sensor starts to send data.
        stops: whether the sensor stops sending data.
        only_stopped: whether the sensor ignores the command while it sends data.
        learns: a function of the reply, as `Sensor.parse` returns it, that returns options for
            `configure` by name. Their values are numbers, bytes or texts; `configure` receives
            bytes and texts as `Learned`. The options are applied only if the command is in
            `on_open`.
        provides: a function of the reply, as for `learns`, that returns numbers and texts by name.
            Later commands use them in a `Template`, and a link may use them (`Tcp(reported=)`). If
            the function raises ValueError, the command fails with the text of this error.
        every: the interval in seconds at which the command is repeated (a heartbeat); 0 to send it
            once.
    """

    frame: str | None = None
    values: Mapping[str, Any] = field(default_factory=dict)
    args: Mapping[
        str, tuple[str, float, float] | tuple[str, Text | Address | Port | type[bytes]]
    ] = field(default_factory=dict)
    reply: str | tuple[str, ...] | None = None
    matches: Mapping[str, Any] = field(default_factory=dict)
    echoes: tuple[str, ...] = ()
    refusal: str | None = None
    timeout: float = 1.0
    retries: int = 0
    settle: float = 0.0
    link: str = "data"
    lines: Mapping[str, bool] = field(default_factory=dict)
    starts: bool = False
    stops: bool = False
    only_stopped: bool = False
    learns: Callable[[Any], Mapping[str, Any]] | None = None
    provides: Callable[[Any], Mapping[str, str | int | float]] | None = None
    every: float = 0.0
    arguments: Mapping[str, Argument] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        freeze(self, "values", "args", "matches", "lines")
        object.__setattr__(self, "echoes", tuple(self.echoes))
        object.__setattr__(
            self,
            "arguments",
            MappingProxyType({name: argument(given) for name, given in self.args.items()}),
        )

    @property
    def filled(self) -> Mapping[str, Filled]:
        """The values that are filled in when the command is sent, by path."""
        return {path: value for path, value in self.values.items() if isinstance(value, Filled)}

    @property
    def templates(self) -> Mapping[str, Template]:
        """The text templates among the values, by path."""
        return {path: value for path, value in self.values.items() if isinstance(value, Template)}

    @property
    def placeholders(self) -> frozenset[str]:
        """The names in the templates of the command, except its arguments."""
        names = {name for template in self.templates.values() for name in template.names}
        return frozenset(names - set(self.args))

    @property
    def needed(self) -> frozenset[str]:
        """The names of the values that earlier replies must have provided."""
        return self.placeholders - {OWN_ADDRESS, OWN_PORT}

    @property
    def has_own_port(self) -> bool:
        """Whether the command contains the port at which this computer expects the data."""
        has_port = any(isinstance(value, Port) for value in self.values.values())
        return has_port or OWN_PORT in self.placeholders

    @property
    def has_own_address(self) -> bool:
        """Whether the command contains this computer's address."""
        has_address = any(isinstance(value, Address) for value in self.values.values())
        return has_address or OWN_ADDRESS in self.placeholders

    @property
    def fixed(self) -> Mapping[str, Any]:
        """The values that are the same in every frame, by path."""
        taken = {*self.filled, *(one.path.partition("[")[0] for one in self.arguments.values())}
        return {path: value for path, value in self.values.items() if path not in taken}

    @property
    def replies(self) -> tuple[str, ...]:
        """The frame types of possible replies; empty if no reply is documented."""
        if isinstance(self.reply, str):
            return (self.reply,)
        return tuple(self.reply or ())


@dataclass(frozen=True)
class Relative:
    """A related model, installed or not, whose packets have the same layout.

    Args:
        difference: a text that describes how the related model differs from this sensor.
        sends: a function of the data frame's `Fields` that returns True for packets that only the
            related model sends.
    """

    difference: str
    sends: Callable[[Any], Any]


@dataclass(frozen=True)
class Reported:
    """A fact that the sensor reports about itself (`Sensor.info`).

    Args:
        paths: the field, as "frame.path". If several frame types have the fact, the last frame that
            arrived counts.
        where: a function of `Fields` that is True for the frames of the type that contain the fact;
            None for all frames.
        text: a function that converts the raw value to a text; by default, the text is the name of
            the value, or the value with its unit. If it returns "", the fact is left out.
    """

    paths: tuple[str, ...]
    where: Callable[[Any], Any] | None = None
    text: Callable[[Any], str] | None = None

    def __init__(
        self,
        *paths: str,
        where: Callable[[Any], Any] | None = None,
        text: Callable[[Any], str] | None = None,
    ) -> None:
        object.__setattr__(self, "paths", paths)
        object.__setattr__(self, "where", where)
        object.__setattr__(self, "text", text)

    @classmethod
    def of(cls, declared: str | Reported) -> Reported:
        """Convert an entry of `Sensor.info`, which may be a path, to a `Reported`."""
        if isinstance(declared, str):
            return cls(declared)
        return declared

    def path_in(self, frame: str) -> str:
        """Return the path of the field in a frame type; "" if the type lacks the fact."""
        for path in self.paths:
            name, _, field = path.partition(".")
            if name == frame:
                return field
        return ""


class FrameTypes(dict[str, Frame]):
    """The frame types of a sensor by name; a missing name raises `UnknownFrame`."""

    def __init__(self, sensor: str, frames: Mapping[str, Frame]) -> None:
        super().__init__(frames)
        self._sensor = sensor

    def __missing__(self, name: str) -> Frame:
        raise UnknownFrame(name, self, place=self._sensor)


def freeze(value: object, *names: str) -> None:
    """Replace mappings in some fields of a frozen dataclass by read-only copies."""
    for name in names:
        object.__setattr__(value, name, MappingProxyType(dict(getattr(value, name))))

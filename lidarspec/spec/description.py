"""What a sensor is, as values: message types, commands, links, clock, geometry, and what a
simulation needs.

A `Spec` holds what the manual says, and checks that its parts fit together. Everything here is
immutable, knows nothing of streams or arrays, and has no engine: engines are functions of a `Spec`.
`lidarspec.spec.sensor.Sensor` is a `Spec` with these functions as methods.
"""

from __future__ import annotations

import functools
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, Literal, TypeVar

from construct import Construct

from lidarspec.errors import SpecError, UnknownFrame, did_you_mean
from lidarspec.spec.arguments import Address, Argument, Count, Filled, Text, argument
from lidarspec.spec.links import Link, is_datagram
from lidarspec.spec.results import Imu, Points
from lidarspec.spec.syntax import check_struct, fixed_size, frame_tree, prepare
from lidarspec.spec.timing import Clock, Sequence, Split
from lidarspec.spec.tree import Node, Sealed, children
from lidarspec.spec.wire_forms import WireForm

#: version of the plugin interface; the engine reads this one and the one before.
API = 1
STATUSES = ("manual", "vectors", "capture", "hardware")
#: what a field can say of the device itself, in `Spec.info`.
ROLES = ("serial", "firmware", "model", "temperature")
#: where an axis can point: along x, y and z of REP-103, each with its opposite.
DIRECTIONS = ("forward", "back", "left", "right", "up", "down")
#: what a sensor sends for a command, see `Simulation.answers`.
Answer = str | tuple[str, Mapping[str, Any]] | bytes | float
Answers = tuple[Answer, ...] | Callable[[Mapping[str, Any]], Iterable[Answer]]
_ID = re.compile(r"[a-z0-9]+(-[a-z0-9]+)+")
_Described = TypeVar("_Described")


def reject_unknown_arguments(described: type[_Described]) -> type[_Described]:
    """Make a dataclass raise SpecError for an unknown keyword argument."""
    known = [one.name for one in fields(described) if one.init]  # type: ignore[arg-type]
    init = described.__init__

    @functools.wraps(init)
    def checked_init(self: Any, *args: Any, **arguments: Any) -> None:
        for name in arguments:
            if name not in known:
                raise SpecError(_unknown_argument(type(self).__name__, name, known))
        init(self, *args, **arguments)

    described.__init__ = checked_init  # type: ignore[method-assign]
    return described


def _unknown_argument(owner: str, name: str, known: Iterable[str]) -> str:
    """Return the message about an argument that a class does not have."""
    if name in Simulation.__dataclass_fields__:
        suggestion = f"; write {owner}(simulation=Simulation({name}=...))"
    else:
        suggestion = did_you_mean(name, known)
    return f"{owner} has no argument {name!r}{suggestion}"


def _check_simulation(simulation: object) -> None:
    if not isinstance(simulation, Simulation):
        raise SpecError(
            f"expected a Simulation(...), got {simulation!r}; leave it out if nothing is needed",
            path="simulation",
        )


@dataclass(frozen=True, eq=False)
class Simulation:
    """What only a simulated sensor needs; of a sensor, or of one frame type of its own.

    Args:
        sweep: the physical values, by path, of frame number i that are not measured: angles,
            counters, time.
        encode: the measured `Polar` of a batch to the raw values of its fields, by path, where
            ranges have no field of their own.
        rate: how many frames a second are sent; of data, where neither the clock nor the times of
            the points tell; of other frames, where they are sent again and again by themselves.
        answers: command -> all that the sensor sends for it before any data, in order: frames by
            name, or (name, values) with physical values by path, bytes as they are, and seconds of
            a pause, in which it sends its fillers; or a function from the raw fields of the request
            to these. A command that is left out is answered by its reply. Of a sensor only.
        directions: the azimuths and elevations, radians, of the points of frame number i where
            these are `Cartesian`: two arrays that broadcast to the points of a frame.
    """

    sweep: Callable[[int], Mapping[str, Any]] | None = None
    encode: Callable[..., Mapping[str, Any]] | None = None
    rate: float = 0.0
    answers: Mapping[str, Answers] = field(default_factory=dict)
    directions: Callable[[int], tuple[Any, Any]] | None = None

    def __post_init__(self) -> None:
        _freeze(self, "answers")


@reject_unknown_arguments
@dataclass(frozen=True, eq=False)
class Frame:
    """One message type.

    Args:
        struct: its construct, most often a `Checksummed` Struct.
        direction: "in" from the sensor to us, "out" from us to it.
        data: whether it carries the points.
        points: a `points` function of its own, for sensors that can answer in several data frames;
            for points that stand in parts of the frame (`Parts`), their path and a function of
            these, {"modules": points}, {"tlvs.points": points}.
        imu: a function of `Fields` that returns what the sensor's IMU felt, beside points or in a
            frame of its own; with its path where it stands in parts, as for `points`.
        clock: the time in a frame that is not data, where that of the sensor is not in it.
        max_length: the longest it can be, in bytes; longer candidates are not frames. Left out, it
            is the size of the struct, where that is fixed.
        plausible: a function of `Fields`: False where no sensor would send such values, reduced
            with `all` per packet.
        after: name of the frame that has to be the last seen, of all named by any `after`, for this
            one to be looked for.
        confirm: how many in an unbroken run it takes to believe any of them.
        simulation: what a simulated sensor needs for this frame alone, where the sensor can answer
            in several data frames, or sends others that random values never make, or again and
            again by themselves.
        acknowledged: findings of `lidarspec check` that are true and meant, as "LS204" or "LS205
            path.of.a.field" -> the reason.
        wire: how the frame stands on the wire, where its fields have no fixed places there:
            `Tokens`, `Lines`, `Escaped`, or a form of a plugin. The struct then describes what is
            read out of it, and `max_length`, in bytes on the wire, is always needed.

    Raises:
        SpecError: if the struct cannot describe a frame: a part without an end, with bytes that are
            lost, or names that clash.
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

    def __post_init__(self) -> None:
        if self.direction not in ("in", "out"):
            raise SpecError(f"direction is 'in' or 'out', not {self.direction!r}")
        if self.max_length < 0 or self.confirm < 1:
            raise SpecError("max_length and confirm are at least 1")
        _check_simulation(self.simulation)
        _freeze(self, "acknowledged")
        for name in ("points", "imu"):
            if isinstance(own := getattr(self, name), Mapping) and len(own) != 1:
                raise SpecError(
                    f"{name} stand in parts of one kind, not in {', '.join(own) or 'none'}",
                    path=name,
                )
        if self.data and self.clock is not None:
            raise SpecError("data have the clock of the sensor: give it there", path="clock")
        longest = self.max_length or (0 if self.wire is not None else fixed_size(self.struct))
        object.__setattr__(self, "max_length", longest)
        object.__setattr__(self, "prepared", prepare(self.struct, self.room or sys.maxsize))
        check_struct(self.prepared)
        if not longest:
            raise SpecError(
                "max_length may be left out only where the struct has a fixed size, and no wire"
                " form"
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
        root = self.tree.struct if isinstance(self.tree, Sealed) else self.tree
        names = [member.name for member in children(root) if member.name]
        return (
            f"Frame({kind}{size or f'up to {self.max_length}'}"
            f" bytes{': ' * bool(names)}{', '.join(names)})"
        )

    @property
    def room(self) -> int:
        """The most bytes that the struct can have: those of the frame, of which any two may be a
        number of eight in a wire form.
        """
        return self.max_length * (1 if self.wire is None else 4)

    @cached_property
    def tree(self) -> Node:
        """The frame as nodes; made when it is first asked for.

        Raises:
            SpecError: for a constant that its Enum has no value for.
        """
        return frame_tree(self.prepared)


@dataclass(frozen=True)
class Command:
    """Something that can be asked of the sensor.

    Args:
        frame: the outgoing frame that asks it; None for a command that only moves lines.
        values: values of its fields, by path; `Count(16)` is a running number, `Address()` this
            computer's own address.
        args: argument name -> (field path, lowest, highest), in the field's unit; (path, Text(16)),
            (path, Address()) or (path, bytes). A path may lead to an element of an array,
            "ports[1]".
        reply: the frame that answers, or a tuple of those that may; None where no answer is
            documented.
        matches: values that fields of the reply must have for it to be the answer to this command;
            of several frames, each is asked for the fields that it has.
        echoes: fields of the reply that repeat the field of the same path in the request.
        refusal: the frame that comes in place of any reply where the sensor refuses; what it says
            is told, names of an `Enum` in words.
        timeout: seconds to wait for the reply, each time that it is sent.
        retries: how often it is sent again when no reply comes; only for what does no harm when it
            arrives twice.
        settle: seconds that the sensor needs after it before the next command.
        link: the link it goes over.
        lines: levels of control lines, {"dtr": False}, set with it.
        starts, stops: whether the sensor sends data after it, or no longer does.
        only_stopped: whether it is answered only while the sensor sends no data, and passed over
            otherwise.
        learns: a function of the reply, as `Sensor.parse` gives it, that returns options for
            `configure`, by name: numbers, or bytes and texts, which become `Learned`. They are
            applied where the command is among `on_open`.
        every: seconds after which it is sent once more, again and again from its first time on (a
            heartbeat); 0: never.
    """

    frame: str | None = None
    values: Mapping[str, Any] = field(default_factory=dict)
    args: Mapping[str, tuple[str, float, float] | tuple[str, Text | Address | type[bytes]]] = field(
        default_factory=dict
    )
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
    every: float = 0.0
    arguments: Mapping[str, Argument] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        _freeze(self, "values", "args", "matches", "lines")
        object.__setattr__(self, "echoes", tuple(self.echoes))
        object.__setattr__(
            self,
            "arguments",
            MappingProxyType({name: argument(given) for name, given in self.args.items()}),
        )

    @property
    def filled(self) -> Mapping[str, Filled]:
        """The values that are found out when it is sent, by path."""
        return {
            path: value for path, value in self.values.items() if isinstance(value, Count | Address)
        }

    @property
    def fixed(self) -> Mapping[str, Any]:
        """The values that every frame of it has, by path: none that is found out, or that an
        argument goes into.
        """
        taken = {*self.filled, *(one.path.partition("[")[0] for one in self.arguments.values())}
        return {path: value for path, value in self.values.items() if path not in taken}

    @property
    def replies(self) -> tuple[str, ...]:
        """The frames that may answer; none where no answer is documented."""
        if isinstance(self.reply, str):
            return (self.reply,)
        return tuple(self.reply or ())


@dataclass(frozen=True)
class Relative:
    """Another sensor, installed or not, whose packets have the same form.

    Args:
        told_by: what tells it apart, in words.
        sends: a function of the data frame's `Fields`: whether a packet is the other's, and cannot
            be this sensor's.
    """

    told_by: str
    sends: Callable[[Any], Any]


class FrameTypes(dict[str, Frame]):
    """The frame types of a sensor by name; a missing name raises UnknownFrame."""

    def __init__(self, sensor: str, frames: Mapping[str, Frame]) -> None:
        super().__init__(frames)
        self._sensor = sensor

    def __missing__(self, name: str) -> Frame:
        raise UnknownFrame(name, self, place=self._sensor)


@reject_unknown_arguments
@dataclass(frozen=True, eq=False, repr=False)
class Spec:
    """One sensor as its manual describes it: facts, without the methods of a `Sensor`.

    Its fields are the arguments of `lidarspec.spec.Sensor`, which says what each of them is.

    Raises:
        SpecError: for an id, status or reference between its parts that cannot be.
    """

    id: str
    vendor: str = field(kw_only=True)
    model: str = field(kw_only=True)
    frames: Mapping[str, Frame] = field(kw_only=True)
    points: Callable[[Any], Points] | None = field(kw_only=True)
    scan: Split = field(kw_only=True)
    links: Mapping[str, Link] = field(kw_only=True)
    commands: Mapping[str, Command] = field(default_factory=dict, kw_only=True)
    clock: Clock | None = field(default=None, kw_only=True)
    sequence: Sequence | None = field(default=None, kw_only=True)
    fillers: bytes = field(default=b"", kw_only=True)
    state: Mapping[str, Mapping[str, Any]] = field(default_factory=dict, kw_only=True)
    simulation: Simulation = field(default_factory=Simulation, kw_only=True)
    configure: Any = field(default=None, kw_only=True)
    recognise: Callable[[tuple[bytes, ...]], Mapping[str, Any]] | None = field(
        default=None, kw_only=True
    )
    on_open: tuple[str, ...] = field(default=(), kw_only=True)
    on_close: tuple[str, ...] = field(default=(), kw_only=True)
    range_limits: tuple[float, float] = field(kw_only=True)
    vendor_axes: tuple[str, str, str] | None = field(default=None, kw_only=True)
    beams: int | None = field(default=None, kw_only=True)
    turn: tuple[float, float] | None = field(default=None, kw_only=True)
    relatives: Mapping[str, str | Relative] = field(default_factory=dict, kw_only=True)
    info: Mapping[str, str] = field(default_factory=dict, kw_only=True)
    status: str = field(kw_only=True)
    source: str = field(kw_only=True)
    aliases: tuple[str, ...] = field(default=(), kw_only=True)
    api: int = field(default=API, kw_only=True)
    acknowledged: Mapping[str, str] = field(default_factory=dict, kw_only=True)
    options: Mapping[str, Any] = field(default_factory=dict, kw_only=True)
    hooked: Callable[[Any], Any] | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        object.__setattr__(self, "frames", MappingProxyType(FrameTypes(self.id, self.frames)))
        _freeze(self, "links", "commands", "state", "relatives", "info", "acknowledged", "options")
        for name in ("on_open", "on_close", "aliases"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        _check_spec(self)

    @property
    def data_frame(self) -> str:
        """The name of the frame type that carries the points.

        Raises:
            UnknownFrame: if it has none yet (a sensor that needs a file first).
        """
        names = self.data_frames
        if not names:
            raise UnknownFrame(
                "data", self.frames, place=self.id, hint="; configure the sensor first"
            )
        answer = self.options.get("answer")
        return answer if answer in names else names[0]

    @cached_property
    def incoming(self) -> Mapping[str, Frame]:
        """The frame types that the sensor sends, by name, in the order that decides where several
        fit.
        """
        return {name: frame for name, frame in self.frames.items() if frame.direction == "in"}

    @cached_property
    def data_frames(self) -> tuple[str, ...]:
        """The names of the frame types that carry points."""
        return tuple(name for name, frame in self.frames.items() if frame.data)

    def points_of(self, frame: str) -> Callable[[Any], Points]:
        """The `points` function of a frame type: its own, or for data the sensor's.

        Raises:
            SpecError: where the frame type has no points.
        """
        name, _, parts = frame.partition(".")
        own = self.frames[name].points
        if isinstance(own, Mapping):
            function = own.get(parts)
        else:
            function = own or (self.points if self.frames[name].data and not parts else None)
        if function is None:
            raise SpecError("this frame type has no points", path=frame, sensor=self.id)
        return function

    def imu_of(self, frame: str) -> Callable[[Any], Imu]:
        """The `imu` function of a frame type, or of its parts.

        Raises:
            SpecError: where the frame type has none; it names those that have.
        """
        name, _, parts = frame.partition(".")
        own = self.frames[name].imu
        if isinstance(own, Mapping):
            function = own.get(parts)
        else:
            function = own
        if function is None:
            if self.imu_frames:
                having = f"those of {', '.join(self.imu_frames)} have"
            else:
                having = "no frame of the sensor has"
            raise SpecError(
                f"this frame type has nothing of an IMU; {having}", path=frame, sensor=self.id
            )
        return function

    @cached_property
    def imu_frames(self) -> tuple[str, ...]:
        """The names of the incoming frame types that say what an IMU felt."""
        return tuple(name for name, frame in self.incoming.items() if frame.imu is not None)

    def parts_with(self, what: str, frame: str) -> str:
        """The path of the parts of a frame type that have its "points" or its "imu"; "" where the
        frame itself has them.
        """
        if frame in self.frames:
            own = getattr(self.frames[frame], what)
        else:
            own = None
        return next(iter(own)) if isinstance(own, Mapping) else ""

    def simulation_of(self, frame: str) -> Simulation:
        """What a simulation of one frame type needs: the frame's own, and for data the sensor's
        where the frame has none.
        """
        own = self.frames[frame].simulation
        if self.frames[frame].data:
            shared = self.simulation
        else:
            shared = Simulation()
        fields = ("sweep", "encode", "rate", "directions")
        return Simulation(**{name: getattr(own, name) or getattr(shared, name) for name in fields})

    @property
    def datagrams(self) -> bool:
        """Whether frames come one to a datagram."""
        return is_datagram(self.links.get("data"))

    @property
    def counts_losses(self) -> bool:
        """Whether lost packets are counted: by a counter, or a clock with a declared pace."""
        if self.sequence is not None:
            return True
        return self.clock is not None and self.clock.pace is not None

    def __repr__(self) -> str:
        options = "".join(f", {name}={value!r}" for name, value in self.options.items())
        return (
            f"Sensor({self.id}, {self.vendor} {self.model}, frames:"
            f" {', '.join(self.frames) or 'none yet'}{options})"
        )


_AnySpec = TypeVar("_AnySpec", bound=Spec)


def with_frames(sensor: _AnySpec, frames: Mapping[str, Frame]) -> _AnySpec:
    """A sensor with these frame types alone, and without what names others: commands, state, what
    frames say of the device.
    """
    clock = sensor.clock
    if clock is not None and clock.told is not None and clock.told[0] not in frames:
        clock = replace(clock, told=None)
    return replace(
        sensor, frames=frames, clock=clock, commands={}, state={}, info={}, on_open=(), on_close=()
    )


def _freeze(value: object, *names: str) -> None:
    for name in names:
        object.__setattr__(value, name, MappingProxyType(dict(getattr(value, name))))


def _check_spec(sensor: Spec) -> None:
    _check_simulation(sensor.simulation)
    if not _ID.fullmatch(sensor.id):
        raise SpecError(
            "an id is vendor-model in lower case with hyphens", path="id", sensor=sensor.id
        )
    if sensor.status not in STATUSES:
        raise SpecError(
            f"status is one of {', '.join(STATUSES)}, not {sensor.status!r}",
            path="status",
            sensor=sensor.id,
        )
    if not API - 1 <= sensor.api <= API:
        raise SpecError(
            f"written for interface {sensor.api}; this engine reads {API - 1} and {API}",
            path="api",
            sensor=sensor.id,
        )
    for name, frame in sensor.frames.items():
        _known(sensor, f"frames.{name}.after", [frame.after], sensor.frames)
    for name, command in sensor.commands.items():
        _known(
            sensor,
            f"commands.{name}",
            [command.frame, *command.replies, command.refusal],
            sensor.frames,
        )
        _known(sensor, f"commands.{name}.link", [command.link], sensor.links)
        if command.only_stopped and not any(
            other.starts or other.stops for other in sensor.commands.values()
        ):
            raise SpecError(
                "it is answered only while the sensor is stopped, and no command starts or"
                " stops it",
                path=f"commands.{name}",
            )
        if command.learns is not None and not (command.replies and sensor.configure is not None):
            raise SpecError(
                "what it learns comes with a reply, and goes to `configure`: both are needed",
                path=f"commands.{name}.learns",
            )
        if "timeout" in command.args:
            raise SpecError(
                "'timeout' is how long its reply is waited for, and cannot be an argument",
                path=f"commands.{name}.args",
            )
    if sensor.commands:
        _known(sensor, "simulation.answers", sensor.simulation.answers, sensor.commands)
    _known(sensor, "state", sensor.state, sensor.frames)
    if sensor.clock is not None and sensor.clock.told is not None:
        _known(sensor, "clock.told", sensor.clock.told[:1], sensor.frames)
        if sensor.clock.wraps_at is None or callable(sensor.clock.source):
            raise SpecError(
                "what is told completes a clock of fields that starts again at `wraps_at`",
                path="clock.told",
                sensor=sensor.id,
            )
    _known(sensor, "info", [path.partition(".")[0] for path in sensor.info.values()], sensor.frames)
    if unknown := sorted(set(sensor.info) - set(ROLES)):
        raise SpecError(
            f"{unknown[0]!r} is not among {', '.join(ROLES)}", path="info", sensor=sensor.id
        )
    if unknown := sorted(set(sensor.vendor_axes or ()) - set(DIRECTIONS)):
        raise SpecError(f"no direction {unknown[0]!r}", path="vendor_axes", sensor=sensor.id)
    if sensor.beams is not None and sensor.beams < 1:
        raise SpecError(
            f"a scan has at least 1 point, not {sensor.beams}", path="beams", sensor=sensor.id
        )
    if sensor.turn is not None and not 0 < sensor.turn[0] <= sensor.turn[1]:
        raise SpecError(
            f"the slowest and the fastest number of scans a second, not {sensor.turn}",
            path="turn",
            sensor=sensor.id,
        )
    _known(sensor, "on_open, on_close", [*sensor.on_open, *sensor.on_close], sensor.commands)
    if sensor.points is None and any(
        frame.data and frame.points is None for frame in sensor.frames.values()
    ):
        raise SpecError("a data frame without a points function", path="points", sensor=sensor.id)


def _known(sensor: Spec, path: str, names: Iterable[str | None], table: Mapping[str, Any]) -> None:
    for name in names:
        if name is not None and name not in table and sensor.frames:
            raise SpecError(
                f"{name!r} is not among {', '.join(table) or 'none'}", path=path, sensor=sensor.id
            )

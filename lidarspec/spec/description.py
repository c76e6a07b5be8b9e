"""What can be done with a sensor, as an interface, and where the engine comes from that does it.

A sensor is found and looked at far more often than all of this is needed, so the engine is imported by the first method that asks for it.

A sensor as a value: message types, commands, links, clock and geometry, written down once.

Everything here is immutable and knows nothing of streams or arrays. What can be done with a sensor (parse, decode,
...) is offered as methods, which hand over to the one `lidarspec.spec.description.Engine` that the package installs.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeVar

from construct import Construct

from lidarspec.errors import SpecError, UnknownFrame
from lidarspec.spec.construct_layer import prepare
from lidarspec.spec.links import Link, is_datagram
from lidarspec.spec.results import Points
from lidarspec.spec.rules import check_struct
from lidarspec.spec.timing import Clock, Sequence, Split

if TYPE_CHECKING:
    from lidarspec.framing.decoder import Decoder
    from lidarspec.framing.results import Found
    from lidarspec.packets.packets import Packets
    from lidarspec.scans.scans import Scan


class Engine(Protocol):
    """What the methods of `Sensor` hand over to."""

    def parse(self, sensor: Sensor, data: bytes, *, frame: str | None, verify: bool) -> Any: ...
    def build(self, sensor: Sensor, frame: str, value: Any, values: Mapping[str, Any], *, units: bool) -> bytes: ...
    def example(self, sensor: Sensor, frame: str, *, seed: int) -> bytes: ...
    def command(self, sensor: Sensor, name: str, arguments: Mapping[str, Any]) -> bytes: ...
    def decoder(self, sensor: Sensor, *, stream: bool | None, backend: str) -> Decoder: ...
    def split(self, sensor: Sensor, data: Any, *, backend: str) -> list[Found]: ...
    def decode(self, sensor: Sensor, data: Any, *, frame: str | None, backend: str) -> Packets: ...
    def scans(self, sensor: Sensor, data: Any, *, backend: str) -> Iterator[Scan]: ...
    def configure(self, sensor: Sensor, options: Mapping[str, Any]) -> Sensor: ...
    def rebuild(self, sensor_id: str, options: Mapping[str, Any]) -> Sensor: ...


_loaders: list[Callable[[], Engine]] = []


def install(load: Callable[[], Engine]) -> None:
    """Make what `load` returns the engine of every sensor; it is called once, by the first method that needs it."""
    _loaders[:] = [load]
    engine.cache_clear()


@functools.cache
def engine() -> Engine:
    """The engine that is installed."""
    return _loaders[0]()


#: version of the plugin interface; the engine reads this one and the one before.
API = 1
STATUSES = ("manual", "vectors", "capture", "hardware")
Value = TypeVar("Value", "Frame", "Sensor")
#: what a sensor sends for a command: see `Command.answers`.
Answer = str | tuple[str, Mapping[str, Any]] | bytes | float
_ID = re.compile(r"[a-z0-9]+(-[a-z0-9]+)+")


@dataclass(frozen=True, eq=False)
class Frame:
    """One message type.

    Args:
        struct: its construct, most often a `Checksummed` Struct.
        direction: "in" from the sensor to us, "out" from us to it.
        data: whether it carries the points.
        points: a `points` function of its own, for sensors that can answer in several data frames.
        max_length: the longest it can be, in bytes; longer candidates are not frames.
        plausible: a function of `Fields`: False where no sensor would send such values, reduced with `all` per packet.
        after: name of the frame that has to be the last seen, of all named by any `after`, for this one to be looked for.
        confirm: how many in an unbroken run it takes to believe any of them.
        sweep: a `sweep` function of its own, for sensors that can answer in several data frames, and for other frames that
            random values never make.
        encode: an `encode` function of its own: the measured `Polar` of a batch to the raw values of its fields, by path.
        rate: how many a second are sent; of data, where neither the clock nor the times of the points tell; of other frames, where
            they are sent again and again by themselves.
        acknowledged: findings of `lidarspec check` that are true and meant, as "LS204" or "LS205 path.of.a.field" -> the reason.

    Raises:
        SpecError: if the struct cannot describe a frame (see `lidarspec.spec.rules`).
    """

    struct: Construct
    direction: Literal["in", "out"] = field(default="in", kw_only=True)
    data: bool = field(default=False, kw_only=True)
    points: Callable[[Any], Points] | None = field(default=None, kw_only=True)
    max_length: int = field(kw_only=True)
    plausible: Callable[[Any], Any] | None = field(default=None, kw_only=True)
    after: str | None = field(default=None, kw_only=True)
    confirm: int = field(default=1, kw_only=True)
    sweep: Callable[[int], Mapping[str, Any]] | None = field(default=None, kw_only=True)
    encode: Callable[..., Mapping[str, Any]] | None = field(default=None, kw_only=True)
    rate: float = field(default=0.0, kw_only=True)
    acknowledged: Mapping[str, str] = field(default_factory=dict, kw_only=True)
    prepared: Construct = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if self.direction not in ("in", "out"):
            raise SpecError(f"direction is 'in' or 'out', not {self.direction!r}")
        if self.max_length < 1 or self.confirm < 1:
            raise SpecError("max_length and confirm are at least 1")
        _freeze(self, "acknowledged")
        object.__setattr__(self, "prepared", prepare(self.struct))
        check_struct(self.prepared)


@dataclass(frozen=True)
class Command:
    """Something that can be asked of the sensor.

    Args:
        frame: the outgoing frame that asks it; None for a command that only moves lines.
        values: values of its fields, by path.
        args: argument name -> (field path, lowest, highest), in the field's unit.
        reply: the frame that answers, or a tuple of those that may; None where no answer is documented.
        matches: values that fields of the reply must have for it to be the answer to this command; of several frames, each is
            asked for the fields that it has.
        echoes: fields of the reply that repeat the field of the same path in the request.
        timeout: seconds to wait for the reply, each time that it is sent.
        retries: how often it is sent again when no reply comes; only for what does no harm when it arrives twice.
        settle: seconds that the sensor needs after it before the next command.
        link: the link it goes over.
        lines: levels of control lines, {"dtr": False}, set with it.
        starts, stops: whether the sensor sends data after it, or no longer does.
        every: seconds after which it is sent once more, again and again from its first time on (a heartbeat); 0: never.
        answers: all that the sensor sends for it before any data, in order, for simulation: frames by name, or (name, values) with
            physical values by path, bytes as they are, and seconds of a pause, in which it sends its fillers; or a function from the
            raw fields of the request to these. Left out, it is the reply.
    """

    frame: str | None = None
    values: Mapping[str, Any] = field(default_factory=dict)
    args: Mapping[str, tuple[str, float, float]] = field(default_factory=dict)
    reply: str | tuple[str, ...] | None = None
    matches: Mapping[str, Any] = field(default_factory=dict)
    echoes: tuple[str, ...] = ()
    timeout: float = 1.0
    retries: int = 0
    settle: float = 0.0
    link: str = "data"
    lines: Mapping[str, bool] = field(default_factory=dict)
    starts: bool = False
    stops: bool = False
    every: float = 0.0
    answers: tuple[Answer, ...] | Callable[[Mapping[str, Any]], Iterable[Answer]] | None = None

    def __post_init__(self) -> None:
        _freeze(self, "values", "args", "matches", "lines")
        object.__setattr__(self, "echoes", tuple(self.echoes))

    @property
    def replies(self) -> tuple[str, ...]:
        """The frames that may answer; none where no answer is documented."""
        return (self.reply,) if isinstance(self.reply, str) else tuple(self.reply or ())


@dataclass(frozen=True)
class Configure:
    """``sensor.configure(...)``: the engine's options, then the sensor's own function, on a new value."""

    sensor: Sensor
    function: Callable[..., Sensor] | None

    def __call__(self, **options: Any) -> Sensor:
        """A new sensor with these options; the old one stays as it is.

        Raises:
            UnknownOption: for an option that neither the engine nor the sensor has.
        """
        return engine().configure(self.sensor, options)


@dataclass(frozen=True, eq=False, repr=False)
class Sensor:
    """One sensor, described.

    Args:
        id: vendor-model in lower case with hyphens; the same everywhere and for ever.
        vendor, model: as people write them.
        frames: every message type by name, in both directions; where several fit at one place, their order decides.
        points: a function of `Fields` that returns `Polar` or `Cartesian`; None where each data frame has its own.
        scan: where one scan ends and the next begins.
        links: by name; the data come over "data", commands over the link that they name.
        commands: what can be asked of it, by name.
        clock: its own time, if it has one.
        sequence: its counter of packets, if it has one.
        fillers: bytes that it sends between frames; they are counted on their own.
        state: defaults of other frames' fields for ``f.state``, by frame and path, in units.
        sweep: the physical values, by path, of data frame number i that are not measured: all that a simulation needs.
        encode: the measured `Polar` of a batch to the raw values of its fields, where ranges have no field of their own.
        configure: a function of the sensor and its options, by name, that returns another sensor.
        on_open, on_close: names of the commands that are sent when it is opened and closed.
        range_limits: the shortest and the longest range that it can measure, metres.
        vendor_axes: where the vendor's x, y and z point, of forward, backward, left, right, up and down, for ``frame="vendor"``.
        status: how far it is proven: "manual", "vectors", "capture" or "hardware".
        source: the manual with its revision and sections, the captures.
        aliases: other ids that it is known by.
        api: the version of this interface that it was written for.
        acknowledged: findings of `lidarspec check` about the sensor as a whole that are true and meant, as "LS401" -> the reason.
        options: what it was configured with; not for plugins to set.

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
    sweep: Callable[[int], Mapping[str, Any]] | None = field(default=None, kw_only=True)
    encode: Callable[..., Any] | None = field(default=None, kw_only=True)
    configure: Any = field(default=None, kw_only=True)
    on_open: tuple[str, ...] = field(default=(), kw_only=True)
    on_close: tuple[str, ...] = field(default=(), kw_only=True)
    range_limits: tuple[float, float] = field(kw_only=True)
    vendor_axes: tuple[str, str, str] | None = field(default=None, kw_only=True)
    status: str = field(kw_only=True)
    source: str = field(kw_only=True)
    aliases: tuple[str, ...] = field(default=(), kw_only=True)
    api: int = field(default=API, kw_only=True)
    acknowledged: Mapping[str, str] = field(default_factory=dict, kw_only=True)
    options: Mapping[str, Any] = field(default_factory=dict, kw_only=True)

    def __post_init__(self) -> None:
        _freeze(self, "frames", "links", "commands", "state", "acknowledged", "options")
        function = self.configure.function if isinstance(self.configure, Configure) else self.configure
        object.__setattr__(self, "configure", Configure(self, function))
        for name in ("on_open", "on_close", "aliases"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        _check_sensor(self)

    @property
    def data_frame(self) -> str:
        """The name of the frame type that carries the points.

        Raises:
            UnknownFrame: if it has none yet (a sensor that needs a file first).
        """
        names = [name for name, frame in self.frames.items() if frame.data]
        if not names:
            raise UnknownFrame("data", self.frames, place=self.id, hint="; configure the sensor first")
        answer = self.options.get("answer")
        return answer if answer in names else names[0]

    @property
    def datagrams(self) -> bool:
        """Whether frames come one to a datagram."""
        return is_datagram(self.links.get("data"))

    def parse(self, data: bytes, frame: str | None = None, *, verify: bool = True) -> Any:
        """Exactly one frame as a construct Container of raw wire integers.

        Args:
            frame: its type; found out where left out.
            verify: False accepts wrong constants, a wrong checksum and trailing bytes.

        Raises:
            WireError: where the bytes are not such a frame: sensor, offset, field path, expected and got.
        """
        return engine().parse(self, data, frame=frame, verify=verify)

    def build(self, frame: str, value: Any = None, /, *, units: bool = False, **values: Any) -> bytes:
        """The bytes of one frame; constants, counts and the checksum are filled in.

        Args:
            value: a mapping of all fields, such as what `parse` returned; `values` override it.
            units: take physical values, and round them to the wire's steps.

        Raises:
            UsageError: for a missing or unknown field, or a value that its field cannot hold.
        """
        return engine().build(self, frame, value, values, units=units)

    def example(self, frame: str, *, seed: int = 0) -> bytes:
        """The bytes of a valid frame with seeded random content."""
        return engine().example(self, frame, seed=seed)

    def command(self, name: str, **arguments: Any) -> bytes:
        """The bytes of a command; arguments by name, in units.

        Raises:
            UnknownCommand, OutOfRange: for what the sensor does not take.
        """
        return engine().command(self, name, arguments)

    def decoder(self, *, stream: bool | None = None, backend: str = "auto") -> Decoder:
        """A new incremental decoder, sans-IO and independent of every other.

        Args:
            stream: True reads a byte stream, False one datagram for each `feed`; by default what the data link says.
        """
        return engine().decoder(self, stream=stream, backend=backend)

    def split(self, data: Any, *, backend: str = "auto") -> list[Found]:
        """Every incoming frame of all types in stream order; `data` as in `decode`."""
        return engine().split(self, data, backend=backend)

    def decode(self, data: Any, frame: str | None = None, *, backend: str = "auto") -> Packets:
        """The data frames, or those of another type, as columns.

        Args:
            data: bytes (a stream), an iterable of datagrams, or an (n, size) uint8 array of datagrams.
            backend: "auto", "numpy", "jit" or "construct": the same results.
        """
        return engine().decode(self, data, frame=frame, backend=backend)

    def scans(self, data: Any, *, backend: str = "auto") -> Iterator[Scan]:
        """Every scan of the data; the first and last piece are marked ``complete=False``."""
        return engine().scans(self, data, backend=backend)

    def __repr__(self) -> str:
        options = "".join(f", {name}={value!r}" for name, value in self.options.items())
        return f"Sensor({self.id}, {self.vendor} {self.model}, frames: {', '.join(self.frames) or 'none yet'}{options})"

    def __reduce__(self) -> tuple[Callable[..., Sensor], tuple[str, dict[str, Any]]]:
        return _rebuild, (self.id, dict(self.options))


def _rebuild(sensor_id: str, options: Mapping[str, Any]) -> Sensor:
    return engine().rebuild(sensor_id, options)


def _freeze(value: object, *names: str) -> None:
    for name in names:
        object.__setattr__(value, name, MappingProxyType(dict(getattr(value, name))))


def _check_sensor(sensor: Sensor) -> None:
    if not _ID.fullmatch(sensor.id):
        raise SpecError("an id is vendor-model in lower case with hyphens", path="id", sensor=sensor.id)
    if sensor.status not in STATUSES:
        raise SpecError(f"status is one of {', '.join(STATUSES)}, not {sensor.status!r}", path="status", sensor=sensor.id)
    if not API - 1 <= sensor.api <= API:
        raise SpecError(f"written for interface {sensor.api}; this engine reads {API - 1} and {API}", path="api", sensor=sensor.id)
    for name, frame in sensor.frames.items():
        _known(sensor, f"frames.{name}.after", [frame.after], sensor.frames)
    for name, command in sensor.commands.items():
        _known(sensor, f"commands.{name}", [command.frame, *command.replies], sensor.frames)
        _known(sensor, f"commands.{name}.link", [command.link], sensor.links)
        if "timeout" in command.args:
            raise SpecError("'timeout' is how long its reply is waited for, and cannot be an argument", path=f"commands.{name}.args")
    _known(sensor, "state", sensor.state, sensor.frames)
    _known(sensor, "on_open, on_close", [*sensor.on_open, *sensor.on_close], sensor.commands)
    if sensor.points is None and any(frame.data and frame.points is None for frame in sensor.frames.values()):
        raise SpecError("a data frame without a points function", path="points", sensor=sensor.id)


def _known(sensor: Sensor, path: str, names: Iterable[str | None], table: Mapping[str, Any]) -> None:
    for name in names:
        if name is not None and name not in table and sensor.frames:
            raise SpecError(f"{name!r} is not among {', '.join(table) or 'none'}", path=path, sensor=sensor.id)


def replaced(value: Value, **changes: Any) -> Value:
    """A copy of a frame or sensor with changes; what is derived from its parts is made anew."""
    given = {f.name: getattr(value, f.name) for f in fields(value) if f.init}
    return type(value)(**{**given, **changes})

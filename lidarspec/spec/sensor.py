"""The facts of a sensor's manual as fields of a `SensorDescription`.

A description is immutable, and is checked when it is made. Plugins and users make its subclass
`lidarspec.Sensor`, which has methods to decode, build and so on.
"""

from __future__ import annotations

import inspect
import math
import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from numbers import Real
from os import PathLike
from reprlib import repr as shown
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from lidarspec.errors import (
    LidarSpecError,
    PluginError,
    SpecError,
    UnknownFrame,
    UnknownOption,
    UsageError,
)
from lidarspec.spec.description import (
    Command,
    Frame,
    FrameTypes,
    Relative,
    Reported,
    Simulation,
    check_simulation,
    freeze,
    reject_unknown_arguments,
)
from lidarspec.spec.links import Link, Tcp, is_datagram
from lidarspec.spec.options import Learned, OptionType, option_types
from lidarspec.spec.results import Imu, Points
from lidarspec.spec.timing import EPOCHS, HOUR_S, Clock, OnChange, OnWrap, PacketCounter, Split
from lidarspec.trusted_files import resolve_inside

if TYPE_CHECKING:
    from pathlib import Path

#: The version of the plugin interface. Plugins for this version and for the previous version are
#: accepted.
API = 1
STATUSES = ("manual", "vectors", "capture", "hardware")
#: The valid keys of `Sensor.info`.
_FACT = re.compile(r"[a-z][a-z0-9_]*")
#: names of the returns of a firing; "varying" means that it depends on a setting of the sensor.
RETURN_NAMES = ("first", "last", "strongest", "second strongest", "varying")
#: The possible directions of a vendor's axes.
DIRECTIONS = ("forward", "back", "left", "right", "up", "down")
_ID = re.compile(r"[a-z0-9]+(-[a-z0-9]+)+")
#: The options that every sensor has.
OPTIONS = ("frame", "answer", "cut", "epoch")
FRAMES_OF_REFERENCE = ("rep103", "vendor")
_Sensor = TypeVar("_Sensor", bound="SensorDescription")
#: The texts that an untrusted file may use as an option, because they cannot be paths.
_WORD = re.compile(r"[A-Za-z0-9_+-]{1,40}")


@reject_unknown_arguments
@dataclass(frozen=True, eq=False, repr=False)
class SensorDescription:
    """The facts of one sensor; `lidarspec.Sensor` explains each of them.

    Raises:
        SpecError: for an invalid fact, or a reference to a frame, command or link that the sensor
            does not have.
    """

    id: str
    vendor: str = field(kw_only=True)
    model: str = field(kw_only=True)
    frames: Mapping[str, Frame] = field(kw_only=True)
    points: Callable[[Any], Points] | None = field(default=None, kw_only=True)
    scan: Split | None = field(default=None, kw_only=True)
    links: Mapping[str, Link] = field(kw_only=True)
    commands: Mapping[str, Command] = field(default_factory=dict, kw_only=True)
    clock: Clock | None = field(default=None, kw_only=True)
    sequence: PacketCounter | None = field(default=None, kw_only=True)
    fillers: bytes = field(default=b"", kw_only=True)
    state: Mapping[str, Mapping[str, Any]] = field(default_factory=dict, kw_only=True)
    simulation: Simulation = field(default_factory=Simulation, kw_only=True)
    configure: Any = field(default=None, kw_only=True)
    recognise: Callable[[tuple[bytes, ...]], Mapping[str, Any]] | None = field(
        default=None, kw_only=True
    )
    on_open: tuple[str, ...] = field(default=(), kw_only=True)
    on_close: tuple[str, ...] = field(default=(), kw_only=True)
    range_limits: tuple[float, float] | None = field(default=None, kw_only=True)
    vendor_axes: tuple[str, str, str] | None = field(default=None, kw_only=True)
    beams: int | None = field(default=None, kw_only=True)
    returns: tuple[str, ...] = field(default=(), kw_only=True)
    turn: tuple[float, float] | None = field(default=None, kw_only=True)
    relatives: Mapping[str, str | Relative] = field(default_factory=dict, kw_only=True)
    info: Mapping[str, str | Reported] = field(default_factory=dict, kw_only=True)
    status: str = field(kw_only=True)
    source: str = field(kw_only=True)
    aliases: tuple[str, ...] = field(default=(), kw_only=True)
    api: int = field(default=API, kw_only=True)
    acknowledged: Mapping[str, str] = field(default_factory=dict, kw_only=True)
    options: Mapping[str, Any] = field(default_factory=dict, kw_only=True)
    hooked: Callable[[Any], Any] | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        object.__setattr__(self, "frames", MappingProxyType(FrameTypes(self.id, self.frames)))
        freeze(self, "links", "commands", "state", "relatives", "info", "acknowledged", "options")
        for name in ("on_open", "on_close", "aliases", "returns"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if isinstance(self.configure, Configure):
            function = self.configure.function
        else:
            function = self.configure
        object.__setattr__(self, "configure", function)
        _check_sensor(self)
        object.__setattr__(self, "configure", Configure(self, function))

    @property
    def data_frame(self) -> str:
        """The name of the frame type with the points.

        If several frame types have points, the option `answer` of `configure` has the name of the
        type that the sensor sends. The default is the first type.

        Raises:
            UsageError: for a sensor without points.
            UnknownFrame: for a sensor whose frame types are unknown until it is configured with a
                file.
        """
        names = self.data_frames
        self.require_points()
        if not names:
            raise UnknownFrame(
                "data", self.frames, place=self.id, hint="; configure the sensor first"
            )
        answer = self.options.get("answer")
        return answer if answer in names else names[0]

    @cached_property
    def incoming(self) -> Mapping[str, Frame]:
        """The frame types that the sensor sends, by name, in the order of `frames`."""
        return {name: frame for name, frame in self.frames.items() if frame.direction == "in"}

    @cached_property
    def data_frames(self) -> tuple[str, ...]:
        """The names of the frame types with points."""
        return tuple(name for name, frame in self.frames.items() if frame.data)

    @property
    def has_points(self) -> bool:
        """Whether the sensor has points; True as long as its frame types are unknown."""
        return bool(self.data_frames) or not self.frames

    def require_points(self) -> None:
        """Raise UsageError for a sensor without points."""
        if not self.has_points:
            example = next(iter(self.incoming), "")
            raise UsageError(
                f"{self.id} has no points: select one of its frame types"
                f" ({', '.join(self.incoming) or 'none'}), as in frame={example!r}"
            )

    def require_imu(self) -> None:
        """Raise UsageError for a sensor without IMU samples."""
        if not self.imu_frames:
            raise UsageError(f"{self.id}: no frame type contains IMU samples")

    @cached_property
    def main_frames(self) -> tuple[str, ...]:
        """The names of the data frames, or of all incoming frames if there are no points."""
        return self.data_frames or tuple(self.incoming)

    @cached_property
    def imu_frames(self) -> tuple[str, ...]:
        """The names of the incoming frame types with IMU measurements."""
        return tuple(name for name, frame in self.incoming.items() if frame.imu is not None)

    @cached_property
    def reported(self) -> Mapping[str, Reported]:
        """The facts that the sensor reports about itself (`info`), by name."""
        return {name: Reported.of(declared) for name, declared in self.info.items()}

    @cached_property
    def info_frames(self) -> tuple[str, ...]:
        """The names of the frame types with information about the device (`info`)."""
        paths = [path for fact in self.reported.values() for path in fact.paths]
        return tuple(dict.fromkeys(path.partition(".")[0] for path in paths))

    def points_of(self, frame: str) -> Callable[[Any], Points]:
        """Return the `points` function of a frame type.

        A data frame without a function of its own uses the function of the sensor.

        Args:
            frame: the name of a frame type, or "name.path" for the parts of a frame.

        Raises:
            SpecError: if the frame type has no points.
        """
        name, _, parts = frame.partition(".")
        function = self.frames[name].points
        if isinstance(function, Mapping):
            function = function.get(parts)
        elif function is None and self.frames[name].data and not parts:
            function = self.points
        if function is None:
            raise SpecError("this frame type has no points", path=frame, sensor=self.id)
        return function

    def imu_of(self, frame: str) -> Callable[[Any], Imu]:
        """Return the `imu` function of a frame type.

        Args:
            frame: the name of a frame type, or "name.path" for the parts of a frame.

        Raises:
            SpecError: if the frame type has no such function.
        """
        name, _, parts = frame.partition(".")
        function = self.frames[name].imu
        if isinstance(function, Mapping):
            function = function.get(parts)
        if function is not None:
            return function
        if self.imu_frames:
            with_imu = ", ".join(self.imu_frames)
            reason = f"this frame type has no IMU samples; frame types with IMU samples: {with_imu}"
        else:
            reason = "no frame type of the sensor has IMU samples"
        raise SpecError(reason, path=frame, sensor=self.id)

    def parts_with(self, function: Literal["points", "imu"], frame: str) -> str:
        """Return the path of the parts of a frame that have a `points` or `imu` function.

        Returns:
            The path; "" if the frame has no such parts.
        """
        if frame not in self.frames:
            return ""
        declared = getattr(self.frames[frame], function)
        if not isinstance(declared, Mapping):
            return ""
        (path,) = declared
        return str(path)

    def simulation_of(self, frame: str) -> Simulation:
        """Return the simulation facts of a frame type.

        For a data frame, facts that the frame type does not declare are taken from the sensor.
        """
        declared = self.frames[frame]
        if declared.data:
            shared = self.simulation
        else:
            shared = Simulation()
        return Simulation(
            sweep=declared.simulation.sweep or shared.sweep,
            encode=declared.simulation.encode or shared.encode,
            rate=declared.simulation.rate or shared.rate,
            directions=declared.simulation.directions or shared.directions,
        )

    @cached_property
    def datagrams(self) -> bool:
        """Whether data arrives in datagrams, and not as a byte stream."""
        return is_datagram(self.links.get("data"))

    @property
    def announces_port(self) -> bool:
        """Whether a command in `on_open` contains this computer's port for the data."""
        return any(self.commands[name].has_own_port for name in self.on_open)

    @property
    def commands_over_data(self) -> bool:
        """Whether commands that have a frame are sent over the data link."""
        return any(one.frame and one.link == "data" for one in self.commands.values())

    @property
    def counts_losses(self) -> bool:
        """Whether lost packets can be counted.

        This requires a packet counter, or a clock that declares the time between packets (`pace`).
        """
        if self.sequence is not None:
            return True
        return self.clock is not None and self.clock.pace is not None

    def __repr__(self) -> str:
        options = "".join(f", {name}={value!r}" for name, value in self.options.items())
        return (
            f"{type(self).__name__}({self.id}, {self.vendor} {self.model}, frames:"
            f" {', '.join(self.frames) or 'none yet'}{options})"
        )


def with_frames(sensor: _Sensor, frames: Mapping[str, Frame]) -> _Sensor:
    """Return a copy of a sensor with only these frame types.

    The copy has no commands, no `state` and no `info`, because they may refer to other frame types.
    """
    clock = sensor.clock
    if clock is not None and clock.reference is not None and clock.reference[0] not in frames:
        clock = replace(clock, reference=None)
    if clock is not None and clock.status is not None and clock.status.frame not in ("", *frames):
        clock = replace(clock, status=None)
    return replace(
        sensor, frames=frames, clock=clock, commands={}, state={}, info={}, on_open=(), on_close=()
    )


def _check_sensor(sensor: SensorDescription) -> None:
    """Raise `SpecError` if a fact is invalid or refers to something that is missing."""
    check_simulation(sensor.simulation)
    _check_facts(sensor)
    for name, frame in sensor.frames.items():
        _check_names(sensor, f"frames.{name}.after", [frame.after], sensor.frames)
    for name, command in sensor.commands.items():
        _check_command(sensor, name, command)
    if sensor.commands:
        _check_names(sensor, "simulation.answers", sensor.simulation.answers, sensor.commands)
        _check_names(sensor, "simulation.effects", sensor.simulation.effects, sensor.commands)
    _check_names(sensor, "state", sensor.state, sensor.frames)
    _check_clock(sensor)
    _check_names(sensor, "info", sensor.info_frames, sensor.frames)
    for name, link in sensor.links.items():
        if sensor.commands and isinstance(link, Tcp) and link.reported:
            _check_reported(sensor, name)
    _check_names(sensor, "on_open, on_close", sensor.on_open, sensor.commands)
    _check_names(sensor, "on_open, on_close", sensor.on_close, sensor.commands)
    if sensor.data_frames:
        _check_points(sensor)


def _check_reported(sensor: SensorDescription, name: str) -> None:
    """Raise `SpecError` if the sensor cannot report the port of a link."""
    if name != "data":
        raise SpecError(
            "only the data link may have `reported`", path=f"links.{name}", sensor=sensor.id
        )
    if not any(
        sensor.commands[opening].provides and sensor.commands[opening].link != "data"
        for opening in sensor.on_open
        if opening in sensor.commands
    ):
        raise SpecError(
            "`reported` requires that a command in `on_open` provides the port, and that this"
            " command is sent over another link",
            path=f"links.{name}",
            sensor=sensor.id,
        )


def _check_points(sensor: SensorDescription) -> None:
    """Raise `SpecError` if a fact about points or scans is missing."""
    if sensor.points is None and any(
        frame.data and frame.points is None for frame in sensor.frames.values()
    ):
        raise SpecError("a data frame requires a points function", path="points", sensor=sensor.id)
    for name in ("scan", "range_limits"):
        if getattr(sensor, name) is None:
            raise SpecError(
                "this argument is required for a sensor with a data frame",
                path=name,
                sensor=sensor.id,
            )


def _check_facts(sensor: SensorDescription) -> None:
    """Raise `SpecError` for a fact that is invalid by itself."""
    if not _ID.fullmatch(sensor.id):
        raise SpecError(
            "invalid id: expected vendor-model in lower case with hyphens",
            path="id",
            sensor=sensor.id,
        )
    if sensor.status not in STATUSES:
        raise SpecError(
            f"status must be one of {', '.join(STATUSES)}, not {sensor.status!r}",
            path="status",
            sensor=sensor.id,
        )
    if not API - 1 <= sensor.api <= API:
        raise SpecError(
            f"the sensor requires version {sensor.api} of the plugin interface; this lidarspec"
            f" supports {API - 1} and {API}",
            path="api",
            sensor=sensor.id,
        )
    for name, frame in sensor.frames.items():
        if frame.endless is not None and not _comes_in_datagrams(sensor, frame):
            raise SpecError(
                f"{frame.endless.reason}. Such a frame has no end in a byte stream, so it must be"
                " sent as a datagram",
                path=f"{name}.{frame.endless.path}".strip("."),
                sensor=sensor.id,
                rule=frame.endless.rule,
            )
    wrong_names = [name for name in sensor.info if not _FACT.fullmatch(name)]
    if wrong_names:
        raise SpecError(
            f"{wrong_names[0]!r} is not a valid name: use lower-case letters, digits and _",
            path="info",
            sensor=sensor.id,
        )
    unknown_directions = sorted(set(sensor.vendor_axes or ()) - set(DIRECTIONS))
    if unknown_directions:
        raise SpecError(
            f"unknown direction {unknown_directions[0]!r}", path="vendor_axes", sensor=sensor.id
        )
    unknown_returns = sorted(set(sensor.returns) - set(RETURN_NAMES))
    if unknown_returns:
        raise SpecError(
            f"unknown name {unknown_returns[0]!r}: expected one of {', '.join(RETURN_NAMES)}",
            path="returns",
            sensor=sensor.id,
        )
    if sensor.beams is not None and sensor.beams < 1:
        raise SpecError(
            f"a scan must have at least 1 point, not {sensor.beams}", path="beams", sensor=sensor.id
        )
    if sensor.turn is not None and not 0 < sensor.turn[0] <= sensor.turn[1]:
        raise SpecError(
            f"expected the lowest and the highest number of scans per second, got {sensor.turn}",
            path="turn",
            sensor=sensor.id,
        )


def _comes_in_datagrams(sensor: SensorDescription, frame: Frame) -> bool:
    """Return whether a frame is never part of a byte stream."""
    if frame.direction == "out":
        return True
    if frame.data and "data" in sensor.links:
        return is_datagram(sensor.links["data"])
    return all(map(is_datagram, sensor.links.values()))


def _check_command(sensor: SensorDescription, name: str, command: Command) -> None:
    """Raise `SpecError` if a command refers to something that is missing."""
    frames = [command.frame, *command.replies, command.refusal]
    _check_names(sensor, f"commands.{name}", frames, sensor.frames)
    _check_names(sensor, f"commands.{name}.link", [command.link], sensor.links)
    if command.only_stopped and not any(
        other.starts or other.stops for other in sensor.commands.values()
    ):
        raise SpecError(
            "only_stopped requires that one of the sensor's commands starts or stops the data",
            path=f"commands.{name}",
        )
    if command.learns is not None and not (command.replies and sensor.configure is not None):
        raise SpecError(
            "learns requires a reply, and a `configure` function that accepts the options",
            path=f"commands.{name}.learns",
        )
    if command.provides is not None and not command.replies:
        raise SpecError("provides requires a reply", path=f"commands.{name}.provides")
    if command.needed and not any(other.provides for other in sensor.commands.values()):
        raise SpecError(
            f"the name {min(command.needed)!r} in a template is unknown: the command has no such"
            " argument, and no command has a `provides` function that could return its value",
            path=f"commands.{name}.values",
            sensor=sensor.id,
        )
    if "timeout" in command.args:
        raise SpecError(
            "'timeout' is reserved for the reply timeout and cannot be an argument",
            path=f"commands.{name}.args",
        )


def _check_clock(sensor: SensorDescription) -> None:
    """Raise `SpecError` if a frame type that the clock needs is missing or unsuitable."""
    clock = sensor.clock
    if clock is None:
        return
    if clock.status is not None and clock.status.frame:
        _check_names(sensor, "clock.status.frame", [clock.status.frame], sensor.incoming)
    if clock.reference is None:
        return
    _check_names(sensor, "clock.reference", clock.reference[:1], sensor.frames)
    if clock.wraps_at is None or callable(clock.source):
        raise SpecError(
            "Clock(reference=...) requires `wraps_at`, and a clock that is read from fields, not by"
            " a function",
            path="clock.reference",
            sensor=sensor.id,
        )


def _check_names(
    sensor: SensorDescription, path: str, names: Iterable[str | None], table: Mapping[str, Any]
) -> None:
    """Raise `SpecError` for the first name that is not in a table; None is allowed."""
    for name in names:
        if name is not None and name not in table and sensor.frames:
            raise SpecError(
                f"unknown name {name!r}: expected one of {', '.join(table) or 'none'}",
                path=path,
                sensor=sensor.id,
            )


@dataclass(frozen=True)
class Configure:
    """The method ``sensor.configure(...)``, which returns a sensor with options.

    Every sensor has the options in `OPTIONS`, and those of the plugin.
    """

    sensor: SensorDescription
    function: Callable[..., SensorDescription] | None

    def __call__(self, **options: Any) -> SensorDescription:
        """Return a copy of the sensor with these options.

        Raises:
            UnknownOption: for an option that the sensor does not have.
            UsageError: for a value that an option does not accept.
            PluginError: if the plugin's function raises any other error.
        """
        sensor = self.sensor
        _check_shared(sensor, options)
        own_options = {name: value for name, value in options.items() if name not in OPTIONS}
        if own_options:
            configured = self._call_function(own_options)
        else:
            configured = sensor
        options = {**sensor.options, **options}
        clock = configured.clock
        if clock is not None and "epoch" in options:
            clock = replace(clock, epoch=options["epoch"])
        return replace(configured, options=options, clock=clock, configure=self.function)

    @property
    def types(self) -> dict[str, OptionType]:
        """The types of the sensor's own options, by name.

        Raises:
            SpecError: for an annotation that cannot be evaluated.
        """
        return option_types(self.function)

    @property
    def files(self) -> tuple[str, ...]:
        """The names of the sensor's own options that accept a path."""
        return tuple(name for name, option in self.types.items() if option.is_file)

    def accepts_value(self, name: str, value: object) -> bool:
        """Return whether an option accepts a value; True if the option is unknown."""
        return self.types.get(name, OptionType()).accepts(value)

    def check_untrusted_options(self, options: Mapping[str, Any], folder: Path) -> dict[str, Any]:
        """Check the options of an untrusted file, and return them as Python values.

        Valid values are numbers, words, the data of a `Learned`, and paths of files in `folder` or
        below it. In the result, these paths begin with `folder`.

        Raises:
            UsageError: for a path outside the folder, or a value of another kind.
        """
        checked = dict(options)
        for name, value in options.items():
            is_word = isinstance(value, str) and _WORD.fullmatch(value)
            if isinstance(value, Mapping):
                checked[name] = Learned.of_dict(value)
            elif name in self.files and value is not None:
                try:
                    checked[name] = resolve_inside(folder, value)
                except UsageError as error:
                    raise UsageError(f"{name}: {error}") from None
            elif not isinstance(value, bool | int | float | None) and not is_word:
                raise UsageError(f"{name}: expected a number or a word, got {shown(value)}")
        return checked

    def _call_function(self, options: Mapping[str, Any]) -> SensorDescription:
        """Return the sensor that the plugin's function makes, with hooks applied."""
        sensor = self.sensor
        if self.function is None:
            raise UnknownOption(min(options), OPTIONS, place=sensor.id)
        try:
            inspect.signature(self.function).bind(sensor, **options)
        except TypeError as error:
            raise UnknownOption(min(options), OPTIONS, place=sensor.id, hint=f": {error}") from None
        types = self.types
        for name, value in options.items():
            option = types.get(name, OptionType())
            if not option.accepts(value):
                raise UsageError(
                    f"{sensor.id}: {name} must be {option.describe()}, not {shown(value)}"
                )
            if option.is_file and value is not None and not isinstance(value, Learned):
                _refuse_pipe(value)
        try:
            configured = self.function(sensor, **options)
        except (LidarSpecError, OSError):
            raise
        except Exception as error:
            raise PluginError.of(
                error, "configure", sensor=sensor.id, function=self.function
            ) from error
        if sensor.hooked is None:
            return configured
        hooked: SensorDescription = sensor.hooked(configured)
        return hooked


def _refuse_pipe(path: str | PathLike[str]) -> None:
    """Raise `UsageError` for a pipe or device, because it may never end."""
    if os.path.exists(path) and not os.path.isfile(path) and not os.path.isdir(path):
        raise UsageError(
            f"{path!s}: expected a regular file, not a pipe or device: write its content to a"
            " file first"
        )


def _check_cut(sensor: SensorDescription, degrees: object) -> None:
    """Raise `UsageError` if the angle is invalid, or scans cannot be cut at an angle."""
    has_angle = isinstance(sensor.scan, OnWrap) or (
        isinstance(sensor.scan, OnChange) and bool(sensor.scan.angle)
    )
    if not has_angle:
        raise UsageError(
            f"{sensor.id}: cut cannot be set, because its scans do not end at an angle"
        )
    if (
        isinstance(degrees, bool)
        or not isinstance(degrees, Real)
        or not math.isfinite(float(degrees))
    ):
        raise UsageError(f"{sensor.id}: cut must be an angle in degrees, not {shown(degrees)}")


def _check_epoch(sensor: SensorDescription, epoch: object) -> None:
    """Raise `UsageError` if the clock of the sensor cannot count from this epoch."""
    if sensor.clock is None and sensor.frames:
        raise UsageError(f"{sensor.id}: epoch cannot be set, because the sensor has no clock")
    if epoch not in EPOCHS:
        raise UsageError(
            f"{sensor.id}: epoch must be one of {', '.join(filter(None, EPOCHS))}, not"
            f" {shown(epoch)}"
        )
    if epoch == "hour" and sensor.clock is not None and sensor.clock.wraps_at != HOUR_S:
        raise UsageError(
            f"{sensor.id}: epoch cannot be hour, because the clock counts beyond one hour"
        )


def _check_shared(sensor: SensorDescription, options: Mapping[str, Any]) -> None:
    frame = options.get("frame", FRAMES_OF_REFERENCE[0])
    if frame not in FRAMES_OF_REFERENCE:
        raise UsageError(
            f"{sensor.id}: frame must be one of {', '.join(FRAMES_OF_REFERENCE)}, not {frame!r}"
        )
    if frame == "vendor" and sensor.vendor_axes is None:
        raise UsageError(f"{sensor.id} declares no vendor axes")
    if "cut" in options:
        _check_cut(sensor, options["cut"])
    if "epoch" in options:
        _check_epoch(sensor, options["epoch"])
    if "answer" in options and options["answer"] not in sensor.data_frames:
        raise UsageError(
            f"{sensor.id}: answer must be one of {', '.join(sensor.data_frames)}, not"
            f" {options['answer']!r}"
        )

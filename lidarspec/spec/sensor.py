"""A sensor: its `Spec`, and what can be done with it as methods.

Each method hands over to the station that does it: wire (parse, build), simulation (example),
framing (decoder, split), packets (decode), scans. They are imported when a method is called first:
a sensor is found and looked at far more often than all of them are needed.
"""

from __future__ import annotations

import base64
import inspect
import math
import os
import re
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from numbers import Integral, Real
from os import PathLike
from reprlib import repr as shown
from typing import TYPE_CHECKING, Any

from lidarspec.display import drawn
from lidarspec.errors import LidarSpecError, PluginError, UnknownOption, UsageError
from lidarspec.spec.description import Spec
from lidarspec.spec.timing import OnChange, OnWrap
from lidarspec.trust import beside

if TYPE_CHECKING:
    from pathlib import Path

    from lidarspec.framing.decoder import Decoder
    from lidarspec.framing.results import Found
    from lidarspec.packets.imu import Waiting
    from lidarspec.packets.packets import Packets
    from lidarspec.scans.scans import Scan
    from lidarspec.scans.selection import Selection

#: bytes of something learned at most, where a file says it.
LARGEST = 1 << 20
#: options that every sensor has.
OPTIONS = ("frame", "answer", "cut")
FRAMES_OF_REFERENCE = ("rep103", "vendor")
#: what a file may give as an option without naming a path.
_WORD = re.compile(r"[A-Za-z0-9_+-]{1,40}")


class Learned(bytes):
    """What a sensor said of itself, as the value of an option: the content of what else is a file,
    never a path.

    An option takes it where its parameter is annotated with it, ``calibration: str | Path |
    Learned``.
    """

    def __repr__(self) -> str:
        return f"Learned({len(self)} bytes)"

    def to_dict(self) -> dict[str, str]:
        """As data, such as in the header of a recording."""
        return {"learned": base64.b64encode(zlib.compress(self)).decode()}

    @classmethod
    def of_dict(cls, data: Mapping[str, Any]) -> Learned:
        """What `to_dict` gave.

        Raises:
            UsageError: for what it never gives, or more than a megabyte.
        """
        reader = zlib.decompressobj()
        try:
            content = reader.decompress(base64.b64decode(data["learned"], validate=True), LARGEST)
        except (KeyError, TypeError, ValueError, zlib.error):
            content = b""
        if not reader.eof or set(data) != {"learned"}:
            raise UsageError(f"{shown(data)} is nothing that a sensor said")
        return cls(content)

    @classmethod
    def content(cls, value: str | PathLike[str] | Learned) -> bytes:
        """The bytes that an option stands for: learned ones themselves, those of a file for its
        path.

        Raises:
            UsageError: for a file that cannot be read.
        """
        if isinstance(value, cls):
            return bytes(value)
        try:
            with open(value, "rb") as file:
                return file.read()
        except (OSError, ValueError) as error:
            raise UsageError(f"{value!s}: {getattr(error, 'strerror', None) or error}") from None


class Sensor(Spec):
    """One sensor, described, and all that can be done with it.

    Args:
        id: vendor-model in lower case with hyphens; the same everywhere and for ever.
        vendor, model: as people write them.
        frames: every message type by name, in both directions; where several fit at one place,
            their order decides.
        points: a function of `Fields` that returns `Polar` or `Cartesian`; None where each data
            frame has its own.
        scan: where one scan ends and the next begins.
        links: by name; the data come over "data", commands over the link that they name.
        commands: what can be asked of it, by name.
        clock: its own time, if it has one.
        sequence: its counter of packets, if it has one.
        fillers: bytes that it sends between frames; they are counted on their own.
        state: defaults of other frames' fields for ``f.state``, by frame and path, in units.
        simulation: what a simulated sensor needs beyond all this.
        configure: a function of the sensor and its options, by name, that returns another sensor.
        recognise: where data frames do not say how they are laid out: a function of datagrams that
            returns the options of `configure` with which they are read, {} where they are of no
            such sensor.
        on_open, on_close: names of the commands that are sent when it is opened and closed.
        range_limits: the shortest and the longest range that it can measure, metres.
        vendor_axes: where the vendor's x, y and z point, of forward, back, left, right, up and
            down, for ``frame="vendor"``.
        beams: points of a scan, where their number is constant.
        turn: the slowest and the fastest number of scans a second.
        relatives: ids of sensors that it can be mistaken for, installed or not -> what tells them
            apart: a text, where it is the pace of the clock or what `info` names as model; a
            `Relative`, where single packets show it.
        info: what frames say of the device ("serial", "firmware", "model", "temperature") -> the
            field, as "frame.path".
        status: how far it is proven: "manual", "vectors", "capture" or "hardware".
        source: the manual with its revision and sections, the captures.
        aliases: other ids that it is known by.
        api: the version of this interface that it was written for.
        acknowledged: findings of `lidarspec check` about the sensor as a whole that are true and
            meant, as "LS401" -> the reason.
        options: what it was configured with; not for plugins to set.
        hooked: applies the hooks of installed plugins to a value like this one; not for plugins to
            set.

    Raises:
        SpecError: for an id, status or reference between its parts that cannot be.
    """

    _repr_html_ = drawn("sensor")

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.configure, Configure):
            function = self.configure.function
        else:
            function = self.configure
        object.__setattr__(self, "configure", Configure(self, function))

    def parse(
        self, data: bytes, frame: str | None = None, *, verify: bool = True, units: bool = False
    ) -> Any:
        """Exactly one frame as a construct Container of raw wire integers.

        Args:
            frame: its type; found out where left out.
            verify: False accepts wrong constants, a wrong checksum and trailing bytes.
            units: physical values, as ``build(units=True)`` takes them: those of scaled fields in
                their units, others as they are.

        Raises:
            WireError: where the bytes are not such a frame: sensor, offset, field path, expected
                and got.
        """
        from lidarspec.frames.parse import parse

        return parse(self, data, frame=frame, verify=verify, units=units)

    def build(
        self, frame: str, value: Any = None, /, *, units: bool = False, **values: Any
    ) -> bytes:
        """The bytes of one frame; constants, counts and the checksum are filled in.

        Args:
            value: a mapping of all fields, such as what `parse` returned; `values` override it.
            units: take physical values, and round them to the wire's steps.

        Raises:
            UsageError: for a missing or unknown field, or a value that its field cannot hold.
        """
        from lidarspec.frames.build import build

        return build(self, frame, value, values, units=units)

    def example(self, frame: str, *, seed: int = 0) -> bytes:
        """The bytes of a valid frame with seeded random content.

        Raises:
            UnknownFrame: for a frame type that the sensor does not have.
        """
        from lidarspec.framing.examples import example

        return example(self, frame, seed=seed)

    def command(self, name: str, /, **arguments: Any) -> bytes:
        """The bytes of a command; arguments by name, in units.

        Raises:
            UnknownCommand, OutOfRange: for what the sensor does not take.
        """
        from lidarspec.frames.commands import build_command

        return build_command(self, name, arguments)

    def decoder(self, *, stream: bool | None = None, backend: str = "auto") -> Decoder:
        """A new incremental decoder, sans-IO and independent of every other.

        Args:
            stream: True reads a byte stream, False one datagram for each `feed`; by default what
                the data link says.
            backend: "auto", "numpy" or "jit": the same results.

        Raises:
            UsageError: for an unknown back end, or a sensor that has no frames before it is
                configured.
        """
        from lidarspec.framing.decoder import Decoder, backend as checked_backend

        chosen = checked_backend(backend)
        sums = None
        if chosen == "jit":
            from lidarspec.points.numba_kernels import compiled_sums

            sums = compiled_sums()
        stream = not self.datagrams if stream is None else stream
        return Decoder(self, stream=stream, backend=chosen, sums=sums)

    def split(self, data: Any, *, backend: str = "auto") -> list[Found]:
        """Every incoming frame of all types, in stream order. Raises on no bytes whatever.

        Args:
            data: bytes (a stream), an iterable of datagrams, or an (n, size) uint8 array of
                datagrams.
            backend: "auto", "numpy" or "jit": the same results.

        Raises:
            UsageError: for a text or a path, an unknown back end, or a sensor that has no frames
                before it is configured.
        """
        from lidarspec.framing.decoder import frames_of, is_stream

        decoder = self.decoder(stream=is_stream(data), backend=backend)
        return [found for frames in frames_of(decoder, data) for found in frames.found()]

    def decode(self, data: Any, frame: str | None = None, *, backend: str = "auto") -> Packets:
        """The data frames, or those of another type, as columns. Raises on no bytes whatever.

        Args:
            data: bytes (a stream), an iterable of datagrams, or an (n, size) uint8 array of
                datagrams.
            frame: the name of a frame type; of several data frames, the first that arrives where
                left out.
            backend: "auto", "numpy" or "jit": the same results.

        Raises:
            UnknownFrame: for a frame type that the sensor does not have.
            UsageError: for a text or a path, an unknown back end, or a sensor that has no frames
                before it is configured.
        """
        return self._decoded(data, frame, backend)[0]

    def _decoded(
        self, data: Any, frame: str | None, backend: str
    ) -> tuple[Packets, Waiting | None]:
        """The packets of a frame type; and where none is named, what an IMU felt by their clock."""
        from lidarspec.framing.decoder import frames_of, is_stream
        from lidarspec.packets.stream import ImuStream, PacketStream, data_frame

        decoder = self.decoder(stream=is_stream(data), backend=backend)
        frames = frames_of(decoder, data)
        name = frame or data_frame(self, frames) or self.data_frame
        stream = PacketStream(self, name, decoder.stats, backend=decoder.backend)
        packets = stream.add(frames, whole=True)
        if frame is None:
            imu = ImuStream(self, decoder.stats, backend=decoder.backend)
        else:
            imu = None
        if imu is not None:
            imu.add(frames, packets, whole=True)
        return packets, None if imu is None else imu.waiting

    def scans(
        self, data: Any, *, backend: str = "auto", select: Selection | None = None
    ) -> Iterator[Scan]:
        """Every scan of the data; the first and last piece are marked ``complete=False``.

        Where there is no data frame in the data, or `points` raises at some of the packets, a
        Python warning says so.

        Args:
            data: bytes (a stream), an iterable of datagrams, or an (n, size) uint8 array of
                datagrams.
            backend: "auto", "numpy" or "jit": the same results.
            select: which scans, and what of each.

        Raises:
            UsageError: for a text or a path, an unknown back end, a sensor that has no frames
                before it is configured, or where none of the scans is wanted.
        """
        from lidarspec.scans.scans import scans_of
        from lidarspec.scans.selection import Sieve

        packets, imu = self._decoded(data, None, backend)
        if packets.stats.bytes_in and not len(packets):
            warnings.warn(
                f"{self.id}: no {packets.frame} frame in the data ({packets.stats}): is it of"
                " another sensor?",
                stacklevel=2,
            )
        found = scans_of(self, [packets], imu)
        return self._followed(
            found if select is None else Sieve(select, "the data").of(found), packets
        )

    def _followed(self, scans: Iterator[Any], packets: Packets) -> Iterator[Scan]:
        """Scans, and behind them what the plugin failed at, and that they have no end."""
        yield from scans
        if packets.stats.unended:
            warnings.warn(f"{self.id}: {packets.stats.unended}", stacklevel=2)
        if (failure := packets.stats.failure(self.id)) is not None:
            warnings.warn(str(failure), stacklevel=2)


@dataclass(frozen=True)
class Configure:
    """``sensor.configure(...)``: the options of every sensor, then the sensor's own function, on a
    new value.
    """

    sensor: Sensor
    function: Callable[..., Sensor] | None

    def __call__(self, **options: Any) -> Sensor:
        """A new sensor with these options; the old one stays as it is.

        Raises:
            UnknownOption: for an option that neither every sensor nor this one has.
            UsageError: for a value that an option cannot have.
            PluginError: where the sensor's own function fails at something else.
        """
        sensor = self.sensor
        own = {name: value for name, value in options.items() if name not in OPTIONS}
        _check_shared(sensor, options)
        configured = self._by_function(own) if own else sensor
        return replace(configured, options={**sensor.options, **options}, configure=self.function)

    @property
    def files(self) -> tuple[str, ...]:
        """The names of the sensor's own options that take a path."""
        return tuple(name for name, kinds in self._kinds.items() if "Path" in kinds)

    def takes(self, name: str, value: object) -> bool:
        """Whether a value is of a type that the option is declared with, by the annotation of its
        parameter; of others nobody knows.
        """
        kinds = self._kinds.get(name, {""})
        if isinstance(value, Learned):
            return "Learned" in kinds
        return any(_TYPES.get(kind, _anything)(value) for kind in kinds)

    def options_of_file(self, options: Mapping[str, Any], folder: Path) -> dict[str, Any]:
        """The options that stand in a file in `folder` that anybody may have written: numbers,
        words, what was learned, files beside it.

        Raises:
            UsageError: for a path that leads anywhere else, and for other values.
        """
        given = dict(options)
        for name, value in options.items():
            if isinstance(value, Mapping):
                given[name] = Learned.of_dict(value)
            elif name in self.files and value is not None:
                try:
                    given[name] = beside(folder, value)
                except UsageError as error:
                    raise UsageError(f"{name}: {error}") from None
            elif not isinstance(value, bool | int | float | None) and not (
                isinstance(value, str) and _WORD.fullmatch(value)
            ):
                raise UsageError(f"{name}: {shown(value)} is neither a number nor a word")
        return given

    @property
    def _kinds(self) -> dict[str, set[str]]:
        """The names of the types that the sensor's own options are declared with, by option."""
        known = inspect.signature(self.function).parameters if self.function is not None else {}
        return {name: _type_names(parameter.annotation) for name, parameter in known.items()}

    def _by_function(self, options: Mapping[str, Any]) -> Sensor:
        if self.function is None:
            raise UnknownOption(min(options), OPTIONS, place=self.sensor.id)
        try:
            inspect.signature(self.function).bind(self.sensor, **options)
        except TypeError as error:
            raise UnknownOption(
                min(options), OPTIONS, place=self.sensor.id, hint=f": {error}"
            ) from None
        for name, value in options.items():
            if not self.takes(name, value):
                kinds = (
                    " or ".join(_TOLD[kind] for kind in sorted(self._kinds[name]) if kind in _TOLD)
                    or "no content"
                )
                raise UsageError(f"{self.sensor.id}: {name} is {kinds}, not {shown(value)}")
            if name in self.files and value is not None and not isinstance(value, Learned):
                _refuse_pipe(value)
        try:
            configured = self.function(self.sensor, **options)
        except (LidarSpecError, OSError):
            raise
        except Exception as error:
            raise PluginError.of(
                error, "configure", sensor=self.sensor.id, function=self.function
            ) from error
        hooked: Sensor = self.sensor.hooked(configured) if self.sensor.hooked else configured
        return hooked


def _refuse_pipe(path: str | PathLike[str]) -> None:
    """Raise UsageError for a pipe or device, which may never end."""
    if os.path.exists(path) and not os.path.isfile(path) and not os.path.isdir(path):
        raise UsageError(
            f"{path!s}: a pipe or device is not read as a file; write its content to a file first"
        )


def _anything(value: object) -> bool:
    return True


#: a type that an option is declared with -> whether a value is of it; what it is called, in the
#: order of the alphabet.
_TYPES: dict[str, Callable[[object], bool]] = {
    "Path": lambda value: isinstance(value, str | PathLike),
    "Learned": lambda value: False,
    "bool": lambda value: isinstance(value, bool),
    "float": lambda value: isinstance(value, Real) and not isinstance(value, bool),
    "int": lambda value: isinstance(value, Integral) and not isinstance(value, bool),
    "str": lambda value: isinstance(value, str),
    "None": lambda value: value is None,
    "Optional": lambda value: value is None,
    "Union": lambda value: False,
}
_TOLD = {
    "Learned": "what a sensor said",
    "Path": "a path",
    "bool": "true or false",
    "float": "a number",
    "int": "a whole number",
    "str": "a text",
}


def _type_names(annotation: object) -> set[str]:
    """The names in an annotation, such as {"str", "Path"} of `str | pathlib.Path`; {""} of none."""
    if annotation is inspect.Parameter.empty:
        return {""}
    if isinstance(annotation, type):
        text = annotation.__name__
    else:
        text = str(annotation)
    return {word.rpartition(".")[2] for word in re.findall(r"[\w.]+", text)}


def _check_cut(sensor: Spec, degrees: object) -> None:
    """Raise UsageError unless scans of a sensor can be cut at an angle, and it is one."""
    has_angle = isinstance(sensor.scan, OnWrap) or (
        isinstance(sensor.scan, OnChange) and bool(sensor.scan.angle)
    )
    if not has_angle:
        raise UsageError(f"{sensor.id}: its scans are not cut at an angle, so cut cannot be set")
    if (
        isinstance(degrees, bool)
        or not isinstance(degrees, Real)
        or not math.isfinite(float(degrees))
    ):
        raise UsageError(f"{sensor.id}: cut is an angle in degrees, not {shown(degrees)}")


def _check_shared(sensor: Spec, options: Mapping[str, Any]) -> None:
    frame = options.get("frame", FRAMES_OF_REFERENCE[0])
    if frame not in FRAMES_OF_REFERENCE:
        raise UsageError(
            f"{sensor.id}: frame is one of {', '.join(FRAMES_OF_REFERENCE)}, not {frame!r}"
        )
    if frame == "vendor" and sensor.vendor_axes is None:
        raise UsageError(f"{sensor.id} declares no axes of its vendor")
    if "cut" in options:
        _check_cut(sensor, options["cut"])
    if "answer" in options and options["answer"] not in sensor.data_frames:
        raise UsageError(
            f"{sensor.id}: answer is one of {', '.join(sensor.data_frames)}, not"
            f" {options['answer']!r}"
        )

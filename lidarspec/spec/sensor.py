"""What every sensor can do: the methods of `Sensor`, carried out by the floors below."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from lidarspec.errors import MissingField, OutOfRange, SpecError, UnknownCommand, UnknownField, UnknownOption, UsageError
from lidarspec.framing.decoder import Decoder, backend as checked_backend, frames_of, is_stream
from lidarspec.framing.frame_engine import codec
from lidarspec.framing.results import Found
from lidarspec.packets.packets import Packets
from lidarspec.packets.stream import PacketStream, data_frame
from lidarspec.plugins import registry
from lidarspec.points.cloud import axis_matrix
from lidarspec.points.numba_kernels import checksums as kernelsums
from lidarspec.scans.scans import Scan, scans_of
from lidarspec.simulation import frame_maker as examples
from lidarspec.spec.description import Configure, Sensor, replaced
from lidarspec.wire import parse as parsing
from lidarspec.wire.build import build

#: options that the engine itself understands, for every sensor.
FRAMES_OF_REFERENCE = ("rep103", "vendor")


class StandardEngine:
    """The engine; it holds nothing, everything is a function of the sensor."""

    parse = staticmethod(parsing.parse)

    def build(self, sensor: Sensor, frame: str, value: Any, values: Mapping[str, Any], *, units: bool) -> bytes:
        return build(sensor, frame, value, values, units=units)

    def example(self, sensor: Sensor, frame: str, *, seed: int) -> bytes:
        return examples.example(sensor, frame, seed=seed)

    def command(self, sensor: Sensor, name: str, arguments: Mapping[str, Any]) -> bytes:
        if name not in sensor.commands:
            raise UnknownCommand(name, sensor.commands, place=sensor.id)
        command, place = sensor.commands[name], f"{sensor.id} {name}"
        unknown = set(arguments) - set(command.args)
        if unknown:
            raise UnknownField(min(unknown), command.args, place=place)
        if command.frame is None:
            return b""
        fields = codec(sensor.frames[command.frame]).schema.fields
        values: dict[str, Any] = {}
        for path, value in command.values.items():
            _put(values, path, value)
        for argument, (path, low, high) in command.args.items():
            if argument not in arguments:
                raise MissingField(argument, place=place)
            value = arguments[argument]
            if not low <= value <= high:
                raise OutOfRange(argument, value, low, high, unit=fields[path].unit, place=place)
            raw = round((value - fields[path].offset) / fields[path].scale)
            bottom, top = fields[path].limits
            _put(values, path, min(max(raw, bottom), top))
        return build(sensor, command.frame, None, values)

    def decoder(self, sensor: Sensor, *, stream: bool | None, backend: str) -> Decoder:
        chosen = checked_backend(backend)
        sums = kernelsums.compiled() if chosen == "jit" else None
        stream = not sensor.datagrams if stream is None else stream
        return Decoder(sensor, stream=stream, interpreted=chosen == "construct", backend=chosen, sums=sums)

    def split(self, sensor: Sensor, data: Any, *, backend: str) -> list[Found]:
        found = frames_of(self.decoder(sensor, stream=is_stream(data), backend=backend), data)
        return [one for spans in found for one in spans.found()]

    def decode(self, sensor: Sensor, data: Any, *, frame: str | None, backend: str) -> Packets:
        decoder = self.decoder(sensor, stream=is_stream(data), backend=backend)
        found = frames_of(decoder, data)
        name = frame or data_frame(sensor, found) or sensor.data_frame
        return PacketStream(sensor, name, decoder.stats, interpreted=decoder.interpreted, backend=decoder.backend).add(found, whole=True)

    def scans(self, sensor: Sensor, data: Any, *, backend: str) -> Iterator[Scan]:
        return scans_of(sensor, [self.decode(sensor, data, frame=None, backend=backend)])

    def configure(self, sensor: Sensor, options: Mapping[str, Any]) -> Sensor:
        own = {name: value for name, value in options.items() if name in ("frame", "answer")}
        rest = {name: value for name, value in options.items() if name not in own}
        _check_own(sensor, own)
        found = sensor
        if rest:
            function = sensor.configure.function
            if function is None:
                raise UnknownOption(min(rest), ("frame", "answer"), place=sensor.id)
            try:
                found = registry().hooked(function(sensor, **rest))
            except TypeError as error:
                if "keyword" in str(error) or "argument" in str(error):
                    raise UnknownOption(min(rest), ("frame", "answer"), place=sensor.id, hint=f": {error}") from None
                raise
        configure = Configure(found, sensor.configure.function)
        return replaced(found, options={**sensor.options, **options}, configure=configure)

    def rebuild(self, sensor_id: str, options: Mapping[str, Any]) -> Sensor:
        sensor = registry().sensor(sensor_id)
        return self.configure(sensor, options) if options else sensor


def _check_own(sensor: Sensor, own: Mapping[str, Any]) -> None:
    if "frame" in own:
        if own["frame"] not in FRAMES_OF_REFERENCE:
            raise UsageError(f"{sensor.id}: frame is one of {', '.join(FRAMES_OF_REFERENCE)}, not {own['frame']!r}")
        if own["frame"] == "vendor" and sensor.vendor_axes is None:
            raise UsageError(f"{sensor.id} declares no axes of its vendor")
        if sensor.vendor_axes is not None:
            try:
                axis_matrix(sensor.vendor_axes)
            except KeyError as error:
                raise SpecError(f"no direction {error}", path="vendor_axes", sensor=sensor.id) from None
    answers = [name for name, frame in sensor.frames.items() if frame.data]
    if "answer" in own and own["answer"] not in answers:
        raise UsageError(f"{sensor.id}: answer is one of {', '.join(answers)}, not {own['answer']!r}")


def _put(values: dict[str, Any], path: str, value: Any) -> None:
    *parents, last = path.split(".")
    for parent in parents:
        values = values.setdefault(parent, {})
    values[last] = value

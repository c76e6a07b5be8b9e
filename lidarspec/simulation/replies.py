"""What a simulated sensor makes of the bytes that it is sent, and what it answers: from the commands of its spec, sans-IO."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from lidarspec.framing.decoder import Decoder
from lidarspec.framing.frame_engine import codec
from lidarspec.simulation.frame_maker import FrameMaker
from lidarspec.spec.description import Answer, Command, Spec
from lidarspec.spec.links import is_datagram
from lidarspec.wire.parse import parse

#: ns of silence after which half a request is forgotten.
PATIENCE = 50_000_000


@dataclass(frozen=True, eq=False)
class Request:
    """A command that arrived: its name, and the raw values of the fields of its frame, by path."""

    name: str
    command: Command
    values: Mapping[str, Any]


@dataclass(frozen=True)
class Answered:
    """A piece of an answer: the name of a frame and its bytes; no name for bytes that are no frame. Or seconds of a pause."""

    frame: str = ""
    data: bytes = b""
    pause: float = 0.0


class Answering:
    """One sensor's side of the conversation."""

    def __init__(self, sensor: Spec) -> None:
        self._sensor = sensor
        self._heard: dict[str, int] = {}
        self._decoders = {
            link: _listening(sensor, link) for link in {command.link for command in sensor.commands.values() if command.frame}
        }
        self._makers: dict[str, FrameMaker] = {}

    def requests(self, data: bytes, now: int, link: str) -> list[Request]:
        """The commands that these bytes complete; what is none is ignored."""
        decoder = self._decoders.get(link)
        if decoder is None:
            return []
        if now - self._heard.get(link, now) > PATIENCE:
            decoder.idle()
        self._heard[link] = now
        requests = (self._request(item.frame, item.data, link) for item in decoder.feed(data))
        return [request for request in requests if request is not None]

    def answers(self, request: Request) -> list[Answered]:
        """All that is sent for a command before any data."""
        declared = self._sensor.simulation.answers.get(request.name)
        chosen: Iterable[Answer] = request.command.replies[:1]
        if declared is not None:
            chosen = declared(request.values) if callable(declared) else declared
        return [self._answer(answer, request) for answer in chosen]

    def frame(self, name: str, number: int = 0, values: Mapping[str, Any] | None = None) -> bytes:
        """A frame of a type other than data: the defaults of the spec, its `sweep`, and these physical values."""
        maker = self._makers.get(name)
        if maker is None:
            maker = self._makers[name] = FrameMaker(self._sensor, name)
        sweep = self._sensor.frames[name].simulation.sweep
        return maker.frame({**self._sensor.state.get(name, {}), **(sweep(number) if sweep else {}), **(values or {})})

    def _answer(self, answer: Answer, request: Request) -> Answered:
        if isinstance(answer, bytes):
            return Answered(data=answer)
        if isinstance(answer, int | float):
            return Answered(pause=float(answer))
        name, values = (answer, {}) if isinstance(answer, str) else answer
        return Answered(name, self.frame(name, 0, {**self._agreed(name, request), **values}))

    def _agreed(self, name: str, request: Request) -> dict[str, float]:
        """The physical values that tie a reply to its request."""
        fields = codec(self._sensor.frames[name]).schema.fields
        raw = {path: request.values[path] for path in request.command.echoes if path in request.values} | dict(request.command.matches)
        return {path: fields[path].physical(value) for path, value in raw.items() if path in fields}

    def _request(self, frame: str, data: bytes, link: str) -> Request | None:
        """The command that a frame is: of several that fit, the one that says most about it."""
        values = dict(_flat(parse(self._sensor, data, frame=frame)))
        fitting = [
            (name, command)
            for name, command in self._sensor.commands.items()
            if (command.frame, command.link) == (frame, link) and all(values.get(path) == value for path, value in command.values.items())
        ]
        if not fitting:
            return None
        name, command = max(fitting, key=lambda one: len(one[1].values))
        return Request(name, command, values)


def _listening(sensor: Spec, link: str) -> Decoder:
    """A decoder of what is sent to the sensor: the outgoing frames, seen from its side."""
    frames = {name: replace(frame, direction="in") for name, frame in sensor.frames.items() if frame.direction == "out"}
    mirrored = replace(sensor, frames=frames, commands={}, state={}, on_open=(), on_close=())
    return Decoder(mirrored, stream=not is_datagram(sensor.links.get(link)))


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value

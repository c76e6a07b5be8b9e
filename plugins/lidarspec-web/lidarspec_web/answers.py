"""What a page is told of a broadcast, and what becomes of what it asks, as JSON has it.

Each answer is a dict with the word `is`; the scans alone go another way (`scene`).
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any

from lidarspec import LidarSpecError, Sensor, UsageError, __version__, explain
from lidarspec.explaining.assignments import arguments
from lidarspec.explaining.contents import duration
from lidarspec.explaining.explanation import Explanation, reply_text
from lidarspec.explaining.wording import asked
from lidarspec.exports.reference import effect
from lidarspec.frames.commands import argument_slot
from lidarspec.points.look import is_flat
from lidarspec.scans.scans import Place
from lidarspec.spec.arguments import Range
from lidarspec_web.backlog import DAMAGED, Backlog, Taken
from lidarspec_web.broadcast import Broadcast, Shown

#: frames whose explanation is kept, and damaged pieces that are told of at once.
KEPT, TOLD = 16, 20


class Answers:
    """What pages are told of a broadcast.

    Args:
        broadcast: what is shown.
        control: whether commands may be sent to a sensor that is no simulated one.

    Attributes:
        duration: of a file, seconds; None where nobody knows.
        why_no_control: why commands are not sent; "" where they are.
    """

    def __init__(self, broadcast: Broadcast, *, control: bool) -> None:
        self.broadcast, self.duration = broadcast, _duration(broadcast)
        self.why_no_control = _why_no_control(broadcast, control=control)
        self._frame = functools.lru_cache(maxsize=KEPT)(self._explained)
        self._verdict = functools.lru_cache(maxsize=DAMAGED)(
            lambda piece: piece.verdict(broadcast.device.sensor)
        )

    def hello(self) -> dict[str, Any]:
        """What a page is told first."""
        broadcast, sensor = self.broadcast, self.broadcast.device.sensor
        return {
            "is": "hello",
            "sensor": sensor.id,
            "title": f"{sensor.vendor} {sensor.model}",
            "source": broadcast.source,
            "live": broadcast.is_live,
            "planar": (
                broadcast.shown is not None
                and is_flat(broadcast.shown.scan.points[broadcast.shown.scan.points.valid])
            ),
            "duration": self.duration,
            "control": not self.why_no_control,
            "why_no_control": self.why_no_control,
            "commands": [form(sensor, name) for name in sensor.commands],
            "restart": restart(sensor),
            "saves": saves(),
            "records": broadcast.switch is not None,
            "history": list(broadcast.history),
            "version": __version__,
        }

    def state(self, *, frozen: bool, since: int, at: Shown | None = None) -> dict[str, Any]:
        """How it goes.

        Args:
            frozen: whether a page has paused a live source.
            since: the number of damaged pieces that it knows of.
            at: the scan that it stands at; by default the newest.
        """
        broadcast, shown = self.broadcast, at or self.broadcast.shown
        switch, paused = broadcast.switch, frozen or broadcast.paused
        current = None if switch is None else switch.recording
        recording = None if current is None else {"name": current[0], "bytes": current[1]}
        trouble = [switch.trouble] if switch is not None and switch.trouble else []
        return {
            "is": "state",
            "at": broadcast.now(),
            "position": shown.position if shown is not None else 0.0,
            "state": "paused" if frozen else broadcast.state,
            "paused": paused,
            "speed": broadcast.speed,
            "figures": broadcast.history[-1] if broadcast.history else None,
            "warnings": [*broadcast.warnings, *trouble],
            "info": broadcast.info,
            "recording": recording,
            "damaged": {"total": broadcast.backlog.damaged, "newest": self._damaged(since)},
        }

    def frame(self, taken: Taken, why: str, place: Place | None = None) -> dict[str, Any]:
        """A frame with every byte explained; `place`: where in it the point is that was asked for."""
        explanation = self._frame(taken.frame, taken.data)
        value = None if place is None else explanation.path_of(place.number, place.part)
        return {
            "is": "frame",
            "number": taken.number,
            "position": self._position(taken.at),
            "hex": taken.data.hex(),
            "why": why,
            "value": value,
            "explanation": explanation.to_dict(),
        }

    def numbered(self, number: int, backlog: Backlog) -> dict[str, Any]:
        """A frame by its number."""
        taken = backlog.frame(number)
        return (
            {"is": "gone", "what": f"frame {number}"}
            if taken is None
            else self.frame(taken, "number")
        )

    def origin(
        self, shown: Shown | None, number: int, index: int, backlog: Backlog
    ) -> dict[str, Any]:
        """The frame that a point of a scan came from, and which of its fields the point is."""
        if shown is None or index >= len(shown.scan):
            return {"is": "gone", "what": f"point {index} of scan {number}"}
        place = shown.scan.provenance(index)
        taken = backlog.at(place)
        return (
            {"is": "gone", "what": f"the frame of point {index}"}
            if taken is None
            else self.frame(taken, "point", place)
        )

    def damaged(self, number: int, backlog: Backlog) -> dict[str, Any]:
        """A damaged piece with what would explain the damage."""
        if (piece := backlog.broken(number)) is None:
            return {"is": "gone", "what": f"damaged piece {number}"}
        facts = {
            "is": "frame",
            "number": number,
            "position": self._position(piece.at),
            "hex": piece.data.hex(),
        }
        return {**facts, "why": "damaged", "value": None, "explanation": backlog.mended(piece)}

    def composed(self, name: str, words: Mapping[str, str]) -> dict[str, Any]:
        """The bytes of a command, explained."""
        sensor = self.broadcast.device.sensor
        data = sensor.command(
            name,
            **arguments(sensor, name, [f"{argument}={text}" for argument, text in words.items()]),
        )
        explanation = explain(data, sensor, sensor.commands[name].frame).to_dict() if data else None
        return {"is": "composed", "command": name, "hex": data.hex(), "explanation": explanation}

    def sent(self, name: str, words: Mapping[str, str]) -> dict[str, Any]:
        """The reply to a command, in words."""
        if self.why_no_control:
            raise UsageError(self.why_no_control)
        device = self.broadcast.device
        found = arguments(
            device.sensor, name, [f"{argument}={text}" for argument, text in words.items()]
        )
        reply = device.send(name, **found)
        return {
            "is": "replied",
            "command": name,
            "text": reply_text(device.sensor, reply),
            "hex": reply.data.hex(),
        }

    def _explained(self, frame: str, data: bytes) -> Explanation:
        return explain(data, self.broadcast.device.sensor, frame)

    def _position(self, at: int) -> float | None:
        began = self.broadcast.began_ns
        return (at - began) * 1e-9 if at > 0 and began else None

    def _damaged(self, since: int) -> list[dict[str, Any]]:
        backlog = self.broadcast.backlog
        return [
            {
                "number": one.number,
                "position": self._position(one.at),
                "offset": one.offset,
                "size": one.size,
                "verdict": self._verdict(one),
            }
            for one in backlog.since(max(since, backlog.damaged - TOLD))
        ]


def _duration(broadcast: Broadcast) -> float | None:
    """How long a file lasts, where that is found out quickly."""
    try:
        return duration(broadcast.source) if broadcast.can_seek else None
    except LidarSpecError:
        return None


def _why_no_control(broadcast: Broadcast, *, control: bool) -> str:
    """Why commands are not sent; "" where they are."""
    sensor = broadcast.device.sensor
    if not sensor.commands:
        return f"{sensor.id} takes no commands"
    if not broadcast.is_live:
        return f"{broadcast.source} is a file: nothing can be sent to it"
    if not control and not broadcast.source.startswith("sim:"):
        return "commands are sent to a sensor only where the page was opened with --control"
    return ""


def saves() -> list[str]:
    """What a scan can be saved as: where a library is needed, it is there."""
    return ["pcd", "ply", "csv", *["las"] * (find_spec("laspy") is not None), "svg"]


def form(sensor: Sensor, name: str) -> dict[str, Any]:
    """A command as a form."""
    command = sensor.commands[name]
    return {
        "name": name,
        "group": _group(sensor, name),
        "only_stopped": command.only_stopped,
        "text": effect(sensor, name),
        "arguments": [_argument(sensor, name, argument) for argument in command.args],
    }


def _group(sensor: Sensor, name: str) -> str:
    """Return "switch" for a command that starts or stops the data, "ask" for one that changes
    nothing, else "set".
    """
    command = sensor.commands[name]
    if command.starts or command.stops:
        return "switch"
    return "ask" if name.startswith("get_") else "set"


def restart(sensor: Sensor) -> dict[str, str] | None:
    """Return the commands that stop the data and start it again, as on opening; None if there are
    none without arguments.
    """
    names = [*sensor.on_open, *sensor.commands]
    plain = [name for name in names if not sensor.commands[name].args]
    stop = next((name for name in plain if sensor.commands[name].stops), None)
    start = next((name for name in plain if sensor.commands[name].starts), None)
    return None if stop is None or start is None else {"stop": stop, "start": start}


def _argument(sensor: Sensor, name: str, argument: str) -> dict[str, Any]:
    kind, info = (
        sensor.commands[name].arguments[argument].kind,
        argument_slot(sensor, name, argument).info,
    )
    facts = {"name": argument, "unit": info.unit, "default": None}
    if not isinstance(kind, Range):
        return {
            **facts,
            "text": ": ".join(filter(None, (info.docs, asked(kind)))),
            "low": None,
            "high": None,
            "choices": [],
        }
    labels = {float(info.physical(raw)): label for raw, label in info.labels.items()}
    choices = [
        {"value": f"{value:g}", "text": label}
        for value, label in labels.items()
        if kind.low <= value <= kind.high
    ]
    return {**facts, "text": info.docs, "low": kind.low, "high": kind.high, "choices": choices}

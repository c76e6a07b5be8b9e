"""The messages to a page, as dicts for JSON.

The entry `is` of a message is its kind. Scans are sent as binary messages (`scan_message`).
`page/src/protocol.ts` declares the same messages for the page.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any

from lidarspec import LidarSpecError, UsageError, __version__, explain
from lidarspec.explaining.assignments import parse_arguments
from lidarspec.explaining.explanation import Explanation, format_reply
from lidarspec.explaining.file_contents import measure_duration
from lidarspec.points.appearance import is_flat
from lidarspec.scans.provenance import PointOrigin
from lidarspec_web.broadcast import Broadcast, ShownScan
from lidarspec_web.command_forms import find_restart, make_form
from lidarspec_web.recent_bytes import MAX_DAMAGED, DamagedBytes, RecentBytes, StoredFrame

#: Number of cached explanations of frames.
KEPT_EXPLANATIONS = 16
#: Maximum number of damaged pieces in one message.
MAX_DAMAGED_LISTED = 20


class PageMessages:
    """Makes the messages to the pages of a broadcast.

    Args:
        control: whether commands may be sent to a real sensor.

    Attributes:
        duration: duration of a file, in seconds; None if it is unknown.
        why_no_control: the reason why commands cannot be sent; "" if they can.
    """

    def __init__(self, broadcast: Broadcast, *, control: bool) -> None:
        self.broadcast = broadcast
        self.duration = _find_duration(broadcast)
        self.why_no_control = _describe_no_control(broadcast, control=control)
        # Several pages show the same frame, and each lists the same damaged pieces.
        self._explain = functools.lru_cache(maxsize=KEPT_EXPLANATIONS)(self._make_explanation)
        self._verdict = functools.lru_cache(maxsize=MAX_DAMAGED)(self._make_verdict)

    def hello(self) -> dict[str, Any]:
        """Return the first message to a page: source, sensor, and available actions."""
        broadcast = self.broadcast
        sensor = broadcast.device.sensor
        return {
            "is": "hello",
            "sensor": sensor.id,
            "title": f"{sensor.vendor} {sensor.model}",
            "source": broadcast.source,
            "live": broadcast.is_live,
            "planar": _is_planar(broadcast.shown),
            "duration": self.duration,
            "control": not self.why_no_control,
            "why_no_control": self.why_no_control,
            "commands": [make_form(sensor, name) for name in sensor.commands],
            "restart": find_restart(sensor),
            "saves": list_save_formats(),
            "records": broadcast.switch is not None,
            "history": list(broadcast.history),
            "version": __version__,
        }

    def state(
        self, *, frozen: bool, first_damaged: int, paused_at: ShownScan | None = None
    ) -> dict[str, Any]:
        """Return the state of the source.

        Args:
            frozen: whether the page has paused its own view of a live source.
            first_damaged: the number of the first `DamagedBytes` that the page does not have yet.
            paused_at: the scan that the page shows if `frozen` is True; None if the page shows the
                newest scan.
        """
        broadcast = self.broadcast
        switch = broadcast.switch
        shown = paused_at or broadcast.shown
        damaged = self._list_damaged(first_damaged)
        warnings = list(broadcast.warnings)
        recording = None
        if switch is not None:
            current = switch.current_file
            if current is not None:
                recording = {"name": current[0], "bytes": current[1]}
            if switch.trouble:
                warnings.append(switch.trouble)
        return {
            "is": "state",
            "at": broadcast.now(),
            "position": 0.0 if shown is None else shown.position,
            "state": "paused" if frozen else broadcast.state,
            "paused": frozen or broadcast.paused,
            "speed": broadcast.speed,
            "figures": broadcast.history[-1] if broadcast.history else None,
            "warnings": warnings,
            "info": broadcast.info,
            "clock": broadcast.clock,
            "recording": recording,
            # The next list begins at this total, so a piece that arrived meanwhile does not count.
            "damaged": {
                "total": damaged[-1]["number"] + 1 if damaged else first_damaged,
                "newest": damaged,
            },
        }

    def frame(
        self, stored: StoredFrame, why: str, point_origin: PointOrigin | None = None
    ) -> dict[str, Any]:
        """Return a frame with every byte explained.

        Args:
            why: the reason why the frame is shown: "last", "number" or "point".
            point_origin: the origin of the point that the page has requested; None for a frame that
                was not requested by a point.
        """
        explanation = self._explain(stored.frame, stored.data)
        value = None
        if point_origin is not None:
            value = explanation.path_of(point_origin.number, point_origin.part)
        return {
            "is": "frame",
            "number": stored.number,
            "position": self._find_position(stored.at),
            "hex": stored.data.hex(),
            "why": why,
            "value": value,
            "explanation": explanation.to_dict(),
        }

    def find_frame(self, number: int, backlog: RecentBytes) -> dict[str, Any]:
        """Return a frame by its number."""
        stored = backlog.frame(number)
        if stored is None:
            return _make_discarded_reply(f"frame {number}")
        return self.frame(stored, "number")

    def find_point_frame(
        self, shown: ShownScan | None, number: int, index: int, backlog: RecentBytes
    ) -> dict[str, Any]:
        """Return the explained frame that contains a point.

        The entry `value` of the result is the path of the point's row in the explanation.

        Args:
            shown: the scan of the point; None if the scan is no longer stored.
            number: the number of the scan.
            index: the index of the point in the scan.
            backlog: the stored frames.
        """
        if shown is None or index >= len(shown.scan):
            return _make_discarded_reply(f"point {index} of scan {number}")
        point_origin = shown.scan.provenance(index)
        stored = backlog.find_point_frame(point_origin)
        if stored is None:
            return _make_discarded_reply(f"the frame of point {index}")
        return self.frame(stored, "point", point_origin)

    def find_damaged(self, number: int, backlog: RecentBytes) -> dict[str, Any]:
        """Return damaged bytes by their number, with an explanation of the damage."""
        piece = backlog.find_damaged(number)
        if piece is None:
            return _make_discarded_reply(f"damaged piece {number}")
        return {
            "is": "frame",
            "number": number,
            "position": self._find_position(piece.at),
            "hex": piece.data.hex(),
            "why": "damaged",
            "value": None,
            "explanation": backlog.explain_damaged(piece),
        }

    def compose_command(self, name: str, texts: Mapping[str, str]) -> dict[str, Any]:
        """Return the bytes of a command, explained.

        Args:
            texts: its arguments as typed, by name.

        Raises:
            UsageError: if an argument is missing or invalid.
        """
        sensor = self.broadcast.device.sensor
        data = sensor.command(name, **parse_arguments(sensor, name, _make_assignments(texts)))
        explanation = None
        if data:
            explanation = explain(data, sensor, sensor.commands[name].frame).to_dict()
        return {"is": "composed", "command": name, "hex": data.hex(), "explanation": explanation}

    def send_command(self, name: str, texts: Mapping[str, str]) -> dict[str, Any]:
        """Send a command, and return the reply as text.

        Raises:
            UsageError: if commands are not allowed, or an argument is missing or invalid.
            CommandError: if the sensor refuses the command or does not reply.
        """
        if self.why_no_control:
            raise UsageError(self.why_no_control)
        device = self.broadcast.device
        values = parse_arguments(device.sensor, name, _make_assignments(texts))
        reply = device.send(name, **values)
        return {
            "is": "replied",
            "command": name,
            "text": format_reply(device.sensor, reply),
            "hex": reply.data.hex(),
        }

    def _make_explanation(self, frame: str, data: bytes) -> Explanation:
        return explain(data, self.broadcast.device.sensor, frame)

    def _make_verdict(self, piece: DamagedBytes) -> str:
        return piece.describe_fault(self.broadcast.device.sensor)

    def _find_position(self, at: int) -> float | None:
        """Return the seconds from the first scan to the arrival time `at`."""
        start_ns = self.broadcast.start_ns
        if at <= 0 or not start_ns:
            return None
        return (at - start_ns) * 1e-9

    def _list_damaged(self, first: int) -> list[dict[str, Any]]:
        """Return the newest damaged bytes whose number is at least `first`."""
        backlog = self.broadcast.backlog
        return [
            {
                "number": piece.number,
                "position": self._find_position(piece.at),
                "offset": piece.offset,
                "size": piece.size,
                "verdict": self._verdict(piece),
            }
            for piece in backlog.list_damaged(max(first, backlog.damaged - MAX_DAMAGED_LISTED))
        ]


def list_save_formats() -> list[str]:
    """Return the suffixes of the files that a scan can be saved as."""
    suffixes = ["pcd", "ply", "csv"]
    if find_spec("laspy") is not None:
        suffixes.append("las")
    suffixes.append("svg")
    return suffixes


def _make_discarded_reply(what: str) -> dict[str, Any]:
    """Return the reply for data that is no longer kept."""
    return {"is": "gone", "what": what}


def _make_assignments(texts: Mapping[str, str]) -> list[str]:
    return [f"{name}={text}" for name, text in texts.items()]


def _is_planar(shown: ShownScan | None) -> bool:
    """Return whether the points of a scan lie in one plane."""
    if shown is None:
        return False
    points = shown.scan.points
    return is_flat(points[points.valid])


def _find_duration(broadcast: Broadcast) -> float | None:
    """Return the duration of a file in seconds; None if it cannot be found quickly."""
    if not broadcast.can_seek:
        return None
    try:
        return measure_duration(broadcast.source)
    except LidarSpecError:
        return None


def _describe_no_control(broadcast: Broadcast, *, control: bool) -> str:
    """Return the reason why commands cannot be sent; "" if they can."""
    sensor = broadcast.device.sensor
    if not sensor.commands:
        return f"{sensor.id} has no commands"
    if not broadcast.is_live:
        return f"cannot send to {broadcast.source}: it is a file"
    if not control and not broadcast.source.startswith("sim:"):
        return "sending commands requires --control on the command line"
    return ""
